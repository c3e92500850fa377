"""A second source that sounds at the same time: what one place explains of the arrays' evidence is taken out of it.

All pairs of an array hear a source with one spectrum, so its share of their GCCs is one even function of lag, shifted
to each pair's delay. The mean over the pairs around their delays tells it, moment by moment; what is left is of the
others, and of reverberation. A moment in which much was said leaves much of that behind, so its rest counts for less: a
second source is often heard best while the first is silent. What tells it from what reverberation leaves is that in
some moment it stands out from all that is heard. It knows no sound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling, microphone_pairs
from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.types import GCC, ArraySpec, BoolArray, Evidence, Float32Array, FloatArray, IntArray

APART_M: Final = 1.0
"""Two places nearer than this are one."""

MOST_MOMENTS: Final = 40
"""Moments kept apart; those of a longer sound are put together, so that a long one takes no more room and time."""

CANDIDATES: Final = 6
"""Places looked at for each source; the right one is hardly ever further down."""

CANDIDATES_APART_M: Final = 0.5
"""Between these, along each axis."""

LITTLE: Final = 200.0
"""Weight of a moment's onsets below which it is mostly noise, and counts the less: noise at 10 dB gives some 30, a
source in a clear moment thousands."""

LEAST_CONFIDENCE: Final = 0.5
"""Below it a second source is not told of."""

LEAST_PROSPECT: Final = 0.1
"""What is less likely than this to be a second source, at first sight, is not looked at closer."""

_LOGISTIC: Final = (-11.6, 6.9)
"""Intercept and weight of the clearness in the log-odds of a second source at a place; fitted to 800 pairs of sounds
and 800 single ones of the development half, of two arrays and of four, RT60 0.4 to 2 s at 20 and 10 dB."""


def clearness(of_arrays: Sequence[float]) -> float:
    """Of a place, by each array's `Moments.clearness`: two lines make it, so it is the mean of the two highest."""
    return float(np.mean(sorted(of_arrays)[-2:]))


def confidence(clearness: float) -> float:
    """Probability that there is a second source, and at this place, by the place's `clearness`."""
    intercept, slope = _LOGISTIC
    return float(1.0 / (1.0 + np.exp(-(intercept + slope * clearness))))


@dataclass(frozen=True, slots=True)
class Moments:
    """One array's evidence, moment by moment.

    Parameters
    ----------
    spec : ArraySpec
    lags_s : (L,) float64
    values : (F, P, L) float32
        Of each moment, not normalised.
    weights : (F,) float64
        Of each moment's onsets.
    """

    spec: ArraySpec
    lags_s: FloatArray
    values: Float32Array
    weights: FloatArray

    @classmethod
    def of(cls, spec: ArraySpec, sampling: LagSampling, frames: Sequence[OnsetGCC], live: BoolArray) -> Moments:
        """From what a listener made of an array's frames, no envelopes; pairs that are not `live` (P,) are silent."""
        size = -(-len(frames) // MOST_MOMENTS)
        together = [summed(frames[first : first + size]) for first in range(0, len(frames), size)]
        whole = summed(together)
        even = live[:, None] * np.float32(whole.weight) / whole.heights(microphone_pairs(len(spec.microphones_m)))
        coarse = np.asarray(np.stack([one.lags for one in together]).real * even, dtype=np.float32)
        fine = sampling.fine(coarse.reshape(-1, coarse.shape[2])).reshape(*coarse.shape[:2], -1)
        return cls(spec, sampling.fine_lags_s, fine, np.array([one.weight for one in together]))

    def without(self, delays_s: FloatArray) -> Evidence:
        """What is left when a source at these delays of the pairs (P,) is taken out."""
        share, starts = self._share(delays_s)
        count, live = len(self.lags_s), self._live
        scale = 1.0 / np.maximum(self.weights, LITTLE)
        scale /= max(float((self.weights * scale).sum()), 1e-9)
        values = np.einsum("f,fpl->pl", scale.astype(np.float32), self.values)
        weighed = scale.astype(np.float32) @ share
        for pair in live:
            values[pair] -= weighed[starts[pair] : starts[pair] + count]
        return Evidence(self.spec, GCC(microphone_pairs(len(self.spec.microphones_m)), self.lags_s, values))

    def clearness(self, delays_s: FloatArray, without_s: FloatArray) -> float:
        """How high a source at some delays (P,) stands without that at others, in the moment where it is clearest.

        It is the mean height over the pairs over the root mean square of all that is heard in that moment, of both
        sources.
        """
        share, starts = self._share(without_s)
        at, live = self._nearest(delays_s), self._live
        if not len(live):
            return 0.0
        heights = (self.values[:, live, at[live]] - share[:, starts[live] + at[live]]).mean(axis=1)
        heard = self.values[:, live]
        rms = np.sqrt(np.einsum("fpl,fpl->f", heard, heard) / (heard.shape[1] * heard.shape[2]))
        return float((heights / np.maximum(rms, 1e-9)).max())

    @property
    def _live(self) -> IntArray:
        return np.flatnonzero(self.values.any(axis=(0, 2)))

    def _nearest(self, delays_s: FloatArray) -> IntArray:
        step_s = self.lags_s[1] - self.lags_s[0]
        places = np.rint((delays_s - self.lags_s[0]) / step_s).astype(np.int64)
        return np.asarray(np.clip(places, 0, len(self.lags_s) - 1))

    def _share(self, delays_s: FloatArray) -> tuple[Float32Array, IntArray]:
        """Share of a source at these delays (P,) in each moment, (F, 2 L - 1), and where in it a pair's begins, (P,).

        It is r(t) = mean over pairs of [R_p(tau_p + t) + R_p(tau_p - t)] / 2, t as far as the lags reach.
        """
        moments, _, count = self.values.shape
        share = np.zeros((moments, 2 * count - 1), dtype=np.float32)
        terms = np.zeros(2 * count - 1, dtype=np.float32)
        starts = count - 1 - self._nearest(delays_s)
        for pair in self._live:
            share[:, starts[pair] : starts[pair] + count] += self.values[:, pair]
            terms[starts[pair] : starts[pair] + count] += 1.0
        return (share + share[:, ::-1]) / np.maximum(terms + terms[::-1], 1.0), starts
