"""The journal: alerts, tracks, and changes of arrays and of the configuration, in each database and over HTTP."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from alert_desk import IN_DOOR, START, after, alert_site, running_desk, sound
from livessl.clock import SystemClock, utc_text
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, Track, TrackState
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.history.backlog import Backlog
from livessl.server.history.journal import Entry, EntryKind, JournalQuery
from livessl.server.journal import Journal
from livessl.server.store import Store
from livessl.server.trails import MAX_POINTS, Trails
from livessl.site.models import Site
from small_site import running_server, site_of, wait_until

SPAN_NS = 60
NAMES = ("door", "north", "100%_sure")


def random_entry(rng: random.Random, number: int) -> Entry:
    kind, name = rng.choice(list(EntryKind)), rng.choice(NAMES)
    text = f"{name} is {rng.choice(['lost', 'Größe', 'armed'])}"
    return Entry(kind, name, f"key-{number}", rng.randrange(SPAN_NS), text, {"number": number, "of": [kind]})


def random_query(rng: random.Random) -> JournalQuery:
    def maybe(value: Any) -> Any:
        return value if rng.random() < 0.4 else None

    return JournalQuery(
        kind=maybe(rng.choice(list(EntryKind))),
        name=maybe(rng.choice(NAMES)),
        since_ns=maybe(rng.randrange(SPAN_NS)),
        until_ns=maybe(rng.randrange(SPAN_NS)),
        text=maybe(rng.choice(["LOST", "größe", "%_", "north", "nowhere"])),
        limit=rng.choice([1, 3, 1000]),
    )


def admits(query: JournalQuery, entry: Entry) -> bool:
    """The definition that the databases are compared with."""
    return (
        query.kind in (None, entry.kind)
        and query.name in (None, entry.name)
        and (query.since_ns is None or entry.time_ns >= query.since_ns)
        and (query.until_ns is None or entry.time_ns <= query.until_ns)
        and (query.text is None or query.text.lower() in f"{entry.name}\n{entry.text}".lower())
    )


def all_of(store: Store, query: JournalQuery) -> list[Entry]:
    found: list[Entry] = []
    while True:
        page = store.journal(query)
        assert len(page.entries) <= query.limit
        found += page.entries
        if page.older is None:
            return found
        query = replace(query, before=page.older)


def texts(store: Store, kind: EntryKind) -> list[str]:
    """Sentences of a kind, oldest first."""
    return [entry.text for entry in all_of(store, JournalQuery(kind))][::-1]


def test_pages_hold_what_a_plain_search_finds(store: Store) -> None:
    rng = random.Random(4)
    entries = [random_entry(rng, number) for number in range(60)]
    for entry in entries:
        store.note(entry)
        store.note(replace(entry, text="the same key again"))
    found_some = 0
    for _ in range(30):
        query = random_query(rng)
        matching = [(entry.time_ns, k, entry) for k, entry in enumerate(entries) if admits(query, entry)]
        wanted = [entry for *_, entry in sorted(matching, key=lambda row: row[:2], reverse=True)]
        found_some += len(wanted) > 1
        assert all_of(store, query) == wanted
    assert found_some > 5
    assert len(all_of(store, JournalQuery())) == 60
    store.expire(30)
    assert {entry.key for entry in all_of(store, JournalQuery())} == {e.key for e in entries if e.time_ns >= 30}


def test_entries_outlive_the_server_and_those_in_memory_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Store(tmp_path / "events.db")
    entry = random_entry(random.Random(1), 1)
    first.note(entry)
    first.close()
    second = Store(tmp_path / "events.db")
    assert second.journal(JournalQuery()).entries == [entry]
    second.close()
    monkeypatch.setattr("livessl.server.store.MAX_EVENTS_IN_MEMORY", 5)
    bounded = Store(None)
    for number in range(9):
        bounded.note(replace(entry, key=str(number), time_ns=number))
    assert [each.key for each in bounded.journal(JournalQuery()).entries] == ["8", "7", "6", "5", "4"]
    bounded.close()


def states(second: int, mode: str = "live", **of: str) -> JsonObject:
    arrays = [
        {"name": name, "state": state, "reason": "no message" if state == "lost" else None}
        for name, state in of.items()
    ]
    return {"now_utc": utc_text((START + 20 * second) * FRAME_NS), "mode": mode, "arrays": arrays}


def test_array_is_in_the_journal_when_its_state_changes_and_only_in_live_runs() -> None:
    store = Store(None)
    journal = Journal(store, SystemClock())
    for second, (north, south) in enumerate([("starting", "healthy"), ("healthy", "healthy"), ("lost", "healthy")]):
        journal.arrays(states(second, north=north, south=south))
        journal.arrays(states(second, north=north, south=south))
    journal.arrays(states(7, "replay", north="degraded", south="lost"))
    journal.arrays(states(8, north="healthy", south="healthy"))
    journal.arrays(states(9, north="healthy", south="lost"))
    assert texts(store, EntryKind.ARRAY) == [
        "array 'north' is healthy after starting",
        "array 'north' is lost after healthy: no message",
        "array 'south' is lost after healthy: no message",
    ]
    [last, *_] = store.journal(JournalQuery(EntryKind.ARRAY)).entries
    assert last.detail == {"state": "lost", "before": "healthy", "reason": "no message"}
    assert last.time_ns == (START + 180) * FRAME_NS
    store.close()


def start_with(store: Store, site: Site) -> None:
    Journal(store, SystemClock()).site(site)


def test_changed_section_of_the_site_file_is_named_at_the_next_start(monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(None)
    warmer, zone = {"temperature_c": 25.0}, {"zones.desk": {"bounds_m": [[1, 2], [1, 2], [0, 1]]}}
    for changes in ({}, {}, warmer, warmer | zone, warmer | zone, {}):
        start_with(store, site_of(changes))
    monkeypatch.setattr("livessl.server.journal.__version__", "99.0")
    start_with(store, site_of())
    first, *others, last = texts(store, EntryKind.CONFIGURATION)
    assert first.startswith("livessl ")
    assert others == [
        "the site file has changed: temperature_c",
        "the site file has changed: zones",
        "the site file has changed: temperature_c, zones",
    ]
    assert last.startswith("livessl 99.0 runs after ")
    store.close()


def follow(trails: Trails, site: Site, places: list[tuple[float, float, float]], number: int = 4) -> None:
    messages = Messages(site, 0, utc=True)
    for k, place in enumerate(places):
        state = TrackState.NEW if k == 0 else TrackState.UPDATE
        track = Track(number, state, (START + k) * FRAME_NS, np.array(place), np.zeros(3), 0.01 * np.eye(3))
        trails.take(track, messages.track(track))


@pytest.mark.parametrize("count", [1, 7, MAX_POINTS, MAX_POINTS + 1, 5 * MAX_POINTS + 3])
def test_track_is_in_the_journal_with_its_path_once_it_has_ended(count: int) -> None:
    store, site = Store(None), site_of()
    trails = Trails(Journal(store, SystemClock()), lambda: False)
    places = [(0.5 + 2.0 * k / count, 0.5, 1.0) for k in range(count)]
    follow(trails, site, places)
    assert all_of(store, JournalQuery()) == []
    trails.end_all()
    [entry] = all_of(store, JournalQuery(EntryKind.TRACK, "4"))
    assert entry.time_ns == START * FRAME_NS
    assert entry.detail["duration_s"] == pytest.approx(0.05 * (count - 1))
    assert (entry.detail["updates"], entry.detail["zones"]) == (count, ["door"])
    path = np.array(entry.detail["path"])
    assert len(path) == min(count, len(path)) <= MAX_POINTS
    assert len(path) >= min(count, MAX_POINTS // 2)
    # each point is one of the track, at its time
    assert path[:, 1:] == pytest.approx(np.array(places)[np.rint(path[:, 0] / 0.05).astype(int)], abs=1e-3)
    store.close()


def test_track_of_a_replay_is_not_kept() -> None:
    store = Store(None)
    trails = Trails(Journal(store, SystemClock()), lambda: True)
    follow(trails, site_of(), [IN_DOOR, IN_DOOR])
    trails.end_all()
    assert all_of(store, JournalQuery()) == []
    store.close()


def test_server_keeps_what_operators_change_and_what_alerts(tmp_path: Path) -> None:
    changes = {"zones_file": "zones.yaml", "server.events_db": "events.sqlite"}
    site = alert_site(tmp_path, changes, rules={"door": {"events": {"zones": ["door"]}, "hold_off_s": 0}})
    desk = {"polygon_m": [[1.5, 1.5], [3.0, 1.5], [2.0, 3.0]]}
    with running_server(site) as server, httpx.Client(base_url=f"{server.url}/api/v1/") as client:
        for change in (
            client.put("zones/desk", json=desk),
            client.put("arrays/south/enabled", json={"enabled": False}),
            client.put("alerts/rules/door/armed", json={"armed": False}),
            client.put("alerts/rules/door/armed", json={"armed": True}),
            client.delete("zones/desk"),
        ):
            assert change.status_code == 200
        found = client.get("history/journal", params={"kind": "configuration", "limit": 3}).json()
        assert [entry["text"].partition("has ")[2] for entry in found["entries"]] == [
            "deleted zone 'desk'",
            "armed rule 'door'",
            "disarmed rule 'door'",
        ]
        older = client.get("history/journal", params={"kind": "configuration", "cursor": found["next_cursor"]}).json()
        assert [entry["name"] for entry in older["entries"]] == ["array south", "zone desk", "site file"]
        assert older["entries"][1]["detail"]["zone"]["polygon_m"] == desk["polygon_m"]
        assert older["next_cursor"] is None
        late = replace(sound(1), start_ns=server.parts.clock.now_ns(), end_ns=server.parts.clock.now_ns() + 10**9)
        final = FinalResults((late,), after(late))
        server.parts.event_log.add_final(final, Messages(site, 0, utc=True), {})
        wait_until(lambda: client.get("history/journal?kind=alert").json()["entries"], "the alert")
        [entry] = client.get("history/journal?kind=alert&name=door&text=CONFIDENCE").json()["entries"]
        [alert] = client.get("alerts").json()["alerts"]
        assert entry["detail"] == {name: alert[name] for name in entry["detail"]}
        assert client.get("history/journal?kind=alert&name=other").json()["entries"] == []
        assert client.get("history/journal?kind=song").status_code == 422
        alerts = "history/journal?kind=alert"  # changes of the arrays' states may still come
        tag = client.get(alerts).headers["ETag"]
        assert client.get(alerts, headers={"If-None-Match": tag}).status_code == 304


def test_alert_that_a_killed_server_left_in_the_outbox_is_in_the_journal_after_the_next_start(tmp_path: Path) -> None:
    changes = {"server.events_db": "events.sqlite"}
    site = alert_site(tmp_path, changes, rules={"door": {"events": {"zones": ["door"]}}})
    with running_desk(site) as desk:  # its store has no journal of alerts, as if the server had been killed before it
        desk.finish(sound(1))
        wait_until(lambda: desk.published, "the alert")
    (tmp_path / "events.sqlite").unlink()  # the outbox is another file
    with running_server(site) as server:
        wait_until(lambda: texts(server.parts.store, EntryKind.ALERT), "the entry")
        [entry] = all_of(server.parts.store, JournalQuery(EntryKind.ALERT))
    assert entry.key == desk.published[0]["key"]


def test_start_waits_for_no_database_and_restores_what_its_journal_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alerts of an outage are in the outbox only; a start puts them into the journal, once it runs."""
    rules = {"door": {"events": {"zones": ["door"]}, "hold_off_s": 0}}
    desks, site = (
        alert_site(tmp_path, {"server.events_db": name}, rules=rules, outbox="outbox.db") for name in ("a.db", "b.db")
    )
    sounds = [sound(k) for k in range(5)]
    with running_desk(desks) as desk:  # it has no journal
        desk.finish(*sounds)
        wait_until(lambda: len(desk.published) == len(sounds), "the alerts")
        desk.alerts.note_in_journal(desk.published[0])
    calls: list[str] = []
    prepare, start = Store.prepare, Backlog.start

    def noted_prepare(store: Store) -> None:
        calls.append("prepare")
        prepare(store)

    def noted_start(backlog: Backlog) -> None:
        calls.append("start")
        start(backlog)

    monkeypatch.setattr(Store, "prepare", noted_prepare)
    monkeypatch.setattr(Backlog, "start", noted_start)
    with running_server(site) as server:
        store, outbox = server.parts.store, server.parts.alerts.outbox
        wait_until(lambda: not outbox.not_in_journal(10), "the entries")
        found = [entry.key for entry in all_of(store, JournalQuery(EntryKind.ALERT))]
    assert found == [alert["key"] for alert in reversed(desk.published[1:])]
    assert calls.index("start") <= 2  # only the opening and the entry about the site file come before it
