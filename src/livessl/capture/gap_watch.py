"""Finds gaps in the sound that no driver flags (lost samples), by comparing the sample count with the time.

Losses that the driver flags are counted in `loss_count`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class GapRule:
    """Windows and threshold of the search for gaps.

    Parameters
    ----------
    recent_s : float
        Length of the recent window, in seconds: longer than a busy machine delays blocks.
    before_s : float
        Length of the window before it, in seconds: so short that a clock that is off by 500 ppm drifts by much
        less than `least_gap_ns` over both windows.
    least_gap_ns : int
        Shortest gap that is found, in ns.
    """

    recent_s: float
    before_s: float
    least_gap_ns: int


HARDWARE: Final = GapRule(0.2, 1.0, 4_000_000)
"""The rule where conversion times come from the device. They include how long blocks waited, so the earliest stamps of
two windows differ by less than 0.2 ms, also on a busy machine."""

SOUND_SERVER: Final = GapRule(2.0, 6.0, 100_000_000)
"""The rule for a sound server. It delivers several blocks at once, in numbers that change, and only the time of their
arrival is known."""

LEAST_BLOCKS: Final = 5
"""Least number of blocks in each window."""


class GapWatch:
    """Compares the earliest stamps of two windows: a stamp can be late, never early.

    Parameters
    ----------
    sample_rate_hz : float
        Nominal rate.
    block_s : float
        Length of a block, in seconds.
    rule : GapRule
    """

    def __init__(self, sample_rate_hz: float, block_s: float, rule: GapRule) -> None:
        self._rate_hz = sample_rate_hz
        self._rule = rule
        self._recent: deque[int] = deque(maxlen=max(LEAST_BLOCKS, round(rule.recent_s / block_s)))
        self._before: deque[int] = deque(maxlen=max(LEAST_BLOCKS, round(rule.before_s / block_s)))

    def restart(self) -> None:
        """Forget the stamps, after a gap that is known."""
        self._recent.clear()
        self._before.clear()

    def push(self, first_index: int, time_ns: int) -> int:
        """Take in a block; return the length of a gap in ns that began within the recent window, 0 if there is none.

        The length comes out too short by the delay of the blocks before the gap.

        Parameters
        ----------
        first_index : int
            Index of the block's first sample.
        time_ns : int
            Its stamp.
        """
        if len(self._recent) == self._recent.maxlen:
            self._before.append(self._recent.popleft())
        self._recent.append(time_ns - round(first_index / self._rate_hz * 1e9))
        if len(self._before) < LEAST_BLOCKS:
            return 0
        gap_ns = min(self._recent) - min(self._before)
        if gap_ns < self._rule.least_gap_ns:
            return 0
        self.restart()
        return gap_ns
