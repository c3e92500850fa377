"""Writes docs/performance.md from the benchmarks' files; with `--measure` it runs the benchmarks first.

    python benchmarks/performance.py --measure      # about six minutes, on a machine that does nothing else
    python benchmarks/performance.py                # the text alone, from the files in docs/performance/

Every figure in the text comes from those files.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

import machine
from livessl.cli.progress import counted
from livessl.clock import SystemClock
from livessl.core.types import FRAME_S
from livessl.lab.bench import kernels

HERE: Final = Path(__file__).parent
DOCS: Final = HERE.parent / "docs"
OURS: Final = "livessl, map, compiled"

LIVE: Final = (
    (4, 1, False), (4, 20, False), (4, 100, False), (8, 20, False), (16, 20, False), (32, 20, False), (64, 20, False),
    (16, 20, True), (64, 20, True),
)  # fmt: skip
"""Arrays and clients of each run of the service, and whether a foreign process keeps each core busy meanwhile."""

TO_BUY: Final = (10, 100, 1000)
"""Numbers of arrays for which hardware is recommended."""

USED: Final = 0.6
"""Share of cores, memory and links that is in use if all arrays send sound at once."""

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Fit:
    """The growth of a cost: `factor * x ** exponent`, or `factor * x + offset`, and the largest deviation.

    Parameters
    ----------
    factor, exponent, offset : float
    worst : float
        Largest deviation of a measurement from the fit, relative to the fit.
    """

    factor: float
    exponent: float
    offset: float
    worst: float

    def __call__(self, x: float) -> float:
        """Return the cost at x."""
        return self.offset + self.factor * float(x**self.exponent)

    @classmethod
    def power(cls, x: Sequence[float], y: Sequence[float]) -> Fit:
        """Fit a power by least squares of the logarithms."""
        exponent, logarithm = np.polyfit(np.log(x), np.log(y), 1)
        return cls._judged(math.exp(logarithm), float(exponent), 0.0, x, y)

    @classmethod
    def line(cls, x: Sequence[float], y: Sequence[float]) -> Fit:
        """Fit a line by least squares of the relative deviations, so that small costs count as much as large ones."""
        factor, offset = np.polyfit(x, y, 1, w=1.0 / np.asarray(y))
        return cls._judged(float(factor), 1.0, float(offset), x, y)

    @classmethod
    def _judged(cls, factor: float, exponent: float, offset: float, x: Sequence[float], y: Sequence[float]) -> Fit:
        fitted = factor * np.asarray(x, dtype=np.float64) ** exponent + offset
        return cls(factor, exponent, offset, float(np.abs(np.asarray(y) / fitted - 1.0).max()))


def measure(folder: Path, parts: Iterable[str], *, brief: bool) -> None:
    """Run the benchmarks, one after the other, each writing its file.

    Raises
    ------
    subprocess.CalledProcessError
        If one fails; exactness fails if the search and the map differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs: dict[str, Callable[[], None]] = {
        "kernels": lambda: _measure_kernels(folder, 5 if brief else 200),
        "peers": lambda: _script("peers.py", folder, *(["--rounds", "2", "--search-rounds", "3"] if brief else [])),
        "exactness": lambda: _script("exactness.py", folder, *(["--sounds", "1"] if brief else [])),
        "startup": lambda: _script("startup.py", folder, *(["--starts", "2"] if brief else [])),
        "live": lambda: _measure_live(folder, 3.0 if brief else 12.0),
    }
    for part in parts:
        print(f"performance: measuring {part}", file=sys.stderr)
        runs[part]()


def _script(name: str, folder: Path, *options: str) -> None:
    subprocess.run([sys.executable, str(HERE / name), "--out", str(folder), *options], check=True)  # noqa: S603 - ours


def _measure_kernels(folder: Path, rounds: int) -> None:
    about = machine.describe()
    with counted("kernels", "round") as show:
        report = kernels.measure(SystemClock(), rounds, progress=show)
    _write(folder / "kernels.json", {"machine": about, "rounds": rounds, **report.as_json()})


def _measure_live(folder: Path, seconds: float) -> None:
    for arrays, clients, spin in LIVE:
        about = machine.describe()
        command = [sys.executable, "-m", "livessl", "bench", "--live", "--json", *(["--spin"] if spin else [])]
        command += ["--arrays", str(arrays), "--clients", str(clients), "--seconds", str(seconds)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE)  # noqa: S603 - ours
        _write(folder / f"{_live_name(arrays, clients, spin)}.json", {"machine": about, **json.loads(done.stdout)})


def _live_name(arrays: int, clients: int, spin: bool) -> str:
    return f"live-{arrays}-{clients}" + ("-spin" if spin else "")


def _read(file: Path) -> Json:
    report: Json = json.loads(file.read_text(encoding="utf-8"))
    return report


def _write(file: Path, report: Json) -> None:
    file.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def document(folder: Path) -> str:
    """Return the text, made from the files in a folder.

    Raises
    ------
    FileNotFoundError
        If a file is missing; those of the service may all be missing.
    ValueError
        If the files are of different machines, or only some of the service's are missing.
    """
    names = ("kernels", "peers", "exactness", "startup")
    measured, peers, exact, startup = (_read(folder / f"{name}.json") for name in names)
    files = [folder / f"{_live_name(*demand)}.json" for demand in LIVE]
    missing = [file.name for file in files if not file.exists()]
    if 0 < len(missing) < len(files):
        raise ValueError(
            f"{folder}: expected every run of the service or none, {', '.join(missing)} lacking; "
            "measure them: python benchmarks/performance.py --measure live"
        )
    live = [] if missing else [_read(file) for file in files]
    sections = [
        _head([measured, peers, exact, startup, *live]),
        _ratios(peers, exact),
        _side_by_side(peers),
        _exactness(exact),
        _kernels(measured),
        _searches(peers),
        _service(live),
        _startup(startup),
        _growth(peers, live),
        _purchase(peers, live),
    ]
    return "\n\n".join("\n".join(section) for section in sections) + "\n"


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def _number(value: float) -> str:
    """Return a number with three significant figures, without an exponent."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    rounded = value if digits else float(f"{value:.3g}")
    return f"{rounded:,.{digits}f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _paragraph(*parts: str) -> str:
    return textwrap.fill(" ".join(parts), 120, break_long_words=False, break_on_hyphens=False)


def _item(*parts: str) -> str:
    return textwrap.indent(_paragraph(*parts), "  ").replace("  ", "- ", 1)


def _head(reports: Sequence[Json]) -> Iterator[str]:
    machines = [report["machine"] for report in reports]
    one = machines[0]
    if any({**other, "load_before": 0} != {**one, "load_before": 0} for other in machines):
        raise ValueError(
            "docs/performance: expected every file to be of one machine and one set of versions, got several; "
            "measure all of it again: python benchmarks/performance.py --measure"
        )
    yield "# Performance"
    yield ""
    yield _paragraph(
        "This page is generated by `python benchmarks/performance.py --measure`, in about six minutes on a machine",
        "that does nothing else; every figure comes from the files in [performance/](performance). Milliseconds are",
        "those of this machine on that day, so compare ratios, and only within one table. All times are medians, and",
        "on one thread except for the service.",
    )
    yield ""
    yield _paragraph(
        f"{one['cpu']}, {one['cores']} cores, {one['memory_gb']:g} GB; {one['system']}, Python {one['python']},",
        ", ".join(f"{name} {version}" for name, version in one["packages"].items()) + ".",
        "Load average before the measurements:",
        f"{min(m['load_before'] for m in machines):g} to {max(m['load_before'] for m in machines):g}.",
    )
    yield ""
    yield _paragraph(
        "Unless stated otherwise, two tetrahedra of 0.5 m stand 5 m apart in a room of 8 x 10 x 4 m with a",
        "reverberation time of 0.7 s and record a voice at an SNR of 20 dB; blocks have 4096 samples at 44.1 kHz, and",
        "the band is 100 to 6000 Hz.",
    )


def _row(peers: Json, name: str, spacing_m: float) -> Json:
    return next(r for r in peers["side_by_side"] if (r["name"], r["spacing_m"]) == (name, spacing_m))


def _ratios(peers: Json, exact: Json) -> Iterator[str]:
    by_form = {form["kernels"]: form["ratio"] for form in peers["forms"]}
    yield "## In short"
    yield ""
    yield _item(
        f"The map of the 0.1 m grid takes {by_form['numba']:.1f} times what as many bare look-ups take on this",
        f"machine, and {by_form['NumPy']:.1f} times without numba.",
    )
    for name in ("pyroomacoustics", "acoular", "steering product, NumPy"):
        coarse, fine = (_number(_row(peers, name, spacing)["ratio"]) for spacing in (0.5, 0.1))
        yield _item(
            f"From samples to the highest grid point of the summed map, {name} takes {coarse} times as long as livessl",
            f"on a 0.5 m grid and {fine} times on a 0.1 m grid.",
        )
    ours, search = _row(peers, OURS, 0.1), _row(peers, "livessl, search, compiled", 0.1)
    yield _item(
        f"The search, without the map, takes {_number(search['median_ms'] / ours['median_ms'])} of the map's time on a",
        f"0.1 m grid; on {exact['same']} of {exact['maps']} maps it finds the same grid point and value as the map.",
    )


def _side_by_side(peers: Json) -> Iterator[str]:
    yield "## Side by side"
    yield ""
    yield _paragraph(
        f"All codes run in turn, in one process, on one thread, for {peers['rounds']} rounds: from samples through the",
        f"summed map to its highest grid point. The ratio is relative to *{OURS}*. *Correlation* is that with the map",
        f"of the plain formula, the least of {peers['checked']} blocks; *same peak* is the number of these blocks on",
        "which the highest grid point is that of the formula. Imports and tables are not counted.",
    )
    yield ""
    rows = []
    for row in peers["side_by_side"]:
        part = "" if row["timed_nodes"] == row["nodes"] else f" ({row['timed_nodes']} of {row['nodes']} points, scaled)"
        rows.append(
            (
                f"{row['spacing_m']:g} m{part}", row["name"], _number(row["ratio"]), _number(row["median_ms"]),
                "" if row["correlation"] is None else f"{row['correlation']:.4f}",
                "" if row["same_peaks"] is None else f"{row['same_peaks']} of {peers['checked']}",
            )
        )  # fmt: skip
    yield from _table(("grid", "code", "ratio", "ms per block", "correlation", "same peak"), rows)
    yield ""
    yield _paragraph(
        "All codes pad the block with the same number of zeros, so that no lag wraps round. On the fine grid the",
        "others are timed on random grid points, and the time is scaled with their number, because they work point by",
        "point. The steering product stores its matrix, which would take",
        f"{_number(peers['steering_bytes_a_node'] * _row(peers, OURS, 0.1)['nodes'] / 1e9)} GB for the whole fine",
        "grid. acoular's time includes the cross-spectral matrix. pyroomacoustics is made for directions, and its near",
        "field does not work as delivered: several distances raise an error, the grid ignores the distance, and the",
        "steering has the opposite sign of that of the far field. Here it gets the grid points as its grid, with the",
        "sign reversed; the rest is its own loop.",
    )


def _exactness(exact: Json) -> Iterator[str]:
    yield "## The same grid point as the whole map"
    yield ""
    yield _paragraph(
        f"{exact['same']} of {exact['maps']} maps: 2 to {exact['most_arrays']} arrays, a voice, two voices and noise,",
        "grids of 0.1 and 0.05 m.",
    )


def _kernels(measured: Json) -> Iterator[str]:
    yield "## Kernels"
    yield ""
    yield _paragraph(
        f"{measured['kernels']}, {measured['rounds']} rounds; a bare look-up takes {measured['lookup_ns']:.2f} ns. The",
        "ratio is relative to the time of as many bare look-ups. *In turn* is after all other rows, when the caches",
        "hold their data; *again* is right after that, with the next block, as when one recording is processed.",
    )
    yield ""
    yield from _table(
        ("what", "ratio", "in turn, median / 99 % (ms)", "again, median / 99 % (ms)"),
        (
            (one["name"], "" if one["ratio"] is None else f"{one['ratio']:.2f}",
             f"{_number(one['median_ms'])} / {_number(one['p99_ms'])}",
             f"{_number(one['again_median_ms'])} / {_number(one['again_p99_ms'])}")
            for one in measured["timings"]
        ),
    )  # fmt: skip


def _searches(peers: Json) -> Iterator[str]:
    yield "## The search"
    yield ""
    yield _paragraph(
        f"From GCCs to the highest grid point: median / 95 % of {peers['search_rounds']} rounds, in ms.",
    )
    yield ""
    kinds = list(dict.fromkeys(row["kind"] for row in peers["searches"]))
    rows: dict[tuple[str, str, str], list[str]] = {}
    for row in peers["searches"]:
        key = (f"{row['spacing_m']:g} m", str(row["arrays"]), row["length"])
        rows.setdefault(key, []).append(f"{_number(row['median_ms'])} / {_number(row['p95_ms'])}")
    yield from _table(("grid", "arrays", "sound of", *kinds), ((*key, *cells) for key, cells in rows.items()))


def _service(live: Sequence[Json]) -> Iterator[str]:
    yield "## The service"
    yield ""
    if not live:
        yield "Not measured here."
        return
    yield _paragraph(
        "The server, the load and the clients share the cores, and every array sends sound nearly all the time.",
        "Latency is the time from the end of a window to a client; dropped frames are those that no result used.",
    )
    yield ""
    rows = []
    for run in live:
        demand, late = run["demand"], run["latency_ms"]
        dropped = run["frames_dropped"] + sum(run["lost"].values())
        rows.append(
            (
                str(demand["arrays"]), str(demand["clients"]), "all cores busy" if demand["spin"] else "none",
                "nothing" if run["nothing_dropped"] else f"{dropped} frames, {run['updates']:.1f} of "
                f"{run['updates_due']} updates received",
                f"{late['p50']:.0f} / {late['p95']:.0f} / {late['p99']:.0f}", f"{run['cpu_percent']:.0f}",
                " / ".join(f"{mb:.0f}" for mb in run["rss_mb"]),
            )
        )  # fmt: skip
    yield from _table(
        ("arrays", "clients", "other load", "dropped", "latency 50 / 95 / 99 % (ms)", "server (% of a core)",
         "memory at the beginning / end / most (MB)"), rows,
    )  # fmt: skip


def _startup(startup: Json) -> Iterator[str]:
    took_s, processor_s, answered_s = (np.asarray(startup[name]) for name in ("took_s", "processor_s", "answered_s"))
    yield "## Starting"
    yield ""
    median_s, of_processor_s = float(np.median(took_s)), float(np.median(processor_s))
    yield _paragraph(
        f"`livessl serve` listens {_number(median_s)} s after it was called (median of {len(took_s)},",
        f"{_number(took_s.min())} to {_number(took_s.max())} s; {_number(of_processor_s)} s of processor),",
        "with two arrays in that room and a grid of 0.05 m. A request that is sent then is answered after",
        f"{_number(float(np.median(answered_s)))} s, counted from the call: meanwhile the fusion thread loads what it",
        "computes with ([decision 58](decisions/0058-the-fusion-thread-loads-what-computes.md)). At the first start on",
        "a machine it works on NumPy until the kernels are compiled",
        "([decision 57](decisions/0057-numpy-until-kernels-are-compiled.md)).",
    )


def _service_fits(live: Sequence[Json]) -> dict[str, Fit]:
    """Fit processor and memory against arrays and clients, for the runs without other load."""
    idle = [run for run in live if not run["demand"]["spin"]]
    arrays = [run for run in idle if run["demand"]["clients"] == 20]
    clients = [run for run in idle if run["demand"]["arrays"] == 4]

    def against(name: str, runs: Sequence[Json], cost: Callable[[Json], float]) -> Fit:
        return Fit.line([run["demand"][name] for run in runs], [cost(run) for run in runs])

    return {
        "processor, arrays": against("arrays", arrays, lambda run: float(run["cpu_percent"])),
        "processor, clients": against("clients", clients, lambda run: float(run["cpu_percent"])),
        "memory, arrays": against("arrays", arrays, lambda run: float(max(run["rss_mb"]))),
    }


def _growth(peers: Json, live: Sequence[Json]) -> Iterator[str]:
    yield "## How costs grow"
    yield ""
    yield _paragraph(
        "Fits to the measurements above: by least squares of the logarithms for powers, and of relative deviations for",
        "lines. The last column is the largest deviation.",
    )
    yield ""

    def row(what: str, variable: str, x: Sequence[float], fit: Fit, unit: str) -> tuple[str, ...]:
        power = f"{_number(fit.factor)} {variable}^{fit.exponent:.2f}"
        line = f"{_number(fit.offset)} + {_number(fit.factor)} {variable}"
        formula = line if fit.exponent == 1.0 else power
        return what, f"{variable} = {', '.join(f'{one:g}' for one in x)}", f"{formula} {unit}", f"{fit.worst:.0%}"

    def searched(kind: str, **fixed: object) -> list[Json]:
        wanted = {"kind": kind, "length": "block", **fixed}
        return [one for one in peers["searches"] if all(one[key] == value for key, value in wanted.items())]

    rows = []
    for kind in ("voice", "noise"):
        found = searched(kind, spacing_m=0.05)
        x, y = [one["arrays"] for one in found], [one["median_ms"] for one in found]
        rows.append(row(f"search, 0.05 m, {kind}", "arrays", x, Fit.power(x, y), "ms"))
        found = searched(kind, arrays=2)
        x, y = [one["spacing_m"] for one in found], [one["median_ms"] for one in found]
        rows.append(row(f"search, 2 arrays, {kind}", "spacing", x, Fit.power(x, y), "ms"))
    for what, name in (
        ("GCC", "GCC, both arrays"),
        ("peak", "samples to peak, 0.05 m"),
        ("map", "samples to map, 0.1 m"),
    ):
        found = [one for one in peers["microphones"] if one["what"] == what]
        x, y = [one["microphones"] for one in found], [one["median_ms"] for one in found]
        rows.append(row(f"{name}, 2 arrays, voice", "microphones", x, Fit.power(x, y), "ms"))
    x, y = [one["nodes"] / 1000 for one in peers["maps"]], [one["median_ms"] for one in peers["maps"]]
    rows.append(row("samples to map, 2 arrays", "nodes/1000", x, Fit.line(x, y), "ms"))
    if live:
        fits = _service_fits(live)
        for name, fit in fits.items():
            what, variable = name.split(", ")
            x = sorted({run["demand"][variable] for run in live})
            rows.append(row(f"the service's {what}", variable, x, fit, "MB" if what == "memory" else "% of a core"))
    yield from _table(("cost", "measured at", "fit", "largest deviation"), rows)


def _purchase(peers: Json, live: Sequence[Json]) -> Iterator[str]:
    yield "## Hardware for 10, 100 and 1000 arrays"
    yield ""
    carried = [run["demand"]["arrays"] for run in live if run["nothing_dropped"] and not run["demand"]["spin"]]
    if not carried:
        yield "This needs runs of the service that drop nothing; there are none here."
        return
    fits, most = _service_fits(live), max(carried)
    cpu, clients, memory = fits["processor, arrays"], fits["processor, clients"], fits["memory, arrays"]
    base = max(0.0, cpu.offset)
    megabits = 8e-6 * peers["frame_bytes"] / FRAME_S
    yield _paragraph(
        f"By the fits above, a server takes {_number(base)} % of a core for itself and 20 clients,",
        f"{_number(cpu.factor)} % for each array that sends sound, and {_number(clients.factor)} % for each further",
        f"client; it takes {_number(memory.offset)} MB and another {_number(memory.factor)} MB per array. An array of",
        f"four microphones sends {_number(megabits)} Mbit/s during sound, and almost nothing otherwise. The largest",
        f"number of arrays that one server carried on this machine is {most}; for more, use several servers, for",
        "example one per hall. The table assumes that all arrays send sound at once and that nothing is used beyond",
        f"{USED:.0%}.",
    )
    yield ""
    rows = []
    for arrays in TO_BUY:
        servers = math.ceil(arrays / most)
        cores = math.ceil((servers * base + arrays * cpu.factor) / 100.0 / USED)
        gigabytes = (servers * memory.offset + arrays * memory.factor) / 1000.0 / USED
        rows.append(
            (
                str(arrays), str(math.ceil(arrays / 2)), str(servers), f"{cores}", f"{_number(gigabytes)} GB",
                f"{_number(arrays * megabits / USED)} Mbit/s",
            )
        )  # fmt: skip
    yield from _table(("arrays", "eight-channel interfaces", "servers", "cores like these", "memory", "network"), rows)


def main() -> int:
    """Measure if requested, and write the text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("kernels", "peers", "exactness", "startup", "live")
    parser.add_argument(
        "--measure", nargs="*", choices=parts, metavar="PART", help=f"measure all, or some of {', '.join(parts)}"
    )
    parser.add_argument("--brief", action="store_true", help="few rounds, to check that it works")
    parser.add_argument(
        "--out",
        type=Path,
        default=DOCS,
        metavar="DIR",
        help="folder of performance.md and performance/ (default: docs)",
    )
    arguments = parser.parse_args()
    folder = arguments.out / "performance"
    if arguments.measure is not None:
        measure(folder, arguments.measure or parts, brief=arguments.brief)
    (arguments.out / "performance.md").write_text(document(folder), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
