"""Records which frames of one array have arrived for the final pass, live and as backlog.

Frame indices are those of the array's own clock. A node that reconnects sends its backlog between live frames. Until
the backlog has arrived, `known_until` is the last backlog frame, even if later live frames have arrived.
The early pass uses `ArrayStream` instead.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from livessl.core.stream.array_health import is_connected


@dataclass(slots=True)
class FinalReception:
    """The frames of one array that have arrived for the final pass."""

    live_until: int | None = None
    backlog_until: int | None = None  # None while there is no backlog
    live_from: int | None = None  # frames before it are backlog
    last_message_ns: int | None = None
    has_left: bool = False
    given_up: tuple[int, int] | None = None  # half-open range of frame indices whose results are final without it
    seen: set[int] = field(default_factory=set)

    @property
    def known_until(self) -> int | None:
        """Frame index up to which all frames have arrived; None until the first frame, mark or backlog is announced."""
        return self.live_until if self.backlog_until is None else self.backlog_until

    def is_connected(self, now_ns: int) -> bool:
        """Return whether the node has sent any message in the last `LOST_NS`."""
        return is_connected(self.last_message_ns, now_ns)

    def is_backlog(self, frame_index: int) -> bool:
        """Return whether a frame belongs to the backlog, the frames from before the node's connection."""
        return self.backlog_until is not None and self.live_from is not None and frame_index < self.live_from

    def greet(self, backlog: tuple[int, int] | None, now_ns: int) -> None:
        """Take in the node's greeting.

        Parameters
        ----------
        backlog : (int, int) or None
            Frame indices of the oldest kept frame and of the first live frame; None if no backlog is left.
        now_ns : int
        """
        self.touch(now_ns)
        if backlog is not None:
            first, live_from = backlog
            if self.backlog_until is None or self.live_from != live_from:
                self.backlog_until, self.live_from = first - 1, live_from
        elif self.backlog_until is not None and self.live_from is not None:
            self.live_until = later(self.live_until, self.live_from - 1)
            self.backlog_until = None

    def leave(self) -> None:
        """Note that the node has ended on purpose."""
        self.has_left = True

    def touch(self, now_ns: int) -> None:
        """Note that the node has sent a message."""
        self.last_message_ns, self.has_left = now_ns, False

    def take_mark(self, frame_index: int) -> None:
        """Take in a mark. It proves that all live frames up to its frame index have arrived."""
        self.live_until = later(self.live_until, frame_index)

    def take_backlog(self, frame_index: int) -> None:
        """Take in the index of a backlog frame, new or not. It proves that the backlog up to it has arrived."""
        self.backlog_until = later(self.backlog_until, frame_index)

    def is_first_arrival(self, frame_index: int) -> bool:
        """Return whether a frame from before the watermark arrives for the first time, not again.

        It does if it is newer than all live sound, or if results became final without it.
        """
        is_newest = self.live_until is not None and self.live_until < frame_index
        is_given_up = self.given_up is not None and self.given_up[0] <= frame_index < self.given_up[1]
        return frame_index not in self.seen and (is_newest or is_given_up)

    def add(self, frame_index: int) -> None:
        """Add a new frame."""
        self.seen.add(frame_index)
        if not self.is_backlog(frame_index):
            self.live_until = later(self.live_until, frame_index)

    def forget(self, before: int) -> None:
        """Forget the frames below `before`, the watermark; all results before it are final."""
        known, given_up = self.known_until, self.given_up
        if known is None:  # nothing has arrived from the array since the start; a range that is new begins at `before`
            self.given_up = (before if given_up is None else given_up[0], before)
        elif known + 1 < before:
            goes_on = given_up is not None and known + 1 < given_up[1]
            self.given_up = (given_up[0] if given_up is not None and goes_on else known + 1, before)
        if self.seen:
            self.seen = {frame_index for frame_index in self.seen if frame_index >= before}

    def start_over(self) -> None:
        """Forget all frames, because the server's clock was set back."""
        self.seen.clear()
        self.live_until = self.given_up = None


def later(one: int | None, other: int | None) -> int | None:
    """Return the later of two frame indices; None is before all of them."""
    if one is None or other is None:
        return other if one is None else one
    return max(one, other)


def earlier(one: int | None, other: int | None) -> int | None:
    """Return the earlier of two frame indices; None is before all of them."""
    return None if one is None or other is None else min(one, other)
