"""`livessl init`: writes a first site file, from flags, from answers in a terminal, or from defaults."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from livessl.cli import argument, draft_arguments
from livessl.site.draft_parts import SIZE_M


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "site", type=Path, nargs="?", default=Path("site.yaml"), help="file to write (default site.yaml)"
    )
    parser.add_argument("--name", type=draft_arguments.name, help="name of the site (default lab)")
    parser.add_argument("--room", type=draft_arguments.room, metavar="X,Y,Z", help="length, width and height, metres")
    parser.add_argument(
        "--array",
        action="append",
        type=draft_arguments.array,
        default=[],
        metavar="NAME=KIND[:SIZE[xCOUNT]][@X,Y,Z[@YAW]]",
        help=f"array to add. KIND: {', '.join(SIZE_M)}; SIZE: edge, spacing or radius in metres; X,Y,Z: centre; YAW in "
        "degrees; repeatable",
    )
    parser.add_argument("--arrays", type=draft_arguments.array_count, metavar="N", help="number of arrays (default 2)")
    parser.add_argument(
        "--interface",
        action="append",
        default=[],
        metavar="NAME",
        help="audio interface, given by a part of its name; repeatable, and each gets its own node",
    )
    parser.add_argument("--rate", type=argument.sample_rate, metavar="HZ", help="sampling rate (default: by interface)")
    parser.add_argument(
        "--channels",
        action="append",
        type=argument.channels,
        default=[],
        metavar="ARRAY=1,2,3,4",
        help="inputs of an array's microphones, counted from 1 (default: one after the other)",
    )
    parser.add_argument("--temperature", type=draft_arguments.finite, metavar="C", help="degrees Celsius (default 20)")
    parser.add_argument("--yes", action="store_true", help="ask nothing; take defaults for what is not given")
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    parser.add_argument(
        "--drawing",
        type=Path,
        metavar="FILE",
        help="instead of a site file, write a printable drawing (SVG) of the array",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.cli.new_site import write

    return write(arguments)
