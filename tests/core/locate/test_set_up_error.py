"""The error that a wrong set-up causes: predicted as large as it is, and shared by all sounds from one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi

from free_field import BAND_HZ, C_M_S, tetra, true_lags_s
from livessl.core.geometry import posed
from livessl.core.joint_array import joined
from livessl.core.locate.set_up_error import half_axis_m, probability_within, set_up_covariance_m2
from livessl.core.types import ArraySpec, FloatArray, Uncertainty

ALL = (0, 1, 2)
NONE = Uncertainty(0.0, 0.0, 0.0, 0.0)
COORDINATE = st.floats(0.5, 4.5)


def known_to(
    spec: ArraySpec, position_m: float = 0.0, orientation_deg: float = 0.0, temperature_c: float = 0.0
) -> ArraySpec:
    return replace(spec, uncertainty=Uncertainty(position_m, orientation_deg, 0.0, temperature_c))


def found_m(believed: Sequence[ArraySpec], lags_s: Sequence[FloatArray], start_m: FloatArray) -> FloatArray:
    """Where delays of true arrays place a sound by the arrays as they are believed to be."""

    def off(place_m: FloatArray) -> FloatArray:
        return np.concatenate(
            [
                C_M_S * (true_lags_s(spec.microphones_m, place_m) - lags)
                for spec, lags in zip(believed, lags_s, strict=True)
            ]
        )

    return np.asarray(least_squares(off, start_m, x_scale=0.1).x)


def errors_m(believed: Sequence[ArraySpec], source_m: FloatArray, *, seed: int, count: int = 150) -> FloatArray:
    """Errors (N, 3) with set-ups that are off by as much as they are known to."""
    rng, errors = np.random.default_rng(seed), []
    for _ in range(count):
        speed = np.sqrt(1.0 + believed[0].uncertainty.temperature_c / 293.0 * rng.standard_normal())
        lags_s = []
        for spec in believed:
            turn = Rotation.from_rotvec(
                spec.uncertainty.orientation_deg * rng.standard_normal(3), degrees=True
            ).as_matrix()
            shift_m = spec.uncertainty.position_m * rng.standard_normal(3)
            true_m = (spec.microphones_m - spec.centre_m) @ turn.T + spec.centre_m + shift_m
            lags_s.append(true_lags_s(true_m, source_m) / speed)
        errors.append(found_m(believed, lags_s, source_m) - source_m)
    return np.array(errors)


@settings(max_examples=6)
@given(
    source_m=st.tuples(COORDINATE, COORDINATE, st.floats(0.3, 2.5)),
    known=st.sampled_from([(0.02, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 5.0), (0.02, 1.0, 5.0)]),
    count=st.sampled_from([2, 3]),
    seed=st.integers(0, 1000),
)
def test_errors_are_as_large_as_predicted(
    source_m: tuple[float, float, float], known: tuple[float, float, float], count: int, seed: int
) -> None:
    places = ([0.3, 0.4, 2.0], [4.6, 2.2, 1.2], [1.0, 4.7, 2.6])
    believed = [known_to(tetra(str(n), at_m, 0.5, 40.0 * n), *known) for n, at_m in enumerate(places[:count])]
    at_m = np.array(source_m)
    predicted_m2 = set_up_covariance_m2(believed, at_m, ALL)
    errors = errors_m(believed, at_m, seed=seed)
    measured_m2 = errors.T @ errors / len(errors)
    if np.sqrt(np.linalg.eigvalsh(predicted_m2)[-1]) > 0.5:
        return  # so far along a common line of sight the error is no longer linear
    # the mean of 150 squares is within a third of its expectation
    assert np.trace(measured_m2) == pytest.approx(np.trace(predicted_m2), rel=0.45)
    inside = np.einsum("ni,ij,nj->n", errors, np.linalg.pinv(predicted_m2, rcond=1e-6, hermitian=True), errors)
    assert np.mean(inside <= 6.25) > 0.75


@pytest.mark.parametrize("source_m", [[4.0, 6.0, 1.2], [3.0, 4.0, 2.0]])
def test_members_of_a_joint_array_stand_on_frames_of_their_own(source_m: list[float]) -> None:
    """Otherwise their distance, which decides how far the source is, would be exact."""
    members = [
        known_to(tetra(str(n), at_m, 0.2), 0.02, 1.5) for n, at_m in enumerate(([2.0, 2.0, 1.2], [6.0, 2.0, 1.2]))
    ]
    joint = joined(members, {"0": "node", "1": "node"}, "both")
    at_m, rng = np.array(source_m), np.random.default_rng(3)
    errors = []
    for _ in range(200):
        placed_m = []
        for spec in members:
            turn = Rotation.from_rotvec(1.5 * rng.standard_normal(3), degrees=True).as_matrix()
            shifted_m = spec.centre_m + 0.02 * rng.standard_normal(3)
            placed_m.append((spec.microphones_m - spec.centre_m) @ turn.T + shifted_m)
        errors.append(found_m([joint], [true_lags_s(np.vstack(placed_m), at_m)], at_m) - at_m)
    predicted_m = np.sqrt(np.diag(set_up_covariance_m2([joint], at_m, ALL)))
    assert np.sqrt(np.mean(np.square(errors), axis=0)) == pytest.approx(predicted_m, rel=0.35)


def test_an_array_around_the_source_shifts_it_as_far_as_itself() -> None:
    spec = known_to(tetra("north", [1.0, 1.0, 1.5], 0.2), 0.02)
    std_m = np.sqrt(np.diag(set_up_covariance_m2([spec], spec.centre_m, ALL)))
    assert std_m == pytest.approx(0.02, rel=0.1)


def test_one_array_knows_directions_as_well_as_its_own_orientation() -> None:
    spec = known_to(tetra("north", [1.0, 1.0, 1.5], 0.5), orientation_deg=1.5)
    at_m = np.array([1.0, 4.0, 1.5])
    std_m = np.sqrt(np.diag(set_up_covariance_m2([spec], at_m, ALL)))
    assert std_m[[0, 2]] == pytest.approx(3.0 * np.radians(1.5), rel=0.1)
    assert std_m[1] < 0.5 * std_m[0]


def test_a_set_up_that_is_known_exactly_causes_no_error() -> None:
    arrays = [replace(tetra(name, at_m), uncertainty=NONE) for name, at_m in (("a", [1, 1, 1]), ("b", [4, 3, 1]))]
    np.testing.assert_array_equal(set_up_covariance_m2(arrays, np.array([2.0, 4.0, 1.0]), ALL), np.zeros((3, 3)))


def test_there_is_no_error_along_an_axis_that_is_not_searched() -> None:
    flat = ArraySpec(
        "flat", posed(np.array([[0.0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0.2, 0.2, 0]]), [1, 1, 1]), BAND_HZ
    )
    covariance_m2 = set_up_covariance_m2([flat], np.array([3.0, 2.0, 1.0]), (0, 1))
    assert np.diag(covariance_m2)[:2].min() > 0.0
    np.testing.assert_array_equal(covariance_m2[2], np.zeros(3))


@settings(max_examples=15)
@given(
    deviations_m=st.tuples(*[st.floats(0.001, 2.0)] * 3),
    turned=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    radius_m=st.floats(0.05, 2.0),
    seed=st.integers(0, 1000),
)
def test_probability_is_the_share_of_errors_that_are_shorter(
    deviations_m: tuple[float, ...], turned: tuple[float, ...], radius_m: float, seed: int
) -> None:
    turn = Rotation.from_rotvec(turned).as_matrix()
    covariance_m2 = turn @ np.diag(np.square(deviations_m)) @ turn.T
    errors_m = np.random.default_rng(seed).standard_normal((40_000, 3)) * deviations_m
    share = float(np.mean(np.linalg.norm(errors_m, axis=1) <= radius_m))
    # 0.01 is four standard deviations of a share of 40 000
    assert probability_within(radius_m, covariance_m2) == pytest.approx(share, abs=0.012)
    inside = np.einsum("na,ab,nb->n", errors_m @ turn.T, np.linalg.inv(covariance_m2), errors_m @ turn.T)
    assert np.mean(inside <= (half_axis_m(covariance_m2) / max(deviations_m)) ** 2) == pytest.approx(0.9, abs=0.012)


@given(deviation_m=st.floats(0.01, 3.0), axes=st.sampled_from([(0,), (1, 2), (0, 1, 2)]))
def test_probability_of_flat_errors(deviation_m: float, axes: tuple[int, ...]) -> None:
    """In one dimension it is that of the normal distribution, in two that of Rayleigh's, in three of Maxwell's."""
    covariance_m2 = np.zeros((3, 3))
    covariance_m2[axes, axes] = deviation_m**2
    expected = chi(len(axes), scale=deviation_m).cdf(0.5)
    assert probability_within(0.5, covariance_m2) == pytest.approx(expected, abs=3e-3)
    assert probability_within(0.5, np.zeros((3, 3))) == 1.0
