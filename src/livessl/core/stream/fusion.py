"""Fuses all arrays' frames: decides when an event begins and ends (hang-over, longest event); the order of the stages.

The lengths are in `activity` (hang-over) and `parameters` (`max_event_s`). It reads no clock.

`Fusion.step(messages, now_ns)` is the only entry for messages, live and replayed. It uses these stages: `Alignment`
assigns the frames to joint frame indices and closes them, `EvidenceCollector` correlates frames and collects excerpts,
`Verdicts` locates and judges excerpts, `UpdateSchedule` chooses the windows that are located while a sound continues,
`EventReporter` decides when an event is reported, and `Tracker` follows the sources.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from livessl.core.locate.estimator import PowerMaps
from livessl.core.stream.alignment import Alignment
from livessl.core.stream.array_health import ArrayStatus, NodeReport
from livessl.core.stream.event_reporter import EventReporter
from livessl.core.stream.evidence import RELEASE_FRAMES, EvidenceCollector
from livessl.core.stream.pending_event import EventState, PendingEvent
from livessl.core.stream.site_state import SiteState
from livessl.core.stream.tracker import SILENCE_S, Tracker
from livessl.core.stream.update_schedule import UpdateSchedule
from livessl.core.stream.verdict import Verdicts
from livessl.core.types import FRAME_S, Frame, Message, Output, Status, Window


@dataclass(frozen=True, slots=True)
class Role:
    """The role of a pass over the messages.

    Parameters
    ----------
    updates : bool
        Whether the pass locates windows while a sound continues.
    newest_only : bool
        Whether the pass keeps up with live sound: if several windows are due at once, only the newest is located, and
        frames are correlated before a sound begins.
    learns_clocks : bool
        Whether the offsets of the arrays' clocks are learned from the events of this pass. Another pass uses these
        offsets from its next sound on.
    watches_health : bool
        Whether the pass examines frames for dead microphones.
    """

    updates: bool = True
    newest_only: bool = False
    learns_clocks: bool = True
    watches_health: bool = True


EVENTS_ONLY = Role(updates=False)
"""A single pass over recordings."""


class Fusion:
    """One pass over the messages of a site's arrays.

    Parameters
    ----------
    state : SiteState
        State that all passes over the same messages share.
    role : Role
    """

    def __init__(self, state: SiteState, role: Role | None = None) -> None:
        self._state = state
        self._role = role or Role()
        self._parameters = state.parameters
        self._alignment = Alignment(state, watches_health=self._role.watches_health)
        self._verdicts = Verdicts(state)
        self._collector = EvidenceCollector(state, self._alignment, correlates_ahead=self._role.newest_only)
        self._reporter = EventReporter(
            state, self._alignment, self._collector, self._verdicts, learns_clocks=self._role.learns_clocks
        )
        self._tracker = Tracker()
        self._event: PendingEvent | None = None
        self.updates = UpdateSchedule(state, newest_only=self._role.newest_only)
        """Decides which windows are located while a sound goes on."""
        self._correct_clocks()

    # --- steps

    def step(self, messages: Iterable[Message], now_ns: int, *, complete_until: int | None = None) -> list[Output]:
        """Take in messages, in any order between arrays; return the results to report.

        Parameters
        ----------
        messages : iterable of Message
        now_ns : int
            Site time now.
        complete_until : int, optional
            Frame index up to which all messages of all arrays have arrived, including these.
        """
        outputs = self._start_over() if self._alignment.is_set_back(now_ns) else []
        if not self._role.learns_clocks and self._event is None:
            self._correct_clocks()
        self._alignment.begin_step(now_ns)
        self._take(messages)
        if complete_until is not None:
            self._alignment.advance(complete_until)
        if self._event is not None and self._alignment.next is not None:
            self._collector.correlate_arrived(self._alignment.next)
        outputs += self._close_ready()
        if self._event is not None and self._alignment.is_everyone_silent():
            outputs += self._report(self._event)
        outputs += self._tracker.step(now_ns)
        return outputs

    def flush(self, now_ns: int) -> list[Output]:
        """Report everything without waiting for any array, at the end of a recording."""
        self._alignment.begin_step(now_ns)
        self._alignment.stop_waiting()
        outputs = self._close_ready()
        return outputs if self._event is None else outputs + self._report(self._event)

    # --- other input

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute the tables for an array's sound, so that its first event does not wait for them."""
        self._state.prepare(array, sample_rate_hz)

    def begin(self, frame_index: int) -> None:
        """Record that all sound before a frame index has been reported."""
        self._alignment.note_reported(frame_index)

    def leave(self, array: str) -> None:
        """Stop waiting for an array whose node has ended on purpose."""
        self._alignment.leave(array)

    def skip_events(self, reported_until: int | None, closing_until: int | None) -> None:
        """Skip events that another pass reports.

        Those are events whose sound ended before `reported_until`, and those that close by `closing_until`.
        """
        self._reporter.skip(reported_until, closing_until)

    def set_answers(self, array: str, answers: bool) -> None:
        """Record whether the node of an array answers backfill requests; at first none does."""
        self._state.set_answers(array, answers)

    # --- views

    @property
    def unknown_arrays(self) -> int:
        """Number of messages of arrays that the site does not have."""
        return self._alignment.unknown_arrays

    @property
    def closed(self) -> int | None:
        """The last frame index that was closed; None before the first."""
        return self._alignment.closed

    @property
    def is_in_event(self) -> bool:
        """True while an event has begun and has not been reported."""
        return self._event is not None

    @property
    def located(self) -> frozenset[str] | None:
        """Arrays from which the current event is located; None for all, and while there is no event."""
        return self._collector.located

    @property
    def needed_from(self) -> int | None:
        """First frame index whose frames may still be needed; None before the first message."""
        following = self._alignment.next
        if following is None:
            return None
        return self._alignment.pre_roll_start(following if self._event is None else self._event.start)

    def frames_ahead(self, array: str) -> int:
        """Return by how many frames an array's own frame indices are ahead of the joint ones."""
        stream = self._alignment.streams.get(array)
        return 0 if stream is None else stream.frames_ahead

    def status(
        self, now_ns: int, nodes: Mapping[str, NodeReport] | None = None, *, levels: bool = True
    ) -> list[ArrayStatus]:
        """Return the status of every array. Any thread may call it.

        Parameters
        ----------
        now_ns : int
        nodes : mapping of array to NodeReport, optional
            Facts about the arrays that are not in their messages.
        levels : bool
            Whether the status has channel powers, which require a transform for each array.
        """
        return self._alignment.status(now_ns, nodes or {}, levels=levels)

    def power_maps(self, window: Window, separately: Collection[str] | None = None) -> PowerMaps:
        """Return the estimator's maps of a window that it located. Any thread may call it."""
        return self._state.estimator.power_maps(window.evidence, separately)

    # --- messages and frame indices

    def _take(self, messages: Iterable[Message]) -> None:
        for own in messages:
            message = self._alignment.on_joint_index(own)
            if message is None:
                continue
            if isinstance(message, Frame) and message.requested:
                if self._event is not None:
                    self._reporter.take(self._event, message)
            elif self._alignment.accept(message) and self._event is not None:
                self._event.note_late_frame()

    def _start_over(self) -> list[Output]:
        outputs = [] if self._event is None else self._report(self._event)
        outputs += self._tracker.step(self._alignment.now_ns + round(2e9 * SILENCE_S))
        self._alignment.start_over()
        self._collector.discard_ahead()
        self._reporter.start_over()
        self._state.start_over()
        return outputs

    def _close_ready(self) -> list[Output]:
        """Close all frame indices that need not wait; return the results to report."""
        outputs = self._skip_gap()
        while True:
            outputs += self._report_backfilled()
            frame_index = None if self._is_waiting() else self._alignment.close_next()
            if frame_index is None:
                break
            outputs += self._close(frame_index)
            self._prune()
        due = self.updates.due_in_step()
        return outputs if self._event is None else outputs + self._update(self._event, due)

    def _skip_gap(self) -> list[Output]:
        newest = self._alignment.gap_ends_at()
        if newest is None:
            return []
        outputs = [] if self._event is None else self._report(self._event)
        self._alignment.skip_to(newest)
        return outputs

    def _close(self, frame_index: int) -> list[Output]:
        active = any(stream.has_active(frame_index) for stream in self._alignment.streams.values())
        if self._event is None and self._state.advance(frame_index):
            self._collector.discard_ahead()
        if active and self._event is None:
            self._collector.begin_event(frame_index)
            self._event = PendingEvent(frame_index)
        event = self._event
        if event is None:
            self._collector.correlate_ahead(frame_index, self._alignment.reported_until)
            return []
        event.close(frame_index, active=active)
        self._collector.correlate(frame_index, active=active)
        if active:
            self._collector.discard_ahead()
        else:
            self._collector.correlate_ahead(frame_index, event.last_active + 1)
        if event.quiet_frames >= self._parameters.activity.hang_over_frames:
            return self._end(event, became_quiet=True)
        outputs: list[Output] = []
        if self._role.updates and active:
            outputs += self._update(event, self.updates.due_now(event))
        if event.length * FRAME_S >= self._parameters.max_event_s:
            return outputs + self._end(event, became_quiet=False)
        if event.length % RELEASE_FRAMES == 0:
            self._collector.release_samples(frame_index)
        return outputs

    def _prune(self) -> None:
        following = self._alignment.next
        if following is not None:
            keep = max(self._parameters.activity.pre_roll_frames, self._parameters.window_frames)
            self._alignment.prune((following if self._event is None else self._event.start) - keep - 1)

    # --- updates

    def _update(self, event: PendingEvent, last: int | None) -> list[Output]:
        """Locate the window that ends with a frame index, if its event still continues; None for no window."""
        if last is None or event.state is not EventState.OPEN or last < event.start:
            return []
        excerpt = self._collector.window(last)
        if len(excerpt.sounds) < self._parameters.min_arrays:
            return []
        update, found = self._verdicts.locate_window(event, excerpt)
        usable = update.status is not Status.REFUSED and not update.estimate.candidates
        trusted = [*([update.estimate] if usable else []), *update.others]
        tracks = self._tracker.step(excerpt.middle_ns, trusted, probable=found.features is not None)
        return [update, Window(excerpt.middle_ns, found.evidence), *tracks]

    # --- events

    def _end(self, event: PendingEvent, *, became_quiet: bool) -> list[Output]:
        """End an event: report it, unless frames are requested for it first."""
        requests = self._reporter.end(event, became_quiet=became_quiet)
        return [*requests] if requests else self._report(event)

    def _is_waiting(self) -> bool:
        """Return whether an event has to wait for requested frames; no frame index closes meanwhile."""
        return self._event is not None and self._reporter.is_waiting(self._event)

    def _report_backfilled(self) -> list[Output]:
        """Report an event that no longer has to wait for requested frames."""
        event = self._event
        if event is None or event.state is not EventState.AWAITING_BACKFILL or self._reporter.is_waiting(event):
            return []
        return self._report(event)

    def _report(self, event: PendingEvent) -> list[Output]:
        """Report an event now, with the frames that have arrived."""
        results = self._reporter.report(event)
        self._event = None
        self._collector.end_event()
        self._alignment.note_reported(event.last_active + 1)
        if event.became_quiet:
            self._correct_clocks()
        return [*results]

    def _correct_clocks(self) -> None:
        if self._alignment.correct_clocks():
            self._collector.discard_ahead()
