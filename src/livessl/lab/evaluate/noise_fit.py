"""Fits constants of `livessl.core.locate.confidence` to sounds in `noise`."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import Final

import numpy as np
import scipy

from livessl.core.locate.confidence import NEAR_M, ConfidenceFeatures
from livessl.core.types import BoolArray, FloatArray
from livessl.lab.evaluate.localizer_report import Columns
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.noise_summary import OURS

_LEAST: Final = 1e-6
"""Least probability of a right and of a wrong position, so that no single sound decides."""

_RIDGE: Final = 1e-3
"""Cost of the square of each constant relative to its start, in log-likelihood, so that none is infinite where no sound
determines it."""


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """Constants of the confidence that maximize the likelihood of right and wrong positions, all others as they are.

    Parameters
    ----------
    beginning : float
        Log-odds that a beginning costs which has nothing at the position.
    weak : float
        Log-odds that each unit costs by which the second array falls short of a clear peak.
    lines_spread : float
        Factor on the standard deviation along the least certain axis where all arrays are lines.
    elsewhere : float
        Share of sounds that other sources begin, which no feature shows: without it the clear peaks of noise would
        decide the other constants.
    """

    beginning: float
    weak: float
    lines_spread: float
    elsewhere: float


_START: Final = NoiseFit(5.0, 2.0, 3.0, 0.05)

_BOUNDS: Final = ((0.0, 50.0), (0.0, 20.0), (0.2, 30.0), (0.0, 0.5))


def noise_fit(columns: Columns) -> NoiseFit:
    """Fit to the sounds of `onset` whose position has no rivals.

    Parameters
    ----------
    columns : Columns
        Features of the confidence, and `error_m`, of the sounds of the development half.
    """
    chosen = (columns["method"] == OURS) & ~np.isin(columns["sound"], list(OTHER_SOUNDS))
    chosen &= np.nan_to_num(columns["share"].astype(np.float64)) > 0.99
    right = columns["error_m"][chosen].astype(np.float64) <= NEAR_M
    features = _features(columns, chosen)
    log_odds, determined = _otherwise(features)
    lacking, weakness = (np.array([getattr(each, name) for each in features]) for name in ("lacking", "weakness"))
    spread_m = np.maximum([each.spread_m for each in features], 1e-9)
    of_lines = np.array([each.of_lines for each in features])
    start = np.array(astuple(_START))

    def cost(constants: FloatArray) -> float:
        beginning, weak, lines_spread, elsewhere = constants
        likely = scipy.special.expit(log_odds - beginning * lacking - weak * weakness) * determined
        near = scipy.special.erf(NEAR_M / (np.sqrt(2.0) * lines_spread * spread_m))
        likely *= np.where(of_lines, near, 1.0) * (1.0 - elsewhere)
        likely = np.clip(likely, _LEAST, 1.0 - _LEAST)
        ridge = _RIDGE * float(np.square(constants / start).sum())
        return ridge - float(np.where(right, np.log(likely), np.log1p(-likely)).sum())

    found = scipy.optimize.minimize(cost, start, method="Nelder-Mead", bounds=_BOUNDS, tol=1e-3)
    return NoiseFit(*(float(value) for value in found.x))


def _features(columns: Columns, chosen: BoolArray) -> list[ConfidenceFeatures]:
    """Return the features of the chosen sounds; what is null becomes NaN."""
    names = ("margin", "standing", "crossing_deg", "second_array", "background", "beginning", "spread_m")
    values = {name: columns[name][chosen].astype(np.float64) for name in names}
    return [
        ConfidenceFeatures(
            float(values["margin"][row]),
            float(values["standing"][row]),
            float(values["crossing_deg"][row]),
            float(values["second_array"][row]),
            bool(whole),
            background=float(values["background"][row]),
            beginning=None if np.isnan(values["beginning"][row]) else float(values["beginning"][row]),
            spread_m=float(values["spread_m"][row]),
            of_lines=bool(of_lines),
        )
        for row, (whole, of_lines) in enumerate(zip(columns["whole"][chosen], columns["of_lines"][chosen], strict=True))
    ]


def _otherwise(features: list[ConfidenceFeatures]) -> tuple[FloatArray, FloatArray]:
    """Log-odds without what is fitted, and the probability that the distance is determined: (N,) each."""
    bare = [replace(each, beginning=None, spread_m=0.0) for each in features]
    known = np.array([replace(each, crossing_deg=0.0).confidence_at_known_distance for each in bare])
    determined = np.array(
        [each.confidence_of_candidates / max(each.confidence_at_known_distance, _LEAST) for each in bare]
    )
    return np.asarray(scipy.special.logit(np.clip(known, _LEAST, 1.0 - _LEAST))), determined
