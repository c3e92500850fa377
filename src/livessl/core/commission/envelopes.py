"""Finds the times at which the power of a recording rises, by which recordings of different clocks are compared.

The place of a microphone changes the level and the reverberation of a sound, but hardly the times at which its power
rises above the power just before.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray

INTERVAL_S: Final = 0.01
"""Length, in seconds, of the intervals whose power is measured."""

MOST_GAP_S: Final = 3600.0
"""Longest gap in a recording, in seconds; nothing after a longer gap is measured. A clock that is set, such as that of
a machine that starts in 1970, leaves a gap of decades, and each interval of the gap would take memory."""

_DECAY_DB_S: Final = 40.0
"""Decay of reverberation, in dB per second. Power below such a decay of earlier power is no rise."""

_QUIET: Final = 30.0
"""Percentile of the powers of all intervals that is used as the noise between sounds."""

_ABOVE_NOISE: Final = 4.0
"""Ratio of power to the noise between sounds above which the power belongs to a sound."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Least power, full scale squared: the power of rounding to 16 bits."""


class EnvelopeMeter:
    """Measures the power of one array's recording in intervals, up to the first gap longer than `MOST_GAP_S`.

    Parameters
    ----------
    sample_rate_hz : float
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._powers: list[Float32Array] = []
        self._count = 0  # number of intervals so far
        self._waiting: list[Float32Array] = []
        self._is_over = False
        self._at = self._next = 0  # sample indices: the first one that waits, and the next one

    def push(self, index: int, samples: Float32Array) -> None:
        """Take in samples (K, n); `index` is the sample index of the first. Skipped indices are a gap."""
        self._is_over = self._is_over or index - self._next > MOST_GAP_S * self._rate_hz
        if self._is_over:
            return
        if index != self._next:
            self._measure()
            self._skip_to(index)
            skipped = self._edge(self._count) - index
            samples, index = samples[:, skipped:], index + min(skipped, samples.shape[1])
            self._at, self._waiting = index, []
        self._waiting.append(samples)
        self._next = index + samples.shape[1]
        if self._next - self._at >= self._rate_hz:  # a second at a time: blocks are short
            self._measure()

    def _measure(self) -> None:
        """Measure all complete intervals of the samples that wait."""
        # each interval begins at the sample nearest to a multiple of `INTERVAL_S`, so that no error adds up at any rate
        last = self._count
        while self._edge(last + 1) + 1 <= self._next:
            last += 1
        if last == self._count or not self._waiting:
            return
        samples = np.concatenate(self._waiting, axis=1)
        edges = np.array([self._edge(interval) - self._at for interval in range(self._count, last + 1)])
        steps = np.diff(samples[:, : edges[-1] + 1], axis=1)  # differences remove rumble and constants
        energy = np.add.reduceat(steps * steps, edges[:-1], axis=1)
        # the median, because one channel may be dead or noisy
        self._powers.append(np.median(energy / np.diff(edges), axis=0).astype(np.float32))
        self._waiting, self._at, self._count = [samples[:, edges[-1] :]], self._at + int(edges[-1]), last

    def rises(self) -> FloatArray:
        """Return how far the power of each interval exceeds the decay of all earlier ones, in nepers of power, (n,)."""
        self._measure()
        if not self._powers:
            return np.zeros(0)
        power = np.concatenate(self._powers).astype(np.float64)
        known = power[np.isfinite(power)]
        floor = _ABOVE_NOISE * max(float(np.percentile(known, _QUIET)) if len(known) else 0.0, _LEAST_POWER)
        level = np.log(np.maximum(np.nan_to_num(power), floor))
        decay = np.log(10.0) / 10.0 * _DECAY_DB_S * INTERVAL_S * np.arange(len(level))
        past = np.maximum.accumulate(level + decay) - decay
        return np.concatenate([[0.0], np.maximum(0.0, level[1:] - past[:-1])])

    def _skip_to(self, index: int) -> None:
        """Continue with the first interval that begins at or after a sample; skipped intervals have no power."""
        first = self._count
        while self._edge(first) < index:
            first += 1
        if first > self._count:
            self._powers.append(np.full(first - self._count, np.nan, dtype=np.float32))
        self._count = first

    def _edge(self, interval: int) -> int:
        return round(interval * INTERVAL_S * self._rate_hz)
