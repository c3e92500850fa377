"""Set-ups are judged with the small freedom that every careful one has."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from set_ups import BOUNDS_M, C_M_S, Arrays, delays_of, set_up, sources, turned

from livessl.core.commission.places import PlaceSearch, contradictions_s, degrees_of_freedom
from livessl.core.commission.set_up import SetUp, Stacked, careful, inverse
from livessl.core.commission.tolerance import Explained, explained
from livessl.core.types import FloatArray

seeds = st.integers(0, 10_000)
few = settings(deadline=None, max_examples=5)


def explaining(filed: Arrays, delays: Arrays) -> Explained:
    return explained([SetUp(filed, delays, C_M_S, careful(filed))], found_m(filed, delays)[None], BOUNDS_M)[0]


def found_m(filed: Arrays, delays: Arrays) -> FloatArray:
    """Places of the sounds, with the set-up exactly as filed."""
    return PlaceSearch(BOUNDS_M, C_M_S).fit(filed, delays).positions_m


def built(filed: Arrays, rng: np.random.Generator) -> Arrays:
    """A careful set-up: 2 cm, 1.2 degrees and 2 mm from what is filed."""
    true = {}
    for name, at_m in filed.items():
        turn = Rotation.from_rotvec(np.radians(rng.normal(0.0, 1.2, 3)))
        centre_m = at_m.mean(axis=0)
        true[name] = turn.apply(at_m - centre_m) + centre_m + rng.normal(0.0, 0.02, 3) + rng.normal(0.0, 2e-3, (4, 3))
    return true


@few
@given(seed=seeds, count=st.integers(2, 3))
def test_careful_set_up_is_explained_about_as_well_as_an_exact_one(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    filed = set_up(rng, count)
    true = built(filed, rng)
    delays = delays_of(true, sources(rng), rng)
    assert explaining(filed, delays).deviance < explaining(true, delays).deviance + 20.0 * count


@few
@given(seed=seeds, angle_deg=st.floats(12.0, 90.0))
def test_turned_array_is_explained_far_worse(seed: int, angle_deg: float) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    filed = true | {"south": turned(true["south"], angle_deg)}
    delays = delays_of(true, sources(rng), rng)
    assert explaining(filed, delays).deviance > explaining(true, delays).deviance + 12.0


def test_freedom_is_found_where_the_sounds_show_it() -> None:
    rng = np.random.default_rng(3)
    true = set_up(rng, 3)
    filed = true | {"south": turned(true["south"], -2.0)}
    found = explaining(filed, delays_of(true, sources(rng, 20), rng, 2e-6))
    assert found.turns_deg["south"][2] == pytest.approx(2.0, abs=1.0)
    assert abs(found.turns_deg["north"][2]) < 1.0


def test_one_sound_that_an_array_received_as_an_echo_counts_little() -> None:
    rng = np.random.default_rng(4)
    true = set_up(rng, 3)
    at_m = sources(rng)
    delays = delays_of(true, at_m, rng)
    before = explaining(true, delays)
    delays["north"][2] = delays["north"][2][::-1]
    after = explaining(true, delays)
    assert after.deviance < before.deviance + 80.0
    assert np.abs(np.delete(after.places_m - at_m, 2, axis=0)).max() < 0.3


def test_missing_channels_and_sounds_are_left_out() -> None:
    rng = np.random.default_rng(5)
    true = set_up(rng, 2)
    delays = delays_of(true, sources(rng), rng)
    delays["north"][:, 1] = np.nan
    delays["south"][4] = np.nan
    found = explaining(true, delays)
    assert np.isfinite(found.deviance)
    assert np.isfinite(found.places_m).all()


@few
@given(seed=seeds)
def test_set_ups_that_are_fitted_together_do_not_influence_each_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    delays = delays_of(true, sources(rng), rng)
    delays["west"][3] = np.nan
    given_ones = [
        SetUp(true, delays, C_M_S, careful(true)),
        SetUp(true | {"south": turned(true["south"], 9.0)}, delays, C_M_S + 3.0, careful(true), speed_std_m_s=20.0),
        SetUp(
            true, delays | {"north": delays["north"] + [0.0, 1e-4, 0.0, 0.0]}, C_M_S, careful(true), late=("north", 1)
        ),
    ]
    starts_m = np.stack([found_m(true, delays)] * 3)
    together = explained(given_ones, starts_m, BOUNDS_M)
    for one, found in zip(given_ones, together, strict=True):
        [alone] = explained([one], starts_m[:1], BOUNDS_M)
        assert found.deviance == pytest.approx(alone.deviance, abs=0.1)
    assert together[2].late_s == pytest.approx(1e-4, abs=2e-5)
    assert together[2].deviance < together[0].deviance + 10.0


@few
@given(seed=seeds, array=st.sampled_from(["north", "west"]))
def test_places_that_are_refined_together_are_those_that_are_refined_alone(seed: int, array: str) -> None:
    rng = np.random.default_rng(seed)
    true = set_up(rng, 3)
    delays = delays_of(true, sources(rng), rng)
    delays[array][2:4, 1] = np.nan
    filed = true | {array: turned(true[array], 5.0)}
    search = PlaceSearch(BOUNDS_M, C_M_S)
    starts_m = search.fit(true, delays).positions_m
    both = [SetUp(one, delays, C_M_S, careful(one)) for one in (true, filed)]
    together = Stacked(both, BOUNDS_M).placed(np.stack([starts_m, starts_m]))
    for one, places_m in zip(both, together, strict=True):
        alone = search.refine(one.microphones, delays, starts_m)
        off_s = contradictions_s(one.microphones, delays, places_m, C_M_S)
        assert (off_s**2).sum(axis=1) == pytest.approx(alone.misfits_s**2 * degrees_of_freedom(delays), rel=0.1)


@given(seed=seeds)
def test_inverses_of_small_matrices_are_those_of_numpy(seed: int) -> None:
    slopes = np.random.default_rng(seed).normal(0.0, 1e-3, (5, 4, 3, 7)) * np.logspace(0, -3, 3)[:, None]
    matrices = slopes @ slopes.swapaxes(-1, -2)
    assert inverse(matrices) @ matrices == pytest.approx(np.broadcast_to(np.eye(3), matrices.shape), abs=1e-5)
