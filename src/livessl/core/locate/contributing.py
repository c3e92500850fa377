"""Which arrays contribute to a position, and which show no more than their own noise would. It sees correlations only.

If the phases between the microphones are random, each pair's GCC is noise of a known standard deviation, and an array's
SRP is a smooth random field over the directions. The probability that the highest point of such a field exceeds u
standard deviations is about the expected Euler characteristic (Adler and Taylor, Random Fields and Geometry, 2007,
chapter 12).

    p(u) = (1 + l / (2 pi) + a u / (2 pi)^(3/2)) exp(-u^2 / 2)

Here l and a are the length and the area of the directions in units of the field's correlation length. An array stands
out if its own highest place exceeds what noise reaches in a share `FALSE_ALARMS` of all sounds. If another array stands
out, the common place lies on that array's line of sight, and an array has to exceed only what noise reaches along a
line, a = 0.
An array that shows less would move the position to where its noise happens to fit, and would seem to confirm it.

Where at least two other arrays determine the common place, and are together far above what noise reaches anywhere, an
array cannot move it any more. It then has to exceed only what noise reaches at a point. Pairs of microphones in a
reverberant room rarely stand out one by one; those that do are often those that a reflection dominates.

An array that detected a sound by itself received something. If its onsets are faint (`FAINT`), it contributes although
nothing stands out: with the others it may still determine the distance. If they are strong, they must stand out: a
strong sound that comes from nowhere is wind, a touch, or a crackle of the electronics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.geometry import microphone_pairs, pair_weight
from livessl.core.locate.confidence import array_power
from livessl.core.locate.srp import PairTerms
from livessl.core.types import ArraySpec, Evidence

FALSE_ALARMS: Final = 1e-3
"""Share of sounds in which an array that records nothing but noise is taken to contribute."""

FIXED: Final = 7.0
"""Height of several arrays together, in standard deviations in noise, from which their place is no noise. Each of two
arrays of 1 m has some 6000 independent directions, and noise of both reaches 7.0 in `FALSE_ALARMS` of all sounds."""

AT_A_POINT: Final = 1.64
"""Height of an array, in standard deviations, that its noise exceeds in 5 % of all sounds at a place that others
fix."""

_COORDINATES: Final = 3
"""Coordinates that arrays have to determine for their place to be fixed."""

FAINT: Final = 1.0
"""Greatest ratio of `OnsetGCC.noise_power` to its weight at which onsets are faint. With four microphones noise alone
gives 0.3; sounds of the development half that do not stand out, in the paper's room at 10 dB, give at most 0.8, and
incoherent bursts give 1 to 20."""

NO_EVIDENCE: Final = "no direction stands out in the sound"
"""Reason for refusing a position if no array contributes."""

_NEAR_FIELD: Final = 2.0
"""Factor on the number of independent places, because the wave fronts of near sources are curved; found by simulated
noise, with which the rate of false alarms is at most `FALSE_ALARMS`."""


def height(evidence: Evidence, power: float) -> float:
    """Height of an array's SRP above its mean in noise, in standard deviations that it would have in noise.

    Of the pairs' noise two estimates are known: `Evidence.noise_rms`, which is too high where only single windows and
    bins count, and the root mean square over all lags, which is too high where there is sound. The smaller one is
    taken.
    """
    values = evidence.gcc.values
    squares = np.einsum("pl,pl->p", values, values, dtype=np.float64)
    live = int(np.count_nonzero(squares))
    if live == 0:
        return 0.0
    rms, mean, deviation = float(np.sqrt(squares.sum() / (live * values.shape[1]))), 0.0, 1.0
    if uses_envelope(evidence.spec.band_hz):  # magnitudes: Rayleigh distributed
        rms, mean, deviation = rms / np.sqrt(2.0), np.sqrt(np.pi / 2.0), np.sqrt(2.0 - np.pi / 2.0)
    noise = min(rms, evidence.noise_rms) if evidence.noise_rms > 0.0 else rms
    pairs = power / (pair_weight(len(evidence.spec.microphones_m)) * noise)
    return float((pairs - mean * live) / (deviation * np.sqrt(live)))


def threshold(spec: ArraySpec, c_m_s: float, *, on_line: bool = False) -> float:
    """Return the height, in standard deviations, that an array's SRP reaches in noise in `FALSE_ALARMS` of all sounds.

    Parameters
    ----------
    spec : ArraySpec
    c_m_s : float
        Speed of sound, m/s.
    on_line : bool
        Whether the highest place on a line through the room is meant, instead of the highest anywhere.
    """
    return _threshold(spec.microphones_m.tobytes(), len(spec.microphones_m), spec.band_hz, c_m_s, on_line)


def contributing(
    evidence: Sequence[Evidence],
    terms: Sequence[PairTerms],
    highest_power: Callable[[Evidence], float],
    c_m_s: float,
) -> tuple[Evidence, ...]:
    """Return the evidence of those arrays that contribute.

    Parameters
    ----------
    evidence : sequence of Evidence
    terms : sequence of PairTerms
        The arrays' terms at the highest place of all of them together; an array that stands out there needs no search.
    highest_power : callable
        Returns the highest power of one array's own map.
    c_m_s : float
        Speed of sound, m/s.
    """
    heights = [height(part, array_power(part, term)) for part, term in zip(evidence, terms, strict=True)]
    specs = [part.spec for part in evidence]
    leads = [above > threshold(part.spec, c_m_s) for part, above in zip(evidence, heights, strict=True)]

    def contributes(index: int) -> bool:
        part = evidence[index]
        if leads[index]:
            return True
        if part.is_presumed:
            return bool(np.any(part.gcc.values))
        if heights[index] > AT_A_POINT and is_fixed(specs, heights, index):
            return True
        if any(leads) and heights[index] > threshold(part.spec, c_m_s, on_line=True):
            return True
        return height(part, highest_power(part)) > threshold(part.spec, c_m_s)

    return tuple(part for index, part in enumerate(evidence) if contributes(index))


def is_fixed(specs: Sequence[ArraySpec], heights: Sequence[float], without: int) -> bool:
    """Return whether the arrays fix their common place without one of them.

    Of its coordinates a pair of microphones determines one, another array two: the direction.

    Parameters
    ----------
    specs : sequence of ArraySpec
    heights : sequence of float
        Height of each array at the common place, in standard deviations.
    without : int
        Index of the array that is left out.
    """
    others = [k for k in range(len(specs)) if k != without]
    known = sum(min(2, len(specs[k].microphones_m) - 1) for k in others if heights[k] > AT_A_POINT)
    return known >= _COORDINATES and sum(heights[k] for k in others) > FIXED * math.sqrt(len(others))


@lru_cache(maxsize=128)
def _threshold(microphones: bytes, count: int, band_hz: tuple[float, float], c_m_s: float, on_line: bool) -> float:
    """Solve p(u) = `FALSE_ALARMS` for u.

    A GCC of the band has correlation length 1/w in time, w^2 = 4 pi^2 (f1^2 + f1 f2 + f2^2)/3; with the envelope, w is
    taken about the middle of the band. The metric of the directions is the mean over the pairs of w^2 d d^T/c^2, with d
    the vector between two microphones.
    """
    positions_m = np.frombuffer(microphones, dtype=np.float64).reshape(count, 3)
    first, second = microphone_pairs(count).T
    baselines_m = positions_m[second] - positions_m[first]
    low, high = band_hz
    square = (high - low) ** 2 / 12.0 if uses_envelope(band_hz) else (low**2 + low * high + high**2) / 3.0
    metric = (2.0 * np.pi / c_m_s) ** 2 * square * baselines_m.T @ baselines_m / len(first)
    x, y, z = np.sqrt(np.maximum(np.linalg.eigvalsh(metric), 0.0))
    length, area = 2.0 * z, 4.0 * np.pi / 3.0 * (x * y + y * z + x * z)
    heights = np.linspace(1.0, 12.0, 2201)
    places = 1.0 + length / (2.0 * np.pi) + area * heights / (2.0 * np.pi) ** 1.5
    if on_line:
        places = np.full_like(heights, 1.0 + length / (2.0 * np.pi))
    likely = (1.0 if on_line else _NEAR_FIELD) * places * np.exp(-np.square(heights) / 2.0)
    return float(heights[np.argmax(likely <= FALSE_ALARMS)])
