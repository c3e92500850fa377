"""Collects frames for the final pass, late ones included; drops and counts those that are `too_late` for it.

How long missing frames are awaited is decided in `held_frames`.

A frame that was late for early results is still part of the final result. A frame that comes after the results of its
time are final is dropped and counted as `too_late`. Frame indices of single arrays follow the clocks of those arrays.
A joint frame index is smaller by the number of frames by which the array's clock is ahead; the final pass estimates
this number from its events.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from functools import reduce

from livessl.core.stream.alignment import is_ahead_of_clock, is_too_old
from livessl.core.stream.held_frames import HeldFrames
from livessl.core.stream.reception import FinalReception, earlier, later
from livessl.core.stream.site_state import SiteState
from livessl.core.types import FRAME_NS, Event, Mark, Message


class FinalInput:
    """Frames that have arrived for the final pass, and the frame indices before which no more will arrive.

    Parameters
    ----------
    state : SiteState
    arrays : iterable of str
        Arrays whose sound is awaited.
    frames_ahead : callable
        Returns by how many frames an array's own frame indices are ahead of the joint ones.
    hold_ns, hold_bytes : int
        Limits on the frames that are held for an absent array: see `HeldFrames`.
    """

    def __init__(
        self,
        state: SiteState,
        arrays: Iterable[str],
        frames_ahead: Callable[[str], int],
        *,
        hold_ns: int,
        hold_bytes: int,
    ) -> None:
        self._state = state
        self._frames_ahead = frames_ahead
        self._limits = hold_ns, hold_bytes
        self._receptions = {name: FinalReception() for name in arrays}
        self.duplicates = dict.fromkeys(self._receptions, 0)
        """Number of frames of each array that had already arrived before."""
        self.backlog_frames = dict.fromkeys(self._receptions, 0)
        """Number of frames of each array that arrived as backlog."""
        self.too_late = dict.fromkeys(self._receptions, 0)
        """Number of new frames of each array that arrived after the results of their time were final."""
        self.thinned = Counter[str]()
        """Number of frames of each array whose samples were dropped, because too many frames were held."""
        self.start_over()

    def start_over(self) -> None:
        """Forget all frames, because the server's clock was set back; the counts remain."""
        self.held = HeldFrames(*self._limits)
        """Frames that the final pass has not processed yet."""
        self._newest: int | None = None  # the newest frame index that has arrived from any array
        self._late: set[int] = set()  # active frame indices that the early pass could not use in time
        self._forgotten_before: int | None = None
        for reception in self._receptions.values():
            reception.start_over()

    def greet(self, array: str, backlog: tuple[int, int] | None, now_ns: int) -> None:
        """Take in the greeting of an array's node: see `FinalReception.greet`."""
        self._receptions[array].greet(backlog, now_ns)

    def leave(self, array: str) -> None:
        """Stop waiting for an array whose node has ended on purpose."""
        if array in self._receptions:
            self._receptions[array].leave()

    def take(self, message: Message, now_ns: int, *, settled: int | None, closed_early: int | None) -> bool:
        """Take in a message; return whether the early pass takes it as well.

        Parameters
        ----------
        message : Message
        now_ns : int
            Site time now.
        settled : int or None
            Joint frame index before which all results are final.
        closed_early : int or None
            Last joint frame index that the early pass has closed.
        """
        reception = self._receptions.get(message.array)
        if reception is None:
            return True
        own = message.frame_index
        frame_index, is_backlog = own - self._frames_ahead(message.array), reception.is_backlog(own)
        if is_ahead_of_clock(frame_index, now_ns) or (not is_backlog and is_too_old(frame_index, now_ns)):
            return True  # the early pass rejects it, and notes why
        reception.touch(now_ns)
        self._newest = later(self._newest, frame_index)
        if isinstance(message, Mark):
            reception.take_mark(own)
            return True
        if is_backlog:
            reception.take_backlog(own)
        if own in reception.seen or (settled is not None and frame_index < settled):
            (self.too_late if reception.is_first_arrival(own) else self.duplicates)[message.array] += 1
            return False
        reception.add(own)
        self.held.push(message, frame_index, now_ns)
        self.backlog_frames[message.array] += is_backlog
        is_in_time = not is_backlog or now_ns - frame_index * FRAME_NS < self._state.parameters.deadline_s * 1e9
        if message.active and (not is_in_time or (closed_early is not None and frame_index <= closed_early)):
            self._late.add(frame_index)
        return is_in_time

    def complete_until(self, now_ns: int, position: int | None) -> int | None:
        """Return the frame index up to which all awaited arrays have sent everything; None if one has sent nothing.

        An array that is not connected is awaited until the frames of the others are overdue. `position` is the frame
        index up to which the final pass has processed frames.
        """
        self.thinned.update(self.held.expire(now_ns, position, shedding=self._state.relief.arrays is not None))
        connected: list[int | None] = []
        away: list[int | None] = []
        for name, reception in self._receptions.items():
            if not (reception.has_left or self._state.is_excluded(name)):
                known = reception.known_until
                known = None if known is None else known - self._frames_ahead(name)
                (connected if reception.is_connected(now_ns) else away).append(known)
        if away:
            connected.append(later(reduce(earlier, away), self.held.overdue_until))
        return later(reduce(earlier, connected) if connected else self.end, self.held.forced_until)

    @property
    def end(self) -> int | None:
        """Frame index at which all sound so far has certainly ended; None before the first message."""
        return None if self._newest is None else self._newest + self._state.parameters.activity.hang_over_frames + 1

    def was_late(self, event: Event) -> bool:
        """Return whether the early pass could not use active frames of an event, because they came too late."""
        return any(event.start_ns <= frame_index * FRAME_NS < event.end_ns for frame_index in self._late)

    def forget(self, settled: int) -> None:
        """Forget the frames before `settled`, the joint frame index before which all results are final."""
        if settled == self._forgotten_before:
            return
        self._forgotten_before = settled
        self._late = {frame_index for frame_index in self._late if frame_index >= settled}
        for name, reception in self._receptions.items():
            reception.forget(settled + self._frames_ahead(name))
