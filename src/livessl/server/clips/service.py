"""The clips of a running server: the fusion thread hands over frames and events, a thread of low priority writes."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from livessl.clock import Clock
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.types import FRAME_NS, FRAME_S, Event, Message, Status
from livessl.server.api.encode import JsonObject
from livessl.server.clips.cut import Cut, cut
from livessl.server.clips.folder import ClipFolder
from livessl.server.clips.record import ENHANCED, Recipe, write_clip
from livessl.server.clips.ring import FrameRing
from livessl.server.overload import Overload
from livessl.server.site_time import SiteTime
from livessl.site.models import Site
from livessl.site.server_models import ClipsConfig

MAX_WAITING: Final = 200
"""Most events that wait for their clips; further ones get none, and are counted."""

SETTLE_NS: Final = 1_000_000_000
"""Time, in nanoseconds, that frames after an event may take to arrive: twice the deadline of a frame index."""

SPARE_NS: Final = 20_000_000_000
"""Time, in nanoseconds, in which the clip of a final event is cut: frames are kept so much longer than the longest
event and what is kept before and after it."""

POLL_S: Final = 0.2
"""Interval, in seconds, at which the thread looks for events whose frames have all come."""

EXPIRE_NS: Final = 60_000_000_000
"""Interval, in nanoseconds, at which old clips are deleted."""

DAY_NS: Final = 86_400_000_000_000

NICENESS: Final = 10
"""Niceness of the thread: it works when nothing else does."""

STOP_S: Final = 5.0
"""Longest wait, in seconds, for the thread when the server stops."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Ahead:
    """The time by which an array's clock is ahead, and the whole frames of it by which the fusion corrects indices."""

    ns: int
    frames: int


@dataclass(frozen=True, slots=True)
class _Job:
    """An event that waits for its clip until a monotonic time, and how far each array's clock is ahead."""

    event: Event
    due_ns: int
    ahead: dict[str, _Ahead]


@dataclass(slots=True)
class Counts:
    """Counts since the server started."""

    written: int = 0
    """Clips that were written."""
    incomplete: int = 0
    """Written clips in which frames of the event are missing for at least one array."""
    without_sound: int = 0
    """Events of which no frame was left when the clip was cut."""
    shed: int = 0
    """Events without a clip because too many waited, or the server was overloaded."""
    failed: int = 0
    """Events without a clip because of an error."""
    deleted: int = 0
    """Clips that were deleted because of age or lack of space."""


class Clips:
    """Cuts, keeps and deletes clips.

    The fusion thread calls `take` and `take_final`; every thread may call the rest.

    Parameters
    ----------
    site : Site
    config : ClipsConfig
        The site's `server.clips`.
    clock : Clock
    site_time : SiteTime
        Knows whether a replay runs; its events get no clips.
    overload : Overload
        No clip is cut while an overload leaves out whole arrays: their frames have no samples then.

    Raises
    ------
    ClipsError
        If the folder cannot be used.
    """

    def __init__(self, site: Site, config: ClipsConfig, clock: Clock, site_time: SiteTime, overload: Overload) -> None:
        self._site = site
        self._config = config
        self._clock = clock
        self._site_time = site_time
        self._overload = overload
        self.folder = ClipFolder(site.file(config.folder))
        """The clips that are stored."""
        self._ring = FrameRing()
        self._spare_ns = SPARE_NS + round(1e9 * (site.fusion.max_event_s + config.pre_s + config.post_s))
        self._specs = {spec.name: spec for spec in site.processed}
        self._lock = threading.Lock()
        self._waiting: deque[_Job] = deque()
        self.counts = Counts()
        """Outcomes of the events since the server started."""
        self._trouble: str | None = None
        self._expired_ns: int | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    def prepare(self, site: Site) -> Callable[[], None]:
        """Return a function that makes the next clips use the arrays of this site; any thread may call this."""
        specs = {spec.name: spec for spec in site.processed}

        def take_over() -> None:
            self._site, self._specs = site, specs

        return take_over

    # --- for the fusion thread

    def take(self, messages: Iterable[Message], settled: int | None) -> None:
        """Take in frames.

        Parameters
        ----------
        messages : iterable of Message
        settled : int or None
            Frame index before which all results are final.
        """
        if not self._site_time.is_replay:
            self._ring.take(messages, None if settled is None else settled * FRAME_NS - self._spare_ns)

    def take_final(self, event: Event, clock_offsets: ClockOffsets) -> None:
        """Take in a final event; only one with a position gets a clip."""
        estimate = event.estimate
        if self._site_time.is_replay or event.status is not Status.LOCATED or estimate is None:
            return
        if self.waiting >= MAX_WAITING:
            self.counts.shed += 1
            return
        names = [name for name in self._specs if name in event.heard_by or name in estimate.arrays]
        ahead = {name: _ahead(clock_offsets, name) for name in names}
        longest_ns = round(1e9 * self._config.post_s) + SETTLE_NS
        wait_ns = min(max(event.end_ns + longest_ns - self._clock.now_ns(), 0), longest_ns)
        with self._lock:
            self._waiting.append(_Job(event, self._clock.monotonic_ns() + wait_ns, ahead))

    # --- for the API

    @property
    def waiting(self) -> int:
        """Number of events that wait for their clips."""
        return len(self._waiting)

    @property
    def frames_dropped(self) -> int:
        """Frames that no clip can have, because the memory for frames was full."""
        return self._ring.dropped

    @property
    def problems(self) -> list[str]:
        """Sentences for the reasons of `health`."""
        found = [] if self._trouble is None else [self._trouble]
        kept, most = self.folder.kept_bytes, self._config.max_bytes
        if kept > most:
            found.append(
                "server.clips.max_bytes: clips that are kept for ever, or may be as they are unreadable, take "
                f"{kept / 1e6:.1f} MB of {most / 1e6:.1f} MB, so that new ones are deleted; keep fewer, or raise it"
            )
        return found

    def is_waiting(self, event_id: str) -> bool:
        """Return whether an event waits for its clip."""
        with self._lock:
            return any(job.event.id == event_id for job in self._waiting)

    # --- the thread

    def best_file(self, event_id: str) -> Path | None:
        """Return the recording that people listen to first: the enhanced one, or that of the first array.

        Raises
        ------
        UnreadableClipError
        """
        clip = self.folder.read(event_id)
        if clip is None:
            return None
        names = [file["name"] for file in clip.files]
        name = ENHANCED if ENHANCED in names else next(iter(names), None)
        return None if name is None else clip.file(name)

    def start(self) -> None:
        """Begin to cut clips."""
        self._thread = threading.Thread(target=self._run, name="clips", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop; events that wait get no clip."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=STOP_S)

    def _run(self) -> None:
        try:
            with suppress(OSError):  # a system that does not know priorities of threads
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
            self.folder.load()
            while not self._stop.is_set():
                if not self.work():
                    self._stop.wait(POLL_S)
        except BaseException as error:
            self.failure = error
            _log.exception("the thread of the clips has failed; the server ends")
            raise

    def work(self) -> bool:
        """Delete what is old, and write the clip of one event; return whether there was one. The thread calls it."""
        self._expire()
        with self._lock:
            job = self._waiting[0] if self._waiting else None
        if job is None or job.due_ns > self._clock.monotonic_ns():
            return False
        if self._overload.relief.arrays is None:
            self._write(job)
        else:
            self.counts.shed += 1
        with self._lock:
            self._waiting.popleft()  # only now: until then the event counts as waiting
        return True

    def _write(self, job: _Job) -> None:
        event = job.event
        try:
            cuts = self._cuts(job)
            if not cuts:
                self.counts.without_sound += 1
                return
            recipe = Recipe(event, tuple(cuts), self._config.enhanced, self._site.c_m_s)
            self.folder.put(event.id, lambda partial: write_clip(recipe, partial))
        except OSError as error:
            self.counts.failed += 1
            self._report(f"the clip of {event.id!r} was not stored: {error.strerror or error}; free some space")
            return
        except Exception as error:  # noqa: BLE001 - whatever one event has about it, the next one gets its clip
            self.counts.failed += 1
            _log.debug("the clip of %r failed", event.id, exc_info=error)
            self._report(
                f"the clip of {event.id!r} was not made: {type(error).__name__}: {error}; report this as a bug, and "
                "set the clips' enhanced to false if it occurs again"
            )
            return
        self.counts.written += 1
        self.counts.incomplete += any(lacks(each, event) for each in cuts)
        self._trouble = self._expired_ns = None  # there may be too many bytes now

    def _cuts(self, job: _Job) -> list[Cut]:
        begin_ns = job.event.start_ns - round(1e9 * self._config.pre_s)
        end_ns = job.event.end_ns + round(1e9 * self._config.post_s)
        found = (
            cut(self._specs[name], self._ring.between(name, begin_ns + at.ns, end_ns + at.ns), at.ns, at.frames)
            for name, at in job.ahead.items()
        )
        return [each for each in found if each is not None]

    def _expire(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if self._expired_ns is not None and now_ns - self._expired_ns < EXPIRE_NS:
            return
        self._expired_ns = now_ns
        limits = (self._config.max_age_days, self._site.store.retention_days)
        days = min((limit for limit in limits if limit is not None), default=None)
        before_ns = None if days is None else self._clock.now_ns() - round(days * DAY_NS)
        try:
            self.folder.erase_left()
        except OSError as error:
            self._report(f"deleted clips were not erased: {error.strerror or error}; correct that")
        try:
            self.counts.deleted += self.folder.expire(before_ns, self._config.max_bytes)
        except OSError as error:
            self._report(f"old clips were not deleted: {error.strerror or error}; correct that")

    def _report(self, what: str) -> None:
        text = f"server.clips.folder: {what}"
        if self._trouble is None:
            _log.error("%s", text)
        self._trouble = text


def _ahead(clock_offsets: ClockOffsets, array: str) -> _Ahead:
    frames = clock_offsets.frames_ahead(array)
    return _Ahead(round(1e9 * (frames * FRAME_S + clock_offsets.rest_s(array))), frames)


def lacks(each: Cut, event: Event) -> bool:
    """Return whether frames of the event itself are missing in what an array recorded."""
    begin_s, end_s = ((at_ns - each.time_ns) / 1e9 for at_ns in (event.start_ns, event.end_ns))
    is_cut = begin_s < -FRAME_S or end_s > each.duration_s + FRAME_S
    return is_cut or any(first < end_s and last > begin_s for first, last in each.gaps_s)


def state_of(clips: Clips | None) -> JsonObject:
    """Return the figures of a server's clips as the API reports them."""
    counts = Counts() if clips is None else clips.counts
    folder = None if clips is None else clips.folder
    return {
        "enabled": clips is not None,
        "clips": 0 if folder is None else folder.count,
        "bytes": 0 if folder is None else folder.nbytes,
        "kept": 0 if folder is None else folder.kept,
        "unreadable": 0 if folder is None else folder.unreadable,
        "waiting": 0 if clips is None else clips.waiting,
        "frames_dropped": 0 if clips is None else clips.frames_dropped,
        **asdict(counts),
    }
