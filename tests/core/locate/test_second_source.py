"""Two sources that sound together are both found; one source yields no second."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, band_mean_cos, burst, heard, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import LagSampling, microphone_pairs
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import highest_place
from livessl.core.locate.second_source import FrameGCCs, SecondSourceSearch, confidence, prominence
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
    """Sounds of sources that sound together, each given by position and level; a second source is wanted if `apart`.

    The first sounds in all `frames`, the second in eight.
    """
    frame, sounds = round(FRAME_S * RATE_HZ), {}
    for number, spec in enumerate(specs):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (4, frames * frame)).astype(np.float32)
        for seed, (place_m, level) in enumerate(sources):
            length = (8 if seed else frames) * frame
            samples[:, :length] += np.float32(level) * heard(spec, place_m, burst(length, seed))
        front_end = estimator.onset_front_end(spec.name, RATE_HZ)
        silence = np.random.default_rng(9).normal(0.0, 1e-4, (4, 8 * frame)).astype(np.float32)
        front_end.push(silence, quiet=True)
        onsets = tuple(front_end.push(part, quiet=False) for part in np.split(samples, frames, axis=1))
        sounds[spec.name] = Sound((samples,), RATE_HZ, onsets, sources=2 if apart else 1)
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
        assert error_m(one, place_m) < 0.1  # each disturbs the phases of the other
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


def test_one_source_has_no_second_with_four_arrays(estimator: Onset) -> None:
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


def test_prominence_is_high_only_at_the_source_and_in_a_frame_in_which_it_sounds() -> None:
    """The first source sounds alone in eight frames, with the second in one."""
    sampling = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S)
    axis_s = sampling.fine_lags_s
    first_s, second_s, elsewhere_s = (
        true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M, [0.3, 0.4, 2])
    )

    def of(lags_s: FloatArray) -> FloatArray:
        return band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz)

    values = np.stack([of(first_s)] * 8 + [of(first_s) + of(second_s)]).astype(np.float32)
    for scale in (1.0, 1e3):
        frames = FrameGCCs(NORTH, axis_s, values * np.float32(scale), np.full(9, scale))
        clear = frames.prominence(second_s, first_s)
        rms = float(np.sqrt(np.square(values[-1]).mean()))
        assert clear == pytest.approx(1.0 / rms, rel=0.2)  # removing the first takes a sixth of one pair along
        assert frames.prominence(elsewhere_s, first_s) < 0.5 * clear
        alone = FrameGCCs(NORTH, axis_s, values[:8] * np.float32(scale), np.full(8, scale))
        assert alone.prominence(second_s, first_s) < 0.1 * clear


def test_a_second_source_must_be_prominent_at_two_arrays() -> None:
    assert confidence(prominence([2.5, 2.5])) == confidence(prominence([2.5, 0.0, 2.5, 1.0])) > 0.9
    assert confidence(prominence([3.0, 0.0])) < 0.5
    assert confidence(prominence([1.0, 1.0, 1.0, 1.0, 1.0])) < 0.1


def test_the_place_that_is_prominent_in_a_frame_wins_over_a_higher_one() -> None:
    """Eight frames hold the first source and a remainder of reverberation elsewhere, one frame the second source."""
    left_m, evidence, frames = np.array([1.9, 1.1, 2.2]), [], []
    search = PeakSearch([NORTH, SOUTH], GRID, C_M_S)
    for spec in (NORTH, SOUTH):
        axis_s = LagSampling.shared(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S).fine_lags_s
        first, second, left = (
            band_mean_cos(axis_s - true_lags_s(spec.microphones_m, at_m)[:, None], spec.band_hz)
            for at_m in (ONE_M, OTHER_M, left_m)
        )
        values = np.stack([first + 0.25 * left] * 8 + [second]).astype(np.float32)
        frames.append(FrameGCCs(spec, axis_s, values, np.full(9, 1e3)))
        evidence.append(Evidence(spec, GCC(microphone_pairs(4), axis_s, values.mean(axis=0))))
        search.prepare(spec.name, axis_s)
    place = highest_place(evidence, search, GRID, C_M_S)
    assert np.linalg.norm(place.position_m - ONE_M) < 0.1
    without = [each.without(true_lags_s(each.spec.microphones_m, ONE_M)) for each in frames]
    rest = highest_place(without, search, GRID, C_M_S)
    assert np.linalg.norm(rest.position_m - left_m) < 0.1  # it is the highest
    other, confidence = SecondSourceSearch(search, GRID, C_M_S).beside(place, frames)
    assert np.linalg.norm(other.position_m - OTHER_M) < 0.1
    assert confidence > 0.9


def test_no_second_source_is_returned_unless_wanted(estimator: Onset) -> None:
    assert estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)], apart=False)).others == ()


def test_one_array_alone_finds_no_second_source(estimator: Onset) -> None:
    sounds = sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)])
    assert estimator.locate({"north": sounds["north"]}).others == ()
