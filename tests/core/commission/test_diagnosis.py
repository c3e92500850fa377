"""Wrong orders of channels and wrong poses are told apart by the delays of some sounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from set_ups import BOUNDS_M, C_M_S, Arrays, delays_of, set_up, sources, turned

from livessl.core.commission.diagnosis import MOST_ARRAYS, Diagnosis, diagnose, most_doubtful
from livessl.core.commission.judge import fitted_together
from livessl.core.commission.places import PlaceSearch
from livessl.core.commission.set_up import SetUp, careful
from livessl.core.commission.tolerance import unknowns_of
from livessl.core.geometry import posed, tetrahedron

seeds = st.integers(0, 10_000)
few = settings(deadline=None, max_examples=3)


def diagnosed(filed: Arrays, delays: Arrays) -> Diagnosis:
    return diagnose(filed, delays, BOUNDS_M, C_M_S)


@few
@given(seed=seeds, count=st.integers(2, 3))
def test_nothing_is_said_of_a_set_up_as_it_is_filed(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng, count)
    found = diagnosed(filed, delays_of(filed, sources(rng), rng))
    assert found.best is None
    assert not found.contradicts


@few
@given(seed=seeds, pair=st.sampled_from([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]), array=st.integers(0, 1))
def test_two_swapped_channels_are_named(seed: int, pair: tuple[int, int], array: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng)
    name = list(filed)[array]
    delays = delays_of(filed, sources(rng), rng)
    order = np.arange(4)
    order[list(pair)] = order[list(pair)[::-1]]
    found = diagnosed(filed, delays | {name: delays[name][:, order]}).best
    assert found is not None
    assert (found.fault, found.array) == ("swapped", name)
    assert found.order == tuple(order + 1)
    assert found.misfit_s < 15e-6


@few
@given(seed=seeds, angle_deg=st.floats(20.0, 100.0), sense=st.sampled_from([-1.0, 1.0]))
def test_a_turned_array_is_named_with_its_angle(seed: int, angle_deg: float, sense: float) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    filed = true | {"south": turned(true["south"], -sense * angle_deg)}
    found = diagnosed(filed, delays_of(true, sources(rng), rng)).best
    assert found is not None
    assert (found.fault, found.array) == ("turned", "south")
    assert found.turn_deg == pytest.approx((0.0, 0.0, sense * angle_deg), abs=3.0)


@few
@given(seed=seeds)
def test_arrays_wired_the_other_way_round_are_named(seed: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng)
    delays = {name: one[:, [0, 1, 3, 2]] for name, one in delays_of(filed, sources(rng), rng).items()}
    found = diagnosed(filed, delays).best
    assert found is not None
    assert (found.fault, found.order) == ("mirrored", (1, 2, 4, 3))


@few
@given(seed=seeds)
def test_exchanged_arrays_are_named(seed: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng, 3)
    delays = delays_of(filed, sources(rng), rng)
    found = diagnosed(filed, delays | {"north": delays["west"], "west": delays["north"]}).best
    assert found is not None
    assert (found.fault, {found.array, found.other}) == ("exchanged", {"north", "west"})


@few
@given(seed=seeds, channel=st.integers(0, 3), late_us=st.floats(120.0, 400.0))
def test_a_late_channel_is_named_with_its_delay(seed: int, channel: int, late_us: float) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng, 3)
    delays = delays_of(filed, sources(rng), rng)
    delays["west"][:, channel] += 1e-6 * late_us
    found = diagnosed(filed, delays).best
    assert found is not None
    assert (found.fault, found.array, found.channel) == ("late_channel", "west", channel + 1)
    assert 1e6 * found.late_s == pytest.approx(late_us, abs=40.0)


def test_which_of_two_arrays_has_moved_is_left_open() -> None:
    rng = np.random.default_rng(5)
    true = set_up(rng)
    filed = true | {"south": true["south"] + [0.7, 0.3, 0.0]}
    found = diagnosed(filed, delays_of(true, sources(rng), rng))
    assert found.contradicts
    assert found.best is None or found.best.fault == "moved"
    assert {one.array for one in found.rivals[:2]} == {"north", "south"}


def test_two_sounds_are_too_few() -> None:
    rng = np.random.default_rng(6)
    filed = set_up(rng)
    delays = {name: one[:, [1, 0, 2, 3]] for name, one in delays_of(filed, sources(rng, 2), rng).items()}
    assert diagnosed(filed, delays).best is None


def test_channels_without_sound_and_arrays_that_missed_sounds_are_left_out() -> None:
    rng = np.random.default_rng(7)
    filed = set_up(rng, 3)
    delays = delays_of(filed, sources(rng), rng)
    delays["north"][:, 1] = np.nan
    delays["west"][3:5] = np.nan
    assert diagnosed(filed, delays).best is None
    swapped = delays | {"south": delays["south"][:, [3, 1, 2, 0]]}
    found = diagnosed(filed, swapped).best
    assert found is not None
    assert (found.fault, found.array, found.order) == ("swapped", "south", (4, 2, 3, 1))


def many(rng: np.random.Generator, count: int) -> Arrays:
    """Tetrahedra all over the room, turned at random."""
    return {
        f"array{index}": posed(tetrahedron(0.5), tuple(at_m), yaw_deg=float(rng.uniform(-180.0, 180.0)))
        for index, at_m in enumerate(rng.uniform([1.0, 1.0, 1.5], [7.0, 9.0, 3.0], (count, 3)))
    }


@pytest.mark.parametrize("count", [2, 8, 24, 48])
def test_set_ups_that_are_fitted_together_take_bounded_memory(count: int) -> None:
    rng = np.random.default_rng(count)
    filed = many(rng, count)
    one = SetUp(filed, delays_of(filed, sources(rng), rng), C_M_S, careful(filed))
    unknowns = unknowns_of(one)
    assert unknowns == 18 * count + 2
    rows = fitted_together(one)
    assert rows >= 1
    assert rows * unknowns**2 * 8 <= 64e6


@few
@given(seed=seeds, wrong=st.integers(0, 11), angle_deg=st.floats(20.0, 100.0))
def test_of_many_arrays_the_wrong_one_is_among_those_that_are_judged(seed: int, wrong: int, angle_deg: float) -> None:
    rng = np.random.default_rng(seed)
    true = many(rng, 12)
    name = f"array{wrong}"
    filed = true | {name: turned(true[name], angle_deg)}
    used = most_doubtful(filed, delays_of(true, sources(rng), rng), PlaceSearch(BOUNDS_M, C_M_S))
    assert name in used
    assert len(used) == len(set(used)) == MOST_ARRAYS
    assert used == [one for one in filed if one in used]
