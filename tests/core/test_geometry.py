"""Shapes, poses, directions and the grid, tested by properties instead of their formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.distance import pdist

from livessl.core.geometry import (
    Grid,
    as_positions_m,
    circle,
    direction_deg,
    line,
    pan_tilt_deg,
    posed,
    speed_of_sound_m_s,
    tetrahedron,
)
from livessl.core.types import FloatArray

X, Y, Z = np.eye(3)
BOUNDS_M = ((-1.0, 2.3), (0.5, 4.1), (0.2, 2.9))


def test_sound_travels_at_343_m_s_at_20_degrees() -> None:
    assert speed_of_sound_m_s(20.0) == pytest.approx(343.2, abs=0.1)  # the textbook's 343.2 m/s
    assert speed_of_sound_m_s(0.0) == pytest.approx(331.3)
    assert speed_of_sound_m_s(20.0) - speed_of_sound_m_s(19.0) == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize("given_m", [[[1, 2, 3]], ((1.0, 2.0, 3.0),), np.array([[1, 2, 3]], dtype=np.float32)])
def test_positions_may_be_any_sequence_or_array(given_m: ArrayLike) -> None:
    positions_m = as_positions_m(given_m)
    assert positions_m.dtype == np.float64
    assert positions_m.tolist() == [[1.0, 2.0, 3.0]]


def test_positions_are_a_copy() -> None:
    given_m = np.zeros((2, 3))
    as_positions_m(given_m)[0, 0] = 1.0
    assert given_m[0, 0] == 0.0


@pytest.mark.parametrize(
    ("given_m", "said"),
    [
        ([1.0, 2.0, 3.0], r"expected shape \(n, 3\), got \(3,\)"),
        ([[1.0, 2.0]], r"expected shape \(n, 3\), got \(1, 2\)"),
        ([[1.0, 2.0, np.nan]], "expected finite coordinates"),
        ([[1.0, 2.0, np.inf]], "expected finite coordinates"),
    ],
)
def test_positions_of_another_shape_or_not_finite_are_an_error(given_m: ArrayLike, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        as_positions_m(given_m)


def test_tetrahedron_is_regular_and_around_the_origin() -> None:
    microphones_m = tetrahedron(0.37)
    np.testing.assert_allclose(pdist(microphones_m), 0.37)
    np.testing.assert_allclose(microphones_m.mean(axis=0), 0.0, atol=1e-15)


def test_tetrahedron_has_its_apex_first_then_the_base_counter_clockwise_from_x() -> None:
    apex, *base = tetrahedron(1.0)
    np.testing.assert_allclose(apex[:2], 0.0)
    assert apex[2] > 0
    assert np.ptp([m[2] for m in base]) == 0.0
    azimuths = [direction_deg(np.zeros(3), m)[0] % 360 for m in base]
    np.testing.assert_allclose(azimuths, [0.0, 120.0, 240.0])


def test_circle_goes_counter_clockwise_from_x() -> None:
    np.testing.assert_allclose(circle(0.2, 4), 0.2 * np.array([X, Y, -X, -Y]), atol=1e-16)
    np.testing.assert_allclose(circle(0.2, 4, clockwise=True), 0.2 * np.array([X, -Y, -X, Y]), atol=1e-16)


def test_line_goes_along_x_around_the_origin() -> None:
    np.testing.assert_allclose(line(0.1, 4), np.outer([-0.15, -0.05, 0.05, 0.15], X), atol=1e-16)


@pytest.mark.parametrize(
    ("angles", "x_to", "y_to", "z_to"),
    [
        ({"yaw_deg": 90.0}, Y, -X, Z),  # counter-clockwise seen from above
        ({"pitch_deg": 90.0}, -Z, Y, X),  # lowers the +x end
        ({"roll_deg": 90.0}, X, Z, -Y),
        ({"pitch_deg": 90.0, "roll_deg": 90.0}, -Z, X, -Y),  # y rolls up to z, which then pitches to x
        ({"yaw_deg": 90.0, "pitch_deg": 90.0}, -Z, -X, Y),  # z pitches to x, which then yaws to y
        ({"yaw_deg": 90.0, "roll_deg": 90.0}, Y, Z, X),  # z rolls to -y, which then yaws to x
    ],
)
def test_pose_rolls_then_pitches_then_yaws(
    angles: dict[str, float], x_to: FloatArray, y_to: FloatArray, z_to: FloatArray
) -> None:
    shift = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(posed(np.eye(3), shift, **angles) - shift, [x_to, y_to, z_to], atol=1e-15)


@pytest.mark.parametrize(
    ("target_m", "expected"),
    [
        ([3.0, 2.0, 1.0], (0.0, 0.0, 2.0)),
        ([1.0, 5.0, 1.0], (90.0, 0.0, 3.0)),
        ([0.0, 1.0, 1.0], (-135.0, 0.0, np.sqrt(2.0))),
        ([1.0, 2.0, 3.0], (0.0, 90.0, 2.0)),
        ([2.0, 2.0, 0.0], (0.0, -45.0, np.sqrt(2.0))),
    ],
)
def test_direction_is_azimuth_elevation_distance(target_m: ArrayLike, expected: tuple[float, float, float]) -> None:
    assert direction_deg(np.array([1.0, 2.0, 1.0]), np.asarray(target_m)) == pytest.approx(expected)


angles_deg = st.floats(-179.0, 179.0)
metres = st.floats(-50.0, 50.0)


@given(
    pan_deg=angles_deg,
    tilt_deg=st.floats(-89.0, 89.0),
    distance_m=st.floats(0.1, 100.0),
    position_m=st.tuples(metres, metres, metres),
    mounted_deg=st.tuples(angles_deg, angles_deg, angles_deg),
)
def test_camera_that_pans_and_tilts_so_looks_at_the_place(
    pan_deg: float,
    tilt_deg: float,
    distance_m: float,
    position_m: tuple[float, float, float],
    mounted_deg: tuple[float, float, float],
) -> None:
    """The place is built by turning the camera: first upwards, then to the right, then as it is mounted."""
    ahead_m = posed(np.array([[distance_m, 0.0, 0.0]]), np.zeros(3), pitch_deg=-tilt_deg)
    target_m = posed(posed(ahead_m, np.zeros(3), yaw_deg=-pan_deg), position_m, *mounted_deg)[0]
    found = pan_tilt_deg(target_m, position_m, *mounted_deg)
    assert found == pytest.approx((pan_deg, tilt_deg, distance_m), abs=1e-6)


def test_camera_pans_to_the_right_and_tilts_upwards() -> None:
    """One on the wall y = 0 looks into the room along +y."""
    assert pan_tilt_deg([3.0, 2.0, 2.0], [1.0, 0.0, 2.0], yaw_deg=90.0) == pytest.approx((45.0, 0.0, np.sqrt(8.0)))
    assert pan_tilt_deg([1.0, 1.0, 1.0], [1.0, 0.0, 2.0], yaw_deg=90.0) == pytest.approx((0.0, -45.0, np.sqrt(2.0)))


spans = st.tuples(st.floats(-20.0, 20.0), st.floats(0.0, 9.0)).map(lambda span: (span[0], span[0] + span[1]))


@given(bounds_m=st.tuples(spans, spans, spans), spacing_m=st.floats(0.5, 3.0), seed=st.integers(0, 2**32 - 1))
def test_no_point_is_further_than_half_a_cell_from_a_grid_point(
    bounds_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]], spacing_m: float, seed: int
) -> None:
    grid = Grid(bounds_m, spacing_m)
    points_m = grid.points_m()
    point_m = np.random.default_rng(seed).uniform(grid.lower_m, grid.upper_m)
    offset_m = np.abs(points_m - point_m)
    # half a cell along every axis at once, so half its diagonal; 1e-12: rounding of coordinates up to 29 m
    nearest = int((offset_m**2).sum(axis=1).argmin())
    assert (offset_m[nearest] <= grid.cell_m / 2 + 1e-12).all()
    # the cells fill the box exactly
    np.testing.assert_allclose(points_m.min(axis=0) - grid.cell_m / 2, grid.lower_m, atol=1e-12)
    np.testing.assert_allclose(points_m.max(axis=0) + grid.cell_m / 2, grid.upper_m, atol=1e-12)
    # as near to the wanted spacing as possible: n cells instead of n +- 1 are off by at most half a cell in all
    assert (np.abs(np.array(grid.shape) * spacing_m - (grid.upper_m - grid.lower_m)) <= spacing_m * (1.0 + 1e-9)).all()
    several = np.array(grid.shape) > 1
    assert (grid.cell_m[several] <= 1.25 * spacing_m + 1e-12).all()
    assert (grid.cell_m[several] >= 0.75 * spacing_m - 1e-12).all()


def test_grid_points_are_numbered_z_fastest() -> None:
    grid = Grid(BOUNDS_M, 0.3)
    assert grid.shape == (11, 12, 9)
    assert grid.size == 11 * 12 * 9 == len(grid.points_m())
    points_m = grid.points_m()
    for index in (0, 1, 9, 108, 777, grid.size - 1):
        np.testing.assert_allclose(grid.point_m(index), points_m[index])
        cell = [int(i) for i in np.unravel_index(index, grid.shape)]
        along = [float(grid.axis_m(axis)[cell[axis]]) for axis in range(3)]
        np.testing.assert_allclose(along, points_m[index])
    np.testing.assert_allclose(points_m[0], [-0.85, 0.65, 0.35])
    np.testing.assert_allclose(points_m[1] - points_m[0], [0.0, 0.0, 0.3], atol=1e-12)


def test_equal_bounds_make_a_plane() -> None:
    grid = Grid((BOUNDS_M[0], BOUNDS_M[1], (1.2, 1.2)), 0.3)
    assert grid.shape == (11, 12, 1)
    assert grid.free_axes == (0, 1)
    assert grid.cell_m[2] == 0.0
    assert (grid.points_m()[:, 2] == 1.2).all()
    assert Grid(BOUNDS_M, 0.3).free_axes == (0, 1, 2)


def test_impossible_grids_are_an_error() -> None:
    for spacing_m in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="grid: expected spacing_m > 0"):
            Grid(BOUNDS_M, spacing_m)
    with pytest.raises(ValueError, match=r"grid: expected lower <= upper bound on y, got \[4.1, 0.5\]"):
        Grid((BOUNDS_M[0], (4.1, 0.5), BOUNDS_M[2]), 0.3)
