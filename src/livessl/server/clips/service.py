"""Decides which events get a clip and how long clips are kept (age, bytes); a thread of low priority writes them."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from livessl.clock import Clock
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, Event, Message, Status
from livessl.schema.clips import MissingReason
from livessl.server.api.encode import JsonObject
from livessl.server.clips.cut import Cut, cut
from livessl.server.clips.folder import ClipFolder
from livessl.server.clips.index import Figures
from livessl.server.clips.outcomes import Counts, Outcomes
from livessl.server.clips.record import ENHANCED, Made, Recipe, make_clip, write_clip
from livessl.server.clips.ring import FrameRing
from livessl.server.clips.speech import SpeechDetector, SpeechError
from livessl.server.clips.trouble import Subject, Trouble
from livessl.server.clips.waiting import Ahead, Job, WaitingEvents
from livessl.server.overload import Overload
from livessl.server.site_time import SiteTime
from livessl.site.models import Site
from livessl.site.server_models import ClipsConfig

MAX_WAITING: Final = 200
"""Most events that wait for their clips; further ones get none, and are counted. Refused events take at most half of
the places, so that they displace no others."""

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
"""Niceness of the thread: the localization comes first."""

STOP_S: Final = 5.0
"""Longest wait, in seconds, for the thread when the server stops."""

WITHOUT_REASONS: Final = "it is not known why earlier events have no clip"
UNSAVED_REASONS: Final = "it is not stored why events have no clip"

_log = logging.getLogger(__name__)


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
        self._outcomes = Outcomes(site.file(config.folder))
        self._speech = SpeechDetector() if site.privacy == "no-speech" else None
        self._ring = FrameRing()
        self._spare_ns = SPARE_NS + round(1e9 * (site.fusion.max_event_s + config.pre_s + config.post_s))
        self._specs = {spec.name: spec for spec in site.processed}
        self._waiting = WaitingEvents()
        self._trouble = Trouble()
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
        """Take in a final event; it gets a clip if `server.clips.of` has its status, and an array has sound of it."""
        if self._site_time.is_replay or event.status not in self._config.of:
            return
        if _arrays_of(event).isdisjoint(self._specs):
            self._outcomes.left_out(event, MissingReason.WITHOUT_SOUND)
            return
        if not self._has_room(event):
            self._outcomes.left_out(event, MissingReason.SHED)
            return
        ahead = {name: Ahead.of(clock_offsets, name) for name in self._specs}
        longest_ns = round(1e9 * self._config.post_s) + SETTLE_NS
        wait_ns = min(max(event.end_ns + longest_ns - self._clock.now_ns(), 0), longest_ns)
        self._waiting.put(Job(event, self._clock.monotonic_ns() + wait_ns, ahead))

    def _has_room(self, event: Event) -> bool:
        """Return whether an event may wait: refused ones leave half of the places to others, and come last."""
        if event.status is Status.REFUSED:
            return self.waiting < MAX_WAITING // 2 and not self._overload.relief.shed
        return self.waiting < MAX_WAITING

    # --- for the API

    @property
    def counts(self) -> Counts:
        """Outcomes of the events since the server started."""
        return self._outcomes.counts

    @property
    def waiting(self) -> int:
        """Number of events that wait for their clips."""
        return len(self._waiting)

    @property
    def frames_dropped(self) -> int:
        """Frames that no clip can have, because the memory for frames was full."""
        return self._ring.dropped

    def why_missing(self, event_id: str, status: str | None) -> MissingReason | None:
        """Return why an event without a clip has none; None if that is not known.

        Parameters
        ----------
        event_id : str
        status : str or None
            Its status; None if the event is not known.
        """
        known = self._outcomes.missing.why(event_id)
        if known is None and status is not None and status not in self._config.of:
            return MissingReason.STATUS
        return known

    @property
    def problems(self) -> list[str]:
        """Sentences for the reasons of `health`."""
        found = self._trouble.texts
        kept, most = self.folder.figures.kept_bytes, self._config.max_bytes
        if kept > most:
            found.append(
                "server.clips.max_bytes: clips that are kept for ever, or may be as they are unreadable, take "
                f"{kept / 1e6:.1f} MB of {most / 1e6:.1f} MB, so that new ones are deleted; keep fewer, or raise it"
            )
        return found

    def is_waiting(self, event_id: str) -> bool:
        """Return whether an event waits for its clip."""
        return event_id in self._waiting

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
        if self._speech is not None:
            self._speech.close()
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
        self._trouble.report_of(Subject.READING_REASONS, WITHOUT_REASONS, self._outcomes.missing.load)
        self._expire()
        self._trouble.report_of(Subject.SAVING_REASONS, UNSAVED_REASONS, self._outcomes.missing.save)
        job = self._waiting.due(self._clock.monotonic_ns())
        if job is None:
            return False
        if self._overload.relief.arrays is None and not _comes_too_late(job, self._ring):
            self._write(job)
        else:
            self._outcomes.left_out(job.event, MissingReason.SHED)
        self._waiting.done(job)
        return True

    def _write(self, job: Job) -> None:
        event = job.event
        try:
            cuts = _cuts(job, self._ring, self._specs, self._config)
            if not cuts:
                self._outcomes.left_out(event, MissingReason.WITHOUT_SOUND)
                return
            made = make_clip(Recipe(event, tuple(cuts), self._config.enhanced, self._site.c_m_s))
            if self._has_speech(made):
                self._trouble.clear(Subject.MAKING)
                self._outcomes.left_out(event, MissingReason.SPEECH)
                return
            self.folder.put(event.id, lambda folder: write_clip(made, folder))
        except Exception as error:  # noqa: BLE001 - whatever one event has about it, the next one gets its clip
            if not self._stop.is_set():
                self._outcomes.left_out(event, MissingReason.FAILED)
                self._trouble.report(*_failure(event, error))
            return
        self._outcomes.written(is_complete=not any(lacks(each, event) for each in cuts))
        self._trouble.clear(Subject.MAKING, Subject.STORING)
        self._expired_ns = None  # there may be too many bytes now

    def _has_speech(self, made: Made) -> bool:
        if self._speech is None:
            return False
        found = self._speech.has_speech((one.samples, one.sample_rate_hz) for one in made.recordings)
        self._trouble.clear(Subject.DETECTING)
        return found

    def _expire(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if self._expired_ns is not None and now_ns - self._expired_ns < EXPIRE_NS:
            return
        self._expired_ns = now_ns
        limits = (self._config.max_age_days, self._site.store.retention_days)
        days = min((limit for limit in limits if limit is not None), default=None)
        before_ns = None if days is None else self._clock.now_ns() - round(days * DAY_NS)
        expire_reasons = partial(self._outcomes.missing.expire, before_ns)
        attempts: tuple[tuple[Subject, str, Callable[[], None]], ...] = (
            (Subject.ERASING, "deleted clips were not erased", self.folder.erase_left),
            (Subject.EXPIRING_REASONS, "it is still noted why old events have no clip", expire_reasons),
            (Subject.DELETING, "old clips were not deleted", partial(self._delete_old, before_ns)),
        )
        for subject, what, act in attempts:
            self._trouble.report_of(subject, what, act)

    def _delete_old(self, before_ns: int | None) -> None:
        self._outcomes.deleted(self.folder.expire(before_ns, self._config.max_bytes))


def _arrays_of(event: Event) -> set[str]:
    """Return the arrays that detected an event, and those that it was located by."""
    return {*event.heard_by, *(() if event.estimate is None else event.estimate.arrays)}


def _comes_too_late(job: Job, ring: FrameRing) -> bool:
    """Return whether frames of a refused event were released while it waited behind others."""
    return job.event.status is Status.REFUSED and any(
        ring.has_released(name, job.event.start_ns + job.ahead[name].ns)
        for name in _arrays_of(job.event) & job.ahead.keys()
    )


def _cuts(job: Job, ring: FrameRing, specs: Mapping[str, ArraySpec], config: ClipsConfig) -> list[Cut]:
    """Return what each array has recorded around an event."""
    begin_ns = job.event.start_ns - round(1e9 * config.pre_s)
    end_ns = job.event.end_ns + round(1e9 * config.post_s)
    found, own = [], _arrays_of(job.event)
    for name, at in job.ahead.items():
        if name in specs and (name in own or job.event.status is Status.REFUSED):
            frames = ring.between(name, begin_ns + at.ns, end_ns + at.ns)
            # frames that were requested for a refused event are a part of why it was refused
            if name in own or any(frame.requested for frame in frames):
                found.append(cut(specs[name], frames, at.ns, at.frames))
    return [each for each in found if each is not None]


def _failure(event: Event, error: Exception) -> tuple[Subject, str]:
    """Return what an error that has prevented a clip is about, and a sentence about it."""
    if isinstance(error, OSError):
        return Subject.STORING, f"the clip of {event.id!r} was not stored: {error.strerror or error}; free some space"
    if isinstance(error, SpeechError):
        return Subject.DETECTING, f"the clip of {event.id!r} was not stored, for it may contain speech: {error}"
    _log.debug("the clip of %r failed", event.id, exc_info=error)
    return Subject.MAKING, (
        f"the clip of {event.id!r} was not made: {type(error).__name__}: {error}; report this as a bug, and set the "
        "clips' enhanced to false if it occurs again"
    )


def lacks(each: Cut, event: Event) -> bool:
    """Return whether frames of the event itself are missing in what an array recorded."""
    begin_s, end_s = ((at_ns - each.time_ns) / 1e9 for at_ns in (event.start_ns, event.end_ns))
    is_cut = begin_s < -FRAME_S or end_s > each.duration_s + FRAME_S
    return is_cut or any(first < end_s and last > begin_s for first, last in each.gaps_s)


def state_of(clips: Clips | None) -> JsonObject:
    """Return the figures of a server's clips as the API reports them."""
    counts = Counts() if clips is None else clips.counts
    figures = Figures() if clips is None else clips.folder.figures
    return {
        "enabled": clips is not None,
        "clips": figures.count,
        "bytes": figures.nbytes,
        "kept": figures.kept,
        "unreadable": figures.unreadable,
        "waiting": 0 if clips is None else clips.waiting,
        "frames_dropped": 0 if clips is None else clips.frames_dropped,
        **asdict(counts),
    }
