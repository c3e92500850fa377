"""Poses are refined from sounds at unknown places, with one array known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from set_ups import BOUNDS_M, C_M_S, Arrays, delays_of, set_up, sources, turned

from livessl.core.commission.arrivals import Arrivals, mean_times_s
from livessl.core.commission.poses import moved
from livessl.core.commission.refine import refine


def filed(true: Arrays, rng: np.random.Generator, turn_deg: float) -> Arrays:
    """The set-up with the array 'north' as it is, and the others up to half a metre off and turned."""
    return {
        name: at_m if name == "north" else turned(at_m, turn_deg) + rng.uniform(-0.3, 0.3, 3)
        for name, at_m in true.items()
    }


@settings(max_examples=3)
@given(seed=st.integers(0, 10_000), turn_deg=st.sampled_from([-170.0, -60.0, 0.0, 25.0, 90.0]))
def test_twenty_sounds_tell_the_poses_from_rough_ones(seed: int, turn_deg: float) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    delays = delays_of(true, sources(rng, 20), rng)
    found = refine(filed(true, rng, turn_deg), delays, BOUNDS_M, C_M_S + 2.0, ["north"])
    assert set(found.poses) == {"south", "west"}
    for name, pose in found.poses.items():
        off_m = pose.microphones_m.mean(axis=0) - true[name].mean(axis=0)
        assert np.linalg.norm(off_m) < max(0.12, 4.0 * pose.position_std_m)
        turn, _ = Rotation.align_vectors(
            pose.microphones_m - pose.microphones_m.mean(axis=0), true[name] - true[name].mean(axis=0)
        )
        assert np.degrees(turn.magnitude()) < 2.0
        assert pose.misfit_s < 12e-6 < pose.misfit_before_s
    assert abs(found.c_m_s - C_M_S) < max(2.0, 3.0 * found.c_std_m_s)


def test_a_sound_whose_echo_was_received_does_not_count() -> None:
    rng = np.random.default_rng(5)
    true = set_up(rng, 3)
    delays = delays_of(true, sources(rng, 20), rng)
    delays["west"][7] += rng.normal(0.0, 400e-6, 4)
    found = refine(filed(true, rng, 10.0), delays, BOUNDS_M, C_M_S, ["north"])
    assert found.sounds == 19
    pose = found.poses["west"]
    off_m = pose.microphones_m.mean(axis=0) - true["west"].mean(axis=0)
    assert np.linalg.norm(off_m) < 4.0 * pose.position_std_m
    assert pose.misfit_s < 6e-6


def test_sounds_that_one_array_received_alone_tell_nothing() -> None:
    rng = np.random.default_rng(6)
    true = set_up(rng, 2)
    delays = delays_of(true, sources(rng, 20), rng)
    delays["south"][8:] = np.nan
    with pytest.raises(ValueError, match="expected 10 sounds or more that another array received, got 8"):
        refine(true, delays, BOUNDS_M, C_M_S, ["north"])


@pytest.mark.parametrize("known", [[], ["north", "south"]])
def test_one_array_is_known_and_one_is_refined(known: list[str]) -> None:
    rng = np.random.default_rng(7)
    true = set_up(rng, 2)
    with pytest.raises(ValueError, match="one array or more to be known"):
        refine(true, delays_of(true, sources(rng, 20), rng), BOUNDS_M, C_M_S, known)


def test_times_between_arrays_on_one_clock_tell_distances() -> None:
    rng = np.random.default_rng(8)
    true = set_up(rng, 3)
    places_m = sources(rng, 20)
    delays = delays_of(true, places_m, rng, std_s=8e-6)
    times_s = mean_times_s(list(true.values()), places_m, C_M_S) + rng.normal(0.0, 40e-6, (20, 3))
    times_s[4, 1] = np.nan
    times_s += rng.uniform(0.0, 10.0, (20, 1))  # when a sound was made is not known
    rough = filed(true, rng, 20.0)
    without = refine(rough, delays, BOUNDS_M, C_M_S, ["north"])
    found = refine(rough, delays, BOUNDS_M, C_M_S, ["north"], Arrivals(tuple(true), times_s))
    for name in ("south", "west"):
        off_m = found.poses[name].microphones_m.mean(axis=0) - true[name].mean(axis=0)
        assert np.linalg.norm(off_m) < 0.08
        assert found.poses[name].position_std_m < 0.5 * without.poses[name].position_std_m


def test_the_covariance_says_how_far_the_poses_are_off() -> None:
    squares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        true = set_up(rng, 2)
        delays = delays_of(true, sources(rng, 20), rng, std_s=8e-6)
        off = moved(true["south"], rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.1, 3))
        pose = refine(true | {"south": off}, delays, BOUNDS_M, C_M_S, ["north"]).poses["south"]
        off_m = pose.microphones_m.mean(axis=0) - true["south"].mean(axis=0)
        squares.append(float(off_m @ np.linalg.solve(pose.covariance[:3, :3], off_m)))
    # chi-square of three degrees of freedom: mean 3; the mean of six lies between 0.8 and 8 in 99.9 % of all cases
    assert 0.8 < np.mean(squares) < 8.0
