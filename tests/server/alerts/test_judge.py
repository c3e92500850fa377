"""The thread that judges: what alerts, once, whatever is early, late, repeated, interrupted or dropped."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from alert_desk import (
    ELSEWHERE,
    Desk,
    after,
    alert_site,
    dated,
    encoded,
    key_of,
    refused,
    running_desk,
    sound,
)
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import Event
from livessl.server.alerts import service
from livessl.server.alerts.outbox import OutboxError
from livessl.server.api.encode import Messages
from livessl.server.set_up_watch import SetUpState
from livessl.site.models import Site
from small_site import wait_until

DOOR: dict[str, Any] = {"events": {"zones": ["door"]}, "hold_off_s": 0}
EARLY: dict[str, Any] = {"events": {"zones": ["door"], "early": True}, "hold_off_s": 0}


def site(directory: Path | None = None, **rules: dict[str, Any]) -> Site:
    kept = {} if directory is None else {"server.events_db": "events.sqlite"}
    return alert_site(directory, kept, rules=rules or {"door": DOOR})


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
    first.alerts.stop()
    first.alerts._thread = None  # from here on nobody judges, as after SIGKILL
    first.finish(sound(2), refused(3), sound(4, ELSEWHERE), sound(5))
    first.store.close()
    with running_desk(site(tmp_path)) as desk:
        wait_until(lambda: len(alerted(desk)) == 3, "what was missed")
        desk.finish(sound(6))
        wait_until(lambda: len(alerted(desk)) == 4, "what is new")
        assert alerted(desk) == [key_of(sound(number)) for number in (1, 2, 5, 6)]
    assert alerted_ids(desk) == ["small-2", "small-5", "small-6"]


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
    monkeypatch.setattr(service, "MAX_QUEUE", 3)
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


def test_lost_array_alerts_once_until_it_has_recovered(tmp_path: Path) -> None:
    lost = {"arrays": {"lasts_s": 0}, "hold_off_s": 0}
    with running_desk(site(tmp_path, arrays=lost)) as desk:
        desk.arrays.states["south"] = "lost"
        wait_until(lambda: len(desk.published) == 1, "the first alert")
        desk.arrays.states["north"] = "degraded"
        wait_until(lambda: len(desk.published) == 2, "the second alert")
    assert [alert["array"]["name"] for alert in desk.published] == ["south", "north"]
    assert desk.published[0]["text"] == "array 'south' is lost"
    with running_desk(site(tmp_path, arrays=lost), state="starting") as desk:
        desk.arrays.states["south"] = "lost"  # still: nobody is told again after a restart
        desk.arrays.states["north"] = "healthy"
        wait_until(lambda: desk.alerts.states["arrays"].ongoing == ("south",), "the recovery")
        desk.arrays.states["north"] = "lost"
        wait_until(lambda: desk.published, "the alert about the second loss")
    assert [alert["array"]["name"] for alert in desk.published] == ["north"]


def test_arrays_are_not_watched_during_a_replay() -> None:
    with running_desk(site(arrays={"arrays": {"lasts_s": 0}, "hold_off_s": 0})) as desk:
        desk.time.is_replay = True
        desk.arrays.states["south"] = "lost"
        looks = patch.object(desk.arrays, "describe", side_effect=AssertionError("looked at"))
        with looks:
            desk.alerts.take_final(dated(sound(1)), after(sound(1)))
        desk.time.is_replay = False
        wait_until(lambda: desk.published, "the alert after the replay")


def test_finding_alerts_by_severity() -> None:
    faults = [Finding("swapped", "north", 2, Severity.ERROR, 0.9, "channels are swapped", "exchange the plugs")]
    faults += [Finding("temperature", None, None, Severity.WARNING, 0.9, "it is warm", "correct temperature_c")]
    rules: dict[str, dict[str, Any]] = {
        "errors": {"findings": {}, "hold_off_s": 0},
        "all": {"findings": {"severity": "warning"}, "hold_off_s": 0},
        "swaps": {"findings": {"severity": "info", "faults": ["turned"]}},
    }
    with running_desk(site(None, **rules)) as desk:
        desk.findings.state = SetUpState(3, tuple(faults))
        wait_until(lambda: len(desk.published) == 3, "the alerts")
    found = sorted((alert["rule"], alert["finding"]["fault"]) for alert in desk.published)
    assert found == [("all", "swapped"), ("all", "temperature"), ("errors", "swapped")]
