"""The search finds the highest point of the whole map exactly, with compiled kernels and with NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.geometry import Grid, pair_weight
from livessl.core.kernels import kernels as in_use
from livessl.core.kernels import with_numba, with_numpy
from livessl.core.kernels.arguments import BLOCKS, RUNS
from livessl.core.kernels.search_with_numpy import lag_places
from livessl.core.locate import peak_search, refine, search_cubes, srp
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPMapper
from livessl.core.types import ArraySpec, Evidence, Float32Array, FloatArray

ROOM = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
KERNELS = [pytest.param(with_numba, id="numba"), pytest.param(with_numpy, id="NumPy")]


@pytest.fixture(params=KERNELS)
def kernels(request: pytest.FixtureRequest) -> Iterator[ModuleType]:
    before = in_use.in_use
    in_use.use(request.param)
    yield request.param
    in_use.use(before)


def arrays(count: int, seed: int) -> list[ArraySpec]:
    """Random arrays, most of four microphones, some of two, three or six."""
    rng = np.random.default_rng(seed)
    specs = []
    for number in range(count):
        place_m = rng.uniform([0.4, 0.4, 0.4], [3.8, 4.7, 2.3])
        if rng.random() < 0.7:
            specs.append(tetra(f"a{number}", place_m))
        else:
            shape = rng.uniform(-0.2, 0.2, (int(rng.choice([2, 3, 6])), 3))
            specs.append(ArraySpec(f"a{number}", place_m + shape, BAND_HZ))
    return specs


def sounds(specs: list[ArraySpec], kind: str, seed: int) -> list[Evidence]:
    """Evidence of one talker, of two, or of noise alone, with reflections that differ between arrays."""
    rng = np.random.default_rng(seed)
    evidence = []
    sources_m = rng.uniform([0.2, 0.2, 0.2], [4.0, 4.9, 2.5], ({"talker": 1, "two": 2, "noise": 0}[kind], 3))
    for spec in specs:
        samples = 0.02 * rng.standard_normal((len(spec.microphones_m), 2048)).astype(np.float32)
        for number, source_m in enumerate(sources_m):
            sound = burst(2048, seed + number)
            samples += heard(spec, source_m, sound)
            for _ in range(4):
                samples += 0.3 * heard(spec, rng.uniform(-4.0, 8.0, 3), np.roll(sound, int(rng.integers(2048))))
        evidence.append(Evidence(spec, GCCPhat(spec, RATE_HZ, C_M_S)([samples])))
    return evidence


def mapper_of(one: Evidence, grid: Grid) -> SRPMapper:
    return SRPMapper(one.spec, grid, one.gcc.pairs, one.gcc.lags_s, C_M_S)


def fused_map(evidence: list[Evidence], grid: Grid) -> Float32Array:
    maps = [mapper_of(h, grid)(h.gcc) for h in evidence]
    return np.asarray(np.add.reduce(maps))


def searching(evidence: list[Evidence], grid: Grid) -> PeakSearch:
    searched = PeakSearch([h.spec for h in evidence], grid, C_M_S)
    for h in evidence:
        searched.prepare(h.spec.name, h.gcc.lags_s)
    return searched


@pytest.mark.parametrize("kind", ["talker", "two", "noise"])
@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_peak_is_that_of_the_whole_map(kernels: ModuleType, count: int, kind: str) -> None:
    for seed in range(6 if count <= 2 else 3):
        specs = arrays(count, seed)
        evidence = sounds(specs, kind, seed)
        grid = Grid(ROOM, [0.1, 0.06, 0.23][seed % 3])
        searched = searching(evidence, grid)
        power = fused_map(evidence, grid)
        (found,) = searched.among(evidence)(1)
        assert found.point == power.argmax()
        assert found.power == power.max()


def test_both_kinds_of_kernels_find_the_same_peaks() -> None:
    grid = Grid(ROOM, 0.11)
    evidence = sounds(arrays(3, 5), "two", 5)
    said, powers = [], []
    before = in_use.in_use
    try:
        for prepared_by, searched_by in product((with_numba, with_numpy), repeat=2):  # they may change in between
            in_use.use(prepared_by)
            searched, mapper = searching(evidence, grid), mapper_of(evidence[0], grid)
            in_use.use(searched_by)
            box = np.array([[3, 20], [5, 30], [0, 24]])
            said.append(searched.among(evidence)(6, 2, [box]))
            powers.append(mapper(evidence[0].gcc))
    finally:
        in_use.use(before)
    assert all(each == said[0] for each in said)
    assert len(said[0]) == 6
    for power in powers:
        np.testing.assert_allclose(power, powers[0], rtol=1e-5)


def test_several_peaks_are_those_of_the_map(kernels: ModuleType) -> None:
    grid = Grid(ROOM, 0.1)
    for seed in range(4):
        evidence = sounds(arrays(2, seed), "two", seed)
        power = fused_map(evidence, grid)
        box = np.array([[0, 20], [-3, 25], [2, 90]])
        for without in ([], [box]):
            found = searching(evidence, grid).among(evidence)(5, 3, without)
            assert found == refine.in_map(power, grid)(5, 3, without)
            assert all(first.power >= second.power for first, second in pairwise(found))


def test_no_peak_is_found_where_boxes_cover_the_grid(kernels: ModuleType) -> None:
    grid = Grid(ROOM, 0.3)
    evidence = sounds(arrays(2, 1), "talker", 1)
    everything = np.array([[0, 99], [0, 99], [0, 99]])
    assert searching(evidence, grid).among(evidence)(3, 1, [everything]) == []
    assert len(searching(evidence, grid).among(evidence)(3, 50)) == 1  # the second would lie outside


def test_the_first_of_equal_points_is_the_peak(kernels: ModuleType) -> None:
    """In silence the power is zero everywhere."""
    grid = Grid(ROOM, 0.05)
    spec = arrays(1, 3)[0]
    silent = GCCPhat(spec, RATE_HZ, C_M_S)([np.zeros((len(spec.microphones_m), 2048), np.float32)])
    (found,) = searching([Evidence(spec, silent)], grid).among([Evidence(spec, silent)])(1)
    assert (found.point, found.power) == (0, 0.0)


@pytest.mark.parametrize(
    "bounds",
    [
        ((0.0, 4.2), (0.0, 5.1), (1.2, 1.2)),
        ((1.0, 1.0), (2.0, 2.0), (1.5, 1.5)),
        ((0.0, 0.31), (0.0, 5.1), (0.4, 2.7)),
    ],
)
def test_any_box_is_searched(kernels: ModuleType, bounds: tuple[tuple[float, float], ...]) -> None:
    grid = Grid((bounds[0], bounds[1], bounds[2]), 0.1)
    evidence = sounds(arrays(2, 4), "talker", 4)
    power = fused_map(evidence, grid)
    (found,) = searching(evidence, grid).among(evidence)(1)
    assert [found.point, found.power] == [int(power.argmax()), float(power.max())]


def test_arrays_of_different_rates_and_subsets_of_arrays(kernels: ModuleType) -> None:
    specs = arrays(3, 7)
    source_m = np.array([2.31, 1.17, 0.83])
    grid = Grid(ROOM, 0.1)
    evidence = [
        Evidence(spec, ideal_gcc(spec, true_lags_s(spec.microphones_m, source_m), rate_hz))
        for spec, rate_hz in zip(specs, (16e3, 44.1e3, 48e3), strict=True)
    ]
    searched = searching(evidence, grid)
    for chosen in (evidence, evidence[1:], evidence[::-1], evidence[2:]):
        power = fused_map([Evidence(h.spec, h.gcc) for h in chosen], grid)
        (found,) = searched.among(chosen)(1)
        assert [found.point, found.power] == [int(power.argmax()), float(power.max())]


@pytest.mark.parametrize(
    ("size_m", "spacing_m"), [((8.0, 10.0, 4.0), 0.01), ((60.0, 80.0, 20.0), 0.1), ((1000.0, 1000.0, 30.0), 0.05)]
)
def test_memory_is_bounded_whatever_the_grid(size_m: tuple[float, float, float], spacing_m: float) -> None:
    specs = [tetra("a", np.array([2.0, 3.0, 1.0])), tetra("b", np.array([6.0, 7.0, 2.0]))]
    searched = PeakSearch(specs, box(size_m, spacing_m), C_M_S)
    pairs = sum(len(spec.microphones_m) * (len(spec.microphones_m) - 1) // 2 for spec in specs)
    bytes_per_cell = pairs * (2 + 2 + 2 / 64)  # a place and two reaches of a cell, and its cube's share
    assert searched.table_bytes < 1.2 * search_cubes.MOST_CELLS * bytes_per_cell


def box(size_m: tuple[float, float, float], spacing_m: float) -> Grid:
    x_m, y_m, z_m = size_m
    return Grid(((0.0, x_m), (0.0, y_m), (0.0, z_m)), spacing_m)


def far_apart(size_m: tuple[float, float, float], seed: int) -> tuple[Grid, list[ArraySpec], FloatArray]:
    """A large volume with three arrays, and a source 1 m above the ground."""
    rng = np.random.default_rng(seed)
    edge_m = np.array(size_m)
    specs = [tetra(name, rng.uniform(0.1, 0.9, 3) * edge_m) for name in "abc"]
    source_m = np.array([*rng.uniform(0.1, 0.9, 2) * edge_m[:2], 1.0])
    return box(size_m, 0.1), specs, source_m


@settings(max_examples=4, deadline=None)
@given(
    size_m=st.tuples(st.floats(100.0, 400.0), st.floats(100.0, 400.0), st.floats(2.0, 12.0)), seed=st.integers(0, 99)
)
def test_a_source_in_a_yard_is_found(size_m: tuple[float, float, float], seed: int) -> None:
    grid, specs, source_m = far_apart(size_m, seed)
    evidence = [Evidence(spec, ideal_gcc(spec, true_lags_s(spec.microphones_m, source_m))) for spec in specs]
    found = searching(evidence, grid).among(evidence)(3)
    position_m, _ = refine.refine_peaks(srp.SRPFunctional(evidence, C_M_S), found, grid)
    nearest_m = min(float(np.linalg.norm(spec.centre_m - source_m)) for spec in specs)
    assert np.linalg.norm(position_m - source_m) < 0.05 + 1e-3 * nearest_m


def test_noise_in_a_yard_is_searched_to_the_end() -> None:
    """Cells beside an array span nearly all of its lags, at a rate at which there are a thousand of them."""
    rate_hz = 48e3
    grid, specs, _ = far_apart((120.0, 90.0, 8.0), 3)
    rng = np.random.default_rng(3)
    evidence = []
    for spec in specs:
        samples = rng.standard_normal((len(spec.microphones_m), 4096)).astype(np.float32)
        evidence.append(Evidence(spec, GCCPhat(spec, rate_hz, C_M_S)([samples])))
    found = searching(evidence, grid).among(evidence)(2)
    at_m = np.stack([grid.point_m(peak.point) for peak in found])
    power = srp.SRPFunctional(evidence, C_M_S).value(at_m)
    np.testing.assert_allclose(power, [peak.power for peak in found], atol=0.05)
    some_m = rng.uniform(0.0, 1.0, (20_000, 3)) * (120.0, 90.0, 8.0)
    assert srp.SRPFunctional(evidence, C_M_S).value(some_m).max() < found[0].power + 0.05


def test_the_peak_in_a_yard_is_the_highest_of_the_points_examined(
    kernels: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With fewer points a whole yard can be compared; more than one stride takes part."""
    monkeypatch.setattr(search_cubes, "MOST_POINTS", 60_000)
    for seed in range(3):
        grid, specs, _ = far_apart((60.0, 43.0, 5.3), seed)
        evidence = sounds(specs, "noise", seed)
        cubes = search_cubes.search_cubes(specs, grid, C_M_S)
        assert len(np.unique(cubes.strides)) > 2
        inner = np.stack(np.unravel_index(np.arange(cubes.points**3), (cubes.points,) * 3), axis=1)
        begin = (cubes.corners[:, None] + inner * cubes.strides[:, None, None]).reshape(-1, 3)
        stride = np.repeat(cubes.strides, len(inner))[:, None]
        inside = (begin < grid.shape).all(axis=1)
        at = np.minimum(begin + stride // 2, np.array(grid.shape) - 1)[inside]
        points = np.unique(np.ravel_multi_index(tuple(at.T), grid.shape))
        points_m = np.stack([grid.axis_m(axis)[at] for axis, at in enumerate(np.unravel_index(points, grid.shape))], 1)
        power = np.zeros(len(points), np.float32)
        for part in evidence:
            on_axis = srp.LagPlaces.on(part.gcc.lags_s, C_M_S)
            microphones_m = part.spec.microphones_m.astype(np.float32)
            places = lag_places(
                points_m.astype(np.float32), microphones_m, part.gcc.pairs, on_axis.scale, on_axis.offset
            )
            total = np.zeros(len(points), np.float32)
            for row, place in zip(part.gcc.values, places, strict=True):
                total += row[place]
            power += np.float32(pair_weight(len(microphones_m))) * total
        (found,) = searching(evidence, grid).among(evidence)(1)
        assert (found.point, found.power) == (points[power.argmax()], power.max())
        assert found.stride in cubes.strides


def test_more_lags_than_sixteen_bits_can_count_are_an_error() -> None:
    searched = PeakSearch(arrays(1, 1), Grid(ROOM, 0.5), C_M_S)
    with pytest.raises(ValueError, match="array 'a0': expected fewer than 65535 lags, got 70000; its microphones"):
        searched.prepare("a0", np.arange(70_000) / 1e6)


def test_a_bound_over_too_few_lags_loses_peaks(kernels: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison with the whole map notices a wrong bound."""
    exact = peak_search.run_places
    monkeypatch.setattr(peak_search, "run_places", lambda low, high, block: exact(low, (low + high) // 2, block))
    grid = Grid(ROOM, 0.1)
    lost = 0
    for seed in range(20):
        evidence = sounds(arrays(2, seed), "noise", seed)
        searched = searching(evidence, grid)
        lost += searched.among(evidence)(1)[0].point != fused_map(evidence, grid).argmax()
    assert lost > 0


@pytest.mark.parametrize("width", [90, 256, 1063, 5000])
def test_a_running_maximum_covers_all_lags_between_its_ends(kernels: ModuleType, width: int) -> None:
    rng = np.random.default_rng(width)
    values = rng.standard_normal((2, width)).astype(np.float32)
    block = np.repeat(peak_search.block_lags(width), 2)
    maxima = np.zeros((2, len(RUNS) * BLOCKS), np.float32)
    kernels.running_maxima(values, block, maxima)
    ends = np.sort(rng.integers(0, width, (2, 500)), axis=0).astype(np.uint16)
    for low, high, place in zip(*ends, peak_search.run_places(ends[0], ends[1], int(block[0])), strict=True):
        run = RUNS[place // BLOCKS] * block[0]
        first = place % BLOCKS * block[0]
        assert first <= low <= high < first + run
        assert run <= max(1.25 * (high - low + 2 * block[0]), block[0])
        np.testing.assert_array_equal(maxima[:, place], values[:, first : first + run].max(axis=1))
