"""Index of the stored clips: age, size, kept or not; decides which are deleted first for lack of room.

It reads and writes no files. `folder` owns the clips, and calls this with its lock held.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

from livessl.core.states import Status
from livessl.server.clips.reader import Clip, ClipDiskError, UnreadableClipError


@dataclass(frozen=True, slots=True)
class Entry:
    """The properties of a clip that decide its retention.

    Parameters
    ----------
    start_ns : int
        Begin of the event, nanoseconds since the epoch.
    nbytes : int
    keep : bool or None
        Whether it is kept for ever; None while that is unknown.
    refused : bool
        Whether its event was refused; such a clip is deleted first when there is no room.
    """

    start_ns: int
    nbytes: int
    keep: bool | None
    refused: bool = False

    @classmethod
    def of(cls, clip: Clip) -> Entry:
        """Return the properties of a clip that was read."""
        answer = clip.content.get("answer")  # is not checked, and clips of earlier releases have none
        refused = isinstance(answer, dict) and answer.get("status") == Status.REFUSED
        return cls(clip.start_ns, clip.nbytes, clip.keep, refused)

    @property
    def stays(self) -> bool:
        """True if the clip is deleted neither by age nor for space: it is kept for ever, or may be."""
        return self.keep is not False


@dataclass(frozen=True, slots=True)
class Figures:
    """Number and size of the clips.

    Parameters
    ----------
    count : int
        Events with a clip.
    nbytes : int
        Bytes of all recordings.
    kept : int
        Clips that are kept for ever.
    kept_bytes : int
        Bytes of the clips that are deleted neither for their age nor to make room: they are kept for ever, or may be.
    unreadable : int
        Clips that could not be read when they were last needed.
    """

    count: int = 0
    nbytes: int = 0
    kept: int = 0
    kept_bytes: int = 0
    unreadable: int = 0


class ClipIndex:
    """The entries of all clips, and which of them cannot be read."""

    def __init__(self) -> None:
        self._entries: dict[str, Entry] = {}
        self._unreadable: dict[str, str] = {}  # reasons
        self._unread: set[str] = set()  # clips that the disk has refused, and are tried again

    @property
    def figures(self) -> Figures:
        """Number and size of the clips now."""
        entries = self._entries.values()
        return Figures(
            count=len(entries),
            nbytes=sum(entry.nbytes for entry in entries),
            kept=sum(entry.keep is True for entry in entries),
            kept_bytes=sum(entry.nbytes for entry in entries if entry.stays),
            unreadable=len(self._unreadable),
        )

    @property
    def unread(self) -> list[str]:
        """The clips that the disk has refused, and that are to be read again."""
        return sorted(self._unread)

    def get(self, event_id: str) -> Entry | None:
        """Return the entry of a clip; None if it is not known."""
        return self._entries.get(event_id)

    def is_outdated(self, event_id: str, is_there: bool) -> bool:
        """Return whether a clip that can be read, or is not there, is noted as something else; needs no lock."""
        return event_id in self._unreadable or (is_there and event_id not in self._entries)

    def put(self, event_id: str, entry: Entry) -> None:
        """Note a clip, in place of an earlier one."""
        self._entries[event_id] = entry

    def put_read(self, event_id: str, clip: Clip | None) -> None:
        """Note that a clip was read again, or is not there."""
        self._unreadable.pop(event_id, None)
        self._unread.discard(event_id)
        if clip is not None:
            self._entries[event_id] = Entry.of(clip)

    def put_refused_by_disk(self, name: str) -> None:
        """Note that the disk has refused a folder, which is to be read again."""
        self._unread.add(name)

    def put_unreadable(self, event_id: str, error: UnreadableClipError) -> bool:
        """Note that a clip is unreadable, and what is known of whether it is kept; return whether the reason is new."""
        is_new = self._unreadable.get(event_id) != str(error)
        self._unreadable[event_id] = str(error)
        if isinstance(error, ClipDiskError):
            self._unread.add(event_id)
            return is_new
        self._unread.discard(event_id)
        entry = self._entries.get(event_id)
        if entry is not None and entry.keep is None:
            self._entries[event_id] = replace(entry, keep=error.keep)
        return is_new

    def forget(self, event_id: str) -> None:
        """Forget a clip that is gone."""
        self._entries.pop(event_id, None)
        self._unreadable.pop(event_id, None)
        self._unread.discard(event_id)

    def forget_all_but(self, there: AbstractSet[str]) -> None:
        """Forget the clips whose folders are gone."""
        for known in (self._entries, self._unreadable):
            for event_id in known.keys() - there:
                del known[event_id]
        self._unread &= there

    def expired(self, before_ns: int | None) -> list[tuple[str, Entry]]:
        """Return the clips that are older than a time and not kept, the oldest first."""
        return [] if before_ns is None else [one for one in self._oldest_first() if one[1].start_ns < before_ns]

    def by_room(self) -> list[tuple[str, Entry]]:
        """Return the clips that are not kept, in the order in which they make room.

        Those of refused events come first, so that many of them never displace one with a place.
        """
        return sorted(self._oldest_first(), key=lambda one: not one[1].refused)

    def _oldest_first(self) -> list[tuple[str, Entry]]:
        found = [one for one in self._entries.items() if not one[1].stays]
        return sorted(found, key=lambda one: one[1].start_ns)
