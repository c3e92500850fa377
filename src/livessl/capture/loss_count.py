"""Counts lost blocks of sound: overruns that the driver flags, and blocks that the node did not read in time.

Gaps that no driver flags are found in `gap_watch`.
"""

from __future__ import annotations

import logging
from typing import Final

from livessl.capture.gap_watch import HARDWARE, SOUND_SERVER, GapWatch
from livessl.clock import Clock
from livessl.core.types import Block

LAG_SHOWN_NS: Final = 5_000_000_000
"""Time, in nanoseconds, for which blocks that were not read in time are reported as a problem of the device."""

_log = logging.getLogger(__name__)


class LossCount:
    """Counts lost blocks of one device, also across restarts of the device's process.

    Parameters
    ----------
    name : str
        The device's name in the site file, for messages.
    sample_rate_hz : float
        Nominal sampling rate, Hz.
    block_s : float
        Length of a block, in seconds.
    clock : Clock
        Clock that measures how long ago blocks were lost.

    Attributes
    ----------
    lost_blocks : int
        Number of lost blocks: those that the driver flagged, those that this process did not read in time, and one for
        each gap without a flag.
    overruns : int
        Lost blocks that this process did not read in time.
    unflagged_gaps : int
        Number of gaps that the driver did not flag.
    """

    def __init__(self, name: str, sample_rate_hz: float, block_s: float, clock: Clock) -> None:
        self.lost_blocks = 0
        self.overruns = 0
        self.unflagged_gaps = 0
        self._name = name
        self._sample_rate_hz = sample_rate_hz
        self._block_s = block_s
        self._clock = clock
        self._lag_ns: int | None = None
        self._gaps = GapWatch(sample_rate_hz, block_s, SOUND_SERVER)

    def begin(self, *, hardware: bool) -> None:
        """Search for gaps by the rule for hardware, or by that for a sound server, from the next block on."""
        self._gaps = GapWatch(self._sample_rate_hz, self._block_s, HARDWARE if hardware else SOUND_SERVER)

    def is_after_gap(self, block: Block) -> bool:
        """Return True if sound is missing before a block, and the driver has not flagged the gap."""
        if block.overflow:
            self._gaps.restart()
        gap_ns = self._gaps.push(block.first_index, block.stamp_ns)
        if not gap_ns:
            return False
        self.unflagged_gaps += 1
        self.lost_blocks += 1
        _log.warning(
            "%.0f ms of sound of device %r are missing without a flag of its driver; %d such gaps so far",
            gap_ns / 1e6,
            self._name,
            self.unflagged_gaps,
        )
        return True

    def add(self, flagged: int, overruns: int) -> None:
        """Count blocks that the driver flagged, and blocks that this process did not read in time."""
        self.lost_blocks += flagged + overruns
        if overruns:
            self.overruns += overruns
            self._lag_ns = self._clock.monotonic_ns()
            _log.warning("%d blocks of device %r were lost: this node did not read them in time", overruns, self._name)

    @property
    def problem(self) -> str | None:
        """The problem in words if this process has recently not read blocks in time; otherwise None."""
        now_ns = self._clock.monotonic_ns()
        if self._lag_ns is None or now_ns - self._lag_ns > LAG_SHOWN_NS:
            return None
        return (
            f"this machine lags: {self.overruns} blocks of device {self._name!r} were lost because the node did not "
            "read them in time; stop other programs"
        )
