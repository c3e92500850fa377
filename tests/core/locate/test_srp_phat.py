"""SRP-PHAT finds the source, and misses it as soon as a sign, a unit or a channel is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.geometry import Grid, circle, posed
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.types import ArraySpec, FloatArray

BOUNDS_M = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
GRID = Grid(BOUNDS_M, 0.1)
NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
SOURCE_M = np.array([1.13, 3.31, 1.47])

# Lags are exact to a hundredth of a fine lag (derived in test_gcc_phat), 27 um of sound path: over 0.3 m that is
# 90 urad, 0.2 mm at 2.5 m; five times that where directions cross at a small angle.
NEAR_M = 0.001


@pytest.fixture(scope="module")
def estimator() -> SrpPhat:
    return SrpPhat([NORTH, SOUTH], GRID, C_M_S)


def sounds_from(
    source_m: FloatArray, rate_hz: float = RATE_HZ, c_m_s: float = C_M_S, seed: int = 0
) -> dict[str, Sound]:
    n = round(0.2 * rate_hz)
    sound = burst(n, seed)
    return {spec.name: Sound((heard(spec, source_m, sound, rate_hz, c_m_s),), rate_hz) for spec in (NORTH, SOUTH)}


def error_m(found: Localization, source_m: FloatArray = SOURCE_M) -> float:
    return float(np.linalg.norm(found.position_m - source_m))


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_the_position_is_much_finer_than_the_grid(seed: int, estimator: SrpPhat) -> None:
    source_m = np.random.default_rng(seed).uniform([0.3, 2.0, 0.4], [1.6, 3.6, 2.3])
    found = estimator.locate(sounds_from(source_m, seed=seed))
    assert error_m(found, source_m) < NEAR_M
    assert found.confidence > 0.2


def test_maps_are_drawn_from_the_evidence(estimator: SrpPhat) -> None:
    found = estimator.locate(sounds_from(SOURCE_M))
    maps = estimator.power_maps(found.evidence)
    assert maps.arrays.keys() == {"north", "south"}
    assert maps.fused.shape == (maps.grid.size,)
    np.testing.assert_array_equal(maps.fused, maps.arrays["north"] + maps.arrays["south"])
    assert (np.abs(maps.grid.point_m(int(maps.fused.argmax())) - SOURCE_M) <= maps.grid.cell_m).all()
    alone = estimator.power_maps(found.evidence, {"south"})
    assert alone.arrays.keys() == {"south"}
    np.testing.assert_array_equal(alone.arrays["south"], maps.arrays["south"])
    np.testing.assert_array_equal(alone.fused, maps.fused)


@pytest.mark.parametrize("band_limit", [False, True])
def test_maps_use_the_band_limit_of_the_search(band_limit: bool) -> None:
    coarse, unlimited = (SrpPhat([NORTH, SOUTH], Grid(BOUNDS_M, 0.3), C_M_S, band_limit=b) for b in (band_limit, False))
    found = coarse.locate(sounds_from(SOURCE_M))
    limited = coarse.power_maps(found.evidence).fused
    whole = unlimited.power_maps([replace(heard, below=()) for heard in found.evidence]).fused
    assert np.array_equal(limited, whole) is not band_limit


def test_swapped_channels_give_another_position(estimator: SrpPhat) -> None:
    sounds = sounds_from(SOURCE_M)
    assert error_m(estimator.locate(sounds)) < NEAR_M
    for order in ([1, 0, 2, 3], [0, 1, 3, 2], [3, 2, 1, 0]):
        swapped = {name: Sound((sound.segments[0][order],), RATE_HZ) for name, sound in sounds.items()}
        assert error_m(estimator.locate(swapped)) > 0.3


def test_channels_and_microphones_swapped_alike_give_the_same_position() -> None:
    order = np.array([2, 0, 3, 1])
    moved = [ArraySpec(spec.name, spec.microphones_m[order], BAND_HZ) for spec in (NORTH, SOUTH)]
    sounds = {name: Sound((s.segments[0][order],), RATE_HZ) for name, s in sounds_from(SOURCE_M).items()}
    assert error_m(SrpPhat(moved, GRID, C_M_S).locate(sounds)) < NEAR_M


def test_swapped_arrays_give_another_position(estimator: SrpPhat) -> None:
    sounds = sounds_from(SOURCE_M)
    assert error_m(estimator.locate({"north": sounds["south"], "south": sounds["north"]})) > 0.3


def test_speed_of_sound_is_used(estimator: SrpPhat) -> None:
    slow = sounds_from(SOURCE_M, c_m_s=0.95 * C_M_S)
    assert error_m(SrpPhat([NORTH, SOUTH], GRID, 0.95 * C_M_S).locate(slow)) < NEAR_M
    assert error_m(estimator.locate(slow)) > 5 * NEAR_M


@pytest.mark.parametrize("rate_hz", [22050.0, 44100.0, 48000.0])
def test_any_sampling_rate_gives_the_same_position(estimator: SrpPhat, rate_hz: float) -> None:
    at_this, at_16 = sounds_from(SOURCE_M, rate_hz), sounds_from(SOURCE_M)
    assert error_m(estimator.locate(at_this)) < NEAR_M
    assert error_m(estimator.locate({"north": at_this["north"], "south": at_16["south"]})) < NEAR_M
    wrong = {name: Sound(sound.segments, RATE_HZ) for name, sound in at_this.items()}
    assert error_m(estimator.locate(wrong)) > 5 * NEAR_M


def test_positions_are_absolute() -> None:
    shift = np.array([10.0, -3.0, 1.0])
    x, y, z = ((low + d, high + d) for (low, high), d in zip(BOUNDS_M, shift, strict=True))
    moved = [ArraySpec(spec.name, spec.microphones_m + shift, BAND_HZ) for spec in (NORTH, SOUTH)]
    found = SrpPhat(moved, Grid((x, y, z), 0.1), C_M_S).locate(sounds_from(SOURCE_M))
    assert error_m(found, SOURCE_M + shift) < NEAR_M


def results(found: Localization) -> list[bytes]:
    gccs = [heard.gcc.values for heard in found.evidence]
    arrays = (found.position_m, found.covariance_m2, np.array(found.confidence), *gccs)
    return [array.tobytes() for array in arrays]


def test_the_order_of_the_arrays_does_not_change_a_bit(estimator: SrpPhat) -> None:
    sounds = sounds_from(SOURCE_M)
    turned: Mapping[str, Sound] = dict(reversed(sounds.items()))
    assert results(estimator.locate(sounds)) == results(estimator.locate(turned))
    other = SrpPhat([SOUTH, NORTH], GRID, C_M_S)
    assert results(other.locate(sounds)) == results(estimator.locate(sounds))
    assert results(estimator.locate(sounds_from(SOURCE_M, seed=1))) != results(estimator.locate(sounds))


def test_prepare_does_not_change_the_answer() -> None:
    sounds = sounds_from(SOURCE_M)
    made = SrpPhat([NORTH, SOUTH], GRID, C_M_S)
    made.prepare("north", RATE_HZ)
    made.prepare("north", 48_000.0)
    assert results(made.locate(sounds)) == results(SrpPhat([NORTH, SOUTH], GRID, C_M_S).locate(sounds))


def test_several_segments_are_located_as_one_sound(estimator: SrpPhat) -> None:
    one, other = sounds_from(SOURCE_M, seed=1), sounds_from(SOURCE_M, seed=2)
    both = {name: Sound((*one[name].segments, *other[name].segments), RATE_HZ) for name in one}
    assert error_m(estimator.locate(both)) < NEAR_M


def test_one_array_alone_gives_the_direction(estimator: SrpPhat) -> None:
    found = estimator.locate({"north": sounds_from(SOURCE_M)["north"]})
    towards, right = found.position_m - NORTH.centre_m, SOURCE_M - NORTH.centre_m
    cosine = towards @ right / np.linalg.norm(towards) / np.linalg.norm(right)
    assert np.degrees(np.arccos(cosine)) < 0.05  # twice 90 urad for each of two angles, and float64's arccos near 1
    assert [heard.spec.name for heard in found.evidence] == ["north"]


def test_silence_and_dead_channels_give_finite_answers(estimator: SrpPhat) -> None:
    silent = {name: Sound((np.zeros((4, 800), dtype=np.float32),), RATE_HZ) for name in ("north", "south")}
    found = estimator.locate(silent)
    assert found.confidence == 0.0
    assert (estimator.power_maps(found.evidence).fused == 0.0).all()
    assert np.isfinite(found.position_m).all()
    np.testing.assert_allclose(found.covariance_m2, np.diag(np.array([4.2, 5.1, 2.7]) ** 2 / 12), rtol=1e-9)
    sounds = sounds_from(SOURCE_M)
    dead = sounds["north"].segments[0].copy()
    dead[2] = 0.0
    assert error_m(estimator.locate({"north": Sound((dead,), RATE_HZ), "south": sounds["south"]})) < 3 * NEAR_M


def test_arrays_of_two_to_sixteen_microphones_work_together() -> None:
    round_table = ArraySpec("table", posed(circle(0.15, 16), [2.2, 2.4, 0.8]), BAND_HZ)
    pair = ArraySpec("pair", np.array([[2.5, 4.9, 1.2], [2.8, 4.9, 1.25]]), BAND_HZ)
    specs = (round_table, pair, SOUTH)
    sound = burst(3200)
    sounds = {spec.name: Sound((heard(spec, SOURCE_M, sound),), RATE_HZ) for spec in specs}
    assert error_m(SrpPhat(specs, GRID, C_M_S).locate(sounds)) < 2 * NEAR_M


def test_a_position_on_a_plane_grid_stays_in_its_plane() -> None:
    plane = Grid((BOUNDS_M[0], BOUNDS_M[1], (1.47, 1.47)), 0.1)
    found = SrpPhat([NORTH, SOUTH], plane, C_M_S).locate(sounds_from(SOURCE_M))
    assert error_m(found) < NEAR_M
    assert found.position_m[2] == 1.47
    assert (found.covariance_m2[2] == 0.0).all()
