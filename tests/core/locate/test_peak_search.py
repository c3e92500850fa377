"""The search finds the highest point of the whole map exactly, with compiled kernels and with NumPy."""

from __future__ import annotations

from itertools import pairwise
from types import ModuleType

import numpy as np
import pytest

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.geometry import Grid
from livessl.core.kernels import with_numba, with_numpy
from livessl.core.kernels.arguments import BLOCKS, RUNS
from livessl.core.locate import peak_search, refine, srp
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPMapper
from livessl.core.types import ArraySpec, Evidence, Float32Array

ROOM = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
KERNELS = [pytest.param(with_numba, id="numba"), pytest.param(with_numpy, id="NumPy")]


@pytest.fixture(params=KERNELS)
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    chosen: ModuleType = request.param
    for module in (peak_search, srp):
        monkeypatch.setattr(module, "kernels", chosen)
    return chosen


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


def fused_map(evidence: list[Evidence], grid: Grid) -> Float32Array:
    maps = [SRPMapper(h.spec, grid, h.gcc.pairs, h.gcc.lags_s, C_M_S)(h.gcc) for h in evidence]
    return np.asarray(np.add.reduce(maps))


def searching(evidence: list[Evidence], grid: Grid) -> PeakSearch:
    searched = PeakSearch([h.spec for h in evidence], grid, C_M_S)
    for h in evidence:
        searched.prepare(h.spec.name, h.gcc.lags_s)
    return searched


@pytest.mark.parametrize("kind", ["talker", "two", "noise"])
@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_peak_is_that_of_the_whole_map(kernels: ModuleType, count: int, kind: str) -> None:
    for seed in range(6):
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
    said = []
    for kind in (with_numba, with_numpy):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(peak_search, "kernels", kind)
            searched = searching(evidence, grid)
            box = np.array([[3, 20], [5, 30], [0, 24]])
            said.append(searched.among(evidence)(6, 2, [box]))
    assert said[0] == said[1]
    assert len(said[0]) == 6


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


def test_memory_does_not_grow_with_the_grid() -> None:
    specs = arrays(2, 2)
    coarse, fine = (PeakSearch(specs, Grid(((0.0, 8.0), (0.0, 10.0), (0.0, 4.0)), s), C_M_S) for s in (0.05, 0.01))
    assert coarse.table_bytes == fine.table_bytes
    hall = PeakSearch(specs, Grid(((0.0, 60.0), (0.0, 80.0), (0.0, 20.0)), 0.5), C_M_S)
    pairs = sum(len(spec.microphones_m) * (len(spec.microphones_m) - 1) // 2 for spec in specs)
    bytes_per_cell = (
        2 * pairs * (1 + 8 + 1 / 64)
    )  # a place of 16 bits for the cell, for its halves and its cube's share
    assert hall.table_bytes < 2 * peak_search.MOST_CELLS * bytes_per_cell


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
