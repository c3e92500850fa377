"""Converts sample indices to site time in spite of jitter and drift, and cuts blocks into frames. It reads no clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import FRAME_NS, Block, ClockState, Float32Array

MEMORY_S: Final = 60.0
"""Time constant of the line fit, in seconds: longer than the jitter of blocks, shorter than the warm-up of a
crystal."""

STEP_NS: Final = 200_000_000
"""Deviation from the line, in nanoseconds, that is too large for jitter; scheduling delays are smaller."""

STEP_BLOCKS: Final = 3
"""Number of consecutive stamps with such a deviation that count as a step of the clock; fewer are late callbacks."""

LOCKED_S: Final = 2.0
"""Length of sound, in seconds, that is needed before the fit is used."""

_SLOPE_RIDGE_S2: Final = 1e4
"""Weight of the prior of the drift: (10 ms of stamp jitter / 100 ppm of drift) squared. Its influence decreases with
the number of blocks."""

_NOISE_FACTOR: Final = 3.0
"""Multiple of the standard deviation of the drift that counts as its error."""

_BOUNDARY: Final = 0.4
"""Rounding of frame boundaries to samples. It is not 0.5, because at 22.05 kHz every other boundary would be a tie."""


class Timeline:
    """Running line fit of (sample index, arrival stamp), because the stamps of single blocks are noisy.

    The fit is an exponentially forgetting least-squares fit of the stamps' residuals from the nominal rate.

    Parameters
    ----------
    sample_rate_hz : float
        Nominal rate of the device.
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._suspects = 0
        self.steps = 0
        self.restart()

    def restart(self) -> None:
        """Forget the fit: the next stamp starts a new one."""
        self._origin: tuple[int, int] | None = None
        self._weight = self._mean_x_s = self._mean_y_ns = self._cxx = self._cxy = self._cyy = 0.0
        self._last_x_s = 0.0

    @property
    def started(self) -> bool:
        """True once the first stamp has arrived."""
        return self._origin is not None

    @property
    def drift_ppm(self) -> float:
        """Excess of the device's clock rate over the nominal rate, in parts per million."""
        return -self._slope_ns_s / 1e3

    @property
    def drift_error_ppm(self) -> float | None:
        """Possible error of `drift_ppm`, in parts per million; None as long as the fit is not used.

        The error is the sum of the part of the drift that the prior still suppresses, and three standard deviations due
        to the jitter of the stamps.
        """
        if self._last_x_s < LOCKED_S or self._cxx <= 0.0:
            return None
        held_back = abs(self._slope_ns_s) * _SLOPE_RIDGE_S2 / self._cxx
        jitter_ns = float(np.sqrt(max(0.0, self._cyy - self._cxy**2 / self._cxx) / self._weight))
        return (held_back + _NOISE_FACTOR * jitter_ns / float(np.sqrt(self._cxx))) / 1e3

    @property
    def state(self) -> ClockState:
        """State of the fit: settling, locked, or stepped."""
        if self._last_x_s >= LOCKED_S:
            return ClockState.LOCKED
        return ClockState.STEPPED if self.steps else ClockState.SETTLING

    def update(self, index: int, stamp_ns: int) -> bool:
        """Take in the stamp of a block; return True if the clock has stepped and the fit starts anew."""
        if self._origin is None:
            self._origin = (index, stamp_ns)
        stepped = False
        if abs(stamp_ns - self.time_ns(index)) > STEP_NS:
            self._suspects += 1
            if self._suspects < STEP_BLOCKS:
                return False
            self.restart()
            self._origin = (index, stamp_ns)
            self.steps += 1
            stepped = True
        self._suspects = 0
        x_s, y_ns = self._residual(index, stamp_ns)
        keep = float(np.exp(-(x_s - self._last_x_s) / MEMORY_S))
        self._last_x_s = x_s
        self._weight = keep * self._weight + 1.0
        dx, dy = x_s - self._mean_x_s, y_ns - self._mean_y_ns
        self._mean_x_s += dx / self._weight
        self._mean_y_ns += dy / self._weight
        self._cxx = keep * self._cxx + dx * (x_s - self._mean_x_s)
        self._cxy = keep * self._cxy + dx * (y_ns - self._mean_y_ns)
        self._cyy = keep * self._cyy + dy * (y_ns - self._mean_y_ns)
        return stepped

    def time_ns(self, index: int) -> int:
        """Return the site time of a sample, nanoseconds since the epoch."""
        first, start_ns = self._known_origin()
        x_s = (index - first) / self._rate_hz
        return start_ns + round(x_s * 1e9 + self._mean_y_ns + self._slope_ns_s * (x_s - self._mean_x_s))

    def index_at(self, time_ns: int) -> float:
        """Return the sample index, with its fraction, at a site time: the inverse of `time_ns`."""
        first, start_ns = self._known_origin()
        slope = self._slope_ns_s
        x_s = (time_ns - start_ns - self._mean_y_ns + slope * self._mean_x_s) / (1e9 + slope)
        return first + x_s * self._rate_hz

    @property
    def _slope_ns_s(self) -> float:
        return self._cxy / (self._cxx + _SLOPE_RIDGE_S2)

    def _known_origin(self) -> tuple[int, int]:
        if self._origin is None:
            raise RuntimeError("timeline: expected a stamp before the first query of a time; call update() first")
        return self._origin

    def _residual(self, index: int, stamp_ns: int) -> tuple[float, float]:
        first, start_ns = self._known_origin()
        x_s = (index - first) / self._rate_hz
        return x_s, (stamp_ns - start_ns) - x_s * 1e9


@dataclass(frozen=True, slots=True)
class Cut:
    """All channels of a device at one frame index: `samples` (channels, n) from site time `time_ns` on."""

    frame_index: int
    time_ns: int
    samples: Float32Array


@dataclass(frozen=True, slots=True)
class FramerState:
    """State of a framer, which marks report: its counters, and the drift and state of its clock."""

    overflows: int
    lost_frames: int
    drift_ppm: float
    clock: ClockState


class Framer:
    """Cuts a device's blocks at multiples of 50 ms. Frames are contiguous, so some are one sample longer than others.

    Parameters
    ----------
    sample_rate_hz : float
        Nominal rate of the device.
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self.timeline = Timeline(sample_rate_hz)
        self.overflows = 0
        self.lost_frames = 0
        self._frame_samples = sample_rate_hz * FRAME_NS / 1e9
        self._parts: list[Float32Array] = []
        self._begin = self._end = 0
        self._frame_index: int | None = None

    @property
    def state(self) -> FramerState:
        """Counters and clock after the last block."""
        return FramerState(self.overflows, self.lost_frames, self.timeline.drift_ppm, self.timeline.state)

    def push(self, block: Block) -> list[Cut]:
        """Take in a block; return the frames that it completes. A frame with a gap in it is dropped."""
        count = block.samples.shape[1]
        if count == 0:
            return []
        if block.overflow:
            self.overflows += 1
        gap = self.timeline.started and (block.overflow or block.first_index != self._end)
        if gap:
            self._tear()
            if block.overflow:  # how many samples are missing is unknown, so the line no longer holds
                self.timeline.restart()
        if self.timeline.update(block.first_index, block.stamp_ns):
            self._tear()
        if self._frame_index is None:
            self._begin = self._end = block.first_index
        self._parts.append(block.samples)
        self._end = block.first_index + count
        return self._cut()

    def _tear(self) -> None:
        if self._frame_index is not None:
            self.lost_frames += 1
        self._parts.clear()
        self._frame_index = None

    def _boundary(self, frame_index: int) -> int:
        return int(np.floor(self.timeline.index_at(frame_index * FRAME_NS) + _BOUNDARY))

    def _cut(self) -> list[Cut]:
        if self._frame_index is None:
            frame_index = self.timeline.time_ns(self._begin) // FRAME_NS
            while self._boundary(frame_index) < self._begin:
                frame_index += 1
            start = self._boundary(frame_index)
            if start >= self._end:
                self._parts.clear()
                return []
            self._drop(start - self._begin)
            self._frame_index = frame_index
        cuts: list[Cut] = []
        while (stop := self._boundary(self._frame_index + 1)) <= self._end:
            length = stop - self._begin
            if not 0.5 * self._frame_samples <= length <= 1.5 * self._frame_samples:
                self._tear()  # the line moved by more than half a frame: start over on the new frame index
                break
            cuts.append(Cut(self._frame_index, self.timeline.time_ns(self._begin), self._take(length)))
            self._frame_index += 1
        return cuts

    def _joined(self) -> Float32Array:
        return self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts, axis=1)

    def _drop(self, count: int) -> None:
        self._parts = [self._joined()[:, count:]]
        self._begin += count

    def _take(self, count: int) -> Float32Array:
        joined = self._joined()
        self._parts = [joined[:, count:]]
        self._begin += count
        return joined[:, :count]
