"""Two sources that sound together are both found; one source yields no second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, band_mean_cos, burst, heard, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate.estimator import Course, Localization, Sound
from livessl.core.locate.frame_gccs import FrameGCCs
from livessl.core.locate.onset import Onset
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import highest_place
from livessl.core.locate.second_source import SecondSourceFeatures, SecondSourceSearch
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
    late: int = 0,
) -> dict[str, Sound]:
    """Sounds of sources that sound together, each given by position and level; a second source is wanted if `apart`.

    The first sounds in all `frames`, the second in eight of them from frame `late` on.
    """
    frame, sounds = round(FRAME_S * RATE_HZ), {}
    for number, spec in enumerate(specs):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (4, frames * frame)).astype(np.float32)
        for seed, (place_m, level) in enumerate(sources):
            first, length = (late * frame, min(8, frames - late) * frame) if seed else (0, frames * frame)
            samples[:, first : first + length] += np.float32(level) * heard(spec, place_m, burst(length, seed))
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
    """The second one begins while the first one goes on: it has an onset of its own."""
    found = estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, level)], frames=11, late=3))
    (second,) = found.others
    places = sorted([(found, ONE_M), (second, OTHER_M)], key=lambda pair: error_m(*pair))
    if error_m(*places[0]) > 0.5:
        places = [(found, OTHER_M), (second, ONE_M)]
    for one, place_m in places:
        assert error_m(one, place_m) < 0.1  # each disturbs the phases of the other
    assert found.confidence > 0.8
    assert found.refused is None
    assert 0.8 <= second.confidence <= 1.0
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


def frames_of(spec: ArraySpec, axis_s: FloatArray, values: FloatArray, scale: float = 1.0, quiet: int = 0) -> FrameGCCs:
    """Frames with these GCCs, the first of which are the pre-roll."""
    count = len(values)
    is_quiet = np.arange(count) < quiet
    return FrameGCCs(
        spec, axis_s, values.astype(np.float32) * np.float32(scale), np.full(count, scale), np.ones(count), is_quiet
    )


def test_prominence_is_high_only_at_the_source_and_in_a_frame_in_which_it_sounds() -> None:
    """The first source sounds in eight frames, the second alone in one more."""
    axis_s = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S).fine_lags_s
    first_s, second_s, elsewhere_s = (
        true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M, [0.3, 0.4, 2])
    )
    first, second = (band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz) for lags_s in (first_s, second_s))
    values = np.stack([first] * 8 + [second])
    for scale in (1.0, 1e3):
        remainder = frames_of(NORTH, axis_s, values, scale).without(first_s)
        above_all, above_noise = remainder.prominences(second_s)
        rms = float(np.sqrt(np.square(second).mean()))
        assert above_noise.argmax() == above_all.argmax() == 8
        assert above_noise[8] == pytest.approx(1.0 / rms, rel=0.2)  # removing the first takes a sixth of one pair along
        assert above_all[8] > 0.8 * above_noise[8]  # the first is silent there, and so are its reflections
        assert remainder.prominences(elsewhere_s)[1][8] < 0.5 * above_noise[8]
        assert max(above_noise[:8]) < 0.1 * above_noise[8]


def test_what_is_weaker_than_the_first_source_in_its_own_frame_may_be_a_reflection() -> None:
    axis_s = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S).fine_lags_s
    first_s, second_s = (true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M))
    first, second = (band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz) for lags_s in (first_s, second_s))
    remainder = frames_of(NORTH, axis_s, np.stack([first + 0.6 * second, second])).without(first_s)
    above_all, above_noise = remainder.prominences(second_s)
    assert above_noise.min() > 1.5
    assert above_all[0] < 0.7 < 1.5 < above_all[1]


def test_what_was_there_before_the_sound_is_no_source() -> None:
    """A fan is received alone before the sound, together with it, and alone after it."""
    axis_s = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S).fine_lags_s
    first_s, fan_s = (true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M))
    first, fan = (band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz) for lags_s in (first_s, fan_s))
    values = np.stack([0.3 * fan] * 4 + [10.0 * first] * 2 + [0.3 * fan] * 2)
    steady = frames_of(NORTH, axis_s, values, quiet=4).without(first_s)
    assert max(steady.prominences(fan_s)[0]) < 0.5
    values[:4] = 0.0
    began = frames_of(NORTH, axis_s, values, quiet=4).without(first_s)
    assert max(began.prominences(fan_s)[0]) > 2.0


def test_a_pair_that_receives_both_sources_alike_does_not_count() -> None:
    """Unequal clocks and wrong geometry leave a remainder beside the first source."""
    axis_s = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S).fine_lags_s
    first_s = true_lags_s(NORTH.microphones_m, ONE_M)
    values = band_mean_cos(axis_s - (first_s + np.linspace(-5e-5, 5e-5, 6))[:, None], NORTH.band_hz)[None]
    remainder = frames_of(NORTH, axis_s, values).without(first_s)
    assert max(remainder.prominences(first_s + 3e-5)[1]) == 0.0


def test_a_place_that_is_not_the_highest_of_the_remainder_is_no_source() -> None:
    clear = SecondSourceFeatures(above_all=2.0, above_noise=2.0, margin=0.2, peak_to_rms=2.0)
    assert clear.confidence > 0.99
    assert replace(clear, margin=0.0).confidence == 0.0
    assert replace(clear, above_all=0.5).confidence < 0.5  # a reflection of the first source


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
        values = np.stack([first + 0.25 * left] * 8 + [second])
        frames.append(frames_of(spec, axis_s, values, 1e3))
        evidence.append(Evidence(spec, GCC(microphone_pairs(4), axis_s, values.mean(axis=0).astype(np.float32))))
        search.prepare(spec.name, axis_s)
    place = highest_place(evidence, search, GRID, C_M_S)
    assert np.linalg.norm(place.position_m - ONE_M) < 0.1
    without = [each.without(true_lags_s(each.spec.microphones_m, ONE_M)).evidence() for each in frames]
    rest = highest_place(without, search, GRID, C_M_S)
    assert np.linalg.norm(rest.position_m - left_m) < 0.1  # it is the highest
    other, features = SecondSourceSearch(search, GRID, C_M_S).beside(place, frames)
    assert np.linalg.norm(other.position_m - OTHER_M) < 0.1
    assert features.prospect > 0.9


PAIRS = [
    ArraySpec(f"pair{k}", np.array([at_m, at_m + np.eye(3)[k % 3]]), NORTH.band_hz)
    for k, at_m in enumerate(
        np.array([[0.2, 0.3, 0.4], [3, 0.2, 1], [3.9, 3, 0.5], [0.4, 4.5, 1], [3, 4.0, 1.4], [2, 2, 2.4]])
    )
]
"""Six pairs of microphones a metre apart, along the axes of the room."""


@pytest.mark.parametrize("seed", range(4))
def test_one_clap_among_strong_reflections_has_no_second_source_at_pairs_of_microphones(seed: int) -> None:
    """Any two hyperboloids cross: a reflection at each of two arrays gives a place at which nothing was."""
    rng = np.random.default_rng(seed)
    source_m = rng.uniform([0.5, 0.5, 0.4], [3.7, 4.6, 2.2])
    images_m = [
        source_m * [1, 1, -1],
        source_m * [-1, 1, 1],
        [8.4, 0, 0] - source_m * [1, -1, -1],
        source_m * [1, -1, 1],
    ]
    frame, everywhere = round(FRAME_S * RATE_HZ), Onset(PAIRS, GRID, C_M_S)
    sounds = {}
    for number, spec in enumerate(PAIRS):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (2, 16 * frame)).astype(np.float32)
        clap = burst(1200, seed)
        for late, image_m in enumerate([source_m, *images_m]):
            first = 8 * frame + round(late * rng.uniform(0.002, 0.006) * RATE_HZ)
            samples[:, first : first + 1200] += np.float32(rng.uniform(0.5, 0.8) if late else 1.0) * heard(
                spec, image_m, clap
            )
        front_end = everywhere.onset_front_end(spec.name, RATE_HZ)
        onsets = tuple(front_end.push(part, quiet=k < 8) for k, part in enumerate(np.split(samples, 16, axis=1)))
        course = Course(np.arange(16), np.ones(16), 8)
        sounds[spec.name] = Sound((samples[:, 8 * frame :],), RATE_HZ, onsets, sources=2, course=course)
    assert everywhere.locate(sounds).others == ()


@pytest.mark.parametrize("level", [0.5, 0.25])
def test_each_source_has_its_own_level(estimator: Onset, level: float) -> None:
    """The first sounds from the beginning, the second when it is over; frames have the power of what sounds in them."""
    frame, sounds = round(FRAME_S * RATE_HZ), {}
    for number, spec in enumerate((NORTH, SOUTH)):
        samples = np.random.default_rng(number).normal(0.0, 1e-4, (4, 24 * frame)).astype(np.float32)
        samples[:, 8 * frame : 16 * frame] += heard(spec, ONE_M, burst(8 * frame))
        samples[:, 16 * frame :] += np.float32(level) * heard(spec, OTHER_M, burst(8 * frame, 1))
        parts = np.split(samples, 24, axis=1)
        front_end = estimator.onset_front_end(spec.name, RATE_HZ)
        onsets = tuple(front_end.push(part, quiet=k < 8) for k, part in enumerate(parts))
        course = Course(np.arange(24), np.array([float(np.square(part).mean()) for part in parts]), 8)
        sounds[spec.name] = Sound((samples[:, 8 * frame :],), RATE_HZ, onsets, sources=2, course=course)
    found = estimator.locate(sounds)
    (second,) = found.others
    assert error_m(found, ONE_M) < 0.1
    assert error_m(second, OTHER_M) < 0.1
    assert found.power is not None
    assert second.power is not None
    assert 10.0 * np.log10(second.power / found.power) == pytest.approx(20.0 * np.log10(level), abs=1.5)


def test_no_second_source_is_returned_unless_wanted(estimator: Onset) -> None:
    assert estimator.locate(sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)], apart=False)).others == ()


def test_one_array_alone_finds_no_second_source(estimator: Onset) -> None:
    sounds = sounds_of(estimator, [(ONE_M, 1.0), (OTHER_M, 1.0)])
    assert estimator.locate({"north": sounds["north"]}).others == ()
