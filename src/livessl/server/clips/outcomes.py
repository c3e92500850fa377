"""Counts the clips that were written, deleted or left out, and notes why an event has none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from livessl.core.types import Event
from livessl.schema.clips import MissingReason
from livessl.server.clips.missing import MissingClips


@dataclass(slots=True)
class Counts:
    """Counts since the server started."""

    written: int = 0
    """Clips that were written."""
    incomplete: int = 0
    """Written clips in which frames of the event are missing for at least one array."""
    without_sound: int = 0
    """Events of which no frame was left when the clip was cut."""
    with_speech: int = 0
    """Events without a clip because speech was detected in it, and the privacy mode is `no-speech`."""
    shed: int = 0
    """Events without a clip because too many waited, or the server was overloaded."""
    failed: int = 0
    """Events without a clip because of an error."""
    deleted: int = 0
    """Clips that were deleted because of age or lack of space."""


class Outcomes:
    """Counts the clips that were written and those that were not. The fusion thread and that of the clips call it.

    Parameters
    ----------
    folder : Path
        Folder of the clips, where it is remembered why events have none.
    """

    def __init__(self, folder: Path) -> None:
        self.counts = Counts()
        """Outcomes of the events since the server started."""
        self.missing = MissingClips(folder)
        """Why events have no clip."""

    def written(self, *, is_complete: bool) -> None:
        """Count a clip that was written."""
        self.counts.written += 1
        self.counts.incomplete += not is_complete

    def deleted(self, count: int) -> None:
        """Count clips that were deleted because of age or lack of space."""
        self.counts.deleted += count

    def left_out(self, event: Event, reason: MissingReason) -> None:
        """Count an event that gets no clip, and remember why."""
        match reason:
            case MissingReason.SPEECH:
                self.counts.with_speech += 1
            case MissingReason.WITHOUT_SOUND:
                self.counts.without_sound += 1
            case MissingReason.SHED:
                self.counts.shed += 1
            case MissingReason.FAILED:
                self.counts.failed += 1
        self.missing.note(event.id, event.start_ns, reason)
