"""Poses are measured from sounds at known and at unknown places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from set_ups import BOUNDS_M, C_M_S, delays_of, set_up, sources

from livessl.core.commission.places import PlaceSearch
from livessl.core.commission.poses import Freedom, adjust
from livessl.core.commission.resection import from_known_places, measure_pose, measure_poses
from livessl.core.types import FloatArray

few = settings(deadline=None, max_examples=3)


def moved(microphones_m: FloatArray, shift_m: FloatArray, turn: FloatArray) -> FloatArray:
    centre_m = microphones_m.mean(axis=0)
    return np.asarray(Rotation.from_rotvec(turn).apply(microphones_m - centre_m) + centre_m + shift_m)


@few
@given(seed=st.integers(0, 10_000))
def test_eight_claps_at_known_places_give_the_pose_from_anywhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng)["north"]
    places_m = sources(rng, 8)
    delays = delays_of({"north": true}, places_m, rng)["north"]
    filed = moved(true, rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.5, 3))
    known_m = places_m + rng.normal(0.0, 0.01, places_m.shape)
    found = measure_pose(filed, delays, known_m, C_M_S, 0.01)
    # now and then eight random places lie so that the pose is known to little more than 0.1 m, and it says so
    assert np.abs(found.microphones_m - true).max() < max(0.08, 3.0 * found.position_std_m)
    assert found.position_std_m < 0.2
    assert found.misfit_s < 15e-6 < found.misfit_before_s


def test_claps_in_one_direction_do_not_determine_a_pose() -> None:
    rng = np.random.default_rng(2)
    true = set_up(rng)["north"]
    places_m = true.mean(axis=0) + np.array([3.0, 2.0, 0.0]) * np.linspace(0.8, 1.2, 5)[:, None]
    delays = delays_of({"north": true}, places_m, rng)["north"]
    assert not measure_pose(true, delays, places_m, C_M_S, 0.01).is_determined


def test_three_claps_are_too_few() -> None:
    rng = np.random.default_rng(2)
    true = set_up(rng)["north"]
    places_m = sources(rng, 3)
    with pytest.raises(ValueError, match="expected 4 sounds or more at known places, got 3"):
        measure_pose(true, delays_of({"north": true}, places_m, rng)["north"], places_m, C_M_S, 0.01)


@few
@given(seed=st.integers(0, 10_000))
def test_a_pose_is_refined_from_sounds_at_unknown_places(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    delays = delays_of(true, sources(rng, 20), rng)
    filed = true | {"south": moved(true["south"], rng.normal(0.0, 0.05, 3), np.array([0.0, 0.0, 0.2]))}
    begin_m = PlaceSearch(BOUNDS_M, C_M_S).fit(filed, delays).positions_m
    found = adjust(filed, delays, begin_m, C_M_S, Freedom({"south": (0.1, 30.0)}))
    pose = found.poses["south"]
    assert abs(pose.turn_deg[2] + np.degrees(0.2)) < 2.5
    off_m = pose.applied(filed["south"]) - true["south"]
    assert np.sqrt((off_m**2).sum(axis=1)).max() < 0.1
    assert 0.0 < np.sqrt(pose.covariance[5, 5]) < np.radians(2.0)


def test_the_speed_of_sound_is_measured_with_the_places_known() -> None:
    rng = np.random.default_rng(3)
    true = set_up(rng)
    places_m = sources(rng, 8)
    delays = delays_of(true, places_m, rng)
    found = adjust(true, delays, places_m, 335.0, Freedom({}, speed_std_m_s=20.0), place_std_m=0.01)
    assert abs(found.c_m_s - C_M_S) < 1.0
    assert 0.0 < found.c_std_m_s < 3.0


def test_a_line_of_microphones_has_no_direction_to_begin_with() -> None:
    rng = np.random.default_rng(4)
    line_m = np.column_stack([np.linspace(0.0, 0.3, 4), np.zeros(4), np.zeros(4)])
    assert from_known_places(line_m, np.zeros((5, 4)), sources(rng, 5)) is None


@few
@given(seed=st.integers(0, 10_000))
def test_claps_tell_the_poses_of_all_arrays_and_the_speed_of_sound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    places_m = sources(rng, 8)
    delays = delays_of(true, places_m, rng)
    delays["west"][2:] = np.nan  # too few for this array
    filed = {name: moved(at_m, rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.5, 3)) for name, at_m in true.items()}
    found = measure_poses(filed, delays, places_m, C_M_S + 4.0, 0.01)
    assert set(found.poses) == {"north", "south"}
    for name, pose in found.poses.items():
        assert np.abs(pose.microphones_m - true[name]).max() < max(0.08, 3.0 * pose.position_std_m)
    assert abs(found.c_m_s - C_M_S) < max(2.0, 3.0 * found.c_std_m_s)
    assert found.c_std_m_s < 2.0


def test_a_sound_that_one_array_missed_counts_the_delays_of_the_others() -> None:
    rng = np.random.default_rng(3)
    true = set_up(rng)
    places_m = sources(rng, 1)
    delays = {"north": delays_of(true, places_m, rng, std_s=100e-6)["north"]}
    alone = adjust(true, delays, places_m, C_M_S, Freedom({}), place_std_m=0.01)
    found = adjust(true, {**delays, "south": np.full((1, 4), np.nan)}, places_m, C_M_S, Freedom({}), place_std_m=0.01)
    assert found.misfits_s == pytest.approx(alone.misfits_s, rel=1e-3)


@pytest.mark.parametrize("count", [2, 4])
def test_the_pose_of_a_line_is_determined_although_its_turn_about_itself_is_not(count: int) -> None:
    rng = np.random.default_rng(5)
    line_m = np.array([4.0, 2.5, 2.0]) + np.linspace(-0.2, 0.2, count)[:, None] * np.array([0.8, 0.6, 0.0])
    places_m = sources(rng, 20)
    filed = moved(line_m, np.array([0.2, -0.1, 0.1]), np.array([0.1, 0.2, 0.3]))
    delays = delays_of({"line": line_m}, places_m, rng)
    found = measure_poses({"line": filed}, delays, places_m, C_M_S, 0.01).poses["line"]
    assert found.is_determined, (found.position_std_m, found.orientation_std_deg)
    assert np.abs(found.microphones_m - line_m).max() < max(0.03, 3.0 * found.position_std_m)
    axis = (line_m[1] - line_m[0]) / np.linalg.norm(line_m[1] - line_m[0])
    assert abs(found.turn.as_rotvec() @ axis) < 0.1
    claps_in_one_direction_m = line_m.mean(axis=0) + np.array([3.0, 2.0, 0.0]) * np.linspace(0.8, 1.2, 5)[:, None]
    unknown = delays_of({"line": line_m}, claps_in_one_direction_m, rng)["line"]
    assert not measure_pose(line_m, unknown, claps_in_one_direction_m, C_M_S, 0.01).is_determined
