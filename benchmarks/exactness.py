"""The search against the whole map: it must find the same grid point and the same value on every map.

    python benchmarks/exactness.py --out docs/performance

Two to eight arrays, a voice, two voices and noise, grids of 0.1 and 0.05 m; the maps are those of
the compiled mapper.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from threadpoolctl import threadpool_limits

import machine
from livessl.cli.progress import counted
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.kernels import kernels
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPMapper
from livessl.core.types import Evidence, Float32Array
from livessl.lab.bench.kernels import C_M_S, KINDS, PLACES_M, RATE_HZ, Blocks, array_specs
from peer_maps import room_grid

COUNTS: Final = (2, 3, 4, 6, 8)
SPACINGS_M: Final = (0.1, 0.05)
SOUNDS: Final = 6
"""Sounds of each kind: with three kinds, five numbers of arrays and two grids they make 180 maps."""


def compare(
    spacings_m: Sequence[float] = SPACINGS_M,
    counts: Sequence[int] = COUNTS,
    sounds: int = SOUNDS,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[dict[str, Any]]:
    """Compare the search with the map, case by case.

    Returns
    -------
    list of dict
        For each case the number of `maps`, and the number on which the search found the `same` grid point and value.
    """
    specs = array_specs(max(counts))
    blocks = Blocks(specs)
    gcc = [GCCPhat(spec, RATE_HZ, C_M_S) for spec in specs]
    cases: dict[tuple[float, int, str], dict[str, int]] = {}
    done, total = 0, len(spacings_m) * len(KINDS) * sounds
    for spacing_m in spacings_m:
        grid = room_grid(spacing_m)
        search = PeakSearch(specs, grid, C_M_S)
        for spec, make in zip(specs, gcc, strict=True):
            search.prepare(spec.name, make.lags_s)
        mappers = [SRPMapper(s, grid, make.pairs, make.lags_s, C_M_S) for s, make in zip(specs, gcc, strict=True)]
        for kind in KINDS:
            for number in range(sounds):
                heard = [
                    Evidence(s, make([x])) for s, make, x in zip(specs, gcc, blocks.sound(kind, number), strict=True)
                ]
                maps = [mapper(one.gcc) for mapper, one in zip(mappers, heard, strict=True)]
                for count, point, value in _peaks(maps, counts):
                    (found,) = search.among(heard[:count])(1)
                    case = cases.setdefault((spacing_m, count, kind), {"maps": 0, "same": 0})
                    case["maps"] += 1
                    case["same"] += (found.point, found.power) == (point, value)
                progress(done := done + 1, total)
    names = ("spacing_m", "arrays", "kind")
    return [dict(zip(names, key, strict=True)) | found for key, found in cases.items()]


def _peaks(maps: Sequence[Float32Array], counts: Sequence[int]) -> Iterator[tuple[int, int, float]]:
    """Highest point, and its value, of the fused maps of the first so many arrays; fused one after the other."""
    fused = maps[0].copy()
    for count, one in enumerate(maps[1:], start=2):
        fused += one
        if count in counts:
            point = int(fused.argmax())
            yield count, point, float(fused[point])


def main() -> int:
    """Compare, write exactness.json, and fail unless all results are the same."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--sounds", type=int, default=SOUNDS, help=f"sounds of each kind (default: {SOUNDS})")
    arguments = parser.parse_args()
    about = machine.describe()
    with threadpool_limits(limits=1), counted("maps", "sound") as show:
        cases = compare(sounds=arguments.sounds, progress=show)
    maps, same = (sum(case[name] for case in cases) for name in ("maps", "same"))
    report = {
        "machine": about,
        "kernels": kernels.NAME,
        "maps": maps,
        "same": same,
        "most_arrays": len(PLACES_M),
        "cases": cases,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "exactness.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    for case in cases:
        if case["same"] < case["maps"]:
            print(
                f"{case['spacing_m']:g} m, {case['arrays']} arrays, {case['kind']}: "
                f"{case['same']} of {case['maps']} the same"
            )
    print(f"{same} of {maps} maps: the search finds the same point and value")
    return 0 if same == maps else 1


if __name__ == "__main__":
    sys.exit(main())
