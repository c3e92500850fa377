"""Searches, pages, exports and heat maps in each database, compared with a plain search through a list."""

from __future__ import annotations

import csv
import io
import json
import random
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet as pq

from livessl.server.api.encode import JsonObject
from livessl.server.history.export import COLUMNS, csv_lines, json_lines, parquet
from livessl.server.history.heat_map import Cells
from livessl.server.history.query import Cursor
from livessl.server.store import Query, Store
from messages import event_message

EVENTS, SPAN_NS = 70, 40
ZONES, ARRAYS, STATUSES = ("door", "hall", "100%_sure"), ("north", "south", "west"), ("located", "refused")


def random_event(rng: random.Random, number: int) -> JsonObject:
    placed = rng.random() < 0.8
    heard_by = rng.sample(ARRAYS, rng.randint(0, 3))
    return event_message(
        id=f"small-{number}",
        time_utc=f"2026-01-31T12:00:{rng.randrange(60):02}.{rng.randrange(10**6):06}Z",
        position_m=[round(rng.uniform(-0.5, 4.5), 4), round(rng.uniform(0, 5), 4), 1.0] if placed else None,
        covariance_m2=[[0.5, 0.1, 0.2], [0.1, 0.6, 0.3], [0.2, 0.3, 0.7]] if placed else None,
        confidence=rng.choice([0.0, 0.25, 0.5, 0.75, 1.0]),
        status=rng.choice(STATUSES),
        level_dbfs=rng.choice([None, -60.0, -40.5, -20.0]),
        zones=rng.sample(ZONES, rng.randint(0, 3)),
        arrays=[name for name in heard_by if rng.random() < 0.5],
        heard_by=heard_by,
        reason=rng.choice([None, "Größe, unklar", 'a "loud"\nsound']),
        excluded=rng.random() < 0.4,
    )


@pytest.fixture(scope="module")
def listed() -> list[tuple[JsonObject, int]]:
    """Events with their starts, some of which are the same."""
    rng = random.Random(1)
    return [(random_event(rng, k), rng.randrange(SPAN_NS)) for k in range(EVENTS)]


@pytest.fixture(scope="module", params=["memory", "sqlite", "postgresql"])
def stored(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, listed: list[tuple[JsonObject, int]]
) -> Iterator[Store]:
    place: Any = None
    if request.param == "sqlite":
        place = tmp_path_factory.mktemp("search") / "events.db"
    elif request.param == "postgresql":
        place = request.getfixturevalue("postgresql").url()
    store = Store(place)
    store.add_all(listed)
    yield store
    store.close()


def random_query(rng: random.Random) -> Query:
    def maybe(value: Any) -> Any:
        return value if rng.random() < 0.3 else None

    return Query(
        since_ns=maybe(rng.randrange(SPAN_NS)),
        until_ns=maybe(rng.randrange(SPAN_NS)),
        zone=maybe(rng.choice(ZONES)),
        min_confidence=maybe(rng.choice([0.0, 0.3, 0.5, 1.0])),
        limit=rng.choice([1, 3, 10, 1000]),
        status=maybe(rng.choice(STATUSES)),
        min_level_dbfs=maybe(rng.choice([-60.0, -40.0])),
        array=maybe(rng.choice(ARRAYS)),
        excluded=maybe(rng.random() < 0.5),
        text=maybe(rng.choice(["GRÖßE", "small-1", "%", "_sure", "loud", "onset", "nowhere", "\\"])),
    )


def admits(query: Query, event: JsonObject, time_ns: int) -> bool:
    """The definition that the databases are compared with."""
    level = event["level_dbfs"]
    words = [event[name] for name in ("id", "status", "method", "reason")] + event["zones"] + event["arrays"]
    return (
        (query.since_ns is None or time_ns >= query.since_ns)
        and (query.until_ns is None or time_ns <= query.until_ns)
        and (query.zone is None or query.zone in event["zones"])
        and (query.min_confidence is None or event["confidence"] >= query.min_confidence)
        and (query.status is None or event["status"] == query.status)
        and (query.min_level_dbfs is None or (level is not None and level >= query.min_level_dbfs))
        and (query.array is None or query.array in event["arrays"] + event["heard_by"])
        and (query.excluded is None or query.excluded == event["excluded"])
        and (query.text is None or any(query.text.lower() in word.lower() for word in words if word))
    )


def expected(listed: list[tuple[JsonObject, int]], query: Query) -> list[JsonObject]:
    """All events that a query admits, newest first."""
    rows = [(time_ns, number, event) for number, (event, time_ns) in enumerate(listed) if admits(query, event, time_ns)]
    return [event for *_, event in sorted(rows, key=lambda row: row[:2], reverse=True)]


@pytest.mark.parametrize("seed", range(3))
def test_pages_in_both_directions_hold_what_a_plain_search_finds(
    stored: Store, listed: list[tuple[JsonObject, int]], seed: int
) -> None:
    rng = random.Random(seed)
    found_some = 0
    for _ in range(25):
        query = random_query(rng)
        wanted = expected(listed, query)
        found_some += bool(wanted)
        older, before = [], None
        while True:
            page = stored.page(replace(query, before=before))
            older += [row.event for row in page.rows]
            if (before := page.older) is None:
                break
        assert older == wanted
        oldest_first, before = [], None
        while True:
            page = stored.page(replace(query, before=before, oldest_first=True))
            oldest_first += [row.event for row in page.rows]
            if (before := page.older) is None:
                break
        assert oldest_first == wanted[::-1]
        newer: list[JsonObject] = []
        after = Cursor(-1, 0)
        while (page := stored.page(replace(query, after=after))).rows:
            newer = [row.event for row in page.rows] + newer
            assert page.newer is not None
            after = page.newer
        assert page.newer == after  # to ask again later
        assert newer == wanted
    assert found_some > 10


@pytest.mark.parametrize("seed", range(3))
def test_heat_map_counts_the_events_of_each_cell(
    stored: Store, listed: list[tuple[JsonObject, int]], seed: int
) -> None:
    rng = random.Random(seed)
    for _ in range(10):
        query, spacing_mm = random_query(rng), rng.choice([250, 300, 1000, 7000])
        cells = Cells((0, 0), (4000, 5000), spacing_mm)
        counts, elsewhere = np.zeros(cells.shape, dtype=int), 0
        for event in expected(listed, query):
            x_m, y_m = (event["position_m"] or [-1, -1])[:2]
            if 0 <= round(1000 * x_m) <= 4000 and 0 <= round(1000 * y_m) <= 5000:
                i, j = round(1000 * x_m) // spacing_mm, round(1000 * y_m) // spacing_mm
                counts[min(i, cells.shape[0] - 1), min(j, cells.shape[1] - 1)] += 1
            else:
                elsewhere += 1
        found = stored.heat_map(query, cells)
        np.testing.assert_array_equal(found.counts, counts)
        assert found.elsewhere == elsewhere


def test_event_at_the_last_edge_is_in_the_last_cell() -> None:
    store = Store()
    for number, position_m in enumerate(([4.0, 5.0, 1.0], [0.0, 0.0, 1.0], [4.001, 1.0, 1.0], [-0.001, 1.0, 1.0])):
        store.add(event_message(id=f"e-{number}", position_m=position_m), number)
    found = store.heat_map(Query(), Cells((0, 0), (4000, 5000), 500))
    assert found.counts.shape == (8, 10)
    assert (found.counts[7, 9], found.counts[0, 0], found.counts.sum(), found.elsewhere) == (1, 1, 2, 2)


def test_exports_hold_all_events_that_a_query_admits(
    stored: Store, listed: list[tuple[JsonObject, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("livessl.server.store.SCANNED_AT_ONCE", 7)
    for query in (Query(), Query(zone="door", min_confidence=0.5), Query(text="nowhere")):
        wanted = expected(listed, query)
        lines = b"".join(json_lines(stored.scan(query))).decode().splitlines()
        assert [json.loads(line) for line in lines] == wanted
        rows = list(csv.DictReader(io.StringIO(b"".join(csv_lines(stored.scan(query))).decode(), newline="")))
        table = pq.read_table(io.BytesIO(b"".join(parquet(stored.scan(query)))))
        assert table.column_names == list(COLUMNS)
        columns = table.to_pylist()
        assert len(rows) == len(columns) == len(wanted)
        for event, row, column in zip(wanted, rows, columns, strict=True):
            assert (row["id"], row["reason"], row["zones"]) == (
                event["id"],
                event["reason"] or "",
                " ".join(event["zones"]),
            )
            assert [column["x_m"], column["y_m"], column["z_m"]] == (event["position_m"] or [None] * 3)
            assert [row["x_m"] == "", float(row["y_m"] or 0)] == [
                event["position_m"] is None,
                (event["position_m"] or [0, 0])[1],
            ]
            assert column["zones"] == event["zones"]
            assert column["time_utc"].isoformat(timespec="microseconds") == event["time_utc"].replace("Z", "+00:00")
            assert column["variance_z_m2"] == (0.7 if event["covariance_m2"] else None)


def test_export_reads_no_more_than_it_hands_on() -> None:
    store = Store()
    store.add_all([(event_message(id=f"e-{k}"), k) for k in range(2500)])
    pieces = json_lines(store.scan(Query()))
    first = next(pieces)
    assert first.count(b"\n") == 1000
    store.add(event_message(id="new"), 10**6)  # nothing is locked, and what is new is not part of it
    assert sum(piece.count(b"\n") for piece in pieces) == 1500
