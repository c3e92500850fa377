"""`livessl init`: writes a first site file, from flags, from answers in a terminal, or from defaults."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from livessl.cli import argument, draft_arguments
from livessl.cli.options import add_older_name
from livessl.site.draft_parts import SIZE_M


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "site", type=Path, nargs="?", default=Path("site.yaml"), help="file to write (default: site.yaml)"
    )
    _add_room(parser)
    _add_arrays(parser)
    _add_interfaces(parser)
    parser.add_argument(
        "--yes", action="store_true", help="ask nothing; use defaults for all that the options do not give"
    )
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    parser.add_argument(
        "--drawing",
        type=Path,
        metavar="FILE",
        help="instead of a site file, write a printable drawing (SVG) of the first array",
    )


def _add_room(parser: Any) -> None:
    parser.add_argument("--name", type=draft_arguments.name, help="name of the site (default: lab)")
    parser.add_argument(
        "--room",
        type=draft_arguments.room,
        metavar="X,Y,Z",
        help="length, width and height of the room in metres (default: 6,5,2.7)",
    )
    parser.add_argument(
        "--temperature",
        type=draft_arguments.finite,
        metavar="C",
        help="air temperature in degrees Celsius (default: 20)",
    )


def _add_arrays(parser: Any) -> None:
    parser.add_argument(
        "--array",
        action="append",
        type=draft_arguments.array,
        default=[],
        metavar="NAME=KIND[:SIZE[xCOUNT]][@X,Y,Z[@YAW]]",
        help=f"array to add; repeat the option for each array. KIND is {', '.join(list(SIZE_M)[:-1])} or "
        f"{list(SIZE_M)[-1]}; SIZE is, in metres, the edge of a tetrahedron or square, the spacing of a line's "
        "microphones or a circle's radius; COUNT is the number of microphones of a line or circle (default: 4); "
        "X,Y,Z is the array's centre in metres; YAW turns it about the vertical axis, in degrees, counterclockwise "
        "seen from above. Omitted parts get a proposed value",
    )
    parser.add_argument("--arrays", type=draft_arguments.array_count, metavar="N", help="number of arrays (default: 2)")


def _add_interfaces(parser: Any) -> None:
    parser.add_argument(
        "--interface",
        action="append",
        default=[],
        metavar="NAME",
        help="audio interface, by its name or a part of it; repeat the option for each interface. Each interface gets "
        "a node of its own (default: one that is connected, otherwise UMC1820)",
    )
    rate = parser.add_argument(
        "--rate",
        type=argument.sample_rate,
        metavar="HZ",
        help="sampling rate in hertz (default: that of the interface)",
    )
    add_older_name(parser, "--sample-rate", rate)
    parser.add_argument(
        "--channels",
        action="append",
        type=argument.channels,
        default=[],
        metavar="ARRAY=1,2,3,4",
        help="inputs of the interface to which the microphones of ARRAY are connected, in the order of the "
        "microphones, counted from 1; repeat the option for each array (default: the next free inputs, in order)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.cli.new_site import write

    return write(arguments)
