"""SRP as a map and as a functional: sign, channels, weights, and comparison with closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from free_field import BAND_HZ, C_M_S, RATE_HZ, band_mean_cos, burst, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.geometry import Grid, line, microphone_pairs, pair_weight
from livessl.core.locate.srp import SRPFunctional, SRPMapper
from livessl.core.steering import steering_delays_s
from livessl.core.types import GCC, ArraySpec, Evidence, FloatArray

BOUNDS_M = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
SOURCE_M = np.array([1.13, 3.31, 1.47])
NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
GRID = Grid(BOUNDS_M, 0.1)


def ideal(spec: ArraySpec, source_m: FloatArray = SOURCE_M) -> GCC:
    return ideal_gcc(spec, true_lags_s(spec.microphones_m, source_m))


def mapped(spec: ArraySpec, gcc: GCC, grid: Grid = GRID, c_m_s: float = C_M_S) -> FloatArray:
    return np.asarray(SRPMapper(spec, grid, gcc.pairs, gcc.lags_s, c_m_s)(gcc), dtype=np.float64)


def exact(spec: ArraySpec, points_m: FloatArray, source_m: FloatArray = SOURCE_M) -> FloatArray:
    """The ideal map (N,), in closed form: 2/K sum R(tau(r) - tau(source))."""
    right = true_lags_s(spec.microphones_m, source_m)
    lags = np.array([true_lags_s(spec.microphones_m, point) for point in points_m])
    return np.asarray(2.0 / len(spec.microphones_m) * band_mean_cos(lags - right, spec.band_hz).sum(axis=1))


def off_axis_deg(spec: ArraySpec, place_m: FloatArray) -> float:
    towards, right = place_m - spec.centre_m, SOURCE_M - spec.centre_m
    return float(np.degrees(np.arccos(towards @ right / np.linalg.norm(towards) / np.linalg.norm(right))))


def test_a_steering_delay_is_positive_if_the_second_microphone_is_further_away() -> None:
    microphones_m = np.array([[0.0, 0.0, 0.0], [0.0, 3.43, 0.0], [1.0, 0.0, 0.0]])
    delays = steering_delays_s(
        np.array([[0.0, -1.0, 0.0], [0.0, 4.43, 0.0]]), microphones_m, microphone_pairs(3), 343.0
    )
    assert delays.shape == (3, 2)
    np.testing.assert_allclose(delays[0], [0.01, -0.01])
    np.testing.assert_allclose(delays[1], [(np.sqrt(2.0) - 1) / 343, (np.hypot(1.0, 4.43) - 4.43) / 343])
    np.testing.assert_allclose(delays[2], delays[1] - delays[0])
    points_m = np.random.default_rng(1).uniform(-2, 2, (20, 3))
    slow, fast = (steering_delays_s(points_m, microphones_m, microphone_pairs(3), c) for c in (331.0, 343.0))
    np.testing.assert_allclose(slow, fast * 343.0 / 331.0)


def test_map_peaks_at_the_source_and_mirrored_lags_do_not() -> None:
    gcc = GCCPhat(NORTH, RATE_HZ, C_M_S)([heard(NORTH, SOURCE_M, burst(3000))])
    points_m = GRID.points_m()
    # Half a cell, 87 mm of diagonal, is 2.5 degrees at the 1.8 m from array to source; one array hardly
    # determines the distance, so only the direction counts.
    assert off_axis_deg(NORTH, points_m[mapped(NORTH, gcc).argmax()]) < 2 * 2.5
    mirrored = GCC(gcc.pairs, gcc.lags_s.copy(), gcc.values[:, ::-1].copy())
    assert off_axis_deg(NORTH, points_m[mapped(NORTH, mirrored).argmax()]) > 90
    swapped = GCC(gcc.pairs[:, ::-1].copy(), gcc.lags_s.copy(), gcc.values.copy())
    assert off_axis_deg(NORTH, points_m[mapped(NORTH, swapped).argmax()]) > 90


def test_the_map_of_two_arrays_peaks_at_a_neighbouring_grid_point() -> None:
    power = sum(mapped(spec, ideal(spec)) for spec in (NORTH, SOUTH))
    points_m = GRID.points_m()
    # perhaps not the nearest of all: half a cell along an axis may cost less in one direction than in another
    assert (np.abs(points_m[int(np.argmax(power))] - SOURCE_M) <= GRID.cell_m).all()


def test_the_map_is_the_functional_to_half_a_fine_lag() -> None:
    spec = ArraySpec("pair", line(0.3, 2) + NORTH.centre_m, BAND_HZ)
    for array in (spec, NORTH):
        gcc = ideal(array)
        on_grid = mapped(array, gcc)
        smooth = SRPFunctional([Evidence(array, gcc)], C_M_S).value(GRID.points_m())
        # half a fine lag off at most: half the largest difference, and what the largest curvature takes off
        steepest = 0.5 * np.abs(np.diff(gcc.values, axis=1)).max(axis=1)
        bend = np.abs(np.diff(gcc.values, 2, axis=1)).max(axis=1) / 8
        bound = (steepest + bend).sum() * 2 / len(array.microphones_m)
        assert np.abs(on_grid - smooth).max() <= bound + 1e-6  # of float32
        assert np.abs(on_grid - smooth).max() > 0.5 * bound / len(gcc.pairs)  # and the bound is tight


def test_the_functional_is_the_closed_form() -> None:
    points_m = np.random.default_rng(2).uniform(GRID.lower_m, GRID.upper_m, (500, 3))
    functional = SRPFunctional([Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)], C_M_S)
    expected = exact(NORTH, points_m) + exact(SOUTH, points_m)
    # Cubic between lags h apart errs by 3/128 h^4 max R^(4) = 3/128 (2 pi 6 kHz h)^4 / 5 = 3.5e-5 for each pair: 6 of
    # weight 1/2 in each of 2 arrays.
    np.testing.assert_allclose(functional.value(points_m), expected, atol=6 * 3.5e-5)
    assert functional.value(SOURCE_M[None])[0] == pytest.approx(6.0, abs=6 * 3.5e-5)
    # an error of a tenth of a per mille in the speed of sound shows
    other = SRPFunctional([Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)], 1.0001 * C_M_S)
    assert np.abs(other.value(points_m) - expected).max() > 2 * 6 * 3.5e-5


def test_the_functional_has_no_kinks() -> None:
    """Over half-millimetres its curvature is the closed form's: a roof at every fine lag would stop a climb."""
    functional = SRPFunctional([Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)], C_M_S)
    h_m = 5e-4
    path_m = SOURCE_M + h_m * np.arange(-100, 100)[:, None] * np.array([0.6, 0.0, 0.8])
    second = np.diff(functional.value(path_m), 2) / h_m**2
    expected = np.diff(exact(NORTH, path_m) + exact(SOUTH, path_m), 2) / h_m**2
    assert np.abs(second - expected).max() < 0.1 * np.abs(expected).max()


def test_the_power_at_the_source_is_the_number_of_independent_delays() -> None:
    x, y, z = (float(coordinate) for coordinate in SOURCE_M)
    point = Grid(((x, x), (y, y), (z, z)), 1.0)
    for count in (2, 3, 8, 16):
        spec = ArraySpec("any", np.random.default_rng(count).uniform(0, 0.3, (count, 3)), BAND_HZ)
        functional = SRPFunctional([Evidence(spec, ideal(spec))], C_M_S)
        # K (K - 1) / 2 pairs of value 1 and weight 2 / K; a point half a fine lag off loses (w h / 2)^2 / 2 / 3
        assert functional.value(SOURCE_M[None])[0] == pytest.approx(count - 1, rel=3.5e-5)
        assert mapped(spec, ideal(spec), point)[0] == pytest.approx(count - 1, rel=0.0036)
    assert pair_weight(4) == 0.5


def test_the_gradient_is_that_of_the_closed_form() -> None:
    functional = SRPFunctional([Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)], C_M_S)
    rng = np.random.default_rng(3)
    h_m = 1e-4
    shifts = h_m * np.concatenate([np.eye(3), -np.eye(3)])
    gradients, expected = [], []
    for _ in range(100):
        point_m = rng.uniform(GRID.lower_m, GRID.upper_m)
        gradients.append(functional.derivatives(point_m)[0])
        around = exact(NORTH, point_m + shifts) + exact(SOUTH, point_m + shifts)
        expected.append((around[:3] - around[3:]) / (2 * h_m))
    # a central difference over 2 h lags takes (w h)^2 / 6 = 1.5 % off a slope at 6 kHz; interpolation as much again
    scale = np.abs(expected).max()
    np.testing.assert_allclose(gradients, expected, atol=0.02 * scale)
    assert np.abs(np.array(gradients) + expected).max() > scale  # the sign


def test_the_hessian_at_the_peak_is_that_of_the_closed_form() -> None:
    functional = SRPFunctional([Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)], C_M_S)
    gradient, hessian = functional.derivatives(SOURCE_M)
    h_m = 1e-3
    expected = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            da, db = h_m * np.eye(3)[a], h_m * np.eye(3)[b]
            corners = np.array([SOURCE_M + da + db, SOURCE_M + da - db, SOURCE_M - da + db, SOURCE_M - da - db])
            value = exact(NORTH, corners) + exact(SOUTH, corners)
            expected[a, b] = (value[0] - value[1] - value[2] + value[3]) / (4 * h_m**2)
    # At the peak every R' is zero, so the Gauss-Newton form is the whole. The second difference over h takes
    # (w h)^2 / 12 off, averaged as w^4 / w^2 over the band 0.6 %; a look-up between two lags 0.6 * (w h)^2 / 8 = 1.1 %.
    np.testing.assert_allclose(hessian, expected, atol=0.02 * np.abs(expected).max())
    assert np.linalg.eigvalsh(hessian).max() < 0
    # it is the top: what is left of the gradient moves it by less than a millimetre
    assert np.abs(np.linalg.solve(hessian, gradient)).max() < 1e-3


def test_pair_terms_are_those_of_each_array() -> None:
    evidence = [Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)]
    terms = SRPFunctional(evidence, C_M_S).pair_terms(SOURCE_M + 0.01)
    assert [term.array for term in terms] == ["north", "south"]
    for term, spec in zip(terms, (NORTH, SOUTH), strict=True):
        np.testing.assert_allclose(term.lags_s, true_lags_s(spec.microphones_m, SOURCE_M + 0.01))
        assert term.gradient_s_m.shape == (6, 3)
        assert (term.curvature < 0).all()


def test_order_of_the_arrays_does_not_matter() -> None:
    evidence = [Evidence(spec, ideal(spec)) for spec in (NORTH, SOUTH)]
    points_m = np.random.default_rng(4).uniform(GRID.lower_m, GRID.upper_m, (50, 3))
    one, other = (SRPFunctional(order, C_M_S) for order in (evidence, evidence[::-1]))
    np.testing.assert_allclose(one.value(points_m), other.value(points_m), rtol=1e-12, atol=1e-14)
    for mine, yours in zip(one.derivatives(SOURCE_M), other.derivatives(SOURCE_M), strict=True):
        np.testing.assert_allclose(mine, yours, rtol=1e-9, atol=1e-9)
    alone = [SRPFunctional([each], C_M_S).value(points_m) for each in evidence]
    np.testing.assert_allclose(one.value(points_m), sum(alone))


def test_swapped_channels_need_swapped_microphones() -> None:
    order = np.array([2, 0, 3, 1])
    moved = ArraySpec("moved", NORTH.microphones_m[order], BAND_HZ)
    samples = heard(NORTH, SOURCE_M, burst(3000))
    usual = mapped(NORTH, GCCPhat(NORTH, RATE_HZ, C_M_S)([samples]))
    both = mapped(moved, GCCPhat(moved, RATE_HZ, C_M_S)([samples[order]]))
    # the same look-ups, with some pairs the other way round: where a lag lies between two, the nearest may differ
    assert np.abs(both - usual).max() < 0.1 * usual.max()
    np.testing.assert_allclose(both.argmax(), usual.argmax())
    one = mapped(NORTH, GCCPhat(NORTH, RATE_HZ, C_M_S)([samples[order]]))
    assert one.max() < 0.8 * usual.max()
    assert off_axis_deg(NORTH, GRID.point_m(int(one.argmax()))) > 20


def test_the_map_of_a_plane_is_a_slice_of_the_volume() -> None:
    height_m = float(GRID.axis_m(2)[13])
    plane = Grid((BOUNDS_M[0], BOUNDS_M[1], (height_m, height_m)), 0.1)
    gcc = ideal(NORTH)
    whole = mapped(NORTH, gcc).reshape(GRID.shape)[:, :, 13]
    np.testing.assert_allclose(mapped(NORTH, gcc, plane).reshape(plane.shape)[:, :, 0], whole, atol=1e-6)


def test_the_functional_is_finite_on_a_microphone() -> None:
    place = NORTH.microphones_m[2]
    functional = SRPFunctional([Evidence(NORTH, ideal(NORTH))], C_M_S)
    assert np.isfinite(functional.value(place[None])).all()
    assert all(np.isfinite(part).all() for part in functional.derivatives(place))
