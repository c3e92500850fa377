"""Finds gaps that no driver flags, by comparing the count of samples with the time. It reads no clock."""

from __future__ import annotations

from collections import deque
from typing import Final

RECENT_S: Final = 0.2
"""Length of the recent window, in seconds. A gap delays every block in it, a busy machine hardly ever does."""

BEFORE_S: Final = 1.0
"""Length of the window before it, in seconds: so short that a crystal off by 500 ppm moves by 0.6 ms in both."""

LEAST_BLOCKS: Final = 5
"""Least number of blocks in each window."""

HARDWARE_GAP_NS: Final = 4_000_000
"""Shortest gap that is found where conversion times come from the device, in ns. There the earliest stamps of two
windows differ by less than 0.2 ms, also on a busy machine."""

SERVER_GAP_NS: Final = 12_000_000
"""The same for a sound server, whose earliest stamps differ by up to 4 ms on a busy machine."""


class GapWatch:
    """Compares the earliest stamps of two windows, because a stamp can be late but not early.

    Parameters
    ----------
    sample_rate_hz : float
        Nominal rate.
    block_s : float
        Length of a block, in seconds.
    """

    def __init__(self, sample_rate_hz: float, block_s: float) -> None:
        self._rate_hz = sample_rate_hz
        self._recent: deque[int] = deque(maxlen=max(LEAST_BLOCKS, round(RECENT_S / block_s)))
        self._before: deque[int] = deque(maxlen=max(LEAST_BLOCKS, round(BEFORE_S / block_s)))

    def restart(self) -> None:
        """Forget the stamps, after a gap that is known."""
        self._recent.clear()
        self._before.clear()

    def push(self, first_index: int, time_ns: int, least_gap_ns: int) -> int:
        """Take in a block; return the length of a gap in ns that began within the recent window, 0 if there is none.

        Parameters
        ----------
        first_index : int
            Index of the block's first sample.
        time_ns : int
            Its stamp.
        least_gap_ns : int
            Shortest gap that is to be found.
        """
        if len(self._recent) == self._recent.maxlen:
            self._before.append(self._recent.popleft())
        self._recent.append(time_ns - round(first_index / self._rate_hz * 1e9))
        if len(self._before) < LEAST_BLOCKS:
            return 0
        gap_ns = min(self._recent) - min(self._before)
        if gap_ns < least_gap_ns:
            return 0
        self.restart()
        return gap_ns
