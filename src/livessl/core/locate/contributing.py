"""Decides which arrays contribute to a position, and which show only noise (false-alarm threshold of an array).

If the phases between the microphones are random, each pair's GCC is noise of a known standard deviation, and an array's
SRP is a smooth random field over the directions. The probability that the highest point of such a field exceeds u
standard deviations is about the expected Euler characteristic (Adler and Taylor, Random Fields and Geometry, 2007,
chapter 12).

    p(u) = (1 + l / (2 pi) + a u / (2 pi)^(3/2)) exp(-u^2 / 2)

Here l and a are the length and the area of the directions in units of the field's correlation length. An array stands
out if its own highest point exceeds the level that noise exceeds in a share `FALSE_ALARMS` of all sounds. If another
array stands out, the common place lies on that array's line of sight, and an array has to exceed only the level for a
line, a = 0. A weaker array would move the position to a place where its noise happens to fit, and would seem to confirm
that place.

If at least two other arrays determine the common place, and are together far above any noise, a further array cannot
move the place any more. It then has to exceed only the level for a point. Single pairs of microphones in a reverberant
room rarely stand out, and those that do are often dominated by a reflection.

An array that detected a sound by itself received something. If its onsets are faint (`FAINT`), it contributes although
nothing stands out, because together with the others it may still determine the distance. If the onsets are strong, they
must stand out: a strong sound without a direction is wind, a touch, or a crackle of the electronics.
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
"""Share of sounds in which an array that records only noise counts as contributing."""

FIXED: Final = 7.0
"""Height of several arrays together, in standard deviations of noise, from which their place is not due to noise. Each
of two arrays of 1 m has some 6000 independent directions, and noise of both reaches 7.0 in `FALSE_ALARMS` of all
sounds."""

AT_A_POINT: Final = 1.64
"""Height of an array, in standard deviations, that noise exceeds in 5 % of all sounds at a place determined by
others."""

_COORDINATES: Final = 3
"""Number of coordinates that arrays must determine to determine a place."""

FAINT: Final = 1.0
"""Greatest ratio of `OnsetGCC.noise_power` to its weight at which onsets are faint. With four microphones noise alone
gives 0.3; sounds of the development half that do not stand out, in the paper's room at 10 dB, give at most 0.8, and
incoherent bursts give 1 to 20."""

NO_EVIDENCE: Final = "no direction stands out in the sound"
"""Reason for refusing a position if no array contributes."""

_NEAR_FIELD: Final = 2.0
"""Factor on the number of independent places, because the wave fronts of near sources are curved. It was chosen with
simulated noise so that the rate of false alarms is at most `FALSE_ALARMS`."""


def height(evidence: Evidence, power: float) -> float:
    """Return the height of an array's SRP above its mean in noise, in standard deviations of the SRP in noise.

    There are two estimates of the pairs' noise: `Evidence.noise_rms`, which is too high if only single windows and bins
    count, and the root mean square over all lags, which is too high if there is sound. The smaller one is used.
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
        Whether the height is that of the highest place on a line through the room, instead of anywhere.
    """
    return _threshold(spec.microphones_m.tobytes(), len(spec.microphones_m), spec.band_hz, c_m_s, on_line)


def contributing(
    evidence: Sequence[Evidence],
    terms: Sequence[PairTerms],
    highest_power: Callable[[Evidence], float],
    c_m_s: float,
) -> tuple[Evidence, ...]:
    """Return the evidence of the contributing arrays.

    Parameters
    ----------
    evidence : sequence of Evidence
    terms : sequence of PairTerms
        The arrays' terms at their common highest place. If an array stands out there, its own place is not searched
        for.
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
    """Return whether the arrays determine their common place without one of them.

    A pair of microphones determines one coordinate. An array of more microphones determines two: the direction.

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

    A GCC of the band has correlation length 1/w in time, w^2 = 4 pi^2 (f1^2 + f1 f2 + f2^2)/3; for envelopes, w is
    computed about the middle of the band. The metric of the directions is the mean over the pairs of w^2 d d^T/c^2,
    with d the vector between two microphones.
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
