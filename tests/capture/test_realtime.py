"""Real-time scheduling: a loop is ended by the kernel, a refusal is told."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys

import pytest

from livessl.capture.realtime import request_realtime

LOOP = """
import sys
from livessl.capture.realtime import request_realtime

print(request_realtime(), flush=True)
while True:
    pass
"""


def test_refusal_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert request_realtime() == "real-time scheduling: Operation not permitted"


def test_limit_of_locked_memory_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (8192, 8192))
    assert request_realtime() == "locked memory: its size is limited"


def test_loop_under_real_time_priority_is_ended_by_the_kernel() -> None:
    looping = subprocess.Popen([sys.executable, "-c", LOOP], stdout=subprocess.PIPE, text=True)
    try:
        assert looping.stdout is not None
        if "real-time" in looping.stdout.readline():
            pytest.skip("this system does not permit real-time scheduling")
        assert looping.wait(60.0) in (-signal.SIGXCPU, -signal.SIGKILL)
    finally:
        looping.kill()
        looping.communicate()
