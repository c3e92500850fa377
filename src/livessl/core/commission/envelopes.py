"""Rises of the sound in a recording, by which recordings of different clocks are compared.

Where and how loud a sound is heard changes its level and its reverberation, but hardly the moments at which its power
rises above all that came shortly before.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray

HOP_S: Final = 0.01
"""Length, in seconds, of the pieces whose power is measured."""

MOST_GAP_S: Final = 3600.0
"""Longest gap, in seconds, after which a recording is still measured: a clock that was set, such as that of a machine
that starts in 1970, leaves a gap of decades, and each piece of it would take memory."""

_DECAY_DB_S: Final = 40.0
"""Decay of reverberation, in dB a second; power that stays below such a decay from earlier power is no rise."""

_QUIET: Final = 30.0
"""Percentile of the pieces' powers that is taken as the noise between sounds."""

_ABOVE_NOISE: Final = 4.0
"""Ratio to that noise above which power is not noise."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Least power, full scale squared: that of rounding to 16 bits."""


class EnvelopeMeter:
    """Measures the power of one array's recording in pieces of `HOP_S`, up to the first gap longer than `MOST_GAP_S`.

    Parameters
    ----------
    sample_rate_hz : float
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._pieces: list[Float32Array] = []
        self._count = 0  # of the pieces so far
        self._waiting: list[Float32Array] = []
        self._is_over = False
        self._at = self._next = 0  # indices of the first sample that waits, and of the one that comes next

    def push(self, index: int, samples: Float32Array) -> None:
        """Take in samples (K, n), of which the first has this index; indices that are left out are a gap."""
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
        """Measure all complete pieces of the samples that wait."""
        # a piece begins at the sample next to a multiple of the hop, so that they keep time at every sampling rate
        last = self._count
        while self._edge(last + 1) + 1 <= self._next:
            last += 1
        if last == self._count or not self._waiting:
            return
        samples = np.concatenate(self._waiting, axis=1)
        edges = np.array([self._edge(piece) - self._at for piece in range(self._count, last + 1)])
        steps = np.diff(samples[:, : edges[-1] + 1], axis=1)  # no rumble and no constant
        energy = np.add.reduceat(steps * steps, edges[:-1], axis=1)
        # the median: one channel may be dead, or noisy
        self._pieces.append(np.median(energy / np.diff(edges), axis=0).astype(np.float32))
        self._waiting, self._at, self._count = [samples[:, edges[-1] :]], self._at + int(edges[-1]), last

    def rises(self) -> FloatArray:
        """Return how far each piece exceeds the decay of all pieces before it, in nepers of power, (n,)."""
        self._measure()
        if not self._pieces:
            return np.zeros(0)
        power = np.concatenate(self._pieces).astype(np.float64)
        known = power[np.isfinite(power)]
        floor = _ABOVE_NOISE * max(float(np.percentile(known, _QUIET)) if len(known) else 0.0, _LEAST_POWER)
        level = np.log(np.maximum(np.nan_to_num(power), floor))
        decay = np.log(10.0) / 10.0 * _DECAY_DB_S * HOP_S * np.arange(len(level))
        past = np.maximum.accumulate(level + decay) - decay
        return np.concatenate([[0.0], np.maximum(0.0, level[1:] - past[:-1])])

    def _skip_to(self, index: int) -> None:
        """Begin again with the first piece that begins at a sample or after it; those before it have no power."""
        first = self._count
        while self._edge(first) < index:
            first += 1
        if first > self._count:
            self._pieces.append(np.full(first - self._count, np.nan, dtype=np.float32))
        self._count = first

    def _edge(self, piece: int) -> int:
        return round(piece * HOP_S * self._rate_hz)
