"""Aligns the frames of all arrays on one frame index; decides how long an array is awaited, and which frames are late.

This holds for early results; final results use `final_input`. A frame ahead of the server's clock is refused here.

A frame index closes when every array that is awaited has reached it, or at its deadline. An active frame that comes
later is kept and counted as late. Early results that were already computed do not include it; the final pass
(`final_input`) does. An array is awaited while it sends, keeps up, and is not excluded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from livessl.core.stream.array_health import ArrayHealth, ArrayStatus, NodeReport, is_connected
from livessl.core.stream.array_stream import ArrayStream
from livessl.core.stream.site_state import SiteState
from livessl.core.types import FRAME_NS, FRAME_S, Frame, Message

EARLIEST_NS: Final = -30_000_000_000
"""Limit, in nanoseconds, of a frame's time minus the server's: below it, 30 s in the past, a frame is backlog."""

LATEST_NS: Final = 500_000_000
"""Limit, in nanoseconds, of a frame's time minus the server's: above it a frame is rejected. Clocks set by NTP
differ by less."""

JUMP_FRAMES: Final = 1200
"""Gap, in frames, beyond which the frame indices in between are skipped and not closed one by one: a minute."""


def is_ahead_of_clock(frame_index: int, now_ns: int) -> bool:
    """Return whether a joint frame index lies in the future of the server's clock, by more than clocks may differ."""
    return frame_index * FRAME_NS - now_ns > LATEST_NS


def is_too_old(frame_index: int, now_ns: int) -> bool:
    """Return whether a joint frame index lies so far in the past that only backlog may have it."""
    return frame_index * FRAME_NS - now_ns < EARLIEST_NS


class Alignment:
    """Keeps the streams of all arrays, and closes frame indices in order.

    Parameters
    ----------
    state : SiteState
    watches_health : bool
        Whether frames are examined for dead microphones.
    """

    def __init__(self, state: SiteState, *, watches_health: bool) -> None:
        self._state = state
        self._deadline_s = state.parameters.deadline_s
        self._watches_health = watches_health
        self._reached: deque[tuple[int, int]] = deque()  # each new highest frame index, and when it came
        self.streams = {
            name: ArrayStream(spec, ArrayHealth(len(spec.microphones_m))) for name, spec in state.arrays.items()
        }
        """Stream of each array. Any thread may iterate over the mapping, which is replaced and never changed."""
        self.now_ns = 0
        """Site time of the last step."""
        self.next: int | None = None
        """Frame index that closes next; None before the first message."""
        self.reported_until: int | None = None
        """Frame index before which all sound has been reported; None before the first event."""
        self.unknown_arrays = 0
        """Number of messages from arrays that are not in the site file."""

    @property
    def closed(self) -> int | None:
        """The last frame index that was closed; None before the first."""
        return None if self.next is None else self.next - 1

    def pre_roll_start(self, start: int) -> int:
        """Return where the pre-roll of a sound that became active at `start` begins: after what has been reported."""
        first = start - self._state.parameters.activity.pre_roll_frames
        return first if self.reported_until is None else max(first, self.reported_until)

    # --- messages

    def begin_step(self, now_ns: int) -> None:
        """Begin a step at a site time."""
        self.now_ns = now_ns

    def on_joint_index(self, message: Message) -> Message | None:
        """Return a message with the joint frame index instead of its array's own; None if the array is unknown."""
        stream = self.streams.get(message.array)
        if stream is None:
            self.unknown_arrays += 1
            return None
        ahead = stream.frames_ahead
        return replace(message, frame_index=message.frame_index - ahead) if ahead else message

    def accept(self, message: Message) -> bool:
        """Take in a message on the joint frame index; return whether it is an active frame that is late."""
        stream, now_ns, is_late = self.streams[message.array], self.now_ns, False
        is_ahead = is_ahead_of_clock(message.frame_index, now_ns)
        if is_ahead or is_too_old(message.frame_index, now_ns):
            off_s = abs(message.frame_index * FRAME_NS - now_ns) / 1e9
            fault = f"its clock is {off_s:.1f} s {'ahead of' if is_ahead else 'behind'} the server's; set both by NTP"
            stream.health.reject(now_ns, fault)
            return False
        if isinstance(message, Frame):
            expected, got = len(stream.spec.microphones_m), len(message.samples)
            if got != expected:
                fault = f"its frames have {got} channels, the server's site file says {expected}"
                stream.health.reject(now_ns, fault)
                return False
            is_late = self._accept_frame(stream, message)
        else:
            stream.health.take_mark(message, now_ns, is_newest=stream.is_newest(message.frame_index))
        self._reach(stream, message.frame_index)
        return is_late

    def advance(self, frame_index: int) -> None:
        """Record that every array has sent all messages up to a frame index."""
        for stream in self.streams.values():
            self._reach(stream, frame_index)

    def _accept_frame(self, stream: ArrayStream, frame: Frame) -> bool:
        is_late = frame.active and self.next is not None and frame.frame_index < self.next
        if is_late:
            stream.health.note_late(self.now_ns, frames=1)
        stream.add(frame)
        stream.health.count_frame()
        if self._watches_health and stream.is_newest(frame.frame_index):
            stream.health.take_frame(frame, stream.spec.band_hz, self.now_ns)
            self._state.channel_faults.take(frame)
        return is_late

    def _reach(self, stream: ArrayStream, frame_index: int) -> None:
        stream.advance(frame_index, self.now_ns)
        if not self._reached or frame_index > self._reached[-1][0]:
            self._reached.append((frame_index, self.now_ns))
        if (self._reached[-1][0] - frame_index) * FRAME_S < self._deadline_s:
            stream.catch_up()
        if self.next is None:
            self.next = frame_index

    # --- closing

    def gap_ends_at(self) -> int | None:
        """Return the newest frame index if a gap longer than `JUMP_FRAMES` lies before it; otherwise None."""
        if self.next is None:
            return None
        newest = self._newest()
        return newest if newest - self.next > JUMP_FRAMES else None

    def note_reported(self, until: int) -> None:
        """Record that all sound before a frame index has been reported."""
        self.reported_until = until

    def skip_to(self, frame_index: int) -> None:
        """Continue with a frame index, without closing those before it."""
        self.next = frame_index

    def close_next(self) -> int | None:
        """Close the next frame index and return it; return None if it has to wait for an array."""
        frame_index = self.next
        if frame_index is None or frame_index > self._newest() or not self._may_close(frame_index):
            return None
        self.next = frame_index + 1
        return frame_index

    def stop_waiting(self) -> None:
        """Treat all arrays as not keeping up, so that none is awaited: at the end of a recording."""
        for stream in self.streams.values():
            stream.fall_behind()

    def is_everyone_silent(self) -> bool:
        """Return whether no array has sent a message for longer than the deadline and the hang-over together."""
        quiet_ns = self._deadline_s * 1e9 + self._state.parameters.activity.hang_over_s * 1e9
        last_ns = (stream.last_message_ns for stream in self.streams.values())
        return all(at_ns is None or self.now_ns - at_ns > quiet_ns for at_ns in last_ns)

    def prune(self, oldest: int) -> None:
        """Discard the frames of all arrays before a frame index."""
        for stream in self.streams.values():
            stream.prune(oldest)

    def _newest(self) -> int:
        return max(stream.complete_until for stream in self.streams.values() if stream.complete_until is not None)

    def _may_close(self, frame_index: int) -> bool:
        while self._reached and self._reached[0][0] < frame_index:
            self._reached.popleft()
        missing = [stream for stream in self.streams.values() if self._is_awaited(stream, frame_index)]
        if not missing:
            return True
        first_ns = self._reached[0][1] if self._reached else self.now_ns
        if self.now_ns - first_ns < self._deadline_s * 1e9:
            return False
        for stream in missing:
            stream.fall_behind()
            stream.health.note_late(self.now_ns)
        return True

    def _is_awaited(self, stream: ArrayStream, frame_index: int) -> bool:
        if stream.complete_until is None or stream.has_left:
            return False
        if self._state.is_excluded(stream.spec.name) or stream.complete_until >= frame_index:
            return False
        return stream.keeps_up and is_connected(stream.last_message_ns, self.now_ns)

    # --- clocks

    def is_set_back(self, now_ns: int) -> bool:
        """Return whether the server's clock was set back, so that closed frame indices lie in its future."""
        closed = self.closed
        return closed is not None and is_ahead_of_clock(closed, now_ns)

    def start_over(self) -> None:
        """Discard all frames and begin anew: after the server's clock was set back, new frames would be late."""
        self.streams = {name: stream.renewed() for name, stream in self.streams.items()}
        self._reached.clear()
        self.next = self.reported_until = None

    def correct_clocks(self) -> bool:
        """Align the arrays by the known offsets of their clocks from here on; return whether any frame index moved.

        Call it only between sounds, because it would split a sound. If the frame indices of an array grow, sound that
        was already reported is not reported again.
        """
        clocks, moved, onward = self._state.clock_offsets, False, 0
        if clocks is None:
            return False
        for name, stream in self.streams.items():
            more = stream.correct_clock(clocks.frames_ahead(name), round(1e9 * clocks.rest_s(name)))
            moved = moved or more != 0
            onward = max(onward, -more)
        if onward and self.next is not None and self.reported_until is not None:
            self.reported_until += onward
            self.next = max(self.next, self.reported_until)
        return moved

    def leave(self, array: str) -> None:
        """Stop waiting for an array whose node has ended on purpose."""
        if array in self.streams:
            self.streams[array].leave()

    def status(self, now_ns: int, nodes: Mapping[str, NodeReport], *, levels: bool) -> list[ArrayStatus]:
        """Return the status of every array; without `levels` it has no channel powers. Any thread may call it."""
        clocks, votes = self._state.clock_offsets, self._state.votes
        return [
            stream.status(
                now_ns,
                votes.of(name),
                None if clocks is None else clocks.of(name),
                nodes.get(name, NodeReport()),
                self._state.channel_faults.of(name),
                levels=levels,
            )
            for name, stream in self.streams.items()
        ]
