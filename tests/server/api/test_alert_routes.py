"""The routes of the alerts, their WebSocket message, metrics and health, from a whole server."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.sync.client import connect

from alert_desk import ELSEWHERE, PATIENT, after, alert_site, encoded, key_of, refused, sound
from livessl.clock import SystemClock
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event
from livessl.server.api.encode import Messages
from livessl.server.app import Server
from livessl.site.tokens import add_token
from scene_server import capture_scene, replay_scene
from small_site import HANG_S, Changes, running_server, wait_until

DOOR = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["run"]}
RULES: dict[str, Any] = {
    "door": DOOR,
    "loud": {"events": {"min_level_dbfs": 0}, "schedule": [{"days": ["mon"], "begin": "03:00", "end": "03:01"}]},
    "arrays": {"arrays": {"states": ["lost"]}},
}


@contextmanager
def alerting(directory: Path, command: str = "true", changes: Changes | None = None) -> Iterator[Server]:
    actions = {"run": {**PATIENT, "attempts": 2, "command": [command]}}
    with running_server(alert_site(directory, changes, actions=actions, rules=RULES)) as server:
        yield server


def finish(server: Server, *events: Event) -> None:
    """Let events become final, as the fusion thread does."""
    messages = Messages(server.parts.site, 0, utc=True)
    server.parts.event_log.add_final(FinalResults(events, after(*events)), messages, {})


def get(server: Server, path: str, status: int = 200, **query: Any) -> dict[str, Any]:
    answer = httpx.get(f"{server.url}/api/v1/{path}", params=query, timeout=HANG_S)
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def rule(server: Server, name: str) -> dict[str, Any]:
    return next(each for each in get(server, "alerts/rules")["rules"] if each["name"] == name)


def test_alerts_come_by_websocket_and_are_listed_with_their_deliveries(tmp_path: Path) -> None:
    url = "/api/v1/live?kinds=alert"
    with alerting(tmp_path) as server:
        with connect(f"ws{server.url.removeprefix('http')}{url}", open_timeout=HANG_S) as live:
            assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
            finish(server, sound(1), refused(2), sound(3, ELSEWHERE), sound(4))
            messages = [json.loads(live.recv(timeout=HANG_S)) for _ in range(2)]
        wait_until(lambda: server.parts.alerts.counts() == {("run", "delivered"): 2}, "the deliveries")
        listed = get(server, "alerts")["alerts"]
        first = get(server, "alerts", limit=1)
        second = get(server, "alerts", limit=1, before=first["next_before"])
        assert get(server, "alerts", rule="loud")["alerts"] == []
        assert get(server, "alerts", 404, rule="lod")["detail"] == "no rule 'lod'; rules are door, loud, arrays"
    assert [message["key"] for message in messages] == [key_of(sound(1)), key_of(sound(4))]
    assert [alert["key"] for alert in listed] == [key_of(sound(4)), key_of(sound(1))]
    deliveries = listed[0].pop("deliveries")
    assert listed[0] == {name: value for name, value in messages[1].items() if name not in ("v", "seq")}
    assert [(each["action"], each["state"], each["attempts"]) for each in deliveries] == [("run", "delivered", 1)]
    assert [page["alerts"][0]["key"] for page in (first, second)] == [key_of(sound(4)), key_of(sound(1))]
    assert (second["next_before"], listed[0]["link"]) == (None, f"{server.url}/#event=small-4")


def test_subscriber_to_a_zone_or_with_a_least_confidence_gets_its_alerts(tmp_path: Path) -> None:
    url = "/api/v1/live?kinds=alert&zone=door&min_confidence=0.99"
    with (
        alerting(tmp_path) as server,
        connect(f"ws{server.url.removeprefix('http')}{url}", open_timeout=HANG_S) as live,
    ):
        live.recv(timeout=HANG_S)
        finish(server, sound(1))
        assert json.loads(live.recv(timeout=HANG_S))["zones"] == ["door"]


def test_rules_are_listed_with_their_states(tmp_path: Path) -> None:
    with alerting(tmp_path) as server:
        finish(server, sound(1))
        wait_until(lambda: rule(server, "door")["alerts"] == 1, "the alert")
        door, loud, arrays = (rule(server, name) for name in ("door", "loud", "arrays"))
        metrics = httpx.get(f"{server.url}/metrics").text
    assert door == {
        "name": "door",
        "watches": "events",
        "armed": True,
        "open_now": True,
        "actions": ["run"],
        "alerts": 1,
        "last_utc": encoded(sound(1))["time_utc"],
        "suppressed": {"disarmed": 0, "off_schedule": 0, "counting": 0, "held_off": 0},
        "ongoing": [],
    }
    assert (loud["open_now"], loud["last_utc"], arrays["watches"]) == (False, None, "arrays")
    assert 'livessl_alerts_total{rule="door"} 1.0' in metrics
    assert 'livessl_alert_rule_armed{rule="door"} 1.0' in metrics
    assert 'livessl_alert_waiting{action="run"} 0.0' in metrics


def test_operator_disarms_and_arms_a_rule(tmp_path: Path) -> None:
    with alerting(tmp_path) as server:
        url = f"{server.url}/api/v1/alerts/rules/door/armed"
        assert httpx.put(url, json={"armed": False}).json() == {"v": 1, "name": "door", "armed": False}
        assert not rule(server, "door")["armed"]
        finish(server, sound(1))
        wait_until(lambda: rule(server, "door")["suppressed"]["disarmed"] == 1, "the verdict")
        assert httpx.put(url, json={"armed": True}).json()["armed"]
        now_s = SystemClock().now_ns() / 1e9 - encoded_start_s(sound(0))
        finish(server, sound(2, at_s=now_s + 1))
        wait_until(lambda: rule(server, "door")["alerts"] == 1, "the alert")
        assert httpx.put(url, json={"armed": "yes"}).status_code == 422
        answer = httpx.put(url.replace("door", "dor"), json={"armed": True})
        assert (answer.status_code, answer.json()["detail"]) == (404, "no rule 'dor'; rules are door, loud, arrays")


def encoded_start_s(event: Event) -> float:
    return event.start_ns / 1e9


def test_dead_letters_are_listed_degrade_health_and_are_sent_again(tmp_path: Path) -> None:
    script = tmp_path / "alarm.sh"
    script.write_text("#!/bin/sh\ntest -e works\n", encoding="utf-8")
    script.chmod(0o755)
    with alerting(tmp_path, "./alarm.sh") as server:
        finish(server, sound(1), sound(2))
        wait_until(lambda: server.parts.alerts.counts() == {("run", "dead"): 2}, "the end of all attempts")
        page = get(server, "alerts/dead-letters", limit=1)
        [letter] = page["dead_letters"]
        assert (letter["state"], letter["attempts"], letter["alert"]["kind"]) == ("dead", 2, "alert")
        assert letter["error"].endswith("alarm.sh exited with 1, expected 0")
        reason = "alerts.actions.run: 2 alerts were given up; see GET alerts/dead-letters"
        assert reason in get(server, "health")["reasons"]
        assert 'livessl_alert_dead_letters{action="run"} 2.0' in httpx.get(f"{server.url}/metrics").text
        (tmp_path / "works").touch()
        url = f"{server.url}/api/v1/alerts/dead-letters/{letter['number']}/resend"
        assert httpx.post(url).json() == {"v": 1, "number": letter["number"]}
        wait_until(lambda: server.parts.alerts.counts().get(("run", "delivered")) == 1, "the delivery")
        assert httpx.post(url).status_code == 404
        [other] = get(server, "alerts/dead-letters")["dead_letters"]
        assert other["number"] < letter["number"] == page["next_before"]


def test_operator_dismisses_dead_letters(tmp_path: Path) -> None:
    with alerting(tmp_path, "false") as server:
        finish(server, *(sound(number) for number in range(3)))
        wait_until(lambda: server.parts.alerts.counts() == {("run", "dead"): 3}, "the end of all attempts")
        [letter] = get(server, "alerts/dead-letters", limit=1)["dead_letters"]
        url = f"{server.url}/api/v1/alerts/dead-letters"
        assert httpx.delete(f"{url}/{letter['number']}").json() == {"v": 1, "dismissed": 1}
        assert httpx.delete(f"{url}/{letter['number']}").status_code == 404
        assert httpx.delete(url, params={"action": "other"}).json()["dismissed"] == 0
        assert len(get(server, "alerts/dead-letters")["dead_letters"]) == 2
        assert httpx.delete(url).json()["dismissed"] == 2
        assert get(server, "alerts/dead-letters")["dead_letters"] == []
        assert "given up" not in " ".join(get(server, "health")["reasons"])
        states = {each["state"] for alert in get(server, "alerts")["alerts"] for each in alert["deliveries"]}
    assert states == {"dismissed"}


def test_second_dry_run_at_a_time_is_sent_away(tmp_path: Path) -> None:
    with alerting(tmp_path) as server:
        url = f"{server.url}/api/v1/alerts/rules/door/dry-run"
        with server.parts.alerts.dry_runs._trying:
            busy = httpx.get(url, timeout=HANG_S)
        assert (busy.status_code, busy.headers["Retry-After"]) == (503, "5")
        assert httpx.get(url, timeout=HANG_S).status_code == 200


@pytest.mark.parametrize(
    "method_and_path", ["PUT rules/door/armed", "POST dead-letters/1/resend", "DELETE dead-letters/1"]
)
def test_viewer_may_look_and_not_change(tmp_path: Path, method_and_path: str) -> None:
    method, path = method_and_path.split()
    tokens = {role: add_token(tmp_path / "tokens.yaml", role, role) for role in ("viewer", "operator")}
    with alerting(tmp_path, changes={"server.http.tokens": "tokens.yaml"}) as server:
        headers = {role: {"Authorization": f"Bearer {token}"} for role, token in tokens.items()}
        url = f"{server.url}/api/v1/alerts"
        found = [
            httpx.request(method, f"{url}/{path}", headers=each, json={"armed": False}) for each in headers.values()
        ]
        assert httpx.get(f"{url}/rules", headers=headers["viewer"]).status_code == 200
    assert [answer.status_code for answer in found] == [403, 200 if method == "PUT" else 404]


def test_dry_run_says_how_often_a_rule_would_have_alerted(tmp_path: Path) -> None:
    now_s = SystemClock().now_ns() / 1e9 - encoded_start_s(sound(0))
    recent = [sound(number, at_s=now_s - 3600 + 10 * number) for number in range(5)]
    old = sound(9, at_s=now_s - 3 * 86400)
    with alerting(tmp_path) as server:
        finish(server, old, *recent, refused(10), sound(11, ELSEWHERE, at_s=now_s - 60))
        wait_until(lambda: rule(server, "door")["alerts"] == 6, "the real alerts")
        day, week = (get(server, "alerts/rules/door/dry-run", days=days) for days in (1, 7))
        assert get(server, "alerts/rules/arrays/dry-run", 404)["detail"].startswith("rule 'arrays' is not on events")
        assert get(server, "alerts/rules/none/dry-run", 404)["detail"].startswith("no rule 'none'")
        get(server, "alerts/rules/door/dry-run", 422, days=0)
        assert len(get(server, "alerts")["alerts"]) == 6  # it has raised nothing
    assert (day["events"], day["matched"], day["alerts"]) == (6, 5, 5)
    assert day["text"] == "rule 'door' would have alerted 5 times in the last day"
    assert (week["matched"], week["alerts"], week["complete"]) == (6, 6, True)
    assert [each["event_id"] for each in week["latest"]] == [event.id for event in (*recent[::-1], old)]


def test_site_without_rules_has_empty_answers_and_no_thread(tmp_path: Path) -> None:
    with running_server(alert_site(tmp_path)) as server:
        assert get(server, "alerts") == {"v": 1, "alerts": [], "next_before": None}
        assert get(server, "alerts/rules") == {"v": 1, "rules": []}
        assert get(server, "alerts/dead-letters")["dead_letters"] == []
        assert "livessl_alert" not in httpx.get(f"{server.url}/metrics").text
    assert list(tmp_path.iterdir()) == []


def test_sounds_of_a_node_alert_and_their_replay_does_not(tmp_path: Path) -> None:
    """From microphones to the alert: real sound, sockets, fusion, final pass."""
    rules = {"door": {"events": {"min_confidence": 0.5}, "hold_off_s": 0}}
    with running_server(alert_site(tmp_path, {"server.events_db": "events.sqlite"}, rules=rules)) as server:
        capture_scene(server)
        wait_until(lambda: rule(server, "door")["alerts"] == 2, "an alert about each sound")
        alerts, events = get(server, "alerts")["alerts"], get(server, "events")["events"]
        replay_scene(server)
        wait_until(lambda: server.parts.event_log.published == 4, "the replayed events")
        capture_scene(server, 4 + len(events))
        wait_until(lambda: rule(server, "door")["alerts"] == 4, "alerts about live sound again")
    assert [alert["event"] for alert in alerts] == events
    assert len({alert["key"] for alert in alerts}) == 2
