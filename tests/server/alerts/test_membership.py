"""Probability that a position lies in a box."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from livessl.server.alerts.membership import probability_in

ANYWHERE = np.array([[-1e3, 1e3]] * 3)
ROOM = np.array([[0.0, 4.0], [0.0, 5.0], [0.0, 3.0]])
TOLERANCE = 0.002
"""Error of the quadrature for the flattest ellipsoids below; for rounder ones it is far smaller."""

coordinate = st.floats(-1.5, 1.5)
std_m = st.floats(0.02, 1.0)


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q


@settings(max_examples=60)
@given(
    mean=st.tuples(coordinate, coordinate, coordinate),
    stds=st.tuples(std_m, std_m, std_m),
    seed=st.integers(0, 10**6),
    low=st.tuples(coordinate, coordinate, coordinate),
    size=st.tuples(*[st.floats(0.1, 3.0)] * 3),
)
def test_equals_the_normal_distribution_of_scipy(mean, stds, seed, low, size) -> None:  # type: ignore[no-untyped-def]
    turn = rotation(seed)
    covariance = turn @ np.diag(np.square(stds)) @ turn.T
    low_m, high_m = np.array(low), np.array(low) + np.array(size)
    found = probability_in(np.array(mean), covariance, np.stack([low_m, high_m], axis=1), ANYWHERE)
    known = multivariate_normal(mean, covariance, seed=1)
    assert found == pytest.approx(known.cdf(high_m, lower_limit=low_m), abs=TOLERANCE)


@settings(max_examples=40)
@given(
    mean=st.tuples(coordinate, coordinate, coordinate),
    stds=st.tuples(st.floats(1e-6, 1e-2), st.floats(1e-3, 0.1), st.floats(1.0, 30.0)),
    seed=st.integers(0, 10**6),
)
def test_rounded_covariance_of_a_direction_has_probabilities(mean, stds, seed) -> None:  # type: ignore[no-untyped-def]
    """Six digits of a long ellipsoid's covariance, as events have them, are often not positive definite."""
    turn = rotation(seed)
    covariance = turn @ np.diag(np.square(stds)) @ turn.T
    rounded = np.array([[float(f"{value:.6g}") for value in row] for row in covariance])
    halves = [np.array([[low, high], [-50, 50], [-50, 50]], dtype=float) for low, high in ((-50, 0), (0, 50))]
    volume = np.array([[-50.0, 50.0]] * 3)
    found = [probability_in(np.array(mean), rounded, half, volume) for half in halves]
    assert all(0.0 <= probability <= 1.0 for probability in found)
    assert sum(found) == pytest.approx(1.0, abs=0.02)


def test_correlated_axes_are_not_treated_as_independent() -> None:
    """A long ellipsoid along the diagonal of a quadrant: independent axes would give a quarter."""
    covariance = np.array([[1.0, 0.999, 0.0], [0.999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    quadrant = np.array([[0.0, 1e3], [0.0, 1e3], [-1e3, 1e3]])
    found = probability_in(np.zeros(3), covariance, quadrant, ANYWHERE)
    exact = 0.25 + np.arcsin(0.999) / (2.0 * np.pi)  # Sheppard's formula
    assert found == pytest.approx(exact, abs=0.01)
    assert found > 0.48


def test_a_zone_at_the_wall_has_the_part_behind_the_wall() -> None:
    zone = np.array([[0.0, 1.0], [1.0, 3.0], [0.0, 3.0]])
    at_wall, covariance = np.array([0.0, 2.0, 1.0]), 0.01 * np.eye(3)
    assert probability_in(at_wall, covariance, zone, ROOM) == pytest.approx(1.0, abs=1e-6)
    assert probability_in(at_wall, covariance, zone, ANYWHERE) == pytest.approx(0.5, abs=1e-6)


def test_parts_of_the_room_have_probabilities_that_add_up_to_one() -> None:
    position, covariance = np.array([1.1, 2.0, 0.2]), np.diag([0.5, 0.3, 0.2])
    edges = [0.0, 1.0, 1.7, 4.0]
    parts = [
        probability_in(position, covariance, np.array([[low, high], [0.0, 5.0], [0.0, 3.0]]), ROOM)
        for low, high in pairwise(edges)
    ]
    assert sum(parts) == pytest.approx(1.0, abs=1e-6)
    assert min(parts) > 0.1


@pytest.mark.parametrize("plane_m", [0.0, 1.0])
def test_in_a_flat_search_volume_only_the_other_axes_count(plane_m: float) -> None:
    plane = np.array([[0.0, 4.0], [0.0, 5.0], [plane_m, plane_m]])
    position, covariance = np.array([1.0, 2.0, plane_m]), np.diag([0.04, 0.04, 0.0])
    zone = np.array([[1.0, 4.0], [0.0, 5.0], [0.0, 2.5]])
    assert probability_in(position, covariance, zone, plane) == pytest.approx(0.5, abs=1e-3)
    above = np.array([[1.0, 4.0], [0.0, 5.0], [plane_m + 0.5, 2.5]])
    assert probability_in(position, covariance, above, plane) == 0.0


def test_a_position_outside_the_volume_is_in_no_zone() -> None:
    zone = np.array([[-9.0, 1.0], [0.0, 5.0], [0.0, 3.0]])
    assert probability_in(np.array([-3.0, 2.0, 1.0]), 0.01 * np.eye(3), zone, ROOM) == 0.0
