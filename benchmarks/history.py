"""The history with many events: searches over HTTP, a day's heat map, exports, live events, and deletion of old ones.

It fills a database with random events, 100 000 a day, serves it by the real server, and measures. The database is an
SQLite file in a temporary folder, a temporary PostgreSQL server (`--postgresql`), or one whose URL is given. The output
is one JSON object; the exit status is 1 if a limit is exceeded.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final
from urllib.parse import urlencode

import httpx

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from history_rows import DAY_NS, EVENTS_A_DAY, START_NS, STEP_NS, fill, random_event
from livessl.clock import SystemClock, utc_text
from livessl.server.api.encode import JsonObject
from livessl.server.app import Server
from livessl.server.history.backlog import Write
from livessl.server.store import Store
from livessl.site.load import parse_site
from postgresql import SETTINGS, running_postgresql

SITE: Final = """
site: history
room: {{size_m: [8.0, 10.0, 4.0]}}
grid: {{spacing_m: 0.5}}
arrays:
  north: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4.0, 2.5, 2.0]}}
  south: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4.0, 7.5, 2.0]}}
zones: {{{zones}}}
server: {{bind: "tcp://127.0.0.1:*", http: {{port: 0}}, events_db: {place}}}
"""
ZONES: Final = 8
"""Zones: slabs of the room, each 1.25 m deep, so that an event lies in one of them."""

DELETED: Final = 1_000_000
"""Most old events that are deleted."""

MOST_DELETING_S: Final = 120.0
"""Longest time, in seconds, for which deletion is measured: it gives way to live events, and may take very long."""

STORED: Final = 20_000
"""Events by which the speed of the store is measured."""

MAX_SEARCH_P95_MS: Final = 50.0
MAX_HEAT_MAP_MS: Final = 500.0
MAX_SLOWER: Final = 1.1
"""Largest ratio of the time that the fusion thread spends on an event, while old ones are deleted, to that without."""


@dataclass(frozen=True)
class Times:
    """Quantiles of some durations, in milliseconds; of processor time in this process, too, where it was measured."""

    p50_ms: float
    p95_ms: float
    max_ms: float
    count: int
    cpu_p95_ms: float | None = None

    @classmethod
    def of(cls, seconds: list[float], cpu_s: list[float] | None = None) -> Times:
        """Return the quantiles of durations in seconds."""
        cpu_p95_ms = None if cpu_s is None else _p95_ms(cpu_s)
        return cls(
            round(1000 * statistics.median(seconds), 3),
            _p95_ms(seconds),
            round(1000 * max(seconds), 3),
            len(seconds),
            cpu_p95_ms,
        )


def _p95_ms(seconds: list[float]) -> float:
    return round(1000 * statistics.quantiles(seconds, n=20, method="inclusive")[18], 3)


@contextmanager
def served(place: str) -> Iterator[Server]:
    """The real server with that database."""
    zones = ", ".join(
        f"zone-{k}: {{bounds_m: [[0, 8], [{1.25 * k}, {1.25 * k + 1.25}], [0, 4]]}}" for k in range(ZONES)
    )
    server = Server(parse_site(SITE.format(place=json.dumps(place), zones=zones)), SystemClock())
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(timeout=30)


def timed(client: httpx.Client, requests: list[str]) -> Times:
    """Return how long answers take; the processor time is that of client and server, without a PostgreSQL server."""
    seconds, cpu_s = [], []
    for request in requests:
        begun, cpu_begun = time.perf_counter(), time.process_time()
        client.get(request).raise_for_status()
        seconds.append(time.perf_counter() - begun)
        cpu_s.append(time.process_time() - cpu_begun)
    return Times.of(seconds, cpu_s)


def random_search(rng: random.Random, count: int) -> str:
    """Return a request with a zone, a time and a confidence, each of many widths."""
    end_ns = START_NS + rng.randrange(count) * STEP_NS
    span_ns = rng.choice([DAY_NS // 24, DAY_NS, 7 * DAY_NS, 1000 * DAY_NS])
    query = {
        "zone": f"zone-{rng.randrange(ZONES)}",
        "since": utc_text(end_ns - span_ns),
        "until": utc_text(end_ns),
        "min_confidence": rng.choice([0.2, 0.5, 0.9, 0.99, 0.999]),
    }
    return f"/api/v1/events?{urlencode(query)}"


def measure_searches(client: httpx.Client, count: int, searches: int) -> dict[str, Times]:
    """Return how long answers take: with all three filters, and by kind of search."""
    rng = random.Random(2)
    kinds: dict[str, Callable[[], str]] = {
        "zone, time, confidence": lambda: random_search(rng, count),
        "newest": lambda: "/api/v1/events",
        "confidence": lambda: f"/api/v1/events?min_confidence={rng.choice([0.5, 0.9, 0.99])}",
        "array, status, level": lambda: (
            f"/api/v1/events?array=south&status=refused&min_level_dbfs={rng.randint(-60, -12)}"
        ),
        "by id": lambda: f"/api/v1/events/history-{rng.randrange(count):09d}",
    }
    return {kind: timed(client, [request() for _ in range(searches)]) for kind, request in kinds.items()}


def measure_storing(store: Store, count: int) -> int:
    """Return how many events a second the store takes, 5000 at a time."""
    rng, begun, first = random.Random(5), time.perf_counter(), count + 2 * 10**6
    for batch in range(first, first + STORED, 5000):
        times = [(number, START_NS + number * STEP_NS) for number in range(batch, batch + 5000)]
        store.add_all([(random_event(rng, number, at_ns), at_ns) for number, at_ns in times])
    return round(STORED / (time.perf_counter() - begun))


def measure_heat_map(client: httpx.Client, count: int) -> Times:
    """Return how long the heat map of a day takes."""
    rng, requests = random.Random(3), []
    for _ in range(10):
        first_ns = START_NS + rng.randrange(max(1, count - EVENTS_A_DAY)) * STEP_NS
        span = urlencode({"since": utc_text(first_ns), "until": utc_text(first_ns + DAY_NS - 1)})
        requests.append(f"/api/v1/history/heat-map?{span}")
    return timed(client, requests)


def measure_exports(client: httpx.Client, count: int) -> dict[str, int]:
    """Return the events a second of each format, for at most 100 000 of them."""
    since = utc_text(START_NS + max(0, count - EVENTS_A_DAY) * STEP_NS)
    found = {}
    for form in ("jsonl", "csv", "parquet"):
        begun, size = time.perf_counter(), 0
        with client.stream("GET", f"/api/v1/events.{form}?{urlencode({'since': since})}") as answer:
            answer.raise_for_status()
            size = sum(len(piece) for piece in answer.iter_raw())
        assert size > 0
        found[form] = round(min(count, EVENTS_A_DAY) / (time.perf_counter() - begun))
    return found


@dataclass(frozen=True)
class Live:
    """Events that come while the server works.

    Parameters
    ----------
    put : Times
        Time that the thread of the fusion spends on an event.
    stored : Times
        Time until it is stored.
    """

    put: Times
    stored: Times


def live_events(store: Store, first: int, until: Callable[[int], bool], per_s: float = 50.0) -> Live:
    """Hand events to the store as the fusion does, as long as `until` is false of their number."""
    rng, put, stored, number = random.Random(4), [], [], 0
    pause, begun = threading.Event(), time.perf_counter()
    while not until(number):
        at_ns = START_NS + (first + number) * STEP_NS
        event, handed = random_event(rng, first + number, at_ns), time.perf_counter()

        def work(event: JsonObject = event, at_ns: int = at_ns, handed: float = handed) -> None:
            store.finalize("history", [(event, at_ns)], [], at_ns // 50_000_000, {})
            stored.append(time.perf_counter() - handed)

        store.backlog.put(Write(work, 1, is_final=True), 0)
        put.append(time.perf_counter() - handed)
        number += 1
        pause.wait(max(0.0, begun + number / per_s - time.perf_counter()))
    store.backlog.settle()
    return Live(Times.of(put), Times.of(stored))


def measure(place: str, count: int, searches: int) -> JsonObject:
    """Fill a database and measure."""
    filled_per_s = fill(place, count)
    with served(place) as server, httpx.Client(base_url=server.url, timeout=120) as client:
        store = server.parts.store
        client.get("/api/v1/events")
        found = {
            "events": count,
            "filled_per_s": round(filled_per_s),
            "stored_per_s": measure_storing(store, count),
            "searches": {kind: asdict(times) for kind, times in measure_searches(client, count, searches).items()},
            "heat_map_of_a_day": asdict(measure_heat_map(client, count)),
            "exported_per_s": measure_exports(client, count),
        }
        quiet = live_events(store, count, lambda number: number >= 500)
        old = max(5000, min(count // 2, DELETED))
        expired: list[tuple[int, float]] = []

        end = threading.Event()
        threading.Timer(MOST_DELETING_S, end.set).start()

        def expire() -> None:
            begun = time.perf_counter()
            gone = store.expire(START_NS + old * STEP_NS, end)
            expired.append((gone, time.perf_counter() - begun))

        deleting = threading.Thread(target=expire)
        deleting.start()
        busy = live_events(store, count + 10**6, lambda number: number >= 20 and not deleting.is_alive())
        deleting.join()
        found["live"] = {"alone": asdict(quiet), "while old events are deleted": asdict(busy)}
        found["deleted"], seconds = expired[0]
        found["deleted_per_s"] = round(expired[0][0] / seconds)
    return found


def too_slow(found: JsonObject) -> list[str]:
    """Return what exceeds its limit, in words."""
    searched = found["searches"]["zone, time, confidence"]["p95_ms"]
    drawn = found["heat_map_of_a_day"]["p95_ms"]
    alone, busy = (times["put"]["p95_ms"] for times in found["live"].values())
    faults = []
    if searched > MAX_SEARCH_P95_MS:
        faults.append(f"searches take {searched} ms (p95), expected at most {MAX_SEARCH_P95_MS}")
    if drawn > MAX_HEAT_MAP_MS:
        faults.append(f"a day's heat map takes {drawn} ms (p95), expected at most {MAX_HEAT_MAP_MS}")
    if busy > max(MAX_SLOWER * alone, 1.0):
        faults.append(f"while old events are deleted, a live event takes {busy} ms (p95) instead of {alone}")
    return faults


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=1_000_000, help="number of events (default: 1000000)")
    parser.add_argument("--searches", type=int, default=200, help="searches of each kind (default: 200)")
    parser.add_argument("--postgresql", action="store_true", help="a temporary PostgreSQL server instead of SQLite")
    parser.add_argument("--database", help="an empty database: a file, or the URL of PostgreSQL")
    arguments = parser.parse_args()
    if arguments.postgresql:
        with running_postgresql({**SETTINGS, "fsync": "on", "shared_buffers": "512MB"}) as server:
            found = measure(server.url(), arguments.events, arguments.searches)
    elif arguments.database:
        found = measure(arguments.database, arguments.events, arguments.searches)
    else:
        with TemporaryDirectory(prefix="livessl-history-") as folder:
            found = measure(str(Path(folder) / "events.sqlite"), arguments.events, arguments.searches)
    print(json.dumps(found, indent=1))
    faults = too_slow(found)
    print("\n".join(faults), file=sys.stderr, end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
