"""How sure a place is: a covariance, a probability, and whether to answer at all. It sees evidence, and no sound.

The numbers fitted here come from simulated events: `livessl evaluate localizer --half development`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.locate import refine
from livessl.core.locate.srp import PairTerms, SRPFunctional, pair_weight
from livessl.core.types import ArraySpec, Evidence, FloatArray

NEAR_M: Final = 0.5
"""The confidence is the probability that the place is right to within so much."""

LEAST_CONFIDENCE: Final = 0.8
"""Below it a place is refused."""

_HEARD: Final = (-3.34, 2.69, 1.03)
"""Intercept, weights of margin and standing in the log-odds of a right place, of arrays that tell distance."""

_HEARD_WHOLE: Final = (-3.56, 10.0, 0.82)
"""The same of evidence that whole segments are part of, where onsets alone were not sure."""

SURE: Final = 0.9
"""From this confidence on, onsets alone will do, if two arrays hear them."""

_HEARS: Final = 2.0
"""Of one array, a standing from which on it surely hears something: noise alone stands as high as its rms."""

_NOWHERE_ELSE: Final = (-0.04, 62.2)
"""Intercept and weight of the margin in the log-odds that no place further along is as good: of one array, or of arrays
side by side, many are."""

CROSSING_DEG: Final = 20.0
"""Where arrays' lines of sight cross at a larger angle they tell how far away a place is, whatever the margin."""

_DELAYS: Final = 3.0
"""Independent delays of the arrays of four microphones that the numbers were fitted with."""

_INFLATION: Final = 1.15
"""What noise and reflections elsewhere on the lag axis do not tell of the peak's own error, as variance, by the root of
the number of arrays: their maps are summed as they are, and the clearest should count for more."""

_DISCORD: Final = 0.4
"""Where pairs disagree by less, most of what stands elsewhere on the lag axis is no noise but the sound's own side
lobes, and the variance shrinks as the square. It is about 0.05 in free field, and 0.7 or more in a room."""

_FINEST_M: Final = 0.005
"""Standard deviation along each axis that is left however clear the evidence: reflections close upon the direct sound,
of which the lag axis tells nothing, move several arrays' places by as much."""


@dataclass(frozen=True, slots=True)
class ConfidenceFeatures:
    """What the confidence goes by.

    Parameters
    ----------
    margin : float
        How far the place stands out from the best other one: 1 - (power there) / (power here), 0 to 1.
    standing : float
        Sum over the arrays of the mean height of an array's GCCs at the place over their root mean square, never below
        0, in proportion to its independent delays: an array that disagrees, or hears only noise, adds nothing.
    crossing_deg : float
        Largest angle at which lines from two arrays cross at the place, 0 to 90; 0 for one array.
    shared : float
        The second highest of the arrays' shares of the standing; 0 for one array.
    whole : bool
        Whether whole segments are part of the evidence.
    """

    margin: float
    standing: float
    crossing_deg: float = 0.0
    shared: float = 0.0
    whole: bool = False

    @property
    def confidence(self) -> float:
        """Probability that the place is right to within `NEAR_M`: heard, and nowhere else."""
        if self.crossing_deg >= CROSSING_DEG:
            return self.heard
        intercept, of_margin = _NOWHERE_ELSE
        return self.heard * _likely(intercept + of_margin * self.margin)

    @property
    def heard(self) -> float:
        """The same, where the arrays tell distance."""
        intercept, of_margin, of_standing = _HEARD_WHOLE if self.whole else _HEARD
        return _likely(intercept + of_margin * self.margin + of_standing * self.standing)

    @property
    def is_sure(self) -> bool:
        """Whether another look at the sound is not worth its time."""
        return self.confidence >= SURE and self.shared >= _HEARS

    @property
    def tell_direction(self) -> bool:
        """Whether there is anything at the place, be it only a direction: noise alone stands as high as its rms."""
        return self.standing >= 1.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a place is worth.

    Parameters
    ----------
    covariance_m2 : (3, 3) float64
    signs : ConfidenceFeatures
    refused : str or None
        Why the place should not be relied on, where it should not.
    """

    covariance_m2: FloatArray
    features: ConfidenceFeatures
    refused: str | None


def judge(
    functional: SRPFunctional,
    evidence: Sequence[Evidence],
    position_m: FloatArray,
    power: float,
    rival_power: float,
    grid: Grid,
    *,
    whole: bool = False,
) -> Judgement:
    """Judge the place found.

    Parameters
    ----------
    functional : SRPFunctional
        Of the evidence.
    evidence : sequence of Evidence
    position_m : (3,) float64
        The highest place.
    power, rival_power : float
        The functional there, and the highest outside its `refine.neighbourhood`.
    grid : Grid
    whole : bool
        Whether whole segments are part of the evidence.
    """
    terms = functional.pair_terms(position_m)
    each = sorted(standing(heard, array_power(heard, term)) for heard, term in zip(evidence, terms, strict=True))
    features = ConfidenceFeatures(
        refine.margin(power, rival_power),
        sum(each),
        crossing_deg([heard.spec for heard in evidence], position_m),
        each[-2] if len(each) > 1 else 0.0,
        whole,
    )
    covariance_m2 = refine.laplace_covariance_m2(functional, evidence, position_m, grid)
    covariance_m2 *= _INFLATION * np.sqrt(len(evidence))
    covariance_m2 *= min(1.0, _discord(evidence, terms, len(grid.free_axes)) / _DISCORD) ** 2
    for axis in grid.free_axes:
        covariance_m2[axis, axis] += _FINEST_M**2
    refused = None
    if features.confidence < LEAST_CONFIDENCE:
        refused = (
            f"too unsure: right to within {NEAR_M:g} m by a probability of {features.confidence:.2f}, of at least "
            f"{LEAST_CONFIDENCE:g} wanted"
        )
    return Judgement(covariance_m2, features, refused)


def _discord(evidence: Sequence[Evidence], terms: Sequence[PairTerms], axes: int) -> float:
    """How far the pairs disagree about a place with so many free axes, as a share of what stands elsewhere; at most 1.

    They have more delays than the place has coordinates, and where they do not agree their slopes R' there are not 0:
    the mean square slope, with the delays that the place has used up allowed for, over s^2 kappa. s^2 is the mean
    square of the GCCs away from the peak and kappa = sum (-R'') / sum R the mean square angular frequency.
    """
    slope, noise, delays = 0.0, 0.0, 0
    for heard, term in zip(evidence, terms, strict=True):
        live = np.any(heard.gcc.values, axis=1)
        if live.any():
            slope += float(np.square(term.slope[live]).mean())
            noise += refine.noise(heard, term, live)
            delays += len(np.unique(heard.gcc.pairs[live])) - 1
    height = sum(float(term.values.sum()) for term in terms)
    hill = sum(float(np.maximum(-term.curvature, 0.0).sum()) for term in terms)
    if delays <= axes or height <= 0.0 or noise * hill <= 0.0:
        return 1.0
    return min(1.0, slope / (noise * hill / height) * delays / (delays - axes))


def crossing_deg(specs: Sequence[ArraySpec], position_m: FloatArray) -> float:
    """Largest angle at which lines from two arrays' centres cross at a place, 0 to 90 degrees; 0 for one array."""
    lines = np.stack([position_m - spec.centre_m for spec in specs])
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-9)
    return float(np.degrees(np.arccos(np.clip(np.abs(lines @ lines.T).min(), 0.0, 1.0))))


def _likely(log_odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-log_odds)))


def standing(heard: Evidence, power: float) -> float:
    """An array's share of the standing: how high its SRP, of this power, stands over what its GCCs are elsewhere.

    Silent pairs, of a microphone that was left out, are no measure of what the others are.
    """
    values = heard.gcc.values
    square = np.einsum("pl,pl->p", values, values)
    live = np.count_nonzero(square)
    noise = float(np.sqrt(square.sum(dtype=np.float64) / (live * values.shape[1]))) if live else 0.0
    return max(0.0, power) / (_DELAYS * noise) if live else 0.0


def array_power(heard: Evidence, term: PairTerms) -> float:
    """An array's SRP at a point, from its pairs' terms there."""
    return pair_weight(len(heard.spec.microphones_m)) * float(term.values.sum())
