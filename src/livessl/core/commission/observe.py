"""Measures the delays and polarity of a sound at the channels of one array, without using the site's geometry.

The poses, the geometry and the order of the channels in the site file are not used, so that they can be examined with
the result. The polarity of each microphone is measured with its delay: an inverted microphone turns the peaks of its
pairs upside down.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.types import Evidence, Float32Array, FloatArray, IntArray, Observation, Received

PEAKS: Final = 3
"""Number of peaks of each pair, positive and negative, that are tried as its delay; reverberation and tones cause
several."""

BEAM: Final = 8
"""Largest number of partial solutions that are kept while microphones are added one by one."""

NEAR_STEPS: Final = 4
"""Number of steps of the lag axis around the common delays within which each pair's own peak is searched for."""

INVERSION: Final = 1.15
"""Least ratio of the peaks with some microphones inverted to the peaks with none inverted. Reverberation alone can make
a trough larger than the peak in some pairs."""

LEAST_SHARPNESS: Final = 3.5
"""Sharpness below which an observation is not used; noise alone has up to 3."""


def receive(evidence: Evidence, segments: Iterable[Float32Array]) -> Received:
    """Return the parts of an array's evidence and samples, segments of (K, n), that `observe` needs."""
    return Received(replace(evidence, background=None, beginning=None), _powers(segments))


def observe(received: Iterable[Received]) -> tuple[Observation, ...]:
    """Measure the delays and polarities of a sound at the channels of each array; skip arrays without exact delays."""
    observed = (_observe(one.evidence, one.powers) for one in received)
    return tuple(one for one in observed if one is not None)


def _observe(evidence: Evidence, powers: FloatArray) -> Observation | None:
    """Measure the delays and polarities of a sound at the channels of one array.

    The delays t and polarities s are those for which the sum over all pairs (i, k) of s_i s_k R_ik(t_k - t_i) is
    highest. Microphones are added one by one; the candidates of each are the highest peaks of its pairs. Return None if
    fewer than two channels carry sound, or the correlations are envelopes, which have no polarity and no exact peak.
    """
    if uses_envelope(evidence.spec.band_hz):
        return None
    pairs = _Pairs(evidence)
    if len(pairs.live) < 2:
        return None
    found = pairs.best(signs=(1.0, -1.0))
    if min(found.signs) < 0.0:
        upright = pairs.best(signs=(1.0,))
        found = found if found.score > INVERSION * upright.score else upright
    return pairs.observation(found, powers)


def _powers(segments: Iterable[Float32Array]) -> FloatArray:
    """Return the mean power (K,) of the first differences, which attenuate hum and rumble and remove constants."""
    differences = [np.diff(segment, axis=1) for segment in segments]
    count = max(1, sum(one.shape[1] for one in differences))
    sums = [np.einsum("kn,kn->k", one, one, dtype=np.float64) for one in differences]
    return np.asarray(np.sum(sums, axis=0) / count)


@dataclass(frozen=True, slots=True)
class _Partial:
    """Delays and polarities of the microphones placed so far, and the sum of their pairs' correlations there."""

    delays_s: tuple[float, ...]
    signs: tuple[float, ...]
    score: float


class _Pairs:
    """The correlations of an array's pairs, in both directions."""

    def __init__(self, evidence: Evidence) -> None:
        gcc = evidence.gcc
        self._name = evidence.spec.name
        self._count = len(evidence.spec.microphones_m)
        self._first_s, self._step_s = float(gcc.lags_s[0]), float(gcc.lags_s[1] - gcc.lags_s[0])
        self._lags = len(gcc.lags_s)
        self._steps = np.arange(self._lags)
        self._values: dict[tuple[int, int], FloatArray] = {}
        self._tops: dict[tuple[tuple[int, int], float], FloatArray] = {}
        heard = np.zeros(self._count, dtype=bool)
        for (i, k), values in zip(gcc.pairs, gcc.values, strict=True):
            if values.any():
                heard[[i, k]] = True
                self._values[int(i), int(k)] = np.asarray(values, dtype=np.float64)
        self.live: IntArray = np.flatnonzero(heard)
        self._rms = float(np.sqrt(np.mean([np.mean(v**2) for v in self._values.values()]))) if self._values else 0.0

    def best(self, signs: tuple[float, ...]) -> _Partial:
        """Return the delays with the highest sum, with these polarities allowed."""
        beam = [_Partial((0.0,), (1.0,), 0.0)]
        for placed, k in enumerate(self.live[1:], start=1):
            grown = [grown for one in beam for grown in self._grown(one, placed, int(k), signs)]
            beam = sorted(grown, key=lambda one: -one.score)[:BEAM]
        return beam[0]

    def observation(self, found: _Partial, powers: FloatArray) -> Observation:
        """Return the delays that fit the pairs' own peaks best, weighted by their heights."""
        index = {int(k): place for place, k in enumerate(self.live)}
        rows, lags_s, heights = [], [], []
        coherence, pair_count = np.zeros(self._count), np.zeros(self._count)
        for (i, k), values in self._values.items():
            a, b = index[i], index[k]
            sign = found.signs[a] * found.signs[b]
            at_s, height = self._peak_near(sign * values, found.delays_s[b] - found.delays_s[a])
            row = np.zeros(len(self.live))
            row[a], row[b] = -1.0, 1.0
            rows.append(row)
            lags_s.append(at_s)
            heights.append(max(height, 0.0) + 1e-9)
            coherence[[i, k]] += height
            pair_count[[i, k]] += 1.0
        matrix, measured_s, weight = np.array(rows), np.array(lags_s), np.array(heights)
        solution, *_ = np.linalg.lstsq(matrix * weight[:, None], measured_s * weight, rcond=None)
        misfit_s = matrix @ solution - measured_s
        delays_s, inverted = np.full(self._count, np.nan), np.zeros(self._count, dtype=bool)
        delays_s[self.live] = solution - solution.mean()
        signs = np.array(found.signs)
        inverted[self.live] = signs != (1.0 if signs.sum() >= 0 else -1.0)
        closure_s = float(np.sqrt(np.average(misfit_s**2, weights=weight)))
        sharpness = float(weight.mean() / max(self._rms, 1e-12))
        coherence /= np.maximum(pair_count, 1.0)
        return Observation(self._name, delays_s, inverted, coherence, powers, sharpness, closure_s)

    def _grown(self, one: _Partial, placed: int, k: int, signs: tuple[float, ...]) -> list[_Partial]:
        """Return the partial solutions with one more microphone, at each peak of its pairs with those placed."""
        pairs = [(place, pair) for place in range(placed) if (pair := (int(self.live[place]), k)) in self._values]
        if not pairs:
            return [_Partial((*one.delays_s, 0.0), (*one.signs, 1.0), one.score)]
        grown = []
        for sign in signs:
            turned = [(one.delays_s[place], sign * one.signs[place], pair) for place, pair in pairs]
            tried_s = np.unique(np.concatenate([from_s + self._peaks(pair, turn) for from_s, turn, pair in turned]))
            scores = np.zeros(len(tried_s))
            for from_s, turn, pair in turned:
                scores += turn * self._at(self._values[pair], tried_s - from_s)
            grown += [
                _Partial((*one.delays_s, tried), (*one.signs, sign), one.score + score)
                for tried, score in zip(tried_s.tolist(), scores.tolist(), strict=True)
            ]
        return grown

    def _peaks(self, pair: tuple[int, int], sign: float) -> FloatArray:
        """Return the lags of the highest local maxima of a pair, or of its lowest minima if the sign is -1, seconds."""
        if (pair, sign) not in self._tops:
            values = sign * self._values[pair]
            inner = values[1:-1]
            tops = np.flatnonzero((inner >= values[:-2]) & (inner > values[2:]) & (inner > 0.0)) + 1
            highest = tops[np.argsort(-values[tops])[:PEAKS]]
            self._tops[pair, sign] = np.asarray(self._first_s + self._step_s * highest, dtype=np.float64)
        return self._tops[pair, sign]

    def _at(self, values: FloatArray, lags_s: FloatArray) -> FloatArray:
        """Return the interpolated correlation at lags; 0 outside the axis."""
        places = (lags_s - self._first_s) / self._step_s
        return np.interp(places, self._steps, values, left=0.0, right=0.0)

    def _peak_near(self, values: FloatArray, lag_s: float) -> tuple[float, float]:
        """Return lag and height of the highest point near a lag, interpolated by a parabola."""
        place = round((lag_s - self._first_s) / self._step_s)
        low, high = max(1, place - NEAR_STEPS), min(self._lags - 2, place + NEAR_STEPS)
        if low > high:
            return lag_s, 0.0
        top = low + int(np.argmax(values[low : high + 1]))
        before, here, after = values[top - 1 : top + 2]
        bend = before - 2.0 * here + after
        shift = float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
        return self._first_s + self._step_s * (top + shift), float(here)
