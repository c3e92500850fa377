"""A whole server that alerts and is edited by operators, killed at random moments while real nodes send sounds."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Thread
from typing import Any, Final, Self

import httpx
from processes import Playing, duration_s, wait_for

from livessl.server.alerts.message import AlertMessages
from livessl.site.load import load_site
from webhook_receiver import Receiver, Request, running_receiver

LIVES: Final = Path(__file__).with_name("forked_servers.py")
WITHIN_S: Final = 90.0
"""Longest wait for a server that starts, and for the last alerts, in seconds."""

FAN: Final = {"polygon_m": [[0.0, 2.5], [4.0, 2.5], [4.0, 5.0], [0.0, 5.0]], "exclude": True}
"""Excluded zone: half of the room, so that about half of the sounds must not alert."""

RULES: Final = {
    "any": {"events": {}, "hold_off_s": 0, "actions": ["guard"]},
    "switched": {"events": {"zones": ["door"]}, "hold_off_s": 0, "armed": False},
}


@dataclass(frozen=True)
class Outcome:
    """Alerts that arrived at the webhook, and changes that were kept.

    Parameters
    ----------
    kills : int
        Servers that were killed.
    interrupted : int
        Kills that met an edit of a zone or rule in progress: it had begun, and was not answered.
    sounds : int
        Events that are stored in the end.
    wanted : frozenset of str
        Keys of the alerts about those that are located and not excluded.
    accepted : dict of str to int
        How often each key arrived and was accepted.
    differing : int
        Keys under which different alerts arrived.
    unwanted : list of str
        Events that alerted although they were refused or excluded.
    forgotten : list of str
        Changes of zones and rules that were answered, and were gone after a kill, or that were half made.
    changes : int
        Changes that were answered.
    """

    kills: int
    interrupted: int
    sounds: int
    wanted: frozenset[str]
    accepted: dict[str, int]
    differing: int
    unwanted: list[str]
    forgotten: list[str]
    changes: int

    @property
    def missing(self) -> list[str]:
        """Keys of alerts that never arrived."""
        return sorted(self.wanted - self.accepted.keys())

    @property
    def copies(self) -> int:
        """Deliveries beyond the first one of each alert."""
        return sum(self.accepted.values()) - len(self.accepted)


@dataclass
class Forked(Playing):
    """A site whose server is forked from a process that has loaded everything."""

    pid: int = 0

    def __enter__(self) -> Self:
        super().__enter__()
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._log, "text": True}
        self._lives = subprocess.Popen([sys.executable, str(LIVES), str(self.site)], **pipes)
        self._open.callback(self._end)
        return self

    def start_server(self) -> None:
        """Start one; it may take a while to answer."""
        assert self._lives.stdin is not None
        assert self._lives.stdout is not None
        print("live", file=self._lives.stdin, flush=True)
        self.pid = int(self._lives.stdout.readline())

    def kill_server(self) -> None:
        """Kill it by SIGKILL."""
        assert self._lives.stdout is not None
        os.kill(self.pid, signal.SIGKILL)
        status = int(self._lives.stdout.readline())
        self.pid = 0
        assert status == -signal.SIGKILL, f"the server had ended by itself: {status}"

    def _end(self) -> None:
        if self.pid:
            self.kill_server()
        assert self._lives.stdin is not None
        self._lives.stdin.close()
        self._lives.wait(timeout=WITHIN_S)
        assert self._lives.stdout is not None
        self._lives.stdout.close()


Zones = dict[str, Any]
"""The drawn zones, whole, by name."""

SHAPES: Final = ([[3.0, 0.1], [3.9, 0.1], [3.5, 0.9]], [[0.1, 1.1], [0.9, 1.1], [0.9, 1.9], [0.1, 1.9]])
"""Corners with which a zone is drawn, and those to which it is changed."""


@dataclass
class Operator:
    """Draws, changes and deletes zones and switches a rule; remembers what was answered and what was under way.

    Parameters
    ----------
    site : Forked
    """

    site: Forked
    zones: Zones = field(default_factory=dict)
    armed: bool = False
    edits: int = 0
    drawn: int = 0
    changes: int = 0
    forgotten: list[str] = field(default_factory=list)
    under_way: bool = False
    begun_s: float = 0.0
    usual_s: float = 0.05
    failure: BaseException | None = None
    _zones: Zones | None = None  # as they are if the edit without an answer was made
    _armed: bool | None = None  # the same of the rule

    def change(self) -> None:
        """Make the next edit of a zone and switch the rule, in turns this or that first.

        Without an answer both outcomes are possible.
        """
        edits = [self._edit_zone, self._switch]
        self.edits += 1
        for edit in edits[:: 1 if self.edits % 2 else -1]:
            edit()

    def _edit_zone(self) -> None:
        step, name = self.drawn % 3, f"drawn-{self.drawn // 3}"
        wanted = {other: zone for other, zone in self.zones.items() if other != name}
        if step < 2:
            wanted[name] = SHAPES[step]
        self.drawn += 1
        self._zones = wanted
        body = {"polygon_m": SHAPES[step]} if step < 2 else None
        if step < 2 or name in self.zones:
            self._send("DELETE" if body is None else "PUT", f"zones/{name}", body)
        self.zones, self._zones = wanted, None

    def _switch(self) -> None:
        self._armed = not self.armed
        self._send("PUT", "alerts/rules/switched/armed", {"armed": self._armed})
        self.armed, self._armed = self._armed, None

    def change_until_killed(self) -> None:
        """Make one edit after the other until the server does not answer any more."""
        try:
            while True:
                self.change()
        except httpx.TransportError:
            return
        except BaseException as error:  # noqa: BLE001 - it is raised by the thread that plays
            self.failure = error

    def wait_under_way(self, after_s: float) -> None:
        """Return while an edit is under way, at the earliest after some time."""
        at_s = time.monotonic() + after_s
        while self.failure is None and not (self.under_way and time.monotonic() >= at_s):
            time.sleep(0.0002)
        if self.failure is not None:
            raise self.failure

    def check(self) -> None:
        """Note what was answered before the kill and is not so after it, and what was half made."""
        found = self._get("zones")["zones"]
        there = {name: zone["polygon_m"] for name, zone in found.items() if name.startswith("drawn-")}
        rules = {rule["name"]: rule["armed"] for rule in self._get("alerts/rules")["rules"]}
        zones = [self.zones] if self._zones is None else [self.zones, self._zones]
        if there not in zones:
            self.forgotten.append(f"zones are {there}, expected one of {zones}")
        if not {"door", "fan"} <= found.keys() or not found["fan"]["exclude"]:
            self.forgotten.append(f"of the site file's zones, {sorted(found)} are left")
        if rules["switched"] not in (self.armed, self._armed):
            self.forgotten.append(f"the rule is {rules['switched']}, expected {self.armed}")
        self.zones, self.armed = there, rules["switched"]
        self._zones = self._armed = None

    def _get(self, what: str) -> Any:
        answer = httpx.get(f"http://127.0.0.1:{self.site.http}/api/v1/{what}", timeout=WITHIN_S)
        answer.raise_for_status()
        return answer.json()

    def _send(self, method: str, what: str, body: Any) -> None:
        url = f"http://127.0.0.1:{self.site.http}/api/v1/{what}"
        with httpx.Client(timeout=WITHIN_S) as client:
            request = client.build_request(method, url, json=body)
            self.begun_s, self.under_way = time.monotonic(), True
            client.send(request).raise_for_status()
            self.under_way = False
        self.usual_s = max(0.5 * self.usual_s, time.monotonic() - self.begun_s)
        self.changes += 1


def play_killed(recordings: Path, directory: Path, kills: int, seed: int) -> Outcome:
    """Play recordings to a server that is killed again and again; let it finish, and return what arrived.

    Every second kill comes while an edit of the operator is under way, the others soon after one was answered. A life
    lasts until none, one or two deliveries have been tried, and then up to half a second longer: on a slow machine a
    server that is killed sooner never comes to an event.
    """
    chance, end_s = random.Random(seed), duration_s(recordings)
    with ExitStack() as stack:
        receiver = stack.enter_context(running_receiver())
        receiver.answer = lambda: (503 if chance.random() < 0.2 else 204, {})
        guard = {"webhook": {"url": receiver.url}, "first_wait_s": 0.05, "longest_wait_s": 0.5, "attempts": 1000}
        alerts = {"actions": {"guard": guard}, "rules": RULES}
        changes = {"alerts": alerts, "zones.fan": FAN, "zones_file": "zones.yaml"}
        site = stack.enter_context(Forked(recordings, directory, seed=seed, changes=changes))
        site.start()
        operator, killed, interrupted = Operator(site), 0, 0
        site.sleep_until(0.5)
        while killed < kills or interrupted == 0:
            wanted = len(receiver.requests) + chance.choice((0, 1, 1, 2))
            give_up_s = time.monotonic() + WITHIN_S
            while len(receiver.requests) < wanted and time.monotonic() < give_up_s and site.now_s() < end_s:
                time.sleep(0.02)
            time.sleep(chance.uniform(0.0, 0.5))
            operator.change()
            if killed % 2 == 0 or killed >= kills:
                interrupted += operator_interrupted(site, operator, chance.uniform(0.0, 4.0 * operator.usual_s))
            else:
                time.sleep(chance.uniform(0.0, 0.05))
                site.kill_server()
            killed += 1
            site.start_server()
            site.wait_ready(WITHIN_S)
            operator.check()
        outcome = _finished(site, receiver, operator, end_s)
        return replace(outcome, kills=killed, interrupted=interrupted)


def operator_interrupted(site: Forked, operator: Operator, after_s: float) -> bool:
    """Kill the server while an edit is under way; return whether it was still without an answer."""
    editing = Thread(target=operator.change_until_killed)
    editing.start()
    operator.wait_under_way(after_s)
    killed_s = time.monotonic()
    site.kill_server()
    editing.join(WITHIN_S)
    assert not editing.is_alive(), "an edit of a killed server does not end"
    return operator.begun_s < killed_s


def _finished(site: Forked, receiver: Receiver, operator: Operator, end_s: float) -> Outcome:
    site.sleep_until(end_s + 1.0)
    wait_for(lambda: all(site.is_settled() for _ in range(3)), "the last events", 2.0 * WITHIN_S)
    messages = AlertMessages(load_site(site.site), "")
    events = site.events()
    alerting = [event for event in events if event["status"] == "located" and not event["excluded"]]
    wanted = frozenset(messages.key("any", event["id"]) for event in alerting)
    wait_for(lambda: wanted <= set(receiver.keys), "the last alerts", WITHIN_S)
    bodies: dict[str, set[bytes]] = defaultdict(set)
    with receiver.lock:
        requests: list[Request] = list(receiver.requests)
    for request in requests:
        bodies[request.key].add(request.body)
    about = [request.alert["event"] for request in requests]
    return Outcome(
        kills=0,
        interrupted=0,
        sounds=len(events),
        wanted=wanted,
        accepted={key: receiver.keys.count(key) for key in set(receiver.keys)},
        differing=sum(len(copies) > 1 for copies in bodies.values()),
        unwanted=sorted({event["id"] for event in about if event["status"] != "located" or event["excluded"]}),
        forgotten=operator.forgotten,
        changes=operator.changes,
    )
