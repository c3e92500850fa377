"""Probability that a position lies in a zone: a box, or a polygon with a range of heights."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path
from scipy.stats import multivariate_normal

from livessl.core.types import FloatArray
from livessl.server.zones.membership import PreparedZones, Prism, box_prism

ANYWHERE = np.array([[-1e3, 1e3]] * 3)
ROOM = np.array([[0.0, 4.0], [0.0, 5.0], [0.0, 3.0]])
TOLERANCE = 0.002
"""Error of the quadrature for the flattest ellipsoids below; for rounder ones it is far smaller."""

UNKNOWN = np.full(1, np.nan)

coordinate = st.floats(-1.5, 1.5)
std_m = st.floats(0.02, 1.0)


def probability_in(position_m: FloatArray, covariance_m2: FloatArray, zone: Prism, volume_m: FloatArray) -> float:
    return float(PreparedZones([zone], volume_m).probabilities(position_m, covariance_m2)[0])


def star(radii: Sequence[float], centre: Sequence[float] = (0.0, 0.0)) -> FloatArray:
    """Corners at any distance around a point: a polygon that is convex or not."""
    angles = np.arange(len(radii)) * 2.0 * np.pi / len(radii) + 0.1
    ring: FloatArray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners: FloatArray = np.asarray(centre) + np.array(radii)[:, None] * ring
    return corners


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q


@settings(max_examples=25)
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
    found = probability_in(np.array(mean), covariance, box_prism(np.stack([low_m, high_m], axis=1)), ANYWHERE)
    known = multivariate_normal(mean, covariance, seed=1)
    assert found == pytest.approx(known.cdf(high_m, lower_limit=low_m), abs=TOLERANCE)


@settings(max_examples=20)
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
    found = [probability_in(np.array(mean), rounded, box_prism(half), volume) for half in halves]
    assert all(0.0 <= probability <= 1.0 for probability in found)
    assert sum(found) == pytest.approx(1.0, abs=0.02)


def test_correlated_axes_are_not_treated_as_independent() -> None:
    """A long ellipsoid along the diagonal of a quadrant: independent axes would give a quarter."""
    covariance = np.array([[1.0, 0.999, 0.0], [0.999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    quadrant = np.array([[0.0, 1e3], [0.0, 1e3], [-1e3, 1e3]])
    found = probability_in(np.zeros(3), covariance, box_prism(quadrant), ANYWHERE)
    exact = 0.25 + np.arcsin(0.999) / (2.0 * np.pi)  # Sheppard's formula
    assert found == pytest.approx(exact, abs=0.01)
    assert found > 0.48


def test_a_zone_at_the_wall_has_the_part_behind_the_wall() -> None:
    zone = np.array([[0.0, 1.0], [1.0, 3.0], [0.0, 3.0]])
    at_wall, covariance = np.array([0.0, 2.0, 1.0]), 0.01 * np.eye(3)
    assert probability_in(at_wall, covariance, box_prism(zone), ROOM) == pytest.approx(1.0, abs=1e-6)
    assert probability_in(at_wall, covariance, box_prism(zone), ANYWHERE) == pytest.approx(0.5, abs=1e-6)


def test_parts_of_the_room_have_probabilities_that_add_up_to_one() -> None:
    position, covariance = np.array([1.1, 2.0, 0.2]), np.diag([0.5, 0.3, 0.2])
    edges = [0.0, 1.0, 1.7, 4.0]
    parts = [
        probability_in(position, covariance, box_prism(np.array([[low, high], [0.0, 5.0], [0.0, 3.0]])), ROOM)
        for low, high in pairwise(edges)
    ]
    assert sum(parts) == pytest.approx(1.0, abs=1e-6)
    assert min(parts) > 0.1


@pytest.mark.parametrize("plane_m", [0.0, 1.0])
def test_in_a_flat_search_volume_only_the_other_axes_count(plane_m: float) -> None:
    plane = np.array([[0.0, 4.0], [0.0, 5.0], [plane_m, plane_m]])
    position, covariance = np.array([1.0, 2.0, plane_m]), np.diag([0.04, 0.04, 0.0])
    zone = np.array([[1.0, 4.0], [0.0, 5.0], [0.0, 2.5]])
    assert probability_in(position, covariance, box_prism(zone), plane) == pytest.approx(0.5, abs=1e-3)
    above = np.array([[1.0, 4.0], [0.0, 5.0], [plane_m + 0.5, 2.5]])
    assert probability_in(position, covariance, box_prism(above), plane) == 0.0


def test_a_position_outside_the_volume_is_in_no_zone() -> None:
    zone = np.array([[-9.0, 1.0], [0.0, 5.0], [0.0, 3.0]])
    assert probability_in(np.array([-3.0, 2.0, 1.0]), 0.01 * np.eye(3), box_prism(zone), ROOM) == 0.0


@settings(max_examples=15)
@given(
    mean=st.tuples(coordinate, coordinate, coordinate),
    stds=st.tuples(std_m, std_m, std_m),
    seed=st.integers(0, 10**6),
    radii=st.lists(st.floats(0.3, 2.0), min_size=3, max_size=9),
    heights=st.tuples(st.floats(-1.0, 0.0), st.floats(0.2, 1.5)),
)
def test_polygon_equals_the_share_of_samples_inside(mean, stds, seed, radii, heights) -> None:  # type: ignore[no-untyped-def]
    turn = rotation(seed)
    covariance = turn @ np.diag(np.square(stds)) @ turn.T
    corners = star(radii)
    volume = np.array([[-1.2, 3.0], [-3.0, 1.1], [-0.7, 3.0]])
    found = probability_in(np.array(mean), covariance, Prism(corners, *heights), volume)
    samples = np.random.default_rng(1).multivariate_normal(mean, covariance, 20_000)
    samples = samples[((samples >= volume[:, 0]) & (samples <= volume[:, 1])).all(axis=1)]
    if len(samples) < 2000:
        return  # too few for a share
    within = Path(corners).contains_points(samples[:, :2])
    within &= (samples[:, 2] >= heights[0]) & (samples[:, 2] <= heights[1])
    assert found == pytest.approx(within.mean(), abs=4.5 * 0.5 / np.sqrt(len(samples)) + TOLERANCE)


@settings(max_examples=15)
@given(turn=st.floats(0.0, 6.3), share=st.floats(0.1, 0.9), seed=st.integers(0, 10**6), backwards=st.booleans())
def test_parts_of_a_polygon_have_probabilities_that_add_up(
    turn: float, share: float, seed: int, backwards: bool
) -> None:
    """A rectangle is cut along a line; the sum does not depend on where, nor on the sense of rotation."""
    rotated = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    whole, left, right = (
        np.array([[a, 0.0], [b, 0.0], [b, 0.8], [a, 0.8]]) @ rotated.T for a, b in ((0, 1), (0, share), (share, 1))
    )
    if backwards:
        left = left[::-1]
    axes = rotation(seed)
    covariance = axes @ np.diag([0.01, 0.2, 0.5]) @ axes.T
    found = [
        probability_in(np.array([0.2, 0.3, 1.0]), covariance, Prism(corners, 0.5, np.inf), ANYWHERE)
        for corners in (whole, left, right)
    ]
    assert found[0] == pytest.approx(found[1] + found[2], abs=TOLERANCE)


@settings(max_examples=20)
@given(
    place=st.tuples(st.floats(0.1, 3.9), st.floats(0.1, 4.9), st.floats(0.1, 2.9)),
    std_m=st.floats(0.01, 0.2),
    seed=st.integers(0, 10**6),
)
def test_shortcut_of_sure_positions_agrees_with_the_integral(place, std_m: float, seed: int) -> None:  # type: ignore[no-untyped-def]
    """The zone is concave and reaches to a wall; without the shortcut, all is integrated."""
    zone = Prism(np.array([[0.0, 1.0], [3.0, 1.0], [3.0, 2.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]]), 0.5, 9.0)
    axes = rotation(seed)
    covariance = axes @ np.diag([0.2 * std_m**2, 0.5 * std_m**2, std_m**2]) @ axes.T
    found = probability_in(np.array(place), covariance, zone, ROOM)
    with patch.object(PreparedZones, "_certain", return_value=UNKNOWN.copy()):
        integrated = probability_in(np.array(place), covariance, zone, ROOM)
    assert found == pytest.approx(integrated, abs=TOLERANCE)


def test_zone_far_from_a_sure_position_has_no_probability() -> None:
    zone = Prism(np.array([[3.0, 3.0], [4.0, 3.0], [3.5, 4.0]]), -np.inf, np.inf)
    assert probability_in(np.array([0.5, 0.5, 1.0]), 0.01 * np.eye(3), zone, ROOM) == 0.0


@settings(max_examples=20)
@given(
    zones=st.lists(
        st.tuples(
            st.lists(st.floats(0.2, 2.5), min_size=3, max_size=8),
            st.tuples(st.floats(-1.0, 5.0), st.floats(-1.0, 6.0)),
            st.sampled_from([(-np.inf, np.inf), (0.5, 2.0), (-2.0, 1.0), (2.9, 9.0), (5.0, 6.0)]),
        ),
        min_size=2,
        max_size=6,
    ),
    place=st.tuples(st.floats(-0.3, 4.3), st.floats(0.0, 5.0), st.floats(0.0, 3.0)),
    stds=st.tuples(std_m, std_m, std_m),
    seed=st.integers(0, 10**6),
)
def test_zones_together_have_the_probabilities_that_each_has_alone(zones, place, stds, seed) -> None:  # type: ignore[no-untyped-def]
    """Zones that overlap, that lie outside the room, and that have other heights do not disturb each other."""
    axes = rotation(seed)
    covariance = axes @ np.diag(np.square(stds)) @ axes.T
    prisms = [Prism(star(radii, centre), *heights) for radii, centre, heights in zones]
    together = PreparedZones(prisms, ROOM).probabilities(np.array(place), covariance)
    alone = [probability_in(np.array(place), covariance, prism, ROOM) for prism in prisms]
    assert together == pytest.approx(alone, abs=1e-5)


def test_without_zones_there_are_no_probabilities() -> None:
    assert PreparedZones([], ROOM).probabilities(np.ones(3), np.eye(3)).shape == (0,)
