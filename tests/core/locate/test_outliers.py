"""An array that disagrees is left out and named; where it is unknown which one is wrong, the position is refused."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import pytest

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, delayed, heard, tetra
from livessl.core.correlate.band import dead_channels
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.types import ArraySpec, Float32Array, FloatArray, Uncertainty

GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
NORTH = tetra("north", [2.7, 4.4, 1.1])
SOUTH = tetra("south", [2.3, 0.9, 1.5], yaw_deg=71.0)
EAST = tetra("east", [3.9, 2.6, 2.1], yaw_deg=-40.0)
SOURCE_M = np.array([1.13, 3.31, 0.83])

NEAR_M = 0.01
"""Onset windows of 32 ms cut the burst at its edges, which costs a centimetre; whole segments are right to 1 mm."""


def turned(spec: ArraySpec, yaw_deg: float, name: str | None = None) -> ArraySpec:
    """Return the array as a site file with a wrong yaw describes it."""
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return ArraySpec(name or spec.name, (spec.microphones_m - spec.centre_m) @ turn.T + spec.centre_m, BAND_HZ)


def sounds_of(
    specs: Sequence[ArraySpec], source_m: FloatArray = SOURCE_M, suspect: Collection[str] = ()
) -> dict[str, Sound]:
    """Sounds of arrays at these positions."""
    sound = burst(6400, seed=2)
    return {spec.name: Sound((heard(spec, source_m, sound),), RATE_HZ, suspect=spec.name in suspect) for spec in specs}


def locate(believed: Sequence[ArraySpec], sounds: dict[str, Sound]) -> Localization:
    return Onset(believed, GRID, C_M_S).locate({spec.name: sounds[spec.name] for spec in believed})


def error_m(found: Localization, source_m: FloatArray = SOURCE_M) -> float:
    return float(np.linalg.norm(found.position_m - source_m))


SOUNDS = sounds_of([NORTH, SOUTH, EAST])
EXACT = Uncertainty(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("yaw_deg", [30.0, -30.0])
def test_a_turned_array_is_left_out_and_named(yaw_deg: float) -> None:
    good = locate([NORTH, SOUTH, EAST], SOUNDS)
    assert good.outliers == {}
    assert error_m(good) < NEAR_M
    found = locate([NORTH, SOUTH, turned(EAST, yaw_deg)], SOUNDS)
    assert found.refused is None
    assert found.outliers is not None
    # its direction turns with it: by 30 degrees about the vertical, times the cosine of some elevation
    assert found.outliers == {"east": pytest.approx(28.0, abs=4.0)}
    assert error_m(found) == error_m(locate([NORTH, SOUTH], SOUNDS))
    assert error_m(found) < NEAR_M
    assert {heard.spec.name for heard in found.evidence} == {"north", "south", "east"}  # maps can be drawn for all


def test_two_arrays_that_disagree_are_refused() -> None:
    assert locate([NORTH, SOUTH], SOUNDS).refused is None
    found = locate([NORTH, turned(SOUTH, -30.0)], SOUNDS)
    assert found.refused is not None
    assert "'north' and 'south' point to different places" in found.refused
    assert found.outliers == {}


def test_a_slightly_turned_array_is_left_out_where_the_site_is_known_exactly() -> None:
    """Five degrees at 2.5 m shift the position by up to 0.2 m: with three arrays one can be left out, with two none."""
    exact = [replace(spec, uncertainty=EXACT) for spec in (NORTH, SOUTH, turned(EAST, 5.0))]
    aside = exact[2]
    found = locate(exact, SOUNDS)
    assert found.outliers is not None
    assert list(found.outliers) == ["east"]
    assert error_m(found) < NEAR_M
    two = locate([exact[0], aside], SOUNDS)
    assert (two.refused, two.outliers) == (None, {})
    assert error_m(two) > NEAR_M
    agree = locate([NORTH, SOUTH, turned(EAST, 3.0)], SOUNDS)
    assert (agree.refused, agree.outliers) == (None, {})


def test_arrays_off_by_no_more_than_the_site_is_known_to_agree() -> None:
    """Poses are off by 2 cm and 1.5 degrees, and channels by 0.05 ms, which rarely makes an outlier."""
    outvoted = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sites = ((NORTH, 17.0), (SOUTH, 71.0), (EAST, -40.0))
        believed = [tetra(s.name, s.centre_m, (0.5, 0.7)[seed % 2], yaw) for s, yaw in sites]
        sounds = {}
        for spec in believed:
            moved = turned(spec, 1.5 * rng.choice([-1.0, 1.0]))
            towards = rng.standard_normal(3)
            place_m = moved.microphones_m + 0.02 * towards / np.linalg.norm(towards)
            travel_s = np.linalg.norm(place_m - SOURCE_M, axis=1) / C_M_S
            late_s = travel_s + 5e-5 * rng.permutation([0.0, 0.0, 1.0, 1.0])
            sounds[spec.name] = Sound((delayed(burst(6400, seed=2), late_s - late_s.mean()),), RATE_HZ)
        found = locate(believed, sounds)
        assert found.refused is None
        assert error_m(found) < 0.5
        outvoted += found.outliers != {}
    assert outvoted <= 1


def test_one_array_alone_is_no_outlier() -> None:
    assert locate([NORTH], SOUNDS).outliers == {}


def test_a_suspect_array_is_used_again_once_it_agrees() -> None:
    """The position is then the same as without suspicion."""
    good = locate([NORTH, SOUTH, EAST], SOUNDS)
    again = locate([NORTH, SOUTH, EAST], sounds_of([NORTH, SOUTH, EAST], suspect=["east"]))
    assert again.outliers == {}
    np.testing.assert_array_equal(again.position_m, good.position_m)
    still = locate([NORTH, SOUTH, turned(EAST, 30.0)], sounds_of([NORTH, SOUTH, EAST], suspect=["east"]))
    assert still.outliers is not None
    assert list(still.outliers) == ["east"]


def test_where_any_two_of_three_agree_the_suspect_one_is_left_out() -> None:
    """In one plane two directions always cross: three arrays show that one is wrong, but not which."""
    flat = [ArraySpec(s.name, s.microphones_m * [1, 1, 0] + [0, 0, 1.3], BAND_HZ) for s in (NORTH, SOUTH, EAST)]
    plane = Grid((GRID.bounds_m[0], GRID.bounds_m[1], (1.3, 1.3)), 0.1)
    source_m = np.array([1.13, 3.31, 1.3])
    believed = [flat[0], flat[1], turned(flat[2], 15.0)]
    sounds = sounds_of(flat, source_m)
    estimator = Onset(believed, plane, C_M_S)
    divided = estimator.locate(sounds)
    assert divided.refused is not None
    assert "it is unknown which is wrong" in divided.refused
    decided = estimator.locate(sounds_of(flat, source_m, suspect=["east"]))
    assert decided.refused is None
    assert decided.outliers is not None
    assert list(decided.outliers) == ["east"]
    assert error_m(decided, source_m) < NEAR_M


def with_dead(sound: Sound, channel: int, samples: Float32Array) -> Sound:
    segment = sound.segments[0].copy()
    segment[channel] = samples
    return Sound((segment,), sound.sample_rate_hz)


@pytest.mark.parametrize("rms", [0.0, 1e-4])
def test_pairs_of_a_dead_microphone_are_left_out(rms: float) -> None:
    """Dead means 30 dB below the others; a louder microphone that records only noise is not recognized as dead."""
    noise = np.random.default_rng(5).standard_normal(6400).astype(np.float32)
    for level, left_out in ((rms, True), (0.05, False)):
        sounds = SOUNDS | {"south": with_dead(SOUNDS["south"], 2, level * noise)}
        found = locate([NORTH, SOUTH], sounds)
        (south,) = (heard.gcc for heard in found.evidence if heard.spec.name == "south")
        silent = ~south.values.any(axis=1)
        assert silent.tolist() == [left_out and 2 in pair for pair in south.pairs.tolist()]
        if left_out:
            assert error_m(found) < 2 * NEAR_M  # half of the baselines of one array remain
            assert found.refused is None


def test_dead_is_far_below_the_second_loudest() -> None:
    rng = np.random.default_rng(1)
    samples = rng.standard_normal((4, 800)).astype(np.float32)
    assert not dead_channels([samples]).any()
    samples[1] *= 0.02  # 34 dB
    samples[3] *= 100.0  # a loose contact crackles
    assert dead_channels([samples, samples]).tolist() == [False, True, False, False]
    samples[1] *= 2.5  # 26 dB
    assert not dead_channels([samples]).any()
    offset = np.array([0.0, 3.0, 0.0, 0.0], dtype=np.float32)[:, None]
    samples[1] = 0.0
    assert dead_channels([samples + offset]).tolist() == [False, True, False, False]
    assert not dead_channels([np.zeros((4, 800), dtype=np.float32)]).any()  # there is nothing to compare with
