"""Two sources at once: both found, and of one source no second made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from free_field import C_M_S, RATE_HZ, burst, heard, tetra

from livessl.core.estimators import Localization, Onset, Sound
from livessl.core.geometry import Grid
from livessl.core.types import FRAME_S, FloatArray

GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
NORTH = tetra("north", [2.7, 4.4, 1.1])
SOUTH = tetra("south", [2.3, 0.9, 1.5], yaw_deg=71.0)
ONE_M = np.array([1.13, 3.31, 0.83])
OTHER_M = np.array([3.41, 2.27, 1.72])


@pytest.fixture(scope="module")
def estimator() -> Onset:
    return Onset([NORTH, SOUTH], GRID, C_M_S)


def sounds_of(estimator: Onset, sources: Sequence[tuple[FloatArray, float]], *, apart: bool = True) -> dict[str, Sound]:
    """What is heard of sources that sound together, each of a level, frame by frame; or only all frames together."""
    frame, sounds = round(FRAME_S * RATE_HZ), {}
    for number, spec in enumerate((NORTH, SOUTH)):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (4, 8 * frame)).astype(np.float32)
        for seed, (place_m, level) in enumerate(sources):
            samples += np.float32(level) * heard(spec, place_m, burst(8 * frame, seed))
        front_end = estimator.listener(spec.name, RATE_HZ)
        silence = np.random.default_rng(9).normal(0.0, 1e-4, (4, 8 * frame)).astype(np.float32)
        front_end.push(silence, quiet=True)
        moments = tuple(front_end.push(part, quiet=False) for part in np.split(samples, 8, axis=1))
        sounds[spec.name] = Sound((samples,), RATE_HZ, moments, sources=2 if apart else 1)
    return sounds


def error_m(found: Localization, place_m: FloatArray) -> float:
    return float(np.linalg.norm(found.position_m - place_m))


@pytest.mark.parametrize("level", [1.0, 0.7])
def test_two_sources_are_both_found(estimator: Onset, level: float) -> None:
    found = estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, level)]))
    (second,) = found.others
    places = sorted([(found, ONE_M), (second, OTHER_M)], key=lambda pair: error_m(*pair))
    if error_m(*places[0]) > 0.5:
        places = [(found, OTHER_M), (second, ONE_M)]
    for one, place_m in places:
        assert error_m(one, place_m) < 0.1  # each pulls at the other's phases: a tenth of what is asked of them
    assert found.confidence > 0.8
    assert found.refused is None
    assert 0.5 <= second.confidence <= 1.0
    assert np.linalg.eigvalsh(second.covariance_m2)[-1] < 0.5**2


@pytest.mark.parametrize("place_m", [ONE_M, OTHER_M])
def test_one_source_has_no_second(estimator: Onset, place_m: FloatArray) -> None:
    found = estimator.locate(sounds_of(estimator, [(place_m, 1.0)]))
    assert found.others == ()
    alone = estimator.locate(sounds_of(estimator, [(place_m, 1.0)], apart=False))
    np.testing.assert_array_equal(found.position_m, alone.position_m)
    assert (found.confidence, found.refused) == (alone.confidence, alone.refused)


def test_nobody_asked_for_a_second(estimator: Onset) -> None:
    assert estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)], apart=False)).others == ()


def test_one_array_tells_no_second(estimator: Onset) -> None:
    sounds = sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)])
    assert estimator.locate({"north": sounds["north"]}).others == ()
