"""The tile of a site in a hall: what is refused, what is warned of, and what `livessl check` says of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from livessl.cli.main import main
from livessl.errors import ConfigError
from livessl.site.hall import hall_of, neighbourhood
from small_site import site_of, write_site

WEST = [[0.0, 0.0], [4.0, 0.0], [4.0, 2.5], [0.0, 2.5]]
"""The half of the small site that has the array `north`."""

FURTHER = {"nodes.lab-pc.further_servers": [{"server": "tcp://127.0.0.1:5571"}]}


def in_hall(tile_m: Any = WEST, **hall: Any) -> dict[str, Any]:
    """Changes of the small site."""
    described = {"name": "works", "tile_m": tile_m, **hall}
    return {
        "server.events_db": "events.sqlite",
        "server.hub": {"servers": ["nats://127.0.0.1:4222"], "hall": described},
    }


def test_arrays_in_the_tile_are_its_own_and_the_others_are_neighbours() -> None:
    site = site_of({**in_hall(), **FURTHER})
    hall = hall_of(site)
    assert hall is not None
    assert neighbourhood(site, hall) == (("north",), ("south",))
    assert [warning for warning in site.warnings if "tile" in warning] == []
    assert hall_of(site_of()) is None


def test_a_hall_of_one_server_is_valid() -> None:
    site = site_of(in_hall([[0, 0], [4, 0], [4, 5], [0, 5], [0, 0]]))
    hall = hall_of(site)
    assert hall is not None
    assert neighbourhood(site, hall) == (("north", "south"), ())
    assert [warning for warning in site.warnings if "tile" in warning] == []


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        (in_hall([[0, 0], [4.2, 0], [4, 5]]), r"inside the room, from \[0, 0\] to \[4, 5\], got \[4.2, 0\]"),
        (in_hall([[0, 0], [4, 5], [4, 0], [0, 5]]), r"expected a polygon with no edges that cross"),
        (in_hall([[0, 0], [1, 1]]), r"expected a polygon with at least 3 points, got 2"),
        (in_hall(tile=WEST), r"server\.hub\.hall\.tile.*did you mean 'tile_m'"),
        (in_hall(name="works hall"), r"server\.hub\.hall\.name"),
        ({"server.hub.hall": {"name": "works", "tile_m": WEST}}, r"server\.hub\.servers"),
        ({"server.hall": {"name": "works", "tile_m": WEST}}, r"server\.hall"),
    ],
)
def test_faults_of_a_tile_are_named(changes: dict[str, Any], wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        site_of(changes)


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        (in_hall(), "its array 'south' is in a neighbour's tile, but it sends to one server only"),
        ({**in_hall([[0, 0], [1, 0], [1, 1]]), **FURTHER}, "no array is in the tile of this site"),
        (
            {**in_hall(), **FURTHER, "grid.bounds_m": [[0, 4], [0, 2], [0, 3]]},
            "on y the tile reaches from 0 to 2.5 m, and sounds are searched from 0 to 2 m only",
        ),
    ],
)
def test_a_tile_that_cannot_work_as_expected_gives_a_warning(changes: dict[str, Any], wanted: str) -> None:
    assert [warning for warning in site_of(changes).warnings if wanted in warning]


def test_addresses_of_a_node_are_compared_with_the_server_by_any_of_its_servers() -> None:
    """In the site file of the second server, the node's first server is the neighbour."""
    two = {"server.bind": "tcp://127.0.0.1:5571", **FURTHER}
    assert not [warning for warning in site_of(two).warnings if "5571" in warning]
    assert [
        warning for warning in site_of({**two, "server.bind": "tcp://127.0.0.1:5572"}).warnings if "5572" in warning
    ]


def test_check_says_whose_the_arrays_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_site(tmp_path, {**in_hall(), **FURTHER})
    assert main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "hall 'works': this server's tile has 10 m2, with the arrays north; its neighbours' arrays: south" in said
    assert main(["check", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["hall"] == {"name": "works", "own": ["north"], "neighbours": ["south"]}
