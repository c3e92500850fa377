"""Computes the confidence of a position, scales its covariance, and refuses it below the confidence threshold.

The threshold is `LEAST_CONFIDENCE`. It sees correlations and no sound. The constants were fitted to simulated events by
`livessl evaluate localizer --half development`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, pair_weight
from livessl.core.locate import refine
from livessl.core.locate.srp import PairTerms, SRPFunctional
from livessl.core.mirror import flatness
from livessl.core.types import ArraySpec, Candidate, Evidence, FloatArray

NEAR_M: Final = 0.5
"""Largest error, in metres, of a position that counts as right: the confidence is the probability of that."""

LEAST_CONFIDENCE: Final = 0.8
"""Confidence below which a position is refused."""

SURE: Final = 0.9
"""Confidence at and above which whole segments are not examined, provided that two arrays have a clear peak."""

CROSSING_DEG: Final = 20.0
"""Angle, in degrees, from which arrays whose lines of sight cross determine the distance, whatever the margin."""

_ONSET_FIT: Final = (-3.34, 2.69, 1.03)
"""Log-odds of a right position where the distance is determined: intercept, weight of the margin, weight of the
peak-to-RMS ratio."""

_WHOLE_SEGMENT_FIT: Final = (-3.56, 10.0, 0.82)
"""The same as `_ONSET_FIT` for evidence that includes whole segments; fitted where onsets alone were not sure."""

_BACKGROUND_FIT: Final = 36.6
"""Log-odds by which a background that explains the whole power at the position lowers the confidence; fitted by
`livessl evaluate localizer --scenario noise --half development`."""

_BACKGROUND_RMS: Final = 2.5
"""Power of a background at a position, relative to its root mean square elsewhere, that is there by chance: it is known
from some tenths of a second, and the position is where the background adds to the sound."""

_BEGINNING_FIT: Final = 9.2
"""Log-odds by which a beginning that has nothing at the position lowers the confidence. This constant and the next
two that end in `_FIT` are fitted as `_BACKGROUND_FIT` is."""

_BEGUN: Final = 0.4
"""Peak-to-RMS ratio of a beginning, relative to that of the whole sound, from which on it lacks nothing."""

_WEAK_FIT: Final = 1.5
"""Log-odds lost for each unit of the peak-to-RMS ratio by which the second array falls short of `CLEAR_PEAK_TO_RMS`,
where lines of sight that cross determine the distance: one of them is then little better than noise."""

_DISAGREEMENT_FIT: Final = 6.0
"""Log-odds lost for each unit of `ConfidenceFeatures.disagreement` above `AGREED`: 1 leaves hardly any position."""

AGREED: Final = 0.6
"""Peak-to-RMS ratio that one of two arrays may lose at the right position, in a set-up that is off by the default
`livessl.core.types.Uncertainty`."""

_LINES_SPREAD_FIT: Final = 10.0
"""Factor on the standard deviation along the position's least certain axis where all arrays are lines: three of them
give as many angles as there are coordinates, with none to spare. The share of errors beyond `NEAR_M` is then normal."""

_LEAST_LOG_ODDS: Final = -100.0
"""Log-odds below which a probability is 0 for every purpose; a background may be any number of times the power."""

_DISTANCE_FIT: Final = (-0.04, 62.2)
"""Log-odds that no position further along the line of sight is as good: intercept, weight of the margin. It matters for
one array, or arrays side by side, whose maps have a ridge along that line."""

CLEAR_PEAK_TO_RMS: Final = 2.0
"""Peak-to-RMS ratio at and above which one array's peak cannot be noise; noise gives about 1."""

_FITTED_DELAYS: Final = 3.0
"""Independent delays of an array of four microphones, with which the constants were fitted."""

_INFLATION: Final = 1.15
"""Factor on the variance, together with the square root of the number of arrays, for errors that the noise elsewhere on
the lag axis does not show: maps are summed with equal weight although clearer arrays deserve more."""

_CALIBRATED_MISFIT: Final = 0.4
"""Residual misfit below which the values elsewhere on the lag axis are mostly side lobes of the sound, not noise, so
that the variance decreases with the square of the misfit. It is about 0.05 in free field, and 0.7 or more in a room."""

_PLACED_M: Final = 0.0005
"""Standard deviation, in metres, with which the acoustic centres of an array's microphones are known relative to each
other at best. Coordinates that follow from the curvature of the wavefront cannot be more exact than that."""

_LEAST_DEVIATION_M: Final = 0.005
"""Standard deviation along each axis, in metres, that remains even with the clearest evidence. Reflections just after
the direct sound, which the lag axis does not resolve, move positions by that much."""


@dataclass(frozen=True, slots=True)
class ConfidenceFeatures:
    """The measurements from which the confidence is computed.

    Parameters
    ----------
    margin : float
        1 - (power at the best other place) / (power at the position), 0 to 1.
    peak_to_rms : float
        Sum over the arrays of the mean height of an array's GCCs at the position over their root mean square, never
        below 0, in proportion to its independent delays. An array that disagrees, or records only noise, adds nothing.
    crossing_deg : float
        Largest angle at which lines from two arrays cross at the position, 0 to 90; 0 for one array.
    second_array : float
        Second highest of the arrays' shares of `peak_to_rms`; 0 for one array.
    whole : bool
        Whether the evidence includes whole segments.
    share : float
        Probability of the position among the places that explain the evidence about as well, such as mirror images.
    background : float
        Share of the power at the position, beyond chance, that the background would have if it continued as before the
        sound; 0 if the background is not known.
    beginning : float or None
        `peak_to_rms` of the frames in which the sound begins; None if they are not known.
    spread_m : float
        Greatest standard deviation of the position by its covariance, metres.
    of_lines : bool
        Whether the microphones of each array lie on a line, so that no array alone gives a direction.
    disagreement : float
        Greater one of the peak-to-RMS ratios that two arrays lose against their own highest places; 0 if unknown.
    """

    margin: float
    peak_to_rms: float
    crossing_deg: float = 0.0
    second_array: float = 0.0
    whole: bool = False
    share: float = 1.0
    background: float = 0.0
    beginning: float | None = None
    spread_m: float = 0.0
    of_lines: bool = False
    disagreement: float = 0.0

    @property
    def confidence(self) -> float:
        """Probability that the position is right to within `NEAR_M`."""
        return self.share * self.confidence_of_candidates

    @property
    def confidence_of_candidates(self) -> float:
        """Probability that the position or a place that explains the evidence as well is right to within `NEAR_M`."""
        near = self.confidence_at_known_distance * self.share_of_near_peaks
        if self.crossing_deg >= CROSSING_DEG:
            return near
        intercept, of_margin = _DISTANCE_FIT
        return near * _probability(intercept + of_margin * self.margin)

    @property
    def share_of_near_peaks(self) -> float:
        """Share of right peaks that are nearer than `NEAR_M`; 1 unless the microphones of each array lie on a line."""
        if not self.of_lines:
            return 1.0
        return math.erf(NEAR_M / (math.sqrt(2.0) * _LINES_SPREAD_FIT * max(self.spread_m, 1e-9)))

    @property
    def weakness(self) -> float:
        """Amount by which the second array falls short of a clear peak if it determines the distance; 0 otherwise."""
        return max(0.0, CLEAR_PEAK_TO_RMS - self.second_array) if self.crossing_deg >= CROSSING_DEG else 0.0

    @property
    def lacking(self) -> float:
        """Share of the peak that is missing where the sound begins, 0 to 1; 0 if the beginning is not known."""
        if self.beginning is None or self.peak_to_rms <= 0.0:
            return 0.0
        return max(0.0, 1.0 - self.beginning / (_BEGUN * self.peak_to_rms))

    @property
    def confidence_at_known_distance(self) -> float:
        """Probability that the position is right to within `NEAR_M` if the arrays determine its distance."""
        intercept, of_margin, of_ratio = _WHOLE_SEGMENT_FIT if self.whole else _ONSET_FIT
        log_odds = intercept + of_margin * self.margin + of_ratio * self.peak_to_rms
        lost = _BACKGROUND_FIT * self.background + _BEGINNING_FIT * self.lacking + _WEAK_FIT * self.weakness
        lost += _DISAGREEMENT_FIT * max(0.0, self.disagreement - AGREED)
        return _probability(log_odds - lost)

    @property
    def is_sure(self) -> bool:
        """True if a second look would hardly improve the answer: see `SURE`."""
        return self.confidence_of_candidates >= SURE and self.second_array >= CLEAR_PEAK_TO_RMS

    @property
    def has_direction(self) -> bool:
        """True if the position stands out from noise, so that at least its direction means something."""
        return self.peak_to_rms >= 1.0


@dataclass(frozen=True, slots=True)
class Rivals:
    """Other places that explain the evidence about as well as a position.

    Parameters
    ----------
    share : float
        Probability of the position, and of places nearer than `NEAR_M`, among all of them.
    candidates : tuple of Candidate
        The position, and then the other places, most probable first; their probabilities sum to 1.
    spread_m2 : (3, 3) float64
        Second moment of the rivals nearer than `NEAR_M` about the position, square metres. They count as the same
        answer, so they are added to its covariance.
    reason : str or None
        Reason, in words, for the other places; None without other places.
    """

    share: float
    candidates: tuple[Candidate, ...]
    spread_m2: FloatArray
    reason: str | None = None

    @property
    def is_ambiguous(self) -> bool:
        """True if the position is too improbable to be reported without the other places."""
        return self.share < LEAST_CONFIDENCE


@dataclass(frozen=True, slots=True)
class Judgement:
    """The certainty of a position.

    Parameters
    ----------
    covariance_m2 : (3, 3) float64
        Square metres.
    features : ConfidenceFeatures
    refused : str or None
        Reason, in words, not to rely on the position or its `candidates`; None if they can be relied on.
    candidates : tuple of Candidate
        The position and the places that explain the evidence about as well; empty if the position is clearly the best.
    ambiguity : str or None
        Reason, in words, for the candidates; None without candidates.
    """

    covariance_m2: FloatArray
    features: ConfidenceFeatures
    refused: str | None
    candidates: tuple[Candidate, ...] = ()
    ambiguity: str | None = None


def judge(
    functional: SRPFunctional,
    evidence: Sequence[Evidence],
    position_m: FloatArray,
    power: float,
    rival_power: float,
    grid: Grid,
    *,
    whole: bool = False,
    rivals: Rivals | None = None,
) -> Judgement:
    """Judge a position.

    Parameters
    ----------
    functional : SRPFunctional
        SRP of the evidence.
    evidence : sequence of Evidence
    position_m : (3,) float64
        Position at which the functional is highest.
    power, rival_power : float
        Value of the functional at the position, and the highest power outside its `refine.neighbourhood`.
    grid : Grid
        Search grid.
    whole : bool
        Whether the evidence includes whole segments.
    rivals : Rivals or None
        Other places that explain the evidence about as well.
    """
    terms = functional.pair_terms(position_m)
    ratios = sorted(peak_to_rms(part, array_power(part, term)) for part, term in zip(evidence, terms, strict=True))
    covariance_m2 = refine.laplace_covariance_m2(functional, evidence, position_m, grid)
    covariance_m2 *= _INFLATION * np.sqrt(len(evidence))
    covariance_m2 *= min(1.0, _residual_misfit(evidence, terms, len(grid.free_axes)) / _CALIBRATED_MISFIT) ** 2
    covariance_m2 += refine.placement_covariance_m2(functional, position_m, _PLACED_M, grid)
    for axis in grid.free_axes:
        covariance_m2[axis, axis] += _LEAST_DEVIATION_M**2
    sighting = [part.spec for part in evidence if _has_line_of_sight(part.spec, grid, functional.c_m_s)]
    features = ConfidenceFeatures(
        refine.margin(power, rival_power),
        sum(ratios),
        crossing_deg(sighting, position_m),
        ratios[-2] if len(ratios) > 1 else 0.0,
        whole,
        1.0 if rivals is None else rivals.share,
        _background_share(evidence, position_m, power, functional.c_m_s),
        _beginning(evidence, position_m, functional.c_m_s),
        float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance_m2)[-1]))),
        not sighting,
    )
    if rivals is not None:
        covariance_m2 += rivals.spread_m2
    ambiguous = rivals is not None and rivals.is_ambiguous
    confidence = features.confidence_of_candidates if ambiguous else features.confidence
    refused = None
    if confidence < LEAST_CONFIDENCE:
        refused = f"confidence {confidence:.2f} is below the threshold of {LEAST_CONFIDENCE:.2f}"
    if rivals is None or not ambiguous:
        return Judgement(covariance_m2, features, refused)
    return Judgement(covariance_m2, features, refused, rivals.candidates, rivals.reason)


def background_power(evidence: Sequence[Evidence], position_m: FloatArray, c_m_s: float) -> tuple[float, float]:
    """Return the background's power at a position and its root mean square anywhere; 0 and 0 if it is not known."""
    known = [
        replace(part, gcc=replace(part.gcc, values=part.background)) for part in evidence if part.background is not None
    ]
    if not known:
        return 0.0, 0.0
    square = 0.0
    for part in known:
        of_pairs = np.square(part.gcc.values).mean(axis=1, dtype=np.float64).sum()
        square += pair_weight(len(part.spec.microphones_m)) ** 2 * float(of_pairs)
    return float(SRPFunctional(known, c_m_s).value(position_m[None])[0]), float(np.sqrt(square))


def _background_share(evidence: Sequence[Evidence], position_m: FloatArray, power: float, c_m_s: float) -> float:
    """Return the share of the power at a position, beyond chance, that the background has; at least 0."""
    if power <= 0.0:
        return 0.0
    there, rms = background_power(evidence, position_m, c_m_s)
    return max(0.0, there - _BACKGROUND_RMS * rms) / power


def _beginning(evidence: Sequence[Evidence], position_m: FloatArray, c_m_s: float) -> float | None:
    """Return the peak-to-RMS ratio of the beginning at a position; None if the beginning is not known."""
    known = [part.beginning for part in evidence if part.beginning is not None]
    if not known:
        return None
    terms = SRPFunctional(known, c_m_s).pair_terms(position_m)
    return sum(peak_to_rms(part, array_power(part, term)) for part, term in zip(known, terms, strict=True))


def _has_line_of_sight(spec: ArraySpec, grid: Grid, c_m_s: float) -> bool:
    """Return whether an array alone gives a line of sight; microphones on a line give a cone, except in a plane."""
    flat = flatness([spec], c_m_s)
    return flat is None or not flat.is_line or len(grid.free_axes) < 3


def _residual_misfit(evidence: Sequence[Evidence], terms: Sequence[PairTerms], axes: int) -> float:
    """Return the pairs' disagreement about a position with `axes` free coordinates, as a share of the noise; 0 to 1.

    There are more delays than coordinates. If the pairs disagree, the slopes R' of their GCCs at the position are not
    0. The misfit is the mean square slope, corrected for the delays that the coordinates use up, over s^2 kappa:
    s^2 is the mean square of the GCCs away from the peak, and kappa = sum (-R'') / sum R the mean square angular
    frequency.
    """
    slope, noise, delays = 0.0, 0.0, 0
    for part, term in zip(evidence, terms, strict=True):
        live = np.any(part.gcc.values, axis=1)
        if live.any():
            slope += float(np.square(term.slope[live]).mean())
            noise += refine.noise(part, term, live)
            delays += len(np.unique(part.gcc.pairs[live])) - 1
    height = sum(float(term.values.sum()) for term in terms)
    hill = sum(float(np.maximum(-term.curvature, 0.0).sum()) for term in terms)
    if delays <= axes or height <= 0.0 or noise * hill <= 0.0:
        return 1.0
    return min(1.0, slope / (noise * hill / height) * delays / (delays - axes))


def crossing_deg(specs: Sequence[ArraySpec], position_m: FloatArray) -> float:
    """Return the largest angle between lines from two arrays to a position, 0 to 90 degrees; 0 for one array."""
    if len(specs) < 2:
        return 0.0
    lines = np.stack([position_m - spec.centre_m for spec in specs])
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-9)
    return float(np.degrees(np.arccos(np.clip(np.abs(lines @ lines.T).min(), 0.0, 1.0))))


def _probability(log_odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-max(log_odds, _LEAST_LOG_ODDS))))


def peak_to_rms(evidence: Evidence, power: float) -> float:
    """Return the peak-to-RMS ratio of an array whose SRP has this power: the power over the RMS of its GCCs.

    Pairs of a dead microphone, which are all zeros, do not count.
    """
    values = evidence.gcc.values
    square = np.einsum("pl,pl->p", values, values)
    live = np.count_nonzero(square)
    noise = float(np.sqrt(square.sum(dtype=np.float64) / (live * values.shape[1]))) if live else 0.0
    return max(0.0, power) / (_FITTED_DELAYS * noise) if live else 0.0


def array_power(evidence: Evidence, term: PairTerms) -> float:
    """Return an array's SRP at a point from the terms of its pairs there."""
    return pair_weight(len(evidence.spec.microphones_m)) * float(term.values.sum())
