"""Prove that the working tree behaves as the commit BASE does: the same probes with the code of both, compared.

BASE is checked out into a temporary folder that is removed at the end. Each command runs as a process of its own, with
the same interpreter and PYTHONPATH at either tree's `src`. One line for each probe says "same", or "DIFFERENT" and
what differs. Recordings are simulated by BASE and located by both.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from unchanged_probes import PROBES, Finding, Options, performance
from unchanged_trees import Pair, ProbeError, checked_out

REPOSITORY: Final = Path(__file__).parents[1]

MOST_LINES: Final = 10
"""Most differences shown of one probe."""

SAME: Final = 0
DIFFERENT: Final = 1
WRONG_USE: Final = 2
INTERRUPTED: Final = 130


def _at_least(least: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from `least` on: with none, a probe would compare nothing and find no change."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least} on, got {text!r}")
        return int(text)

    return parse


def _parser() -> argparse.ArgumentParser:
    listed = "\n".join(f"  {name:<10} {(probe.__doc__ or '').splitlines()[0]}" for name, probe in PROBES.items())
    parser = argparse.ArgumentParser(
        prog="scripts/unchanged",
        description=__doc__,
        epilog=f"probes:\n{listed}\n\nexample: scripts/unchanged main --only wire check locate",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("base", metavar="BASE", help="commit whose behaviour is to be kept, such as main")
    parser.add_argument("head", metavar="HEAD", nargs="?", help="commit to compare with it (default: the working tree)")
    parser.add_argument("--only", nargs="+", choices=list(PROBES), metavar="PROBE", help="run only these probes")
    parser.add_argument("--skip", nargs="+", choices=list(PROBES), default=[], metavar="PROBE", help="leave these out")
    default = Options()
    parser.add_argument(
        "--seeds", type=_at_least(1), default=default.seeds, help=f"worlds of the faults (default: {default.seeds})"
    )
    parser.add_argument(
        "--jobs", type=_at_least(1), default=default.jobs, help=f"processes for them (default: {default.jobs})"
    )
    parser.add_argument(
        "--sounds",
        type=_at_least(1),
        default=default.sounds,
        help=f"sounds of each kind for the exactness (default: {default.sounds})",
    )
    parser.add_argument(
        "--scenes", type=_at_least(1), default=default.scenes, help=f"simulated scenes (default: {default.scenes})"
    )
    parser.add_argument(
        "--performance", action="store_true", help="also compare `livessl bench`; this never changes the exit code"
    )
    parser.add_argument("--repeats", type=_at_least(2), default=3, help="performance: runs of each tree (default: 3)")
    return parser


def report(name: str, finding: Finding, most: int = MOST_LINES) -> str:
    """Return what is printed about a probe: one line, and below it further differences."""
    if not finding.differences:
        return f"{name:<10} same ({finding.compared})"
    first, *others = finding.differences
    lines = [f"{name:<10} DIFFERENT: {first}", *(f"{'':<10}            {line}" for line in others[: most - 1])]
    if len(others) >= most:
        lines.append(f"{'':<10}            and {len(others) - most + 1} more")
    return "\n".join(lines)


def probe(pair: Pair, names: Sequence[str], options: Options) -> bool:
    """Run probes and print a report on each; returns whether all found the same."""
    same = True
    for name in names:
        if sys.stderr.isatty():
            print(f"{name} …", end="\r", file=sys.stderr, flush=True)
        try:
            finding = PROBES[name](pair, options)
        except ProbeError as error:
            finding = Finding("", [str(error)])
        print(report(name, finding), flush=True)
        same &= not finding.differences
    return same


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare; 0 where all is the same, 1 where anything differs, 2 for wrong use."""
    parsed = _parser().parse_args(arguments)
    names = [name for name in parsed.only or PROBES if name not in parsed.skip]
    options = Options(parsed.seeds, parsed.jobs, parsed.sounds, parsed.scenes)
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with checked_out(REPOSITORY, parsed.base, parsed.head) as pair:
            same = probe(pair, names, options)
            if parsed.performance:
                for line in performance(pair, parsed.repeats):
                    print(f"{'bench':<10} {line}", flush=True)
    except ValueError as error:
        print(f"unchanged: error: {error}", file=sys.stderr)
        return WRONG_USE
    except ProbeError as error:
        print(f"unchanged: error: {error}", file=sys.stderr)
        return DIFFERENT
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, previous)
    return SAME if same else DIFFERENT


if __name__ == "__main__":
    sys.exit(main())
