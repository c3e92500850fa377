"""Fits what a background takes from the confidence of `livessl.core.locate.confidence` to sounds of `noise`."""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.locate.confidence import CROSSING_DEG, NEAR_M, ConfidenceFeatures
from livessl.core.types import BoolArray, FloatArray
from livessl.lab.evaluate.localizer_report import Columns
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.noise_summary import OURS

_LEAST: Final = 1e-9
"""Probability that is added on both sides, so that its logarithm exists."""


def background_fit(columns: Columns) -> float:
    """Return the log-odds that a background costs which explains the whole power at a position.

    It maximizes the likelihood of right and wrong positions with all other constants as they are, over the sounds of
    `onset` whose distance is determined and whose position has no rivals.

    Parameters
    ----------
    columns : Columns
        Features of the confidence, and `error_m`, of the sounds of the development half.
    """
    chosen = (columns["method"] == OURS) & ~np.isin(columns["sound"], list(OTHER_SOUNDS))
    chosen &= np.nan_to_num(columns["crossing_deg"].astype(np.float64)) >= CROSSING_DEG
    chosen &= np.nan_to_num(columns["share"].astype(np.float64)) > 0.99
    right = columns["error_m"][chosen].astype(np.float64) <= NEAR_M
    background = columns["background"][chosen].astype(np.float64)
    otherwise = _log_odds_without_background(columns, chosen)
    weight = 0.0
    for _ in range(50):  # Newton's method on a concave likelihood; the ridge keeps it finite
        likely = 1.0 / (1.0 + np.exp(weight * background - otherwise))
        gradient = -float(background @ (right - likely)) - 1e-3 * weight
        curvature = float(np.square(background) @ (likely * (1.0 - likely))) + 1e-3
        weight += float(np.clip(gradient / curvature, -5.0, 5.0))
    return weight


def _log_odds_without_background(columns: Columns, chosen: BoolArray) -> FloatArray:
    names = ("margin", "standing", "crossing_deg", "second_array", "whole")
    rows = zip(*(columns[name][chosen].tolist() for name in names), strict=True)
    likely = np.array(
        [
            ConfidenceFeatures(margin, standing, crossing, second, bool(whole)).confidence_at_known_distance
            for margin, standing, crossing, second, whole in rows
        ]
    )
    return np.asarray(np.log((likely + _LEAST) / (1.0 - likely + _LEAST)))
