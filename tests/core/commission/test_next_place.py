"""Places for the next clap are proposed where they tell most about the poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from set_ups import BOUNDS_M, C_M_S, delays_of, set_up, sources

from livessl.core.commission.next_place import AIM_DEG, AIM_M, expected_stds, proposed_place
from livessl.core.commission.resection import measure_pose
from livessl.core.types import FloatArray

STD_M = 0.01


def proposed(microphones: dict[str, FloatArray], count: int) -> FloatArray:
    places_m = np.zeros((0, 3))
    for _ in range(count):
        place_m = proposed_place(microphones, places_m, BOUNDS_M, C_M_S, STD_M)
        assert place_m is not None
        places_m = np.vstack([places_m, place_m])
    return places_m


@settings(max_examples=3)
@given(seed=st.integers(0, 10_000))
def test_proposed_places_tell_more_than_random_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    microphones = set_up(rng, 2)
    chosen = proposed(microphones, 6)

    def worst(places_m: FloatArray) -> float:
        stds = [expected_stds(at_m, places_m, C_M_S, STD_M) for at_m in microphones.values()]
        return max(max(position_m / AIM_M, angle_deg / AIM_DEG) for position_m, angle_deg in stds)

    assert worst(chosen) <= np.median([worst(sources(rng, 6)) for _ in range(20)])
    assert worst(chosen) < worst(chosen[:4]) < worst(chosen[:2])


def test_a_person_can_reach_proposed_places() -> None:
    rng = np.random.default_rng(1)
    microphones = set_up(rng, 3)
    places_m = proposed(microphones, 8)
    assert (places_m >= BOUNDS_M[:, 0] + 0.5).all()
    assert (places_m <= BOUNDS_M[:, 1] - 0.5).all()
    assert places_m[:, 2].max() <= 2.0
    for at_m in microphones.values():
        assert np.linalg.norm(places_m - at_m.mean(axis=0), axis=1).min() >= 1.0
    between_m = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)[np.triu_indices(8, 1)]
    assert between_m.min() >= 0.75


def test_a_line_can_become_known_well_enough() -> None:
    rng = np.random.default_rng(4)
    line_m = np.array([4.0, 5.0, 2.0]) + np.linspace(-0.3, 0.3, 4)[:, None] * np.array([0.8, 0.6, 0.0])
    few, many = (expected_stds(line_m, sources(rng, count), C_M_S, STD_M)[1] for count in (5, 30))
    assert many < few < 10.0
    assert many < AIM_DEG


def test_a_cupboard_has_no_place_to_propose() -> None:
    rng = np.random.default_rng(2)
    cupboard_m = np.array([[0.0, 0.9], [0.0, 0.9], [0.0, 2.0]])
    assert proposed_place(set_up(rng, 2), np.zeros((0, 3)), cupboard_m, C_M_S, STD_M) is None


def test_the_prediction_is_what_the_measurement_says_of_itself() -> None:
    rng = np.random.default_rng(3)
    true = set_up(rng)["north"]
    places_m = sources(rng, 8)
    pose = measure_pose(true, delays_of({"north": true}, places_m, rng)["north"], places_m, C_M_S, STD_M)
    position_m, angle_deg = expected_stds(true, places_m, C_M_S, STD_M)
    assert position_m == pytest.approx(pose.position_std_m, rel=0.3)
    assert angle_deg == pytest.approx(pose.orientation_std_deg, rel=0.3)
