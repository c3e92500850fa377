"""livessl and other codes at the same work, in one process, in turn, on one thread: their times and their accuracy.

    python benchmarks/peers.py --out docs/performance

Two tetrahedra, blocks of 4096 samples, 100 to 6000 Hz, the room of `livessl.lab.bench.kernels`. The work is the whole
path from samples through the summed map to its highest grid point. All codes pad a block with as many zeros as livessl
does, so that no lag wraps round and all maps are comparable. Beside each time stands the correlation of the map with
that of the plain formula in double precision. Imports, tables and other one-time work are not counted.

On the fine grid the others are timed on a random part of the grid points, and the time is scaled with their number: all
of them work point by point, and their work per block is below a hundredth of that on the part.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeVar

import numba
import numpy as np
from threadpoolctl import threadpool_limits

import machine
from livessl import wire
from livessl.cli.progress import counted
from livessl.clock import SystemClock
from livessl.core.correlate.gcc_phat import GCCPhat, correlated
from livessl.core.geometry import Grid, posed, tetrahedron
from livessl.core.kernels import kernels, with_numba, with_numpy
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.refine import Peak
from livessl.core.locate.srp import SRPMapper
from livessl.core.types import ArraySpec, Evidence, Float32Array, FloatArray, Frame
from livessl.lab.bench import kernels as bench
from peer_maps import PEERS, STEERING_BYTES, Power, Sounds, reference, room_grid

COARSE_M: Final = 0.5
FINE_M: Final = 0.1
PART: Final = 1000
"""Grid points of the fine grid on which the others are timed."""

CHECKED: Final = 3
"""Number of blocks whose maps are compared with the reference."""

SPACINGS_M: Final = (0.5, 0.1, 0.05)
COUNTS: Final = (2, 4, 8)
MICROPHONES: Final = (2, 4, 8, 16)
MAP_SPACINGS_M: Final = (0.5, 0.2, 0.1, 0.05)

Heard = TypeVar("Heard")


@contextmanager
def using(form: ModuleType) -> Iterator[None]:
    """Build and run with one form of the kernels."""
    before = kernels.in_use
    kernels.use(form)
    try:
        yield
    finally:
        kernels.use(before)


class Ours:
    """The code of livessl with one form of the kernels, on one grid.

    Parameters
    ----------
    specs : sequence of ArraySpec
    grid : Grid
    form : module
    """

    def __init__(self, specs: Sequence[ArraySpec], grid: Grid, form: ModuleType) -> None:
        self._form = form
        self._gcc = {spec.name: GCCPhat(spec, bench.RATE_HZ, bench.C_M_S) for spec in specs}
        self._specs = specs
        self._power = np.empty(grid.size, np.float32)
        with using(form):
            self._mappers = [
                SRPMapper(s, grid, self._gcc[s.name].pairs, self._gcc[s.name].lags_s, bench.C_M_S) for s in specs
            ]
            self._search = PeakSearch(specs, grid, bench.C_M_S)
            for spec in specs:
                self._search.prepare(spec.name, self._gcc[spec.name].lags_s)

    def evidence(self, sounds: Sounds) -> list[Evidence]:
        """Return every array's GCC."""
        gccs = correlated([(self._gcc[spec.name], [x]) for spec, x in zip(self._specs, sounds, strict=True)])
        return [Evidence(spec, gcc) for spec, gcc in zip(self._specs, gccs, strict=True)]

    def power(self, sounds: Sounds) -> Float32Array:
        """Return the summed map (G,), which the next call overwrites."""
        return self.mapped(self.evidence(sounds))

    def mapped(self, evidence: Sequence[Evidence]) -> Float32Array:
        """Return the summed map of GCCs."""
        self._power[:] = 0.0
        with using(self._form):
            for mapper, one in zip(self._mappers, evidence, strict=True):
                mapper.add(self._power, one.gcc)
        return self._power

    def peak(self, sounds: Sounds) -> int:
        """Return the highest grid point, without the map."""
        with using(self._form):
            (found,) = self._search.among(self.evidence(sounds))(1)
        return found.point


@dataclass(frozen=True, slots=True)
class _Contender:
    """One code on one grid: the function to time, the number of grid points that it covers, and the map to check.

    `power` gives the map at the grid points of the reference; None if the code makes no map.
    """

    name: str
    spacing_m: float
    nodes: int
    timed_nodes: int
    run: Callable[[Sounds], int]
    power: Power | None


def _contenders(specs: Sequence[ArraySpec], spacing_m: float, part: int | None) -> Iterator[_Contender]:
    """Yield all codes; with `part`, the others work on that number of random grid points."""
    grid = room_grid(spacing_m)
    rng = np.random.default_rng(0)
    which = np.arange(grid.size) if part is None else np.sort(rng.choice(grid.size, part, replace=False))
    points_m = grid.points_m()[which]

    def at_part(ours: Ours) -> Power:
        return lambda sounds: ours.power(sounds)[which]

    def to_peak(power: Power) -> Callable[[Sounds], int]:
        return lambda sounds: int(power(sounds).argmax())

    for form in (with_numba, with_numpy):
        ours = Ours(specs, grid, form)
        label = {"numba": "compiled", "NumPy": "NumPy"}[form.NAME]
        yield _Contender(f"livessl, map, {label}", spacing_m, grid.size, grid.size, to_peak(ours.power), at_part(ours))
        yield _Contender(f"livessl, search, {label}", spacing_m, grid.size, grid.size, ours.peak, None)
    for name, make in {**PEERS, REFERENCE: reference}.items():
        power = make(specs, points_m)
        yield _Contender(name, spacing_m, grid.size, len(which), to_peak(power), power)


REFERENCE: Final = "plain formula, double precision"


def side_by_side(rounds: int, progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
    """Measure times and correlations of all codes on both grids; the reference itself is timed like the rest."""
    specs = bench.array_specs(2)
    blocks = bench.Blocks(specs)
    heard = [blocks.sound("voice", number) for number in range(12)]
    contenders = [*_contenders(specs, COARSE_M, None), *_contenders(specs, FINE_M, PART)]
    cases = [bench.Case(one.name, _each(one.run, heard)) for one in contenders]
    (taken_ms,) = bench.timed_ms(SystemClock(), cases, rounds, progress)

    plain = {one.spacing_m: one for one in contenders if one.name == REFERENCE}
    maps = {m: [np.array(one.power(sounds)) for sounds in heard[:CHECKED]] for m, one in plain.items() if one.power}
    nodes = {m: [int(power.argmax()) for power in maps[m]] for m in maps}
    rows: list[dict[str, Any]] = []
    for one, ms in zip(contenders, taken_ms, strict=True):
        truth = maps[one.spacing_m]
        correlation = None
        if one.power is not None:
            pairs = zip(map(one.power, heard), truth, strict=False)
            correlation = min(float(np.corrcoef(own, true)[0, 1]) for own, true in pairs)
        same = None
        if len(truth[0]) == one.nodes:
            same = sum(one.run(x) == node for x, node in zip(heard, nodes[one.spacing_m], strict=False))
        scale = one.nodes / one.timed_nodes
        rows.append(
            {
                "name": one.name,
                "spacing_m": one.spacing_m,
                "nodes": one.nodes,
                "timed_nodes": one.timed_nodes,
                "median_ms": float(np.median(ms)) * scale,
                "least_ms": float(ms.min()) * scale,
                "correlation": correlation,
                "same_peaks": same,
            }
        )
    for row in rows:
        (ours,) = (r for r in rows if r["name"] == "livessl, map, compiled" and r["spacing_m"] == row["spacing_m"])
        row["ratio"] = row["median_ms"] / ours["median_ms"]
    return rows


def searches(rounds: int, progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
    """Measure the search alone, over grids, numbers of arrays, lengths and kinds of sound; GCCs are computed before."""
    specs = bench.array_specs(max(COUNTS))
    blocks = bench.Blocks(specs)
    gcc = [GCCPhat(spec, bench.RATE_HZ, bench.C_M_S) for spec in specs]
    lengths = {"block": bench.BLOCK, "1 s": bench.SEGMENT}

    def evidence(kind: str, length: str, number: int) -> list[Evidence]:
        sounds = blocks.sound(kind, number, lengths[length])
        return [Evidence(spec, make([x])) for spec, make, x in zip(specs, gcc, sounds, strict=True)]

    heard = {
        (kind, length): [evidence(kind, length, number) for number in range({"block": 12, "1 s": 3}[length])]
        for kind in bench.KINDS
        for length in lengths
    }

    def search_in(peaks: PeakSearch) -> Callable[[list[Evidence]], Peak]:
        return lambda one: peaks.among(one)(1)[0]

    rows: list[dict[str, Any]] = []
    cases = []
    for spacing_m in SPACINGS_M:
        peaks = PeakSearch(specs, room_grid(spacing_m), bench.C_M_S)
        for spec, make in zip(specs, gcc, strict=True):
            peaks.prepare(spec.name, make.lags_s)
        for count in COUNTS:
            for (kind, length), sounds in heard.items():
                some = [one[:count] for one in sounds]
                find = search_in(peaks)
                rows.append(
                    {"spacing_m": spacing_m, "arrays": count, "length": length, "kind": kind} | {"sounds": len(sounds)}
                )
                cases.append(bench.Case("peak", _each(find, some)))
    return _with_times(rows, *bench.timed_ms(SystemClock(), cases, rounds, progress))


def growth(rounds: int, progress: Callable[[int, int], None]) -> dict[str, list[dict[str, Any]]]:
    """Measure times against the number of microphones of two arrays, and of the map against the size of the grid.

    The map of the fine grid alone is measured with both forms of the kernels, relative to as many bare look-ups.
    """
    shape = tetrahedron(0.5)
    parts = [
        ArraySpec(f"{place}.{turn}", posed(shape, place, yaw_deg=23.0 * turn, pitch_deg=41.0 * turn), bench.BAND_HZ)
        for place in bench.PLACES_M[:2]
        for turn in range(max(MICROPHONES) // 4)
    ]
    sounds = bench.Blocks(parts).sound("voice", 0)
    half = len(parts) // 2
    microphones: list[dict[str, Any]] = []
    cases = []
    for count in MICROPHONES:
        specs, heard = [], []
        for name, own in (("a", slice(half)), ("b", slice(half, None))):
            place_m = np.concatenate([part.microphones_m for part in parts[own]])[:count]
            specs.append(ArraySpec(name, place_m, bench.BAND_HZ))
            heard.append(np.concatenate(sounds[own])[:count])
        fine, display = Ours(specs, room_grid(0.05), with_numba), Ours(specs, room_grid(FINE_M), with_numba)
        microphones += [{"microphones": count, "what": what} for what in ("GCC", "peak", "map")]
        cases += [
            bench.Case("GCC", _each(fine.evidence, [heard])),
            bench.Case("peak", _each(fine.peak, [heard])),
            bench.Case("map", _each(display.power, [heard])),
        ]
    specs = bench.array_specs(2)
    block = bench.Blocks(specs).sound("voice", 0)
    maps: list[dict[str, Any]] = []
    for spacing_m in MAP_SPACINGS_M:
        ours = Ours(specs, room_grid(spacing_m), with_numba)
        maps.append({"spacing_m": spacing_m, "nodes": room_grid(spacing_m).size})
        cases.append(bench.Case("map", _each(ours.power, [block])))
    forms: list[dict[str, Any]] = []
    for form in (with_numba, with_numpy):
        ours = Ours(specs, room_grid(FINE_M), form)
        forms.append({"kernels": form.NAME, "look_ups": 12 * room_grid(FINE_M).size})
        cases.append(bench.Case("map alone", _each(ours.mapped, [ours.evidence(block)])))
    cases.append(bench.bare_look_ups())
    (taken_ms,) = bench.timed_ms(SystemClock(), cases, rounds, progress)
    of_microphones, of_maps, of_forms, floor_ms = np.split(
        taken_ms, np.cumsum([len(microphones), len(maps), len(forms)])
    )
    lookup_ms = float(np.median(floor_ms)) / bench.LOOKED_UP
    return {
        "microphones": _with_times(microphones, of_microphones),
        "maps": _with_times(maps, of_maps),
        "forms": [
            row | {"ratio": row["median_ms"] / (row["look_ups"] * lookup_ms)} for row in _with_times(forms, of_forms)
        ],
    }


def frame_bytes() -> int:
    """Return the size of an array's 50 ms on the wire."""
    samples = np.zeros((4, round(bench.RATE_HZ / 20)), np.float32)
    return len(wire.encode(Frame("array1", 0, 0, 0, bench.RATE_HZ, samples, 0.0, True)))


def _each(run: Callable[[Heard], object], heard: Sequence[Heard]) -> Callable[[int], object]:
    """Return a function of the round's number that runs on one block after the other."""
    return lambda number: run(heard[number % len(heard)])


def _with_times(rows: list[dict[str, Any]], taken_ms: FloatArray) -> list[dict[str, Any]]:
    return [
        row | {"median_ms": float(np.median(ms)), "p95_ms": float(np.percentile(ms, 95)), "least_ms": float(ms.min())}
        for row, ms in zip(rows, taken_ms, strict=True)
    ]


def main() -> int:
    """Measure everything and write peers.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--rounds", type=int, default=15, help="rounds of all codes, side by side (default: 15)")
    parser.add_argument(
        "--search-rounds", type=int, default=60, help="rounds of our search and maps alone (default: 60)"
    )
    arguments = parser.parse_args()
    about = machine.describe()
    numba.set_num_threads(1)
    with threadpool_limits(limits=1):
        with counted("side by side", "round") as show:
            rows = side_by_side(arguments.rounds, show)
        with counted("searches", "round") as show:
            found = searches(arguments.search_rounds, show)
        with counted("growth", "round") as show:
            grown = growth(arguments.search_rounds, show)
    report = {
        "machine": about,
        "rounds": arguments.rounds,
        "search_rounds": arguments.search_rounds,
        "checked": CHECKED,
        "side_by_side": rows,
        "searches": found,
        **grown,
        "frame_bytes": frame_bytes(),
        "steering_bytes_a_node": STEERING_BYTES,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "peers.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    for row in rows:
        correlation = "" if row["correlation"] is None else f"  correlation {row['correlation']:.4f}"
        print(
            f"{row['spacing_m']:g} m  {row['name']:<32} {row['median_ms']:12.3f} ms  x {row['ratio']:.3g}{correlation}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
