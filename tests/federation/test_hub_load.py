"""The benchmark of hubs under load, in short: that it runs, that its rows are a hub's own, and what its tables say."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psycopg
import pytest
from sqlalchemy import text

from conftest import require
from hub_history import check_stored, fill_by_sql
from hub_load import Demand, measure_load
from hub_processes import running_hub_process
from hub_report import document, written_into
from hub_sites import ARRAYS, MESSAGES_PER_HOUR, SimulatedSite, hub_rows
from livessl.clock import SystemClock
from livessl.federation.archive import Archive
from livessl.federation.received import Report
from livessl.federation.storing import Delivery
from livessl.server.forwarding.stream import Place
from livessl.server.history.query import Query
from nats_servers import NATS_SERVER

if TYPE_CHECKING:
    from postgresql import PostgreSQL


def test_simulated_site_sends_what_a_hub_takes_in(tmp_path: Path) -> None:
    site = SimulatedSite(3)
    sent = [*site.begin(), *(message for _ in range(60) for message in site.minute())]
    assert len(sent) == 1 + len(ARRAYS) + MESSAGES_PER_HOUR
    assert [message.place.number for message in sent] == list(range(1, len(sent) + 1))
    archive = Archive(tmp_path / "hub.sqlite", SystemClock())
    try:
        taken = archive.take(sent, 0.0)
        assert (len(taken.done), taken.early, taken.rejected) == (len(sent), [], [])
        [known] = archive.sites()
        assert known["arrays"] == dict.fromkeys(ARRAYS, "healthy")
        assert archive.tracks(None) == []
        assert len(archive.alerts(None, 1000, None)) == Counter(message.kind for message in sent)["alert"] == 3
        Report.model_validate_json(site.report())
    finally:
        archive.close()


def test_rows_of_a_large_history_are_those_that_a_hub_stores(tmp_path: Path) -> None:
    made = hub_rows(40, 30, sites=7)
    numbers: Counter[str] = Counter()
    archive = Archive(tmp_path / "hub.sqlite", SystemClock())
    try:
        for row in made.events:
            site, body = str(row[1]).partition("/")[0], json.loads(str(row[-1]))
            assert body.pop("site") == site
            numbers[site] += 1
            delivery = Delivery(site, "event", Place("box.1", numbers[site]), json.dumps(body).encode())
            assert archive.take([delivery], 0.0).done == [delivery]
        with archive.store.database.reading() as connection:
            events = connection.execute(text("SELECT * FROM events ORDER BY number")).mappings().all()
            tags = connection.execute(text("SELECT * FROM event_tags")).mappings().all()
        first = int(str(made.events[0][0])) - int(events[0]["number"])
        for row, stored in zip(made.events, events, strict=True):
            values = [value for name, value in stored.items() if name not in ("number", "body")]
            assert (values, json.loads(stored["body"])) == (list(row[1:-1]), json.loads(str(row[-1])))
        given = {(kind, name, number) for kind, name, _, number, *_ in made.tags}
        assert {(tag["kind"], tag["name"], tag["number"] + first) for tag in tags} == given
    finally:
        archive.close()


def test_history_made_by_postgresql_is_that_of_a_hub(postgresql: PostgreSQL) -> None:
    """Keys and indices are there afterwards, what is made is checked by `check_stored`, and a hub goes on from it."""
    place = postgresql.url()

    def described(db: psycopg.Connection[Any]) -> list[Any]:
        schema = "schemaname = current_schema() AND tablename IN ('events', 'event_tags')"
        indices = sorted(db.execute(f"SELECT indexname, indexdef FROM pg_indexes WHERE {schema}").fetchall())
        keys = (
            "SELECT conname FROM pg_constraint WHERE conrelid = 'events'::regclass AND contype <> 'n' ORDER BY conname"
        )
        return [indices, db.execute(keys).fetchall()]

    archive = Archive(place, SystemClock())
    try:
        with psycopg.connect(place, autocommit=True) as db:
            before = described(db)
            fill_by_sql(place, 40, 0, sites=7)
            fill_by_sql(place, 20, 40, sites=7)
            assert described(db) == before
            db.execute("UPDATE event_tags SET confidence = 2 WHERE number = 45 AND kind = 'site'")
            with pytest.raises(ValueError, match="expected the tags"):
                check_stored(db, 40, 20)
        newest = archive.store.page(Query(site="site-0003", limit=1)).rows[0]
        assert (newest.number, newest.event["id"]) == (60, "history-000000059")
        site = SimulatedSite(3)
        sent = [Delivery(site.name, "event", Place("box.1", 1), json.dumps({**newest.event, "id": "new"}).encode())]
        assert archive.take(sent, 0.0).done == sent
        assert archive.store.page(Query(site="site-0003", limit=1)).rows[0].number == 61
    finally:
        archive.close()


@pytest.mark.processes
def test_one_site_is_measured_from_the_stream_to_the_answers(tmp_path: Path) -> None:
    require(NATS_SERVER is not None, "NATS is not installed (Debian: apt install nats-server)")
    with running_hub_process(tmp_path, sqlite=True) as world:
        found = asyncio.run(measure_load(world, Demand(sites=1, minutes=60, paced_s=0.5, patience_s=100.0)))
    assert found["messages"] == 1 + len(ARRAYS) + MESSAGES_PER_HOUR
    assert found["events"] == 60
    assert found["is_drained"]
    assert found["paced"]["is_drained"]
    assert 0.0 < found["processor_ms_per_message"]["hub"] < 10_000.0
    assert 500 < found["stream_bytes_per_message"] < 5000
    assert found["hub_memory_mb"] > 20.0
    (tmp_path / "sites-1.json").write_text(json.dumps({**ABOUT, **found}))
    said = document(tmp_path)
    assert f"| 1 | 8 | {found['messages']} of 60 min | " in said
    assert "Limits, extrapolated from 1 sites at full speed:" in said


ABOUT: dict[str, Any] = {
    "machine": {"cpu": "A processor", "cores": 2, "load_before": 0.25},
    "database": "PostgreSQL",
    "beside": "nothing else",
}
TIMES = {"p50_ms": 100.0, "p95_ms": 200.0, "max_ms": 300.0, "count": 9}


def load(sites: int) -> dict[str, Any]:
    """A hub that takes 2000 messages a second in, at 0.4 ms each."""
    return {
        **ABOUT,
        "sites": sites,
        "messages": sites * 200,
        "events": sites * 60,
        "minutes": 60,
        "is_drained": True,
        "published_per_s": 5000.0,
        "taken_in_per_s": 2000.0,
        "most_waiting": 321,
        "processor_ms_per_message": {"hub": 0.4},
        "stream_bytes_per_message": 1000.0,
        "database_bytes_per_event": 2500.0,
        "hub_memory_mb": 99.5,
        "paced": {
            "messages_per_s": sites / 18,
            "lag": TIMES,
            "processor_share": {"hub": sites / 2000, "nats": sites / 50_000},
            "is_drained": True,
            "answers": {"newest of all": TIMES, "all sites": TIMES},
        },
    }


def test_tables_name_the_limit_that_comes_first(tmp_path: Path) -> None:
    for sites in (10, 1000):
        (tmp_path / f"sites-{sites}.json").write_text(json.dumps(load(sites)))
    said = document(tmp_path)
    # half a core for 1000 sites; 191 messages an hour: 10 GB / (24 x 191 x 1000 bytes), 2000 / s x 3600 s / 191
    limits = [
        "the hub | 2000 |",
        "10 GB of stream that hold a day of messages | 2182 |",
        "the rate that the hub took in here | 37696 |",
    ]
    places = [said.index(limit) for limit in limits]
    assert places == sorted(places)
    assert "0.1 reports came with each message; at the pace of real time, 3.8 reports come with each" in said
    assert said.index("| 10 | 80 | 2000 of 60 min |") < said.index("| 1000 | 8000 | 200000 of 60 min |")
    assert "the machine did nothing else (load average at the start of each run: 0.2, 0.2)" in said
    late = {**load(1000), "is_drained": False, "minutes": 15}
    del late["paced"]
    (tmp_path / "sites-1000.json").write_text(json.dumps(late))
    said = document(tmp_path)
    assert "| 1000 | 8000 | 200000 of 15 min, not all taken in |" in said
    assert "At the pace of real time" in said, "the figures of 10 sites"


def test_answers_are_extended_by_what_they_follow(tmp_path: Path) -> None:
    for count in (10_000, 100_000, 1_000_000):
        times = {**TIMES, "p95_ms": 3.0 * (count / 10_000) ** 0.5}
        step = {**ABOUT, "history": count, "sites": 9, "answers": {"newest of all": times}}
        step |= {"database_bytes": 2500 * count, "filled_s": 12.3}
        (tmp_path / f"history-{count}.json").write_text(json.dumps(step))
    said = document(tmp_path)
    assert "newest of all: exponent 0.50, so 300 ms at 10⁸ events" in said
    assert "1000000 events of 9 sites take 2.5 GB, 2500 bytes an event." in said


def test_hour_of_sites_is_told_part_by_part(tmp_path: Path) -> None:
    parts = [
        {
            "until_minute": 10.0 * number,
            "messages_per_s": 530.0,
            "lag": TIMES,
            "most_waiting": 100 * number,
            "processor_share": {"hub": 0.1 * number},
            "hub_memory_mb": 90.0 + number,
            "answers": {"all sites": TIMES, "metrics": {**TIMES, "p95_ms": 30.0 * number * number}},
        }
        for number in range(1, 7)
    ]
    found = {"hour": 1000, "minutes": 60, "times_real": 10.0, "messages": 191_000, "events": 60_000, "took_s": 361.2}
    sizes = {"is_drained": True, "stream_bytes": 120_000_000, "database_bytes": 250_000_000}
    (tmp_path / "hour-1000.json").write_text(json.dumps({**ABOUT, **found, **sizes, "parts": parts}))
    said = document(tmp_path)
    assert "191000 messages with 60000 events in 361 s, all taken in at the end" in said
    assert "6.0 MB a day for a site" in said  # 250 MB in an hour of a thousand
    assert "| 10 | 530 | 0.10, 0.20, 0.30 s | 100 | 10.0 % of a core | – | – | 91 MB | 200 ms (all sites) |" in said
    assert "| 1080 ms (metrics) |" in said


def test_tables_are_written_between_their_comments_only(tmp_path: Path) -> None:
    page = "before\n<!-- begin hub load -->\nold\n<!-- end hub load -->\nafter\n"
    assert written_into(page, "new\n") == page.replace("old\n", "\nnew\n\n")
    with pytest.raises(ValueError, match="add them where the tables belong"):
        written_into("before\n", "new\n")
    with pytest.raises(ValueError, match="measure with --sites, --hour or --history"):
        document(tmp_path)
