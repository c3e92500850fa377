"""Peaks found in a map, refined below the grid, and a covariance that matches the scatter of the answers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import GCCPhat, mean_square_angular_frequency
from livessl.core.geometry import Grid, line, posed
from livessl.core.locate import refine
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import GCC, ArraySpec, Evidence, Float32Array, FloatArray

BOUNDS_M = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
GRID = Grid(BOUNDS_M, 0.1)
SOURCE_M = np.array([1.13, 3.31, 1.47])
NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
CHI2_3_MEDIAN = 2.366


def evidence_of(
    specs: tuple[ArraySpec, ...], source_m: FloatArray = SOURCE_M, noise: float = 0.0, seed: int = 1
) -> list[Evidence]:
    """Ideal peaks at the source's lags; and on every lag white noise of a standard deviation."""
    rng = np.random.default_rng(seed)
    evidence = []
    for spec in specs:
        gcc = ideal_gcc(spec, true_lags_s(spec.microphones_m, source_m))
        values = gcc.values + noise * rng.standard_normal(gcc.values.shape)
        evidence.append(Evidence(spec, GCC(gcc.pairs.copy(), gcc.lags_s.copy(), values)))
    return evidence


def covariance_of(evidence: list[Evidence], grid: Grid = GRID, place_m: FloatArray = SOURCE_M) -> FloatArray:
    return refine.laplace_covariance_m2(SRPFunctional(evidence, C_M_S), evidence, place_m, grid)


# The slope of a cubic through lags h apart errs by h^3 R^(4) / 12, so a top by (w h)^2 h / 20 = 34 ns for 6 kHz at an
# eighth of 16 kHz: 12 um of sound path. Over 0.3 m that is 40 urad, 0.1 mm at 2.5 m; five times that where directions
# cross at a small angle:
NEAR_M = 5e-4


def brute_force(power: Float32Array, grid: Grid, count: int) -> list[int]:
    """Take the highest point that is left, and cross out its neighbours, again and again."""
    left = power.reshape(grid.shape).astype(np.float64)
    found: list[int] = []
    while len(found) < count and np.isfinite(left).any():
        x, y, z = (int(i) for i in np.unravel_index(int(left.argmax()), grid.shape))
        found.append(int(np.ravel_multi_index((x, y, z), grid.shape)))
        left[max(0, x - 1) : x + 2, max(0, y - 1) : y + 2, max(0, z - 1) : z + 2] = -np.inf
    return found


@settings(deadline=None)
@given(
    cells=st.tuples(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12)),
    count=st.integers(1, 8),
    smooth=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_peaks_of_a_map_are_those_of_brute_force(
    cells: tuple[int, int, int], count: int, smooth: bool, seed: int
) -> None:
    x, y, z = cells
    grid = Grid(((0.0, float(x)), (0.0, float(y)), (0.0, float(z))), 1.0)
    rng = np.random.default_rng(seed)
    if smooth:
        power = -np.linalg.norm(grid.points_m() - rng.uniform(0, 6, 3), axis=1).astype(np.float32)
    else:
        power = rng.permutation(grid.size).astype(np.float32)
    found = refine.in_map(power, grid)(count)
    points = [peak.point for peak in found]
    assert [peak.power for peak in found] == [power[point] for point in points]
    assert points == brute_force(power, grid, count)
    cell = np.stack(np.unravel_index(points, grid.shape), axis=1)
    assert all(np.abs(cell[a] - cell[b]).max() > 1 for a in range(len(points)) for b in range(a))
    assert all(power[a] >= power[b] for a, b in pairwise(points))


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_refining_climbs_and_stays_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outside_m = rng.uniform(GRID.lower_m - 1.0, GRID.upper_m + 1.0)
    functional = SRPFunctional(evidence_of((NORTH, SOUTH), outside_m, noise=0.1, seed=seed), C_M_S)
    start_m = GRID.point_m(int(rng.integers(GRID.size)))
    position_m, value = refine.refine(functional, start_m, GRID)
    assert (GRID.lower_m <= position_m).all()
    assert (position_m <= GRID.upper_m).all()
    assert value >= functional.value(start_m[None])[0]
    assert value == pytest.approx(functional.value(position_m[None])[0], rel=1e-12)


def test_a_source_outside_the_grid_is_found_on_its_boundary() -> None:
    functional = SRPFunctional(evidence_of((NORTH, SOUTH), np.array([-0.2, 3.1, 1.4])), C_M_S)
    point = int(functional.value(GRID.points_m()).argmax())
    position_m, _ = refine.refine(functional, GRID.point_m(point), GRID)
    assert position_m[0] == 0.0


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_two_arrays_find_a_source_off_the_grid(seed: int) -> None:
    source_m = np.random.default_rng(seed).uniform([0.3, 2.0, 0.4], [1.6, 3.6, 2.3])
    functional = SRPFunctional(evidence_of((NORTH, SOUTH), source_m), C_M_S)
    point = np.abs(GRID.points_m() - source_m).sum(axis=1).argmin()
    position_m, value = refine.refine(functional, GRID.point_m(int(point)), GRID)
    assert np.linalg.norm(position_m - source_m) < NEAR_M
    assert value == pytest.approx(6.0, abs=6 * 3.5e-5)  # the functional's own error, derived at its test


def test_refining_in_a_plane_keeps_its_height() -> None:
    plane = Grid((BOUNDS_M[0], BOUNDS_M[1], (1.2, 1.2)), 0.1)
    source_m = np.array([1.13, 3.31, 1.2])
    evidence = evidence_of((NORTH, SOUTH), source_m)
    functional = SRPFunctional(evidence, C_M_S)
    point = int(functional.value(plane.points_m()).argmax())
    position_m, _ = refine.refine(functional, plane.point_m(point), plane)
    assert position_m[2] == 1.2
    assert np.linalg.norm(position_m - source_m) < NEAR_M
    covariance = covariance_of(evidence, plane, position_m)
    assert (covariance[2] == 0).all()
    assert (covariance[:, 2] == 0).all()
    assert np.linalg.eigvalsh(covariance[:2, :2]).min() > 0


def test_a_grid_of_one_point_returns_that_point() -> None:
    point = Grid(((1.0, 1.0), (2.0, 2.0), (1.5, 1.5)), 0.1)
    evidence = evidence_of((NORTH, SOUTH))
    position_m, _ = refine.refine(SRPFunctional(evidence, C_M_S), point.point_m(0), point)
    assert position_m.tolist() == [1.0, 2.0, 1.5]
    assert (covariance_of(evidence, point, position_m) == 0).all()


def hills(*tops: tuple[tuple[float, float, float], float]) -> Float32Array:
    points_m = GRID.points_m()
    return np.asarray(
        sum(height * np.exp(-50 * ((points_m - place) ** 2).sum(axis=1)) for place, height in tops), dtype=np.float32
    )


FIRST_M, SECOND_M = (1.05, 3.05, 1.25), (3.05, 2.05, 1.25)


def stands_out(power: Float32Array, at_m: FloatArray) -> float:
    find = refine.in_map(power, GRID)
    return refine.confidence(find, find(1)[0], GRID, at_m)


def test_the_confidence_is_the_margin_of_the_peak_over_the_next_place() -> None:
    at_m = np.array(FIRST_M)
    assert stands_out(hills((FIRST_M, 2.0)), at_m) > 0.99
    assert stands_out(hills((FIRST_M, 2.0), (SECOND_M, 2.0)), at_m) < 0.01
    assert stands_out(hills((FIRST_M, 2.0), (SECOND_M, 0.5)), at_m) == pytest.approx(0.75, abs=0.01)
    # within a metre along every axis it is the same place
    near_m, far_m = (1.05 + 0.7, 3.05, 1.25), (1.05 + 1.2, 3.05, 1.25)
    assert stands_out(hills((FIRST_M, 2.0), (near_m, 2.0)), at_m) > 0.9
    assert stands_out(hills((FIRST_M, 2.0), (far_m, 2.0)), at_m) < 0.01
    # the level does not matter
    assert stands_out(100 * hills((FIRST_M, 2.0), (SECOND_M, 0.5)), at_m) == pytest.approx(0.75, abs=0.01)


def test_the_confidence_of_an_empty_map_is_zero() -> None:
    assert stands_out(np.zeros(GRID.size, dtype=np.float32), np.array(FIRST_M)) == 0.0
    assert stands_out(np.full(GRID.size, -1.0, dtype=np.float32), np.array(FIRST_M)) == 0.0
    assert stands_out(hills((SECOND_M, 1.0)), np.array(FIRST_M)) == 0.0  # the peak is elsewhere


@settings(deadline=None, max_examples=25)
@given(noise=st.floats(0.0, 1.0), seed=st.integers(0, 10**6), both=st.booleans())
def test_the_covariance_is_positive_and_no_wider_than_the_volume(noise: float, seed: int, both: bool) -> None:
    place_m = np.random.default_rng(seed).uniform(GRID.lower_m, GRID.upper_m)
    covariance = covariance_of(evidence_of((NORTH, SOUTH) if both else (NORTH,), SOURCE_M, noise, seed), GRID, place_m)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(covariance).min() > 0
    prior = np.diag((GRID.upper_m - GRID.lower_m) ** 2 / 12)  # of a uniform place
    assert np.linalg.eigvalsh(prior - covariance).min() > -1e-9


def test_the_covariance_without_evidence_is_that_of_the_volume() -> None:
    gcc = evidence_of((NORTH,))[0].gcc
    nothing = Evidence(NORTH, GCC(gcc.pairs.copy(), gcc.lags_s.copy(), 0.0 * gcc.values))
    np.testing.assert_allclose(covariance_of([nothing]), np.diag(np.array([4.2, 5.1, 2.7]) ** 2 / 12), rtol=1e-9)


def test_one_array_determines_the_direction_better_than_the_distance() -> None:
    covariance = covariance_of(evidence_of((NORTH,), noise=0.05))
    variance, axes = np.linalg.eigh(covariance)
    towards = (SOURCE_M - NORTH.centre_m) / np.linalg.norm(SOURCE_M - NORTH.centre_m)
    # 1.8 m away from 0.3 m: a lag moves with the angle as d, with the distance as d (d / R) / 2 or less: 12 times less
    assert abs(axes[:, 2] @ towards) > np.cos(np.radians(5))
    assert np.sqrt(variance[2] / variance[1]) > 5
    both = covariance_of(evidence_of((NORTH, SOUTH), noise=0.05))
    assert towards @ both @ towards < 0.2 * (towards @ covariance @ towards)


def test_noise_widens_the_covariance() -> None:
    traces = [np.trace(covariance_of(evidence_of((NORTH, SOUTH), noise=noise))) for noise in (0.05, 0.2, 0.4)]
    assert traces[0] < traces[1] / 2 < traces[2] / 4


def test_covariance_of_one_pair_in_closed_form() -> None:
    """Broadside of two microphones, along their line alone: var(tau) = s^2 kappa / (g kappa)^2, and w = 2/K = 1."""
    spec = ArraySpec("pair", posed(line(0.4, 2), [2.0, 2.0, 1.0]), BAND_HZ)
    grid = Grid(((0.0, 4.0), (4.0, 4.0), (1.0, 1.0)), 0.1)
    source_m = np.array([2.0, 4.0, 1.0])
    (evidence,) = evidence_of((spec,), source_m, noise=0.003)
    (term,) = SRPFunctional([evidence], C_M_S).pair_terms(source_m)
    lobe_s = 2 * np.pi / np.sqrt(mean_square_angular_frequency(BAND_HZ))
    noise = (evidence.gcc.values[0][np.abs(evidence.gcc.lags_s) > lobe_s] ** 2).mean()
    # d tau / dx = 2 sin(gamma / 2) / c for the angle gamma that the pair subtends
    slope_s_m = 2 * 0.2 / np.hypot(0.2, 2.0) / C_M_S
    kappa = mean_square_angular_frequency(BAND_HZ)
    assert -term.curvature[0] == pytest.approx(kappa, rel=0.5)  # three differences of noise 0.003 against 0.029
    variance_s2 = noise * -term.curvature[0] / (term.values[0] * -term.curvature[0]) ** 2 * term.values[0]
    expected = 1 / (slope_s_m**2 / variance_s2 + 12 / 4.0**2)
    assert covariance_of([evidence], grid, source_m)[0, 0] == pytest.approx(expected, rel=1e-6)


@pytest.fixture(scope="module")
def squared_distances() -> FloatArray:
    """Squared Mahalanobis distances of 200 answers: 0.1 s of white noise at 0 dB SNR, at each of two arrays."""
    rng = np.random.default_rng(6)
    n, trials = 1600, 200
    correlate = {spec.name: GCCPhat(spec, RATE_HZ, C_M_S) for spec in (NORTH, SOUTH)}
    point_m = GRID.point_m(int(np.abs(GRID.points_m() - SOURCE_M).sum(axis=1).argmin()))
    distances = np.empty(trials)
    for trial in range(trials):
        sound = rng.standard_normal(n)
        evidence = []
        for spec in (NORTH, SOUTH):
            noisy = heard(spec, SOURCE_M, sound) + rng.standard_normal((4, n))
            evidence.append(Evidence(spec, correlate[spec.name]([noisy.astype(np.float32)])))
        position_m, _ = refine.refine(SRPFunctional(evidence, C_M_S), point_m, GRID)
        error_m = position_m - SOURCE_M
        distances[trial] = error_m @ np.linalg.solve(covariance_of(evidence, GRID, position_m), error_m)
    return distances


# The scale takes an array's pairs for as many delays as are independent, K - 1 of K (K - 1) / 2: it holds where one
# microphone's noise is in all of its pairs alike. Where every pair's noise is its own (low SNR), the pairs together
# determine K / 2 = 2 times as much. The truth lies between, so the median may be half the chi-square's. The median of
# 200 draws has a standard deviation of 1 / (2 p(2.37) sqrt(200)) = 0.19, 8 %; three of them on either side:
LOWEST, HIGHEST = 0.76 * CHI2_3_MEDIAN / 2, 1.24 * CHI2_3_MEDIAN


def test_the_covariance_matches_the_scatter_of_the_answers(squared_distances: FloatArray) -> None:
    assert LOWEST < np.median(squared_distances) < HIGHEST
    assert np.mean(squared_distances < 11.34) > 0.98  # 99 % of a chi-square with three degrees of freedom


@pytest.mark.parametrize("wrong", [1 / 3, 3.0])
def test_a_covariance_wrong_by_a_factor_of_three_would_show(squared_distances: FloatArray, wrong: float) -> None:
    assert not LOWEST < np.median(squared_distances) / wrong < HIGHEST
