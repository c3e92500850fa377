"""Decides when an event is reported: at once, or after frames that were requested for it have come."""

from __future__ import annotations

from collections.abc import Sequence

from livessl.core.stream.alignment import Alignment
from livessl.core.stream.backfill import Backfill
from livessl.core.stream.evidence import EvidenceCollector
from livessl.core.stream.pending_event import EventState, PendingEvent
from livessl.core.stream.site_state import SiteState
from livessl.core.stream.verdict import Verdicts
from livessl.core.types import BackfillRequest, Event, Frame, Status


class EventReporter:
    """Turns pending events into reported ones.

    Parameters
    ----------
    state : SiteState
    alignment : Alignment
    collector : EvidenceCollector
    verdicts : Verdicts
    learns_clocks : bool
        Whether the offsets of the arrays' clocks are learned from the events.
    """

    def __init__(
        self,
        state: SiteState,
        alignment: Alignment,
        collector: EvidenceCollector,
        verdicts: Verdicts,
        *,
        learns_clocks: bool,
    ) -> None:
        self._state = state
        self._alignment = alignment
        self._collector = collector
        self._learns_clocks = learns_clocks
        self._verdicts = verdicts
        self._backfill = Backfill(state, verdicts)
        self._reported_elsewhere: int | None = None
        self._closing_elsewhere: int | None = None

    def skip(self, reported_until: int | None, closing_until: int | None) -> None:
        """Skip events that another pass reports.

        Those are events whose sound ended before `reported_until`, and those that close by `closing_until`.
        """
        self._reported_elsewhere, self._closing_elsewhere = reported_until, closing_until

    def end(self, event: PendingEvent, *, became_quiet: bool) -> list[BackfillRequest]:
        """End an event and locate it; return the requests for frames that its report has to wait for."""
        event.end(became_quiet=became_quiet)
        self._locate(event)
        if event.excerpt is None:
            return []
        span = range(self._alignment.pre_roll_start(event.start), event.last_active + 1)
        streams = self._alignment.streams
        requested = self._backfill.choose(event, span, [name for name in streams if not streams[name].has_left])
        if requested:
            event.await_backfill(requested, self._alignment.now_ns)
        ahead = {name: streams[name].frames_ahead for name in requested}
        spans = {name: frames.span for name, frames in requested.items()}
        return [BackfillRequest(name, span[0] + ahead[name], span[-1] + ahead[name]) for name, span in spans.items()]

    def take(self, event: PendingEvent, frame: Frame) -> None:
        """Take in a frame that answers a request; it is dropped if the event did not request it."""
        self._backfill.take(event, frame)

    def is_waiting(self, event: PendingEvent) -> bool:
        """Return whether the report of an event has to wait for requested frames."""
        return event.state is EventState.AWAITING_BACKFILL and not self._backfill.is_over(event, self._alignment.now_ns)

    def report(self, event: PendingEvent) -> Sequence[Event]:
        """Return the results of an event with the frames that have come, one for each source; its life ends.

        There are none if another pass reports the event.
        """
        if event.state is EventState.OPEN:
            self._locate(event)  # it was cut short
        elif event.state is EventState.AWAITING_BACKFILL:
            is_skipped = self._is_skipped(event)
            results = () if is_skipped else self._backfill.reconsidered(event, self._alignment.now_ns)
            event.set_results(results, event.excerpt)
        event.report()
        return event.results

    def start_over(self) -> None:
        """Forget what was requested before, because the server's clock was set back."""
        self._backfill.start_over()

    def _is_skipped(self, event: PendingEvent) -> bool:
        reported, closing = self._reported_elsewhere, self._closing_elsewhere
        if reported is not None and event.last_active < reported:
            return True
        return closing is not None and event.has_ended and event.closed <= closing

    def _locate(self, event: PendingEvent) -> None:
        """Locate an event by the arrays that detected it, unless another pass does."""
        if self._is_skipped(event):
            return
        span = range(self._alignment.pre_roll_start(event.start), event.closed + 1)
        excerpt = self._collector.event(span)
        if not excerpt.powers:
            return
        verdict = self._verdicts.locate_event(event, excerpt, self._alignment.now_ns)
        event.set_results(verdict.events, excerpt)
        if event.became_quiet and len(verdict.events) == 1:
            self._learn(verdict.events[0], span)
        self._verdicts.count_votes(event, excerpt, verdict)

    def _learn(self, event: Event, span: range) -> None:
        """Learn the offsets of the clocks from a located event."""
        clocks, estimate = self._state.clock_offsets, event.estimate
        if clocks is None or estimate is None or event.status is not Status.LOCATED:
            return
        if self._learns_clocks and clocks.differ(estimate.arrays):
            clocks.learn_from(event.end_ns, estimate.position_m, self._collector.whole_sounds(estimate.arrays, span))
