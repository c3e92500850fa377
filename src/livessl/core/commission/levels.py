"""Meters the level (RMS and peak, dBFS) and the faults of each input, over the last second and since the start."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.commission.channels import (
    MOST_CONSTANT,
    NOISY_DB,
    ChannelFigures,
    ChannelMeter,
    dbfs,
    noise_over_neighbours_db,
)
from livessl.core.types import ChannelLevel, Float32Array, FloatArray, IntArray

RECENT_S: Final = 1.0
"""Length, in seconds, of the sound from which the present level is computed."""

WINDOWS: Final = 10
"""Number of seconds from which mean, hum and noise are computed: few enough to follow a hand at the plugs."""

HUM_WINDOWS: Final = 3
"""Number of seconds from which hum is reported, because a single second may contain a voice."""

LEAST_NEIGHBOURS: Final = 3
"""Fewest channels of an array, silent ones excluded, whose noise is compared."""


@dataclass(frozen=True, slots=True)
class InputLevel(ChannelLevel):
    """Level and faults of one input.

    Parameters
    ----------
    faults : tuple of str
        Faults, in the words of `livessl doctor`: dead, clipping, dc, hum, noisy.
    """

    faults: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Sums:
    count: int
    total: FloatArray
    squares: FloatArray
    peak: FloatArray
    clipped: IntArray


class LevelMeter:
    """Accumulates the samples of a device's inputs.

    Parameters
    ----------
    count : int
        Number of inputs, K.
    sample_rate_hz : float
    arrays : sequence of sequence of int
        Inputs of each array, counted from 0. Only inputs of one array are compared with each other.
    """

    def __init__(self, count: int, sample_rate_hz: float, arrays: Sequence[Sequence[int]] = ()) -> None:
        self._recent_samples = round(RECENT_S * sample_rate_hz)
        self._arrays = tuple(arrays)
        self._meter = ChannelMeter(count, sample_rate_hz, WINDOWS)
        self._recent: deque[_Sums] = deque()
        self._held = 0
        nothing = np.zeros(count)
        self._all = _Sums(0, nothing, nothing, nothing, np.zeros(count, dtype=np.int64))

    def push(self, samples: Float32Array) -> None:
        """Take in the next samples (K, n)."""
        if samples.shape[1] == 0:
            return
        before = self._meter.clipped.copy()
        self._meter.push(samples)
        exact = samples.astype(np.float64)
        sums = _Sums(
            samples.shape[1],
            exact.sum(axis=1),
            np.einsum("ki,ki->k", exact, exact),
            np.maximum(exact.max(axis=1), -exact.min(axis=1)),
            self._meter.clipped - before,
        )
        self._all = _joined([self._all, sums])
        self._recent.append(sums)
        self._held += sums.count
        while self._held - self._recent[0].count >= self._recent_samples:
            self._held -= self._recent.popleft().count

    def recent(self) -> tuple[InputLevel, ...]:
        """Return the level of each input over the last second; empty before the first sample."""
        return self._levels(_joined([*self._recent])) if self._recent else ()

    def overall(self) -> tuple[InputLevel, ...]:
        """Return the level of each input since the start; empty before the first sample."""
        return self._levels(self._all) if self._recent else ()

    def _levels(self, sums: _Sums) -> tuple[InputLevel, ...]:
        figures = self._meter.figures()
        over_db = self._noise_over_db(figures, sums.peak)
        variance = np.maximum(sums.squares / sums.count - (sums.total / sums.count) ** 2, 0.0)
        return tuple(
            self._level(index, sums, float(variance[index]), figures[index] if figures else None, over_db.get(index))
            for index in range(len(variance))
        )

    def _level(
        self, index: int, sums: _Sums, variance: float, figures: ChannelFigures | None, noise_over_db: float | None
    ) -> InputLevel:
        is_dead = sums.peak[index] == 0.0
        hums = figures is not None and figures.hum_hz is not None and self._meter.windows >= HUM_WINDOWS
        found = {
            "dead": is_dead,
            "clipping": sums.clipped[index] > 0,
            "dc": figures is not None and abs(figures.mean) > MOST_CONSTANT,
            "hum": hums,
            "noisy": noise_over_db is not None and noise_over_db > NOISY_DB,
        }
        return InputLevel(
            peak_dbfs=dbfs(float(sums.peak[index]) ** 2),
            rms_dbfs=dbfs(variance),
            clipped=int(self._meter.clipped[index]),
            mean=None if figures is None else figures.mean,
            hum_hz=figures.hum_hz if figures is not None and hums else None,
            hum_dbfs=figures.hum_dbfs if figures is not None and hums else None,
            noise_dbfs=None if figures is None else figures.noise_dbfs,
            noise_over_db=noise_over_db,
            faults=("dead",) if is_dead else tuple(fault for fault, is_so in found.items() if is_so),
        )

    def _noise_over_db(self, figures: Sequence[ChannelFigures], peak: FloatArray) -> dict[int, float]:
        """Return how far the noise of each input is above its neighbours' in an array; silent inputs are skipped."""
        over: dict[int, float] = {}
        for inputs in self._arrays if figures else ():
            alive = [index for index in inputs if peak[index] > 0.0]
            if len(alive) >= LEAST_NEIGHBOURS:
                over |= zip(alive, noise_over_neighbours_db([figures[index] for index in alive]), strict=True)
        return over


def _joined(parts: Sequence[_Sums]) -> _Sums:
    return _Sums(
        sum(part.count for part in parts),
        np.sum([part.total for part in parts], axis=0),
        np.sum([part.squares for part in parts], axis=0),
        np.max([part.peak for part in parts], axis=0),
        np.sum([part.clipped for part in parts], axis=0),
    )
