"""Writes docs/performance.md from the benchmarks' files; with `--measure` it runs the benchmarks first.

    python benchmarks/performance.py --measure      # about six minutes, on a machine that does nothing else
    python benchmarks/performance.py                # the text alone, from the files in docs/performance/

Every figure in the text comes from those files.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import machine
from livessl.cli.progress import counted
from livessl.clock import SystemClock
from livessl.lab.bench import kernels
from performance_page import LIVE, Json, document, live_name

HERE: Final = Path(__file__).parent
DOCS: Final = HERE.parent / "docs"


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
        _write(folder / f"{live_name(arrays, clients, spin)}.json", {"machine": about, **json.loads(done.stdout)})


def _write(file: Path, report: Json) -> None:
    file.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


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
