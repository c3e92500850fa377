"""Makes early and final results by two passes over the same frames, and decides from when on a result is final.

The early pass closes a frame index at its deadline, even if frames are missing. The final pass closes a frame index
when every array has sent all its frames, in whatever order and however late; its events replace the early ones. If no
frame is late, both passes close the same frame indices, and only the final pass reports events.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from livessl.core.locate.estimator import PowerMaps
from livessl.core.stream.alignment import is_ahead_of_clock
from livessl.core.stream.array_health import ArrayStatus, NodeReport
from livessl.core.stream.final_input import FinalInput
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.stream.held_frames import HOLD_BYTES, HOLD_NS
from livessl.core.stream.load_policy import Relief
from livessl.core.stream.site_state import ArraySetUp, SiteState
from livessl.core.stream.update_schedule import UpdateSchedule
from livessl.core.types import FRAME_NS, BackfillRequest, Event, Frame, Message, Output, Window

STRIDE: Final = 40
"""Largest number of frame indices that the final pass closes at one time: two seconds. If there were events among them,
the early pass runs again before the final pass continues."""

FINAL: Final = Role(updates=False, watches_health=False)
"""Role of the final pass. It receives all frames in order, so it learns the offsets of the clocks."""


@dataclass(frozen=True, slots=True)
class FinalResults:
    """Final events in order of time, and the frame index before which all events are final."""

    events: tuple[Event, ...]
    until: int


class TwoPassFusion:
    """Runs the early and the final pass.

    Parameters
    ----------
    state : SiteState
        State that both passes share.
    arrays : iterable of str
        Arrays whose sound is awaited.
    settled : int or None
        Frame index before which all results are already final; None begins anew.
    newest_only : bool
        Whether the early pass keeps up with live sound: see `Role`.
    hold_ns, hold_bytes : int
        Limits on the frames that are held for an absent array: see `HeldFrames`.
    """

    def __init__(
        self,
        state: SiteState,
        arrays: Iterable[str],
        settled: int | None = None,
        *,
        newest_only: bool = False,
        hold_ns: int = HOLD_NS,
        hold_bytes: int = HOLD_BYTES,
    ) -> None:
        self._state, self._final_state = state, state.for_another_pass()
        self._early = Fusion(state, Role(newest_only=newest_only, learns_clocks=False))
        self._arrays = tuple(arrays)
        self.input = FinalInput(state, self._arrays, self._ahead, hold_ns=hold_ns, hold_bytes=hold_bytes)
        """Frames that have arrived for the final pass."""
        self.asked = dict.fromkeys(self._arrays, 0)
        """Number of backfill requests to each array."""
        self.helped = dict.fromkeys(self._arrays, 0)
        """Number of events with requested frames of each array."""
        self._begin(settled)

    @property
    def settled(self) -> int | None:
        """Frame index before which all results are final; None at the beginning."""
        return self._settled if (needed_from := self._final.needed_from) is None else needed_from

    @property
    def settled_of(self) -> dict[str, int]:
        """The frame index `settled` for each array, by the clock of the array's node."""
        settled = self.settled
        return {} if settled is None else {name: settled + self._ahead(name) for name in self._arrays}

    @property
    def updates(self) -> UpdateSchedule:
        """Decides which windows are located while a sound goes on."""
        return self._early.updates

    @property
    def located(self) -> frozenset[str] | None:
        """Arrays from which the current event is located; None for all, and while there is no event."""
        return self._early.located

    def relieve(self, relief: Relief) -> None:
        """Shed the work that `relief` names from now on: see `load_policy`."""
        self._state.relieve(relief)

    def take_over(self, set_up: ArraySetUp) -> None:
        """Locate with another set-up of the same arrays from now on.

        Events that have begun are located with the former set-up in both passes, later events with the new one.
        """
        closed = self._early.closed
        for state in (self._state, self._final_state):
            state.follow(set_up, None if closed is None else closed + 1)
        self._state.votes.clear()

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute the tables for an array's sound, so that its first event does not wait for them."""
        self._early.prepare(array, sample_rate_hz)

    def power_maps(self, window: Window, separately: Collection[str] | None = None) -> PowerMaps:
        """Return the estimator's maps of a window that it located. Any thread may call it."""
        return self._early.power_maps(window, separately)

    def status(
        self, now_ns: int, nodes: Mapping[str, NodeReport] | None = None, *, levels: bool = True
    ) -> list[ArrayStatus]:
        """Return the status of every array: see `Fusion.status`."""
        return self._early.status(now_ns, nodes, levels=levels)

    def greet(self, array: str, backlog: tuple[int, int] | None, now_ns: int, *, answers: bool = False) -> None:
        """Take in the greeting of an array's node.

        Parameters
        ----------
        array : str
        backlog : (int, int) or None
            Frame indices of the oldest kept frame and of the first live frame; None if no backlog is left.
        now_ns : int
        answers : bool
            Whether the node answers backfill requests.
        """
        if array in self._arrays:
            self._state.set_answers(array, answers)
            self.input.greet(array, backlog, now_ns)

    def leave(self, array: str) -> None:
        """Stop waiting for an array whose node has ended on purpose."""
        self._early.leave(array)
        self._state.set_answers(array, False)
        self.input.leave(array)

    def exclude(self, arrays: Collection[str]) -> None:
        """Exclude these arrays from now on, and include all others again: see `SiteState.exclude`."""
        self._state.exclude(arrays)

    def step(self, messages: Iterable[Message], now_ns: int) -> list[Output | FinalResults]:
        """Take in messages, in any order between arrays; return the results to report."""
        settled = self.settled
        if settled is not None and is_ahead_of_clock(settled, now_ns):
            self._begin(None)  # the server's clock was set back: final results lie in the future now
            self._early.skip_events(None, None)
        settled, closed = self.settled, self._early.closed
        live: list[Message] = []
        requested: list[Message] = []
        for message in map(self._state.without_excluded, messages):
            if isinstance(message, Frame) and message.requested:
                requested.append(message)
            elif self.input.take(message, now_ns, settled=settled, closed_early=closed):
                live.append(message)
        frontier = self.input.complete_until(now_ns, self._position)
        final = self._settle(frontier, now_ns, requested)
        self._early.skip_events(self.settled, frontier)
        outputs = [*self._early.step(live + requested, now_ns), *final]
        for output in outputs:
            if isinstance(output, BackfillRequest):
                self.asked[output.array] += 1
        return outputs

    def flush(self, now_ns: int) -> list[Output | FinalResults]:
        """Report everything without waiting for any array, at the end of a recording."""
        end = self.input.end
        self._state.stop_answers()
        self._early.skip_events(end, end)
        outputs: list[Output | FinalResults] = [*self._early.flush(now_ns)]
        while end is not None and (self._position is None or self._position < end):
            outputs += self._settle(end, now_ns)
        return outputs

    def _begin(self, settled: int | None) -> None:
        self._final_state.use_newest()
        self._final = Fusion(self._final_state, FINAL)
        if settled is not None:
            self._final.begin(settled)
        self._settled = settled
        self._position: int | None = None  # frame index up to which the final pass has gone
        self.input.start_over()

    # --- the final pass

    def _ahead(self, array: str) -> int:
        """Return by how many frames an array's own frame indices are ahead of the joint ones."""
        return self._final.frames_ahead(array)

    def _settle(
        self, frontier: int | None, now_ns: int, requested: Sequence[Message] = ()
    ) -> list[FinalResults | BackfillRequest]:
        if frontier is None or self.input.end is None:
            return []
        if self._position is None:
            first = self.input.held.first
            self._position = (frontier if first is None else min(first, frontier)) - 1
        outputs = self._final.step(requested, (self._position + 1) * FRAME_NS) if requested else []
        while self._position < frontier and not any(isinstance(output, Event) for output in outputs):
            end = self._stride_end(self._position, frontier)
            outputs += self._close(end)
            self._position = end
        events = tuple(self._dated(output, now_ns) for output in outputs if isinstance(output, Event))
        settled = self.settled
        if settled is not None:
            self.input.forget(settled)
        for contribution in (contribution for event in events for contribution in event.contributions):
            self.helped[contribution.array] += contribution.asked
        requests = [output for output in outputs if isinstance(output, BackfillRequest)]
        return [*requests, FinalResults(events, settled)] if events and settled is not None else [*requests]

    def _close(self, end: int) -> list[Output]:
        """Let the final pass close all frame indices up to one."""
        before = {name: self._ahead(name) for name in self._arrays}
        outputs = self._final.step(self.input.held.pop_until(end), (end + 1) * FRAME_NS, complete_until=end)
        if any(self._ahead(name) != frames for name, frames in before.items()):
            self.input.held.reindex(self._ahead)
        return outputs

    def _stride_end(self, position: int, frontier: int) -> int:
        """Return the frame index up to which the final pass closes at one time.

        During silence this is the frontier, or the frame index before the first held frame.
        """
        stride, first = position + STRIDE, self.input.held.first
        if not self._final.is_in_event and (first is None or first > stride):
            stride = frontier if first is None else first - 1
        return min(frontier, stride)

    def _dated(self, event: Event, now_ns: int) -> Event:
        """Return an event as it is reported now."""
        return replace(event, latency_s=(now_ns - event.end_ns) / 1e9, late=self.input.was_late(event))
