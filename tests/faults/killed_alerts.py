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
from dataclasses import dataclass, field
from pathlib import Path
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
        Changes of zones and rules that were answered, and were gone after a kill.
    changes : int
        Changes that were answered.
    """

    kills: int
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


@dataclass
class Operator:
    """Draws zones and switches a rule; remembers what was answered.

    Parameters
    ----------
    site : Forked
    """

    site: Forked
    zones: set[str] = field(default_factory=set)
    armed: bool = False
    changes: int = 0
    unsure: set[str] = field(default_factory=set)
    forgotten: list[str] = field(default_factory=list)

    def change(self, number: int) -> None:
        """Draw a zone or delete the last one, and switch the rule; without an answer both outcomes are possible."""
        name = f"drawn-{number // 2}"
        corners = {"polygon_m": [[3.0, 0.1], [3.9, 0.1], [3.5, 0.9]]}
        if number % 2 == 0:
            if self._sent("PUT", f"zones/{name}", corners):
                self.zones.add(name)
        elif name in self.zones and self._sent("DELETE", f"zones/{name}", None):
            self.zones.discard(name)
        if self._sent("PUT", "alerts/rules/switched/armed", {"armed": not self.armed}):
            self.armed = not self.armed

    def check(self) -> None:
        """Note what was answered before the kill and is not so after it."""
        there = {name for name in self._get("zones")["zones"] if name.startswith("drawn-")}
        rules = {rule["name"]: rule["armed"] for rule in self._get("alerts/rules")["rules"]}
        if "zones" not in self.unsure and there != self.zones:
            self.forgotten.append(f"zones are {sorted(there)}, expected {sorted(self.zones)}")
        if "alerts" not in self.unsure and rules["switched"] != self.armed:
            self.forgotten.append(f"the rule is {rules['switched']}, expected {self.armed}")
        self.zones, self.armed = there, rules["switched"]
        self.unsure.clear()

    def _get(self, what: str) -> Any:
        answer = httpx.get(f"http://127.0.0.1:{self.site.http}/api/v1/{what}", timeout=WITHIN_S)
        answer.raise_for_status()
        return answer.json()

    def _sent(self, method: str, what: str, body: Any) -> bool:
        try:
            url = f"http://127.0.0.1:{self.site.http}/api/v1/{what}"
            httpx.request(method, url, json=body, timeout=WITHIN_S).raise_for_status()
        except httpx.TransportError:
            self.unsure.add(what.partition("/")[0])
            return False
        self.changes += 1
        return True


def play_killed(recordings: Path, directory: Path, kills: int, seed: int) -> Outcome:
    """Play recordings to a server that is killed again and again; let it finish, and return what arrived.

    A life lasts until none, one or two deliveries have been tried, and then up to half a second longer: on a slow
    machine a server that is killed sooner never comes to an event.
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
        operator, killed = Operator(site), 0
        site.sleep_until(0.5)
        while killed < kills:
            wanted = len(receiver.requests) + chance.choice((0, 1, 1, 2))
            give_up_s = time.monotonic() + WITHIN_S
            while len(receiver.requests) < wanted and time.monotonic() < give_up_s and site.now_s() < end_s:
                time.sleep(0.02)
            time.sleep(chance.uniform(0.0, 0.5))
            operator.change(killed)
            time.sleep(chance.uniform(0.0, 0.05))
            site.kill_server()
            killed += 1
            site.start_server()
            site.wait_ready(WITHIN_S)
            operator.check()
        return _finished(site, receiver, operator, killed, end_s)


def _finished(site: Forked, receiver: Receiver, operator: Operator, kills: int, end_s: float) -> Outcome:
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
        kills=kills,
        sounds=len(events),
        wanted=wanted,
        accepted={key: receiver.keys.count(key) for key in set(receiver.keys)},
        differing=sum(len(copies) > 1 for copies in bodies.values()),
        unwanted=sorted({event["id"] for event in about if event["status"] != "located" or event["excluded"]}),
        forgotten=operator.forgotten,
        changes=operator.changes,
    )
