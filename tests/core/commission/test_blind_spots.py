"""The doctor says what sounds at unknown places hide, and finds what it says that they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from set_ups import BOUNDS_M, C_M_S, Arrays, delays_of, set_up, sources, turned

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.blind_spots import MOST_HIDDEN_M, blind_spots
from livessl.core.commission.diagnosis import Diagnosis, diagnose
from livessl.core.commission.set_up import Known, careful
from livessl.core.types import FloatArray

STD_S = 2e-6

seeds = st.integers(0, 10_000)
few = settings(deadline=None, max_examples=3)


def exactly(filed: Arrays, sounds: int = 10, orientation_std_deg: float = 1.2) -> Known:
    stds_s = {name: np.full(sounds, STD_S) for name in filed}
    return Known(careful(filed, orientation_std_deg=orientation_std_deg), stds_s)


def hidden(filed: Arrays, delays: Arrays) -> tuple[BlindSpot, ...]:
    return blind_spots(filed, delays, BOUNDS_M, C_M_S, exactly(filed))


def diagnosed(filed: Arrays, delays: Arrays, known: Known) -> Diagnosis:
    return diagnose(filed, delays, BOUNDS_M, C_M_S, known)


def level(rng: np.random.Generator, height_m: float) -> FloatArray:
    """Sounds at the height of the arrays: their lines of sight always meet."""
    places_m = sources(rng)
    places_m[:, 2] = height_m
    return places_m


@few
@given(seed=seeds)
def test_two_arrays_hide_a_level_shift_of_either_from_sounds_at_their_height(seed: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng)
    spots = [one for one in hidden(filed, delays_of(filed, level(rng, 2.0), rng, STD_S)) if one.fault == "moved"]
    assert [set(one.arrays) for one in spots] == [{"north", "south"}]
    assert spots[0].least > MOST_HIDDEN_M
    assert abs(spots[0].along[2]) < 0.2
    assert np.linalg.norm(spots[0].along) == pytest.approx(1.0)


@few
@given(seed=seeds)
def test_three_arrays_hide_no_shift_from_sounds_all_over_the_room(seed: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng, 3)
    spots = hidden(filed, delays_of(filed, sources(rng), rng, STD_S))
    assert not [one for one in spots if one.fault == "moved"]


@few
@given(seed=seeds)
def test_a_shift_that_is_hidden_is_not_told_and_one_that_shows_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng)
    delays = delays_of(true, level(rng, 2.0), rng, STD_S)
    spot = next(one for one in hidden(true, delays) if one.fault == "moved")
    along = np.array(spot.along)

    def filed_off(shift_m: FloatArray) -> Arrays:
        return true | {"south": true["south"] - shift_m}

    assert not diagnosed(filed_off(0.2 * spot.least * along), delays, exactly(true)).contradicts
    upwards = diagnosed(filed_off(np.array([0.0, 0.0, 1.0])), delays, exactly(true))
    assert upwards.contradicts


@few
@given(seed=seeds, angle_deg=st.floats(5.0, 8.0), sense=st.sampled_from([-1.0, 1.0]))
def test_a_small_turn_is_named_where_poses_were_measured(seed: int, angle_deg: float, sense: float) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    filed = true | {"south": turned(true["south"], -sense * angle_deg)}
    found = diagnosed(filed, delays_of(true, sources(rng), rng, STD_S), exactly(filed, orientation_std_deg=0.4)).best
    assert found is not None
    assert (found.fault, found.array) == ("turned", "south")
    assert found.turn_deg == pytest.approx((0.0, 0.0, sense * angle_deg), abs=1.0)


def test_fewer_than_two_arrays_or_three_sounds_say_nothing_of_poses() -> None:
    rng = np.random.default_rng(3)
    filed = set_up(rng)
    delays = delays_of(filed, sources(rng), rng, STD_S)
    assert blind_spots(filed, {"north": delays["north"]}, BOUNDS_M, C_M_S, exactly(filed)) == ()
    few_sounds = {name: one[:2] for name, one in delays.items()}
    assert blind_spots(filed, few_sounds, BOUNDS_M, C_M_S, exactly(filed, sounds=2)) == ()


def test_a_sound_whose_delays_are_said_to_be_poor_counts_little() -> None:
    rng = np.random.default_rng(4)
    filed = set_up(rng, 3)
    delays = delays_of(filed, sources(rng), rng, STD_S)
    delays["west"][:5] += rng.normal(0.0, 60e-6, (5, 4))
    known = exactly(filed)
    told = replace(known, stds_s=dict(known.stds_s) | {"west": np.array([*np.full(5, 60e-6), *np.full(5, STD_S)])})
    assert not diagnosed(filed, delays, told).contradicts
