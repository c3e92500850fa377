"""`livessl check`: validates a site file, lists all its faults and likely mistakes, and draws what it describes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from livessl.cli import argument
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.options import add_json
from livessl.cli.output import print_warnings
from livessl.cli.own_work import NO_PICTURE, is_own_picture, refuse_foreign
from livessl.errors import ConfigError, Fault

if TYPE_CHECKING:
    from livessl.site.models import Site


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument("site", type=Path, help="site file")
    parser.add_argument(
        "--rt60",
        type=argument.rt60,
        default=0.7,
        metavar="S",
        help="reverberation time, seconds, assumed when the error is predicted (default: 0.7)",
    )
    parser.add_argument("--png", type=Path, metavar="FILE", help="also draw floor plan, side view and arrays to FILE")
    add_json(parser, "print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.site.build.grid import search_grid
    from livessl.site.checks import missing_packages, unprotected_addresses
    from livessl.site.load import load_site

    if arguments.png is not None:
        refuse_foreign("--png", [arguments.png], is_own_picture, arguments.site, NO_PICTURE)
    try:
        site = load_site(arguments.site)
        found = [*unprotected_addresses(site), *missing_packages(site)]
        if found:
            raise ConfigError([Fault(f"{arguments.site}: {fault.where}", fault.what) for fault in found])
    except ConfigError as error:
        if arguments.json:
            faults = [{"where": fault.where, "what": fault.what} for fault in error.faults]
            print(json.dumps({"valid": False, "faults": faults}))
            return WRONG_USE
        raise
    from livessl.lab.layout import measures, terminal

    grid, layout = search_grid(site), measures.layout_of(site, arguments.rt60)
    if arguments.png is not None:
        from livessl.lab.layout import figure

        figure.draw(site, arguments.png)
    if arguments.json:
        checked = {"valid": True, "faults": [], "warnings": list(site.warnings), "site": site.site}
        summary = {**checked, "arrays": list(site.arrays), "nodes": grid.size, **_tile_as_json(site)}
        print(json.dumps({**summary, "layout": terminal.as_json(layout, arguments.rt60)}))
    else:
        print_warnings(site)
        arrays = ", ".join(f"{spec.name} ({len(spec.microphones_m)} microphones)" for spec in site.processed)
        print(f"{arguments.site}: valid; site {site.site!r}, arrays {arrays}, {grid.size:,} grid points")
        for line in _tile_in_words(site):
            print(line)
        print(terminal.as_text(layout, arguments.rt60))
    return OK


def _tile_as_json(site: Site) -> dict[str, Any]:
    """Return the hall and whose the arrays are; nothing for a site that has its room to itself."""
    from livessl.site.hall import hall_of, neighbourhood

    hall = hall_of(site)
    return {} if hall is None else {"hall": {"name": hall.name, **neighbourhood(site, hall)._asdict()}}


def _tile_in_words(site: Site) -> Iterator[str]:
    """Yield what the tile of a hall means for a person; nothing for a site that has its room to itself."""
    from livessl.site.hall import hall_of, neighbourhood
    from livessl.site.polygon import signed_area_m2

    hall = hall_of(site)
    if hall is None:
        return
    own, neighbours = neighbourhood(site, hall)
    yield (
        f"hall {hall.name!r}: this server's tile has {abs(signed_area_m2(hall.tile_m)):g} m2, with the arrays "
        f"{', '.join(own) or 'none'}; its neighbours' arrays: {', '.join(neighbours) or 'none'}"
    )
    yield "the hub gets its events in and near the tile, and shows a sound that a neighbour locates as well once"
