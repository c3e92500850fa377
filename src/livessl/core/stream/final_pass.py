"""Live answers now, settled ones when all sound is in: two fusions of the same messages, behind one door.

The live fusion closes a frame index at its deadline, whoever is missing. The settled one closes it when every array
has told all that it has of it, however late and in whatever order that came; its events are those that stay. While
nobody is late the two go in step, and only the settled one tells events. It reads no clock.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from livessl.core.stream.array_health import LOST_NS, ArrayStatus
from livessl.core.stream.fusion import EARLIEST_NS, LATEST_NS, Fusion
from livessl.core.types import FRAME_NS, FRAME_S, BackfillRequest, Event, Frame, Mark, Message, Output

HOLD_NS: Final = 600_000_000_000
"""Sound waits so long for an array that is away: a restart, a cable, a switch. Meanwhile live events tell of it."""

HOLD_BYTES: Final = 256 * 1024 * 1024
"""Sound that waits, at most: five minutes of one array that never falls silent."""

PIECE: Final = 40
"""Intervals settled at a time: two seconds. After a piece with events live sound has its turn."""

_NEVER: Final = -(2**62)
_ALWAYS: Final = 2**62


@dataclass(frozen=True, slots=True)
class FinalResults:
    """Events that stay, and the frame index before which all sound has become such: in order of time."""

    events: tuple[Event, ...]
    until: int


@dataclass(slots=True)
class _Source:
    """How much of one array's sound is known, in frame indices of its own clock."""

    live_until: int = _NEVER
    backlog_at: int | None = None
    live_from: int = _NEVER
    heard_ns: int | None = None
    left: bool = False
    seen: set[int] = field(default_factory=set)

    @property
    def known_until(self) -> int:
        return self.live_until if self.backlog_at is None else self.backlog_at

    def is_there(self, now_ns: int) -> bool:
        return self.heard_ns is not None and now_ns - self.heard_ns < LOST_NS

    def is_backlog(self, frame_index: int) -> bool:
        return self.backlog_at is not None and frame_index < self.live_from


class TwoPassFusion:
    """The live fusion and its settled twin.

    Parameters
    ----------
    fusion : Fusion
        The live one, at its beginning.
    arrays : iterable of str
        Whose sound is waited for.
    settled : int or None
        The frame index before which all is settled already; None begins anew.
    """

    def __init__(self, fusion: Fusion, arrays: Iterable[str], settled: int | None = None) -> None:
        self.live = fusion
        self._excluded: Collection[str] = ()
        self._sources = {name: _Source() for name in arrays}
        self.duplicates = dict.fromkeys(self._sources, 0)
        self.backfilled = dict.fromkeys(self._sources, 0)
        self.too_late = dict.fromkeys(self._sources, 0)
        self.asked = dict.fromkeys(self._sources, 0)
        self.helped = dict.fromkeys(self._sources, 0)
        self._begin(settled)

    @property
    def settled(self) -> int | None:
        """Before this frame index no frame will be looked at again; None at the beginning."""
        return self._slow.needed_from if self._slow.needed_from is not None else self._settled

    @property
    def settled_of(self) -> dict[str, int]:
        """The same for each array, by its own clock: what its node calls that frame index."""
        settled = self.settled
        return {} if settled is None else {name: settled + self._ahead(name) for name in self._sources}

    def greet(self, array: str, backlog: tuple[int, int] | None, now_ns: int, *, answers: bool = False) -> None:
        """An array's node has said what it kept: frame indices of its oldest frame and of the first live one.

        `answers` says whether it can be asked for what it did not send.
        """
        source = self._sources.get(array)
        if source is None:
            return
        (self.live.can_backfill.add if answers else self.live.can_backfill.discard)(array)
        source.heard_ns, source.left = now_ns, False
        if backlog is not None:
            if source.backlog_at is None or source.live_from != backlog[1]:
                source.backlog_at, source.live_from = backlog[0] - 1, backlog[1]
        elif source.backlog_at is not None:
            source.live_until = max(source.live_until, source.live_from - 1)
            source.backlog_at = None

    def leave(self, array: str) -> None:
        """The array's node said good-bye: nobody waits for it."""
        self.live.leave(array)
        self.live.can_backfill.discard(array)
        if array in self._sources:
            self._sources[array].left = True

    def exclude(self, arrays: Collection[str]) -> None:
        """Wait for none of these arrays and ask none of them, from now on, and all others again."""
        self._excluded = arrays
        self.live.exclude(arrays)
        self._slow.exclude(arrays)

    def status(self, now_ns: int, *, levels: bool = True) -> list[ArrayStatus]:
        """How every array is doing: see `Fusion.status`."""
        return self.live.status(now_ns, levels=levels)

    def step(self, messages: Iterable[Message], now_ns: int) -> list[Output | FinalResults]:
        """Take in messages, in any order between arrays; return what there is to tell."""
        if self.settled is not None and self.settled * FRAME_NS - now_ns > LATEST_NS:
            self._begin(None)  # the server's clock was set back: what was settled lies in the future now
            self.live.leave_out(_NEVER, _NEVER)
        live: list[Message] = []
        answers: list[Message] = []
        for message in messages:
            if isinstance(message, Frame) and message.sequence == 0:
                answers.append(message)
            elif self._take(message, now_ns):
                live.append(message)
        frontier = self._frontier(now_ns)
        settled = self._settle(frontier, now_ns, answers)
        self.live.leave_out(_NEVER if self.settled is None else self.settled, frontier)
        told = [*self.live.step(live + answers, now_ns), *settled]
        for output in told:
            if isinstance(output, BackfillRequest):
                self.asked[output.array] += 1
        return told

    def flush(self, now_ns: int) -> list[Output | FinalResults]:
        """End of the recording: settle everything without waiting for anyone."""
        end = self._end()
        self.live.can_backfill.clear()
        self.live.leave_out(end, end)
        outputs: list[Output | FinalResults] = [*self.live.flush(now_ns)]
        while self._newest != _NEVER and (self._position is None or self._position < end):
            outputs += self._settle(end, now_ns)
        return outputs

    def _begin(self, settled: int | None) -> None:
        self._slow = self.live.twin()
        if settled is not None:
            self._slow.begin(settled)
        self._settled = settled
        self._position: int | None = None
        self._newest = _NEVER
        self._overdue = self._forced = _NEVER
        self._waiting: list[tuple[int, str, Frame]] = []
        self._held: deque[tuple[int, int, int]] = deque()  # when it came, its frame index, its bytes
        self._bytes = 0
        self._late: set[int] = set()
        self._forgotten: int | None = None
        for source in self._sources.values():
            source.seen.clear()
            source.live_until = _NEVER

    def _take(self, message: Message, now_ns: int) -> bool:
        """Take in a message; whether the live fusion shall see it."""
        source = self._sources.get(message.array)
        if source is None:
            return True
        own, backlog = message.frame_index, source.is_backlog(message.frame_index)
        frame_index = own - self._ahead(message.array)
        ahead_ns = frame_index * FRAME_NS - now_ns
        if ahead_ns > LATEST_NS or (ahead_ns < EARLIEST_NS and not backlog):
            return True  # it will be rejected there, and the reason told
        source.heard_ns, source.left = now_ns, False
        self._newest = max(self._newest, frame_index)
        if isinstance(message, Mark):
            source.live_until = max(source.live_until, own)
            return True
        if backlog:
            source.backlog_at = max(source.known_until, own)
        if own in source.seen or (self.settled is not None and frame_index < self.settled):
            too_late = own not in source.seen and _NEVER < source.live_until < own
            (self.too_late if too_late else self.duplicates)[message.array] += 1
        else:
            self._keep(source, message, frame_index, now_ns)
            self.backfilled[message.array] += backlog
            closed = self.live.closed
            in_time = -ahead_ns < self.live.parameters.deadline_s * 1e9 if backlog else True
            if message.active and (not in_time or (closed is not None and frame_index <= closed)):
                self._late.add(frame_index)
            return in_time
        return False

    def _ahead(self, array: str) -> int:
        """By how many frame indices its clock is taken to be ahead."""
        return self._slow.frames_ahead(array)

    def _keep(self, source: _Source, frame: Frame, frame_index: int, now_ns: int) -> None:
        source.seen.add(frame.frame_index)
        if source.backlog_at is None or frame.frame_index >= source.live_from:
            source.live_until = max(source.live_until, frame.frame_index)
        heapq.heappush(self._waiting, (frame_index, frame.array, frame))
        self._held.append((now_ns, frame_index, frame.samples.nbytes))
        self._bytes += frame.samples.nbytes

    def _frontier(self, now_ns: int) -> int:
        """The frame index up to which everyone who is waited for has told all."""
        excess = self._bytes - HOLD_BYTES
        while self._held:
            came_ns, frame_index, size = self._held[0]
            if excess > 0:
                self._forced = max(self._forced, frame_index)
            elif now_ns - came_ns > HOLD_NS:
                self._overdue = max(self._overdue, frame_index)
            elif self._position is None or frame_index > self._position:
                break
            excess -= size
            self._held.popleft()
        awaited = {
            name: source for name, source in self._sources.items() if not source.left and name not in self._excluded
        }
        known_until = {name: source.known_until - self._ahead(name) for name, source in awaited.items()}
        there = [known_until[name] for name, source in awaited.items() if source.is_there(now_ns)]
        away = [known_until[name] for name, source in awaited.items() if not source.is_there(now_ns)]
        known = min(min(there, default=_ALWAYS), max(min(away), self._overdue) if away else _ALWAYS)
        return max(self._end() if known == _ALWAYS else known, self._forced)

    def _end(self) -> int:
        """Where what has come so far has surely ended."""
        return self._newest + round(self.live.parameters.hang_over_s / FRAME_S) + 1

    def _settle(
        self, frontier: int, now_ns: int, answers: Sequence[Message] = ()
    ) -> list[FinalResults | BackfillRequest]:
        if self._newest == _NEVER or frontier <= _NEVER:
            return []
        if self._position is None:
            self._position = min(self._waiting[0][0] if self._waiting else frontier, frontier) - 1
        outputs = self._slow.step(answers, (self._position + 1) * FRAME_NS) if answers else []
        while self._position < frontier and not any(isinstance(output, Event) for output in outputs):
            end = min(frontier, self._piece_end(self._position))
            batch: list[Message] = []
            while self._waiting and self._waiting[0][0] <= end:
                frame = heapq.heappop(self._waiting)[2]
                self._bytes -= frame.samples.nbytes
                batch.append(frame)
            ahead = {name: self._ahead(name) for name in self._sources}
            batch += [Mark(name, 0, end + frames, 0.0, 0.0, ()) for name, frames in ahead.items()]
            outputs += self._slow.step(batch, (end + 1) * FRAME_NS)
            if any(self._ahead(name) != frames for name, frames in ahead.items()):
                self._waiting = [(f.frame_index - self._ahead(f.array), f.array, f) for _, _, f in self._waiting]
                heapq.heapify(self._waiting)
            self._position = end
        events = tuple(self._dated(output, now_ns) for output in outputs if isinstance(output, Event))
        self._forget()
        for contribution in (c for event in events for c in event.contributions):
            self.helped[contribution.array] += contribution.asked
        asks = [output for output in outputs if isinstance(output, BackfillRequest)]
        return [*asks, FinalResults(events, until)] if events and (until := self.settled) is not None else [*asks]

    def _piece_end(self, position: int) -> int:
        nearest = self._waiting[0][0] if self._waiting else _ALWAYS
        return position + PIECE if self._slow.hears or nearest <= position + PIECE else nearest - 1

    def _dated(self, event: Event, now_ns: int) -> Event:
        late = any(event.start_ns <= frame_index * FRAME_NS < event.end_ns for frame_index in self._late)
        return replace(event, latency_s=(now_ns - event.end_ns) / 1e9, late=late)

    def _forget(self) -> None:
        settled = self.settled
        if settled is None or settled == self._forgotten:
            return
        self._forgotten = settled
        self._late = {frame_index for frame_index in self._late if frame_index >= settled}
        for name, source in self._sources.items():
            if source.seen:
                source.seen = {own for own in source.seen if own >= settled + self._ahead(name)}
