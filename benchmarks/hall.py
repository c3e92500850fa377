"""Counts whether each sound of a hall on two servers is shown once.

    python benchmarks/hall.py --sounds 200 --rt60 0.7

A hall of 16 x 12 x 5 m has twelve arrays, one every 4 m, and a border through its middle. Each server gets its own
six arrays and the three next to the border. Half of the sounds are anywhere, half within a metre of the border. Arrays
are off their places by the uncertainty that a site file assumes. Each server locates what its arrays record. Counted is
what it sends to the hub, what the hub takes for one sound, and what one server with all arrays finds. Before that, the
time in which a hub stores events, of a hall and of none, is measured. The exit status is 1 if a sound that one server
with all arrays locates is not shown at all.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hall_events import delivered, hall_event
from livessl.clock import SystemClock
from livessl.core.geometry import rotation
from livessl.core.types import Event, FloatArray, Status
from livessl.federation.archive import Archive
from livessl.federation.halls import Halls
from livessl.federation.one_sound import Sighting, sighting, sounds
from livessl.offline import locate
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.forwarding.tile import Tile
from livessl.server.history.query import Query
from livessl.simulation.scene import Scene, Source, render
from livessl.simulation.sounds import SOUNDS
from livessl.site.load import parse_site
from livessl.site.models import Site

HALL_M: Final = (16.0, 12.0, 5.0)
BORDER_M: Final = 8.0
REACH_M: Final = 4.0
"""Distance from the tile up to which a server gets arrays of its neighbour, and searches for sounds."""

NEAR_M: Final = 1.0
"""Distance from the border up to which a sound is at the border."""

RIGHT_M: Final = 0.5
RATE_HZ: Final = 16_000.0
PLACES_M: Final = {f"x{x}y{y}": (x, y, 2.5 + 0.4 * ((x + y) // 4 % 2)) for x in (2, 6, 10, 14) for y in (2, 6, 10)}
"""Centres of the arrays."""

TILES: Final = {"west": (0.0, BORDER_M), "east": (BORDER_M, HALL_M[0])}


class Shown(NamedTuple):
    """Outcome of one sound.

    Parameters
    ----------
    sent : int
        Number of events that both servers sent.
    groups : list of list of Sighting
        The sounds that a hub shows, each with its events.
    alone : list of Event
        Events of one server that has all arrays.
    """

    sent: int
    groups: list[list[Sighting]]
    alone: list[Event]


def hall_site(name: str) -> Site:
    """The site of a server, or of the one that has all arrays."""
    low, high = TILES.get(name, (0.0, HALL_M[0]))
    first, last = max(0.0, low - REACH_M), min(HALL_M[0], high + REACH_M)
    corners = [[low, 0.0], [high, 0.0], [high, HALL_M[1]], [low, HALL_M[1]]]
    shape = {"geometry": {"tetrahedron": {"edge_m": 0.3}}}
    arrays = {
        array: {**shape, "position_m": [float(value) for value in place_m]}
        for array, place_m in PLACES_M.items()
        if first <= place_m[0] <= last
    }
    hub = {"servers": ["nats://127.0.0.1:4222"], "hall": {"name": "works", "tile_m": corners}}
    bounds = [[first, last], [0.0, HALL_M[1]], [0.0, HALL_M[2]]]
    data = {
        "site": name,
        "room": {"size_m": list(HALL_M)},
        "grid": {"spacing_m": 0.2, "bounds_m": bounds},
        "arrays": arrays,
        "server": {"events_db": "events.sqlite", "hub": hub},
    }
    return parse_site(yaml.safe_dump(data))


def placed(count: int, rng: np.random.Generator) -> Iterator[tuple[bool, FloatArray]]:
    """Yield places of sounds, and whether they are at the border, half of them each."""
    centres_m = np.array(list(PLACES_M.values()))
    while count:
        at_border = count % 2 == 0
        reach_m = NEAR_M if at_border else BORDER_M - 0.5
        place_m = np.array([BORDER_M + rng.uniform(-reach_m, reach_m), rng.uniform(0.5, 11.5), rng.uniform(0.5, 2.0)])
        if np.linalg.norm(centres_m - place_m, axis=1).min() >= 1.0:
            count -= 1
            yield at_border, place_m


def hung_arrays(site: Site, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Where the microphones of all arrays really are: a little off, by the uncertainty that the site assumes."""
    hung = {}
    for spec in site.specs:
        turn = rotation(*(rng.normal(0.0, site.uncertainty.orientation_deg, 3)))
        moved_m = spec.centre_m + rng.normal(0.0, site.uncertainty.position_m, 3)
        hung[spec.name] = (spec.microphones_m - spec.centre_m) @ turn.T + moved_m
    return hung


def heard(place_m: FloatArray, rt60_s: float, hung: dict[str, FloatArray], rng: np.random.Generator) -> Any:
    """What all arrays record of a sound at a place."""
    name = str(rng.choice(list(SOUNDS)))
    source = Source(name, 0.7, place_m, SOUNDS[name](rng, RATE_HZ))
    scene = Scene(HALL_M, rt60_s, 343.0, RATE_HZ, (source,), 0.7 + len(source.sound) / RATE_HZ + rt60_s + 1.0)
    return {array: render(scene, at_m, seed=int(rng.integers(2**31))) for array, at_m in hung.items()}


def found(site: Site, recorded: dict[str, Any]) -> list[Event]:
    """The events that a site's arrays give."""
    return locate(site, {spec.name: recorded[spec.name] for spec in site.specs}, RATE_HZ)


def as_sent(site: Site, events: Sequence[Event]) -> list[Sighting]:
    """What the site sends of its events, as the hub reads it."""
    tile, messages = Tile.of(site), Messages(site, 0, utc=True)
    assert tile is not None
    sent: list[JsonObject] = [each for event in events if (each := tile.sent(messages.event(event))) is not None]
    return [sighting({**each, "site": site.site}) for each in sent]


def error_m(event: Sighting | Event, place_m: FloatArray) -> float:
    """Distance of an event from a sound's place; infinite if it is not located."""
    if isinstance(event, Sighting):
        return float(np.linalg.norm(event.places_m[0] - place_m)) if event.rank == 0 else np.inf
    located = event.status is Status.LOCATED and event.estimate is not None
    return float(np.linalg.norm(event.estimate.position_m - place_m)) if located and event.estimate else np.inf


def counts(outcomes: Sequence[tuple[FloatArray, Shown]]) -> JsonObject:
    """The table's row of some sounds."""
    right = Counter(sum(error_m(group[0], place_m) <= RIGHT_M for group in shown.groups) for place_m, shown in outcomes)
    errors = [
        min((error_m(group[0], place_m) for group in shown.groups), default=np.inf) for place_m, shown in outcomes
    ]
    alone = [min((error_m(event, place_m) for event in shown.alone), default=np.inf) for place_m, shown in outcomes]
    return {
        "sounds": len(outcomes),
        "events sent": sum(shown.sent for _, shown in outcomes),
        "events shown": sum(len(shown.groups) for _, shown in outcomes),
        "events of one server": sum(len(shown.alone) for _, shown in outcomes),
        "right and shown once": right[1],
        "right and shown more often": sum(number for times, number in right.items() if times > 1),
        "right with one server": sum(error <= RIGHT_M for error in alone),
        "lost": sum(one <= RIGHT_M and not shown.groups for one, (_, shown) in zip(alone, outcomes, strict=True)),
        "median error, m": round(float(np.median([error for error in errors if np.isfinite(error)])), 3),
        "median error of one server, m": round(float(np.median([error for error in alone if np.isfinite(error)])), 3),
    }


def milliseconds_an_event(count: int, *, in_hall: bool) -> float:
    """Processor time in which a hub stores events of two servers, one at a time in a hall that is busy all the time.

    Each second has a sound at one of ten places, which both servers send; no two are alike.
    """
    with TemporaryDirectory(prefix="livessl-hall-") as folder:
        archive = Archive(Path(folder) / "hub.sqlite", SystemClock(), Halls({"works": tuple(TILES)}))
        deliveries = []
        for number in range(count):
            site, place = number % 2, (number // 2 * 7) % 10
            made = hall_event(f"e{number}", (1.0 + place, 2.0 + 0.01 * site, 1.0), at_s=number // 2, in_tile=site == 0)
            if not in_hall:
                del made["hall"]
            deliveries.append(delivered(("west", "east")[site], number // 2 + 1, made))
        begun_s = time.process_time()
        for delivery in deliveries:
            archive.take([delivery], 1.0)
        spent_s = time.process_time() - begun_s
        shown = len(archive.store.page(Query(copies=False, limit=count)).rows)
        archive.close()
    assert shown == (count // 2 if in_hall else count), "the hub shows other events than those that were made"
    return 1e3 * spent_s / count


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sounds", type=int, default=200, help="sounds in all (default: 200)")
    parser.add_argument("--rt60", type=float, default=0.7, help="reverberation time, seconds (default: 0.7)")
    parser.add_argument("--stored", type=int, default=2000, help="events of a hub's processor time (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, help="of places, sounds and noise (default: 0)")
    arguments = parser.parse_args()
    for in_hall in (False, True):
        spent_ms = milliseconds_an_event(arguments.stored, in_hall=in_hall)
        print(f"The hub stores an event of {'a' if in_hall else 'no'} hall in {spent_ms:.2f} ms of a core.")
    rng = np.random.default_rng(arguments.seed)
    whole, servers = hall_site("whole"), [hall_site(name) for name in TILES]
    outcomes: dict[bool, list[tuple[FloatArray, Shown]]] = {True: [], False: []}
    for at_border, place_m in placed(arguments.sounds, rng):
        recorded = heard(place_m, arguments.rt60, hung_arrays(whole, rng), rng)
        sent = [event for site in servers for event in as_sent(site, found(site, recorded))]
        outcomes[at_border].append((place_m, Shown(len(sent), sounds(sent), found(whole, recorded))))
    rows = {"at the border": counts(outcomes[True]), "anywhere": counts(outcomes[False])}
    print(json.dumps(rows, indent=1))
    print("| |", " | ".join(rows), "|\n|---|---|---|")
    for name in rows["anywhere"]:
        print("|", name, "|", " | ".join(str(row[name]) for row in rows.values()), "|")
    return 1 if any(row["lost"] for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
