"""MQTT with a real Mosquitto: alerts, availability, last will, discovery, and a broker that goes and comes back."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import aiomqtt
import pytest

from alert_desk import PATIENT, Desk, alert_site, key_of, running_desk, sound
from conftest import require
from livessl.errors import ConfigError
from livessl.lab.processes import free_port
from livessl.site.models import Site
from mosquitto import running_mosquitto
from small_site import HANG_S, started, wait_until, write_site

RULE = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["home"]}
LIVES = Path(__file__).parents[2] / "alert_lives.py"
PATH_OF_PASSWORDS = Path("/usr/bin/mosquitto_passwd")


def mqtt_site(directory: Path, port: int, *, kept: bool = False, rules: Any = None, **mqtt: Any) -> Site:
    changes = {"server.events_db": "events.sqlite"} if kept else {}
    actions = {"home": {**PATIENT, "mqtt": {"port": port, **mqtt}}}
    return alert_site(directory, changes, actions=actions, rules=rules or {"door": RULE})


class Listener:
    """Receives every message of a broker; those that the broker kept come first."""

    def __init__(self, port: int, **login: str) -> None:
        self.messages: list[tuple[str, bytes]] = []
        self._login, self._port = login, port
        self._loop = asyncio.new_event_loop()
        self._ready = False
        self._thread = Thread(target=self._loop.run_until_complete, args=(self._listen(),))
        self._task: asyncio.Task[Any] | None = None

    async def _listen(self) -> None:
        self._task = asyncio.current_task()
        try:
            async with aiomqtt.Client("127.0.0.1", self._port, **self._login) as client:  # type: ignore[arg-type]
                await client.subscribe("#", qos=1)
                self._ready = True
                async for message in client.messages:
                    assert isinstance(message.payload, bytes)
                    self.messages.append((str(message.topic), message.payload))
        except (asyncio.CancelledError, aiomqtt.MqttError):
            pass

    def of(self, topic: str) -> list[bytes]:
        return [payload for name, payload in self.messages if name == topic]

    def alerts(self, rule: str = "door", site: str = "livessl/small") -> list[dict[str, Any]]:
        return [json.loads(payload) for payload in self.of(f"{site}/alerts/{rule}")]

    def __enter__(self) -> Listener:
        self._thread.start()
        wait_until(lambda: self._ready, "the subscription")
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(timeout=HANG_S)
        self._loop.close()


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    with running_mosquitto(tmp_path) as port:
        yield port


def states(desk: Desk) -> dict[str, int]:
    return {state: count for (_, state), count in desk.alerts.outbox.counts().items()}


def test_alert_is_published_with_its_key_and_the_servers_presence_is_kept(tmp_path: Path, port: int) -> None:
    availability = "livessl/small/availability"
    with Listener(port) as listener:
        with running_desk(mqtt_site(tmp_path, port)) as desk:
            wait_until(lambda: listener.of(availability) == [b"online"], "the presence")
            desk.finish(sound(1))
            wait_until(lambda: listener.alerts(), "the alert")
            wait_until(lambda: states(desk) == {"delivered": 1}, "the confirmation")
        wait_until(lambda: listener.of(availability) == [b"online", b"offline"], "the goodbye")
        [alert] = listener.alerts()
        assert alert == {"event_type": "alert", **desk.published[0]}
        assert alert["key"] == key_of(sound(1))
    with Listener(port) as later:
        wait_until(lambda: later.of(availability) == [b"offline"], "the kept presence")
        assert later.alerts() == []


@pytest.mark.processes
def test_broker_announces_a_server_that_was_killed(tmp_path: Path, port: int) -> None:
    rule = {**RULE, "actions": ["guard"]}
    alerts = {"actions": {"guard": {**PATIENT, "mqtt": {"port": port}}}, "rules": {"door": rule}}
    site = write_site(tmp_path, {"server.events_db": "events.sqlite", "alerts": alerts})
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with Listener(port) as listener, started(sys.executable, LIVES, site, "100000", **pipes) as lives:
        assert lives.stdin is not None
        assert lives.stdout is not None
        print("live", file=lives.stdin, flush=True)
        process = int(lives.stdout.readline())
        wait_until(lambda: listener.alerts(), "an alert")
        os.kill(process, signal.SIGKILL)
        presence = "livessl/small/availability"
        wait_until(lambda: listener.of(presence) == [b"online", b"offline"], "the last will")


DOCUMENTED = {
    "availability": list, "availability_mode": str, "availability_template": str, "availability_topic": str,
    "device": dict, "device_class": str, "enabled_by_default": bool, "encoding": str, "entity_category": str,
    "event_types": list, "icon": str, "json_attributes_template": str, "json_attributes_topic": str, "name": str,
    "object_id": str, "origin": dict, "payload_available": str, "payload_not_available": str, "qos": int,
    "state_topic": str, "unique_id": str, "value_template": str,
}  # fmt: skip
"""Keys of Home Assistant's MQTT event entity and their types; `origin` is of every discovery message."""

DEVICE = {
    "configuration_url", "connections", "hw_version", "identifiers", "manufacturer", "model", "name", "suggested_area",
    "sw_version", "via_device",
}  # fmt: skip


def test_discovery_describes_each_rule_by_home_assistants_schema(tmp_path: Path, port: int) -> None:
    names = ("door", "hall.north", "hall_north")
    with Listener(port) as listener:
        with running_desk(mqtt_site(tmp_path, port, rules=dict.fromkeys(names, RULE))):
            wait_until(lambda: listener.of("livessl/small/availability"), "the presence")
        found = {topic: json.loads(text) for topic, text in listener.messages if topic.startswith("homeassistant/")}
    assert len(found) == len(names)
    assert {payload["name"] for payload in found.values()} == set(names)
    assert len({payload["unique_id"] for payload in found.values()}) == len(names)
    for topic, payload in found.items():
        assert re.fullmatch(r"homeassistant/event/[A-Za-z0-9_-]+/[A-Za-z0-9_-]+/config", topic)
        assert {"event_types", "state_topic"} <= payload.keys() <= DOCUMENTED.keys()
        assert all(isinstance(value, DOCUMENTED[key]) for key, value in payload.items())
        assert payload["event_types"] == ["alert"]
        assert payload["state_topic"] == f"livessl/small/alerts/{payload['name']}"
        assert payload["availability_topic"] == "livessl/small/availability"
        assert payload["device"].keys() <= DEVICE
        assert payload["device"]["identifiers"] == ["livessl_small"]
        assert re.match("https?://", payload["device"]["configuration_url"])
        assert payload["origin"]["name"] == "livessl"


def test_rule_that_was_taken_out_of_the_site_file_is_forgotten(tmp_path: Path, port: int) -> None:
    def shown(listener: Listener) -> list[str]:
        return [topic.split("/")[3] for topic, text in listener.messages if topic.endswith("/config") and text]

    for rules in (("door", "hall"), ("hall",)):
        with (
            running_desk(mqtt_site(tmp_path, port, kept=True, rules=dict.fromkeys(rules, RULE))),
            Listener(port) as seen,
        ):
            wait_until(lambda seen=seen: seen.of("livessl/small/availability")[-1:] == [b"online"], "the presence")  # type: ignore[misc]
    with Listener(port) as later:
        wait_until(lambda: later.of("livessl/small/availability"), "the kept messages")
        assert shown(later) == ["hall"]


def test_two_actions_at_one_broker_leave_each_others_rules(tmp_path: Path, port: int) -> None:
    actions = {name: {**PATIENT, "mqtt": {"port": port}} for name in ("home", "yard")}
    rules = {"door": RULE, "hall": {**RULE, "actions": ["yard"]}}
    topics = {f"homeassistant/event/livessl_small/{rule}/config" for rule in rules}
    with Listener(port) as listener, running_desk(alert_site(tmp_path, actions=actions, rules=rules)):
        online = "livessl/small/availability"  # the last message with which an action introduces itself
        wait_until(lambda: listener.of(online).count(b"online") == 2, "both introductions")
        introduced = [(topic, text) for topic, text in listener.messages if topic in topics]
    assert {topic for topic, text in introduced if text} == topics
    assert [topic for topic, text in introduced if not text] == []


def test_discovery_can_be_switched_off_and_the_topic_chosen(tmp_path: Path, port: int) -> None:
    with Listener(port) as listener, running_desk(mqtt_site(tmp_path, port, topic="yard/ears", discovery="")) as desk:
        desk.finish(sound(1))
        wait_until(lambda: listener.alerts(site="yard/ears"), "the alert")
        assert {topic for topic, _ in listener.messages} == {"yard/ears/availability", "yard/ears/alerts/door"}


def test_alert_waits_for_a_broker_that_is_away_and_comes_back(tmp_path: Path) -> None:
    port = free_port()
    with ExitStack() as broker:
        broker.enter_context(running_mosquitto(tmp_path, port))
        with running_desk(mqtt_site(tmp_path, port)) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the first delivery")
            broker.close()
            desk.finish(sound(2))
            wait_until(lambda: desk.alerts.deliverers["home"].failed, "a failed attempt")
            with running_mosquitto(tmp_path, port), Listener(port) as listener:
                wait_until(lambda: states(desk) == {"delivered": 2}, "the second delivery")
                wait_until(lambda: listener.of("livessl/small/availability")[-1:] == [b"online"], "the presence")


def test_password_is_read_from_a_file_and_a_wrong_one_is_reported(tmp_path: Path, caplog: Any) -> None:
    require(PATH_OF_PASSWORDS.exists(), "mosquitto_passwd is not installed (Debian: apt install mosquitto)")
    (tmp_path / "users").touch(mode=0o600)
    subprocess.run([PATH_OF_PASSWORDS, "-b", tmp_path / "users", "ears", "quiet"], check=True, capture_output=True)
    for name, text in (("right", "quiet"), ("wrong", "loud")):
        (tmp_path / name).write_text(text + "\n", encoding="utf-8")
        (tmp_path / name).chmod(0o600)
    login = f"allow_anonymous false\npassword_file {tmp_path}/users"
    with running_mosquitto(tmp_path, further=login) as port:
        with running_desk(mqtt_site(tmp_path, port, username="ears", password="wrong")):
            wait_until(lambda: "not authori" in caplog.text.lower(), "the report")
        assert "loud" not in caplog.text
        with running_desk(mqtt_site(tmp_path, port, username="ears", password="right")) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")


@contextmanager
def nothing_importable(monkeypatch: pytest.MonkeyPatch, name: str) -> Iterator[None]:
    with monkeypatch.context() as patched:
        patched.setitem(__import__("sys").modules, name, None)
        yield


@pytest.mark.parametrize(
    ("action", "package"), [({"mqtt": {}}, "aiomqtt"), ({"apprise": {"url": "notify.url"}}, "apprise")]
)
def test_missing_package_is_named_with_its_cure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action: dict[str, Any], package: str
) -> None:
    site = alert_site(tmp_path, actions={"home": action}, rules={"door": RULE})
    with nothing_importable(monkeypatch, package), pytest.raises(ConfigError) as caught:
        Desk(site)
    kind = next(iter(action))
    expected = f"alerts.actions.home.{kind}: needs the package {package}; pip install 'livessl[alerts]'"
    assert str(caught.value) == expected
