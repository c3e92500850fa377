"""Two sources at once: both found, and of one source no second made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, band_mean_cos, burst, heard, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import LagSampling, microphone_pairs
from livessl.core.geometry import Grid
from livessl.core.locate.estimators import Localization, Onset, Sound
from livessl.core.locate.second_source import Moments, clearness, confidence
from livessl.core.types import FRAME_S, GCC, ArraySpec, Evidence, FloatArray

GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
NORTH = tetra("north", [2.7, 4.4, 1.1])
SOUTH = tetra("south", [2.3, 0.9, 1.5], yaw_deg=71.0)
EAST = tetra("east", [3.9, 2.6, 2.1], yaw_deg=-40.0)
WEST = tetra("west", [0.4, 2.4, 1.9], yaw_deg=130.0)
ONE_M = np.array([1.13, 3.31, 0.83])
OTHER_M = np.array([3.41, 2.27, 1.72])


@pytest.fixture(scope="module")
def estimator() -> Onset:
    return Onset([NORTH, SOUTH], GRID, C_M_S)


def sounds_of(
    estimator: Onset,
    sources: Sequence[tuple[FloatArray, float]],
    *,
    apart: bool = True,
    specs: Sequence[ArraySpec] = (NORTH, SOUTH),
    frames: int = 8,
) -> dict[str, Sound]:
    """What is heard of sources that sound together, each of a level, frame by frame; or only all frames together.

    The first sounds in all `frames`, a second in eight.
    """
    frame, sounds = round(FRAME_S * RATE_HZ), {}
    for number, spec in enumerate(specs):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (4, frames * frame)).astype(np.float32)
        for seed, (place_m, level) in enumerate(sources):
            length = (8 if seed else frames) * frame
            samples[:, :length] += np.float32(level) * heard(spec, place_m, burst(length, seed))
        front_end = estimator.listener(spec.name, RATE_HZ)
        silence = np.random.default_rng(9).normal(0.0, 1e-4, (4, 8 * frame)).astype(np.float32)
        front_end.push(silence, quiet=True)
        moments = tuple(front_end.push(part, quiet=False) for part in np.split(samples, frames, axis=1))
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


def test_one_source_has_no_second_however_many_arrays_hear_it(estimator: Onset) -> None:
    specs = [NORTH, SOUTH, EAST, WEST]
    everywhere = Onset(specs, GRID, C_M_S)
    assert everywhere.locate(sounds_of(everywhere, [(ONE_M, 1.0)], specs=specs)).others == ()
    (second,) = everywhere.locate(sounds_of(everywhere, [(ONE_M, 1.0), (OTHER_M, 1.0)], specs=specs)).others
    assert min(error_m(second, place_m) for place_m in (ONE_M, OTHER_M)) < 0.1


def test_a_short_sound_beside_a_long_one_is_not_refused(estimator: Onset) -> None:
    found = estimator.locate(sounds_of(estimator, [(ONE_M, 0.3), (OTHER_M, 1.0)], frames=80))
    (second,) = found.others
    assert found.refused is None
    assert error_m(found, OTHER_M) < 0.1
    assert error_m(second, ONE_M) < 0.1


def test_a_source_is_clear_where_it_is_and_in_the_moment_it_has() -> None:
    """In eight moments the first alone, in one the second too: its share there, and nothing of it elsewhere."""
    sampling = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S)
    axis_s = sampling.fine_lags_s
    first_s, second_s, elsewhere_s = (
        true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M, [0.3, 0.4, 2])
    )

    def of(lags_s: FloatArray) -> FloatArray:
        return band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz)

    values = np.stack([of(first_s)] * 8 + [of(first_s) + of(second_s)]).astype(np.float32)
    for scale in (1.0, 1e3):
        moments = Moments(NORTH, axis_s, values * np.float32(scale), np.full(9, scale))
        clear = moments.clearness(second_s, first_s)
        rms = float(np.sqrt(np.square(values[-1]).mean()))
        assert clear == pytest.approx(1.0 / rms, rel=0.2)  # the share of the first takes a sixth of one pair along
        assert moments.clearness(elsewhere_s, first_s) < 0.5 * clear
        alone = Moments(NORTH, axis_s, values[:8] * np.float32(scale), np.full(8, scale))
        assert alone.clearness(second_s, first_s) < 0.1 * clear


def test_two_arrays_must_hear_a_second_source_clearly() -> None:
    assert confidence(clearness([2.5, 2.5])) == confidence(clearness([2.5, 0.0, 2.5, 1.0])) > 0.9
    assert confidence(clearness([3.0, 0.0])) < 0.5
    assert confidence(clearness([1.0, 1.0, 1.0, 1.0, 1.0])) < 0.1


def test_of_places_that_stand_high_the_one_that_is_clear_in_a_moment_is_told(estimator: Onset) -> None:
    """In eight moments the first, and somewhere else what reverberation leaves; in one the second."""
    left_m, evidence, moments = np.array([1.9, 1.1, 2.2]), [], []
    for spec in (NORTH, SOUTH):
        axis_s = LagSampling.shared(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S).fine_lags_s
        first, second, left = (
            band_mean_cos(axis_s - true_lags_s(spec.microphones_m, at_m)[:, None], spec.band_hz)
            for at_m in (ONE_M, OTHER_M, left_m)
        )
        values = np.stack([first + 0.25 * left] * 8 + [second]).astype(np.float32)
        moments.append(Moments(spec, axis_s, values, np.full(9, 1e3)))
        evidence.append(Evidence(spec, GCC(microphone_pairs(4), axis_s, values.mean(axis=0))))
        estimator.listener(spec.name, RATE_HZ)
    place = estimator._place(evidence)
    assert np.linalg.norm(place.position_m - ONE_M) < 0.1
    rest = estimator._place([each.without(true_lags_s(each.spec.microphones_m, ONE_M)) for each in moments])
    assert np.linalg.norm(rest.position_m - left_m) < 0.1  # it stands highest
    other, confidence = estimator._beside(place, moments)
    assert np.linalg.norm(other.position_m - OTHER_M) < 0.1
    assert confidence > 0.9


def test_nobody_asked_for_a_second(estimator: Onset) -> None:
    assert estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)], apart=False)).others == ()


def test_one_array_tells_no_second(estimator: Onset) -> None:
    sounds = sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)])
    assert estimator.locate({"north": sounds["north"]}).others == ()
