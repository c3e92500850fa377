"""Alerts of a process that is killed at random moments: each arrives at least once, always under the same key."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

from alert_desk import PATIENT, key_of, sound
from small_site import started, wait_until, write_site
from webhook_receiver import running_receiver

LIVES = Path(__file__).parents[2] / "alert_lives.py"
KILLS = 6
SOUNDS = 180


@pytest.mark.processes
def test_every_alert_arrives_and_copies_have_the_same_key(tmp_path: Path) -> None:
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    chance = random.Random(seed)
    wanted = {key_of(sound(number)) for number in range(0, SOUNDS, 3)}
    with running_receiver() as receiver:
        receiver.answer = lambda: (503 if chance.random() < 0.3 else 204, {})
        action = {**PATIENT, "first_wait_s": 0.01, "webhook": {"url": receiver.url}}
        rule = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["guard"]}
        alerts = {"actions": {"guard": action}, "rules": {"door": rule}}
        site = write_site(tmp_path, {"server.events_db": "events.sqlite", "alerts": alerts})
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with started(sys.executable, LIVES, site, str(SOUNDS), **pipes) as lives:
            assert lives.stdin is not None
            assert lives.stdout is not None

            def begin() -> int:
                print("live", file=lives.stdin, flush=True)
                return int(lives.stdout.readline())  # type: ignore[union-attr]

            for _ in range(KILLS):
                process = begin()
                more = len(receiver.requests) + chance.randrange(8)
                wait_until(lambda more=more: len(receiver.requests) >= more, "some requests")  # type: ignore[misc]
                time.sleep(chance.uniform(0.0, 0.03))
                os.kill(process, signal.SIGKILL)
                assert int(lives.stdout.readline()) == -signal.SIGKILL
            assert set(receiver.keys) < wanted, "the sounds do not last for so many lives"
            begin()
            assert int(lives.stdout.readline()) == 0
    assert set(receiver.keys) == wanted
    bodies = defaultdict(set)
    for request in receiver.requests:
        bodies[request.key].add(request.body)
        assert json.loads(request.body)["data"]["event"]["status"] == "located"
    assert {len(copies) for copies in bodies.values()} == {1}
