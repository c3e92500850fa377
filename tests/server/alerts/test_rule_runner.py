"""The thread that judges: what alerts, once, whatever is early, late, repeated, interrupted or dropped."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from alert_desk import (
    ELSEWHERE,
    IN_DOOR,
    Desk,
    after,
    alert_site,
    encoded,
    kept_site,
    key_of,
    refused,
    running_desk,
    sound,
)
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, Event, Track, TrackState
from livessl.server.alerts import backlog, history
from livessl.server.alerts.outbox import DeliveryState, OutboxError
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.store import Store, StoreError
from livessl.server.zones.presence import Presence
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site
from small_site import wait_until

DOOR: dict[str, Any] = {"events": {"zones": ["door"]}, "hold_off_s": 0}
EARLY: dict[str, Any] = {"events": {"zones": ["door"], "early": True}, "hold_off_s": 0}


def site(directory: Path | None = None, **rules: dict[str, Any]) -> Site:
    return kept_site(directory, **(rules or {"door": DOOR}))


def alerted(desk: Desk) -> list[str]:
    """Keys of the kept alerts, oldest first."""
    return [alert["key"] for _, alert in desk.alerts.outbox.recent(10_000)][::-1]


def publish_early(desk: Desk, event: Event) -> None:
    desk.log.add_early(event, Messages(desk.site, 0, utc=True))


def test_final_located_events_in_the_zone_alert_and_refused_ones_never() -> None:
    inside, outside, unsure, last = sound(1), sound(2, ELSEWHERE), refused(3), sound(4)
    with running_desk(site(door=DOOR, any={**DOOR, "events": {"statuses": ["located", "direction-only"]}})) as desk:
        desk.finish(inside, outside, unsure, last)
        wait_until(lambda: len(desk.published) == 5, "all alerts")
        alerts = desk.published
    assert [alert["event"]["id"] for alert in alerts if alert["rule"] == "door"] == [inside.id, last.id]
    assert unsure.id not in {alert["event"]["id"] for alert in alerts}
    alert = alerts[0]
    assert alert["event"] == encoded(inside)
    assert alert["zones"] == ["door"]
    assert alert["membership"][0]["probability"] > 0.99
    assert alert["link"] == "http://127.0.0.1:8000/#event=small-1"
    assert alert["text"].startswith(
        "sound at (0.50, 0.50, 1.00) m, uncertain by 0.09 m, in zone 'door' with probability 1.00, confidence 0.90"
    )


def test_early_events_alert_only_rules_that_ask_for_them() -> None:
    event = sound(1)
    with running_desk(site(door=DOOR, fast=EARLY)) as desk:
        publish_early(desk, event)
        wait_until(lambda: desk.published, "the early alert")
        desk.finish(event)  # the same answer: it is not published again, but final now
        wait_until(lambda: len(desk.published) == 2, "the final alert")
    assert [alert["rule"] for alert in desk.published] == ["fast", "door"]


def test_early_event_that_was_refused_alerts_once_it_is_located() -> None:
    with running_desk(site(fast=EARLY)) as desk:
        publish_early(desk, replace(refused(1), id="small-1"))
        desk.finish(sound(1))
        wait_until(lambda: desk.published, "the alert")
    assert alerted_ids(desk) == ["small-1"]


def test_sound_that_has_alerted_early_does_not_alert_again_under_its_final_id() -> None:
    early = sound(1, at_s=1)
    final = replace(sound(2, at_s=1.1), id="small-final")
    with running_desk(site(fast=EARLY)) as desk:
        publish_early(desk, early)
        wait_until(lambda: desk.published, "the early alert")
        desk.finish(final, sound(9))
        wait_until(lambda: len(desk.published) == 2, "the other alert")
    assert alerted_ids(desk) == ["small-1", "small-9"]


def alerted_ids(desk: Desk) -> list[str]:
    return [alert["event"]["id"] for alert in desk.published]


def test_replayed_events_alert_nobody() -> None:
    with running_desk(site(fast=EARLY)) as desk:
        desk.log.begin_replay()
        desk.finish(sound(1))
        publish_early(desk, sound(2))
        desk.log.begin_live()
        desk.finish(sound(3))
        wait_until(lambda: desk.published, "an alert")
    assert alerted_ids(desk) == ["small-3"]


def test_events_that_became_final_before_a_crash_alert_after_it(tmp_path: Path) -> None:
    """The server is killed after an event was stored as final, and before it was judged."""
    first = Desk(site(tmp_path))
    first.alerts.start()
    wait_until(lambda: first.alerts.outbox.judged_until_ns("small") is not None, "the first start")
    first.finish(sound(1))
    wait_until(lambda: first.published, "the first alert")
    first.alerts.stop()  # from here on nobody judges, as after SIGKILL
    first.finish(sound(2), refused(3), sound(4, ELSEWHERE), sound(5))
    first.store.close()
    with running_desk(site(tmp_path)) as desk:
        wait_until(lambda: len(alerted(desk)) == 3, "what was missed")
        desk.finish(sound(6))
        wait_until(lambda: len(alerted(desk)) == 4, "what is new")
        assert alerted(desk) == [key_of(sound(number)) for number in (1, 2, 5, 6)]
    assert alerted_ids(desk) == ["small-2", "small-5", "small-6"]


def test_new_events_alert_while_the_past_cannot_be_read(tmp_path: Path) -> None:
    """The database comes late; then what was missed is judged, and what has alerted does not alert again."""
    first = Desk(site(tmp_path))
    first.alerts.start()
    wait_until(lambda: first.alerts.outbox.judged_until_ns("small") is not None, "the first start")
    first.alerts.stop()
    first.finish(sound(1))
    first.store.close()
    lost = {"arrays": {"lasts_s": 0}, "hold_off_s": 0}
    desk = Desk(site(tmp_path, door=DOOR, arrays=lost))
    try:
        before_ns = desk.alerts.outbox.judged_until_ns("small")
        with patch.object(desk.store, "finalized", side_effect=StoreError("away")):
            desk.alerts.start()
            desk.finish(sound(2))
            wait_until(lambda: len(desk.published) == 1, "the new event's alert")
            desk.arrays.states["south"] = "lost"
            wait_until(lambda: len(desk.published) == 2, "the array's alert")
            assert desk.alerts.outbox.judged_until_ns("small") == before_ns
            assert [problem.split(":")[0] for problem in desk.alerts.problems] == ["alerts.rules"]
        wait_until(lambda: len(desk.published) == 3, "the missed event's alert")
        wait_until(lambda: not desk.alerts.problems, "the end of the problem")
        assert desk.alerts.outbox.judged_until_ns("small") == after(sound(2)) * FRAME_NS
        assert [(alert["event"] or {}).get("id") for alert in desk.published] == ["small-2", None, "small-1"]
    finally:
        desk.close()


def test_history_from_before_there_were_alerts_does_not_alert(tmp_path: Path) -> None:
    before = Desk(alert_site(tmp_path, {"server.events_db": "events.sqlite"}))
    before.finish(sound(1))
    before.close()
    with running_desk(site(tmp_path)) as desk:
        desk.finish(sound(2))
        wait_until(lambda: desk.published, "an alert")
    assert alerted_ids(desk) == ["small-2"]


def test_events_that_do_not_fit_into_the_queue_are_counted_and_alert_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "MAX_QUEUE", 3)
    desk = Desk(site(tmp_path))
    events = [sound(number) for number in range(8)]
    for event in events:  # the thread does not run yet: nothing takes from the queue
        desk.finish(event)
    assert desk.alerts.unqueued == 5
    desk.alerts.outbox.commit([], {}, 0, ("small", 0))
    desk.alerts.start()
    wait_until(lambda: len(alerted(desk)) == 8, "all alerts")
    desk.finish(sound(8))
    wait_until(lambda: len(alerted(desk)) == 9, "an alert about an event that fits")
    desk.close()
    assert alerted_ids(desk) == [f"small-{number}" for number in range(9)]


def test_missed_events_alert_although_the_store_took_them_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full while the queue is: what did not fit is in the store only later."""
    monkeypatch.setattr(backlog, "MAX_QUEUE", 2)
    desk = Desk(site(tmp_path))
    with patch.object(desk.store, "finalize", side_effect=StoreError("disk full")):
        for number in range(5):
            desk.finish(sound(number))
        desk.alerts.start()
        wait_until(lambda: len(alerted(desk)) == 2, "what is in the queue")
        wait_until(lambda: not desk.alerts.waiting, "a look at what was missed")
        desk.finish(sound(5))
    desk.finish(sound(6))  # the store takes everything
    wait_until(lambda: len(alerted(desk)) == 7, "all alerts")
    desk.close()
    assert alerted_ids(desk) == [f"small-{number}" for number in range(7)]


def test_older_event_that_is_missed_later_alerts_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backlog, "MAX_QUEUE", 1)
    desk = Desk(site(tmp_path))
    messages = Messages(desk.site, 0, utc=True)
    for step, number in enumerate((3, 5, 1, 7)):  # the third one is of a node that was away
        desk.log.add_final(FinalResults((sound(number),), after(sound(8 + step))), messages, {})
    desk.alerts.take_final([], after(sound(20)))  # quiet goes on
    desk.alerts.start()
    wait_until(lambda: len(alerted(desk)) == 4, "all alerts")
    desk.close()
    assert alerted_ids(desk) == ["small-3", "small-1", "small-5", "small-7"]


def test_missed_events_are_judged_page_by_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "PAGE", 2)
    first = Desk(site(tmp_path))
    first.alerts.outbox.commit([], {}, 0, ("small", 0))
    first.finish(*(sound(number) for number in range(7)))
    first.close()  # nobody has judged
    with running_desk(site(tmp_path)) as desk:
        wait_until(lambda: len(alerted(desk)) == 7, "all alerts")
    assert alerted_ids(desk) == [f"small-{number}" for number in range(7)]
    with closing(Store(tmp_path / "events.sqlite")) as store:
        batches = [(len(page), until_ns) for page, until_ns in history.past_pages(store, 0, 2**62)]
    assert [size for size, _ in batches] == [2, 2, 2, 1]
    assert [until_ns for _, until_ns in batches] == [*(sound(number).start_ns for number in (1, 3, 5)), 2**62]


@pytest.mark.parametrize("between", [{}, {"arrays": {"arrays": {}}}])
def test_rules_that_come_back_do_not_alert_about_the_time_between(tmp_path: Path, between: dict[str, Any]) -> None:
    with running_desk(site(tmp_path)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: desk.published, "the first alert")
    without = alert_site(tmp_path, {"server.events_db": "events.sqlite"}, rules=between)
    with running_desk(without) as desk:
        desk.finish(sound(2), sound(3))
    with running_desk(site(tmp_path)) as desk:
        desk.finish(sound(4))
        wait_until(lambda: desk.published, "the next alert")
    assert alerted_ids(desk) == ["small-4"]


@pytest.mark.parametrize("rules", [{}, {"door": DOOR}])
def test_alerts_of_a_removed_action_are_dead_letters_that_can_be_dismissed(
    tmp_path: Path, rules: dict[str, Any]
) -> None:
    kept = {"server.events_db": "events.sqlite"}
    guard = {"guard": {"command": ["false"], "first_wait_s": 1000}}
    door = {"door": {**DOOR, "actions": ["guard"]}}
    with running_desk(alert_site(tmp_path, kept, actions=guard, rules=door)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.deliverers["guard"].failed, "a failed attempt")
    with running_desk(alert_site(tmp_path, kept, rules=rules)) as desk:
        assert desk.alerts.counts() == {("guard", DeliveryState.DEAD): 1}
        assert desk.alerts.problems == ["alerts.actions.guard: 1 alert was given up; see GET alerts/dead-letters"]
        [(letter, _)] = desk.alerts.outbox.dead(10)
        with pytest.raises(LookupError, match="'guard', which the site file does not have; add it"):
            desk.alerts.dead_letters.resend(letter.number)
        desk.alerts.outbox.dismiss(letter.number)
        assert desk.alerts.problems == []


def test_what_the_outbox_does_not_take_is_judged_when_it_does() -> None:
    with running_desk(site()) as desk:
        outbox = desk.alerts.outbox
        with patch.object(outbox, "commit", side_effect=OutboxError("alerts.outbox: cannot be written: disk full")):
            desk.finish(sound(1))
            wait_until(lambda: desk.alerts.problems, "the problem")
            assert "cannot be used" in desk.alerts.problems[0]
            assert alerted(desk) == []
        wait_until(lambda: alerted(desk), "the alert")
        wait_until(lambda: not desk.alerts.problems, "the end of the problem")
    assert alerted_ids(desk) == ["small-1"]


def test_alert_survives_an_event_store_that_cannot_be_written(tmp_path: Path) -> None:
    with running_desk(site(tmp_path)) as desk:
        other = sqlite3.connect(tmp_path / "events.sqlite")
        other.execute("BEGIN EXCLUSIVE")
        desk.finish(sound(1))
        wait_until(lambda: desk.published, "the alert")
        assert not desk.log.is_saved
        other.rollback()
        other.close()


def test_disarmed_rule_stays_disarmed_after_a_restart_until_the_site_file_changes(tmp_path: Path) -> None:
    with running_desk(site(tmp_path)) as desk:
        desk.alerts.arm("door", False)
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.states["door"].suppressed, "the verdict")
    with running_desk(site(tmp_path)) as desk:
        assert not desk.alerts.states["door"].armed
        assert desk.alerts.states["door"].suppressed == {"disarmed": 1}
    for armed in (False, True):
        with running_desk(site(tmp_path, door={**DOOR, "armed": armed})) as desk:
            assert desk.alerts.states["door"].armed is armed


def test_rule_armed_now_does_not_alert_about_the_past() -> None:
    with running_desk(site(door={**DOOR, "armed": False})) as desk:
        desk.alerts.arm("door", True)
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.states["door"].suppressed, "the verdict")
        assert desk.alerts.states["door"].suppressed == {"disarmed": 1}
    assert desk.published == []


def test_events_in_an_excluded_zone_are_kept_flagged_and_never_alert(tmp_path: Path) -> None:
    """The fan stands in the door's zone; what comes from beside it alerts."""
    fan = {"polygon_m": [[0.7, 0.6], [1.0, 0.6], [1.0, 1.0], [0.7, 1.0]], "exclude": True}
    zones = {"zones.fan": fan, "server.events_db": "events.sqlite"}
    rules = {"door": DOOR, "any": {"events": {"early": True}, "hold_off_s": 0}}
    with running_desk(alert_site(tmp_path, zones, rules=rules)) as desk:
        for number, place in enumerate(((0.85, 0.8, 1.0), (0.3, 0.3, 1.0))):
            publish_early(desk, sound(number, place))
        desk.finish(sound(0, (0.85, 0.8, 1.0)), sound(1, (0.3, 0.3, 1.0)))
        wait_until(lambda: len(desk.published) == 2, "the alerts")
        kept = [desk.store.get(f"small-{number}") for number in range(2)]
    assert {(alert["rule"], alert["event"]["id"]) for alert in desk.published} == {
        ("any", "small-1"),
        ("door", "small-1"),
    }
    flags = [(event["excluded"], event["excluded_by"], event["zones"]) for event in kept if event is not None]
    assert flags == [(True, ["fan"], ["door", "fan"]), (False, [], ["door"])]


def test_tracks_alert_by_what_they_do_in_a_zone(tmp_path: Path) -> None:
    zones = {"zones.door.loiter_s": 5, "server.events_db": "events.sqlite"}
    rules = {
        "in": {"tracks": {"zones": ["door"]}, "hold_off_s": 0},
        "stay": {"tracks": {"zones": ["door"], "changes": ["loiter", "leave"]}, "hold_off_s": 60},
    }
    with running_desk(alert_site(tmp_path, zones, rules=rules)) as desk:
        reports = list(walk(desk.site))
        for report, time_ns in reports:
            desk.alerts.take_change(report, time_ns)
        wait_until(lambda: desk.alerts.states["stay"].suppressed, "the last verdict")
    assert [report["change"] for report, _ in reports] == ["enter", "loiter", "leave"]
    assert [(alert["rule"], alert["change"]) for alert in desk.published] == [
        ("in", reports[0][0]),
        ("stay", reports[1][0]),
    ]
    entered, stayed = desk.published
    assert entered["text"] == "track 4 has entered zone 'door', at (0.50, 0.50, 1.00) m"
    assert stayed["text"] == "track 4 stays in zone 'door' after 6.0 s, at (0.50, 0.50, 1.00) m"
    assert (entered["zones"], entered["event"], entered["time_utc"]) == (["door"], None, reports[0][0]["time_utc"])
    assert desk.alerts.states["stay"].suppressed == {"held-off": 1}


def walk(watched: Site) -> Iterator[tuple[JsonObject, int]]:
    """What is reported of a track that comes into the door, stays for six seconds, and leaves."""
    reports: list[tuple[JsonObject, int]] = []
    zones = ZoneMap(watched)
    presence = Presence(lambda: zones, lambda report, time_ns: reports.append((report, time_ns)))
    messages = Messages(watched, 0, utc=True)
    for second, place in ((0, ELSEWHERE), (1, IN_DOOR), (7, IN_DOOR), (8, ELSEWHERE)):
        time_ns = sound(second).start_ns
        track = Track(4, TrackState.UPDATE, time_ns, np.array(place), np.zeros(3), 0.0025 * np.eye(3))
        presence.take(track, messages.track(track))
    yield from reports
