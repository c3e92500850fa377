"""A room that is mirrored in a plane through its arrays sounds the same, if the arrays are nearly their own images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from set_ups import BOUNDS_M, C_M_S, Arrays, delays_of, set_up, sources

from livessl.core.commission.blind_spots import blind_spots
from livessl.core.commission.mirror import mirrored
from livessl.core.commission.set_up import Known, careful
from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import FloatArray

WEST_M, EAST_M = np.array([2.0, 4.0, 1.4]), np.array([6.0, 6.0, 1.8])
YAW_DEG = 26.565051177077994  # of the line from west to east


def pair(west_deg: float, east_deg: float) -> Arrays:
    """Tetrahedra by their yaw from the line between them: at 0 and 60 degrees they are their own mirror images."""
    return {
        "west": posed(tetrahedron(0.5), WEST_M, yaw_deg=YAW_DEG + west_deg),
        "east": posed(tetrahedron(0.5), EAST_M, yaw_deg=YAW_DEG + east_deg),
    }


def reflected(points_m: FloatArray) -> FloatArray:
    """Points mirrored in the upright plane through both arrays."""
    normal = np.array([-np.sin(np.radians(YAW_DEG)), np.cos(np.radians(YAW_DEG)), 0.0])
    return np.asarray(points_m - 2.0 * ((points_m - WEST_M) @ normal)[:, None] * normal)


def near(rng: np.random.Generator) -> FloatArray:
    """Places on both sides of the plane, whose reflections are in the room."""
    return rng.uniform([2.5, 3.5, 0.5], [5.5, 6.5, 2.5], (12, 3))


@given(
    st.sampled_from([0.0, 60.0, 180.0]), st.sampled_from([0.0, 120.0, -60.0]), st.floats(-11, 11), st.integers(0, 99)
)
def test_reflection_and_the_turn_that_it_needs_are_found(west: float, east: float, off_deg: float, seed: int) -> None:
    filed, places_m = pair(west + off_deg, east), near(np.random.default_rng(seed))
    spot = mirrored(filed, places_m, BOUNDS_M)
    assert spot is not None
    assert (spot.fault, spot.arrays) == ("mirrored", ("west", "east"))
    assert spot.least <= 2.0 * abs(off_deg) + 0.5  # a mirror doubles an angle; a tilted plane may need a smaller turn
    # so it is: exchanged channels and this turn give the same delays from the other places
    rng = np.random.default_rng(seed)
    seen = {name: reflected(at_m) for name, at_m in filed.items()}
    one, other = delays_of(filed, places_m, rng, 0.0), delays_of(seen, reflected(places_m), rng, 0.0)
    assert all(np.abs(one[name] - other[name]).max() < 1e-12 for name in filed)


def test_arrays_that_would_be_turned_far_exclude_it() -> None:
    assert mirrored(pair(30.0, 0.0), near(np.random.default_rng(0)), BOUNDS_M) is None


def test_a_place_whose_reflection_is_outside_excludes_it() -> None:
    places_m = np.vstack([near(np.random.default_rng(1)), [[0.2, 9.5, 1.5]]])
    assert mirrored(pair(0.0, 60.0), places_m, BOUNDS_M) is None


@pytest.mark.parametrize("height_m", [0.4, 3.0])
def test_a_third_array_outside_the_plane_excludes_it(height_m: float) -> None:
    third = {"north": posed(tetrahedron(0.5), (2.0, 8.0, height_m), yaw_deg=YAW_DEG)}
    assert mirrored({**pair(0.0, 60.0), **third}, near(np.random.default_rng(2)), BOUNDS_M) is None


def test_a_third_array_in_the_plane_does_not() -> None:
    third = {
        "middle": posed(tetrahedron(0.3), (WEST_M + EAST_M) / 2.0 + np.array([0.0, 0.0, 1.0]), yaw_deg=YAW_DEG + 120.0)
    }
    spot = mirrored({**pair(0.0, 60.0), **third}, near(np.random.default_rng(3)), BOUNDS_M)
    assert spot is not None
    assert spot.arrays == ("west", "east", "middle")


def ring(count: int) -> FloatArray:
    """Microphones of a level circle, of which none is in the plane of y = 0 (count is even)."""
    angles = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([0.1 * np.cos(angles), 0.1 * np.sin(angles), np.zeros(count)], axis=1)


GRID = np.stack(np.meshgrid([-0.063, -0.021, 0.021, 0.063], [-0.063, -0.021, 0.021, 0.063], [0.0]), axis=-1).reshape(
    -1, 3
)


@pytest.mark.parametrize("array", [ring(4), ring(6), ring(8), ring(16), GRID], ids=["4", "6", "8", "16", "grid"])
def test_flat_arrays_of_any_size_are_their_own_images(array: FloatArray) -> None:
    filed = {"west": array + np.array([2.0, 5.0, 1.5]), "east": array + np.array([6.0, 5.0, 1.5])}
    spot = mirrored(filed, near(np.random.default_rng(4)), BOUNDS_M)
    assert spot is not None
    assert spot.arrays == ("west", "east")
    assert spot.least == pytest.approx(0.0, abs=1e-6)
    assert np.abs(spot.along) == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("array", [ring(4), ring(8), GRID], ids=["4", "8", "grid"])
def test_the_plane_of_flat_arrays_needs_no_exchanged_channels(array: FloatArray) -> None:
    """Their mirror images are known from the geometry, and told before any sound."""
    filed = {"west": array + np.array([2.0, 5.0, 1.5]), "east": array + np.array([6.0, 5.0, 1.5])}
    on_one_side_m = np.array([[4.0, 0.5, 1.2]])  # whose image in any upright plane is outside
    narrow_m = np.array([[0.0, 8.0], [0.0, 5.5], [0.0, 4.0]])
    spot = mirrored(filed, on_one_side_m, narrow_m)
    assert spot is None


def test_lines_have_none() -> None:
    line = np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 4)
    filed = {"west": line + WEST_M, "east": line + EAST_M}
    assert mirrored(filed, near(np.random.default_rng(5)), BOUNDS_M) is None


def test_it_is_the_first_of_the_blind_spots_of_sounds() -> None:
    rng = np.random.default_rng(6)
    filed, places_m = pair(4.0, 60.0), near(rng)
    known = Known(careful(filed), {name: np.full(len(places_m), 2e-6) for name in filed})
    spots = blind_spots(filed, delays_of(filed, places_m, rng, 2e-6), BOUNDS_M, C_M_S, known)
    assert spots[0].fault == "mirrored"
    assert "mirrored in the plane through the arrays" in spots[0].message
    elsewhere = set_up(rng, 3)
    delays = delays_of(elsewhere, sources(rng), rng, 2e-6)
    known = Known(careful(elsewhere), {name: np.full(10, 2e-6) for name in elsewhere})
    assert [one for one in blind_spots(elsewhere, delays, BOUNDS_M, C_M_S, known) if one.fault == "mirrored"] == []
