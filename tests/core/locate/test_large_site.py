"""Arrays with the right poses agree in halls and yards, and errors are as large as the covariance says."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Sound
from livessl.core.locate.onset import Onset
from livessl.core.types import FRAME_S

FRAME = round(FRAME_S * RATE_HZ)
QUIET, ACTIVE = 8, 4
CHI2_3 = 16.3
"""99.9 % of the chi-squared distribution of three degrees of freedom."""


@settings(max_examples=4, deadline=None)
@given(size_m=st.floats(40.0, 250.0), height_m=st.floats(4.0, 12.0), seed=st.integers(0, 1 << 30))
def test_arrays_that_are_right_are_no_outliers(size_m: float, height_m: float, seed: int) -> None:
    """Three arrays at least a quarter of the site apart receive a shot from anywhere on the ground."""
    rng = np.random.default_rng(seed)
    centres_m = np.array([[0.15, 0.2], [0.85, 0.25], [0.5, 0.85]]) + rng.uniform(-0.1, 0.1, (3, 2))
    arrays = [
        tetra(name, [*(size_m * at), rng.uniform(2.0, height_m - 1.0)], 0.5, rng.uniform(0.0, 360.0))
        for name, at in zip("abc", centres_m, strict=True)
    ]
    grid = Grid(((0.0, size_m), (0.0, size_m), (0.0, height_m)), 0.5)
    source_m = np.array([*rng.uniform(0.05, 0.95, 2) * size_m, 1.5])
    estimator, shot = Onset(arrays, grid, C_M_S), np.zeros((QUIET + ACTIVE) * FRAME)
    shot[QUIET * FRAME :] = burst(ACTIVE * FRAME, seed)
    sounds = {}
    for spec in arrays:
        noise = rng.normal(0.0, 3e-4, (4, len(shot)))
        samples = (heard(spec, source_m, shot) + noise).astype(np.float32)
        front_end = estimator.onset_front_end(spec.name, RATE_HZ)
        parts = np.split(samples, QUIET + ACTIVE, axis=1)
        onsets = tuple(front_end.push(part, quiet=k < QUIET) for k, part in enumerate(parts))
        sounds[spec.name] = Sound((samples[:, QUIET * FRAME :],), RATE_HZ, onsets)
    found = estimator.locate(sounds)
    assert found.outliers == {}
    error_m = found.position_m - source_m
    assert error_m @ np.linalg.solve(found.covariance_m2, error_m) < CHI2_3
    assert np.linalg.norm(error_m) < 0.02 * size_m
