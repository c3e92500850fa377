"""Two sources that sound together are both found; one source yields no second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, band_mean_cos, burst, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate import frame_gccs
from livessl.core.locate.estimator import Course, Localization, Sound
from livessl.core.locate.frame_gccs import FrameGCCs
from livessl.core.locate.onset import Onset
from livessl.core.locate.outliers import Consensus
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place, highest_place
from livessl.core.locate.second_source import SecondSourceFeatures, SecondSourceSearch, _powers
from livessl.core.locate.srp import SRPFunctional
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


@pytest.mark.parametrize("level", [1.0, 0.8])
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


def test_each_feature_of_a_reflection_lowers_the_confidence() -> None:
    clear = SecondSourceFeatures(above_all=2.5, above_noise=2.6, margin=0.25, explained=0.95)
    assert clear.confidence > 0.95
    for worse in (
        replace(clear, above_all=0.5, above_noise=1.0),
        replace(clear, margin=0.0),
        replace(clear, explained=0.5),
    ):
        assert worse.confidence < clear.confidence
    reflected = SecondSourceFeatures(above_all=0.6, above_noise=1.2, margin=0.15, explained=0.6)
    assert reflected.confidence < 0.1


@pytest.mark.parametrize("count", [1, 2])
def test_a_sound_may_begin_in_the_last_frames_before_its_array_is_active(count: int) -> None:
    """The onset of one source is in the last frames of the pre-roll, that of the other when the array is active."""
    sampling = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S)
    front_end = Onset([NORTH], GRID, C_M_S).onset_front_end("north", RATE_HZ)
    frame, begin = round(FRAME_S * RATE_HZ), 8
    samples = np.random.default_rng(0).normal(0.0, 1e-4, (4, 16 * frame)).astype(np.float32)
    first = (begin - 2) * frame
    samples[:, first : first + 2 * frame] += np.float32(0.3) * heard(NORTH, OTHER_M, burst(2 * frame, 1))
    samples[:, begin * frame :] += heard(NORTH, ONE_M, burst(8 * frame))
    onsets = [front_end.push(part, quiet=k < begin) for k, part in enumerate(np.split(samples, 16, axis=1))]
    loudest = int(np.argmax([onset.weight for onset in onsets[:begin]]))
    one_s, other_s = (true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M))

    def prominence(begin: int) -> float:
        course = Course(np.arange(16), np.ones(16), begin)
        frames = FrameGCCs.of(NORTH, sampling, onsets, np.ones(6, dtype=np.bool_), course)
        return float(frames.without(one_s).prominences(other_s)[0].max())

    assert prominence(loudest + count) > 2.0
    assert prominence(loudest + 6) < 0.5  # it was there long before


@pytest.mark.parametrize("louder", [1.0, 10.0])
def test_a_second_source_is_placed_by_the_frames_that_it_made(louder: float) -> None:
    """In eight frames of the first source there is reverberation elsewhere; in two the second sounds alone."""
    axis_s = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S).fine_lags_s
    first_s, second_s, left_s = (true_lags_s(NORTH.microphones_m, at_m) for at_m in (ONE_M, OTHER_M, [0.3, 0.4, 2.0]))
    first, second, left = (
        band_mean_cos(axis_s - lags_s[:, None], NORTH.band_hz) for lags_s in (first_s, second_s, left_s)
    )
    values = np.stack([louder * (first + 0.6 * left)] * 8 + [second] * 2)
    remainder = frames_of(NORTH, axis_s, values, 1e3).without(first_s)

    def heights(evidence: Evidence) -> list[float]:
        at = [np.abs(axis_s - lags_s[:, None]).argmin(axis=1) for lags_s in (second_s, left_s)]
        return [float(evidence.gcc.values[np.arange(6), each].mean()) for each in at]

    equal, own = heights(remainder.evidence()), heights(remainder.evidence_of(second_s))
    assert equal[0] < equal[1]
    assert own[0] > 3.0 * own[1]


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
    assert features.confidence > 0.9


@pytest.mark.parametrize("off_m", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.4), (0.5, 0.6, -0.2)])
def test_a_first_source_that_was_found_aside_moves_to_where_it_is_clear(off_m: tuple[float, float, float]) -> None:
    """Both sources together may lead to a place between them; each one sounds alone in some frames."""
    search, frames, evidence = PeakSearch([NORTH, SOUTH], GRID, C_M_S), [], []
    for spec in (NORTH, SOUTH):
        axis_s = LagSampling.shared(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S).fine_lags_s
        one, other = (
            band_mean_cos(axis_s - true_lags_s(spec.microphones_m, at_m)[:, None], spec.band_hz)
            for at_m in (ONE_M, OTHER_M)
        )
        values = np.stack([one + 0.3 * other] * 3 + [one] * 3 + [other] * 3)
        frames.append(frames_of(spec, axis_s, values, 1e3))
        evidence.append(Evidence(spec, GCC(microphone_pairs(4), axis_s, values.mean(axis=0).astype(np.float32))))
        search.prepare(spec.name, axis_s)
    aside = replace(highest_place(evidence, search, GRID, C_M_S), position_m=ONE_M + off_m)
    found = SecondSourceSearch(search, GRID, C_M_S).most_likely(aside, frames)
    places_m = sorted([found.first.position_m, found.second.position_m], key=lambda at_m: np.linalg.norm(at_m - ONE_M))
    assert np.linalg.norm(places_m[0] - ONE_M) < 0.1
    assert np.linalg.norm(places_m[1] - OTHER_M) < 0.1
    assert found.features.confidence > 0.9


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


@pytest.mark.parametrize("left_out", ["east", "north"])
def test_a_place_has_the_power_of_the_arrays_that_the_sources_are_separated_by(left_out: str) -> None:
    """Not that of the arrays it was found by, of which an outlier, or one of many arrays, is not among them."""
    specs = (EAST, NORTH, SOUTH)
    evidence = tuple(Evidence(spec, ideal_gcc(spec, true_lags_s(spec.microphones_m, ONE_M))) for spec in specs)
    used = tuple(part for part in evidence if part.spec.name != left_out)
    search = PeakSearch(specs, GRID, C_M_S)
    for part in evidence:
        search.prepare(part.spec.name, part.gcc.lags_s)
    place = highest_place(evidence, search, GRID, C_M_S)
    onset = OnsetGCC(np.zeros((6, 3), dtype=np.complex64), np.ones(4))
    sounds = {part.spec.name: Sound((), RATE_HZ, (onset,), sources=2) for part in used}
    examined: list[Place] = []

    class Recording(SecondSourceSearch):
        def find(self, first: Place, frames: Sequence[FrameGCCs]) -> None:
            examined.append(first)

    def frames_of(part: Evidence) -> FrameGCCs:
        values = part.gcc.values[None]
        return FrameGCCs(part.spec, part.gcc.lags_s, values, np.ones(1), np.ones(1), np.zeros(1, dtype=np.bool_))

    Recording(search, GRID, C_M_S).separate(Consensus(place), used, sounds, frames_of)
    (first,) = examined
    alone = highest_place(used, search, GRID, C_M_S)
    assert first.power == pytest.approx(alone.power, rel=1e-2)
    assert first.rival_power == pytest.approx(alone.rival_power, rel=1e-2)
    assert first.power < 0.8 * place.power


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), height=st.floats(0.05, 0.4))
def test_a_second_source_that_is_clear_in_no_frame_has_its_share_of_the_power(seed: int, height: float) -> None:
    """It is weaker than the first in every frame, so that its part may be reflections; the first keeps its level."""
    rng = np.random.default_rng(seed)
    places, frames = [], []
    for spec in (NORTH, SOUTH):
        whole = ideal_gcc(spec, true_lags_s(spec.microphones_m, ONE_M))
        other = ideal_gcc(spec, true_lags_s(spec.microphones_m, OTHER_M))
        levels = np.array([1.0, 0.7])[:, None, None]
        values = (levels * (whole.values + height * other.values)).astype(np.float32)
        values += 0.02 * rng.standard_normal(values.shape).astype(np.float32)
        weights, powers = 1000.0 * levels[:, 0, 0], np.array([4e-4, 2e-4])
        frames.append(FrameGCCs(spec, whole.lags_s, values, weights, powers, np.zeros(2, dtype=np.bool_)))
        places.append(Evidence(spec, whole))
    evidence = tuple(places)
    functional = SRPFunctional(evidence, C_M_S)
    first, second = (Place(evidence, functional, at_m, 1.0, 0.0) for at_m in (ONE_M, OTHER_M))
    of_first, of_second = _powers(first, second, frames)
    assert of_first == pytest.approx(4e-4)
    assert of_second is not None
    assert of_second / 4e-4 == pytest.approx(height / (1.0 + height), rel=0.35)


def test_the_power_of_sources_is_unknown_without_the_powers_of_the_frames() -> None:
    evidence = tuple(Evidence(spec, ideal_gcc(spec, true_lags_s(spec.microphones_m, ONE_M))) for spec in (NORTH, SOUTH))
    functional = SRPFunctional(evidence, C_M_S)
    first, second = (Place(evidence, functional, at_m, 1.0, 0.0) for at_m in (ONE_M, OTHER_M))
    frames = [
        FrameGCCs(part.spec, part.gcc.lags_s, part.gcc.values[None], np.ones(1), np.zeros(1), np.zeros(1, np.bool_))
        for part in evidence
    ]
    assert _powers(first, second, frames) == (None, None)


@settings(max_examples=20)
@given(count=st.integers(1, 60), most_bytes=st.integers(1, 1 << 20), first_active=st.integers(0, 60))
def test_memory_of_the_frames_is_bounded(count: int, most_bytes: int, first_active: int) -> None:
    """What does not fit is merged: no frame is lost, and none of the sound becomes quiet."""
    sampling = LagSampling.shared(NORTH.band_hz, RATE_HZ, NORTH.aperture_m / C_M_S)
    one = OnsetGCC(np.ones((6, sampling.count), dtype=np.complex64), np.ones(4))
    powers = np.linspace(0.5, 1.0, count)
    course = Course(np.arange(count), powers, first_active)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_gccs, "MAX_BYTES", most_bytes)
        frames = FrameGCCs.of(NORTH, sampling, [one] * count, np.ones(6, dtype=np.bool_), course)
    assert frames.values.nbytes <= max(most_bytes, frames.values[0].nbytes)
    assert len(frames.values) <= frame_gccs.MAX_FRAMES
    assert frames.weights.sum() == pytest.approx(count)
    assert frames.powers.max() == powers.max()
    assert frames.quiet.sum() <= max(0, first_active - frame_gccs.BEGINNING)
    if count <= frame_gccs.MAX_FRAMES and count * frames.values[0].nbytes <= most_bytes:
        assert len(frames.values) == count
