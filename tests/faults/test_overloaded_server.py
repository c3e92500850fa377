"""A server that gets more sound than it can locate: it says so, stays in time and small, and stores every event."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from livessl import wire
from livessl.capture.link import Link
from livessl.capture.spool import Spool
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS, Frame, Mark, Message
from livessl.lab.processes import free_port
from livessl.site.node_models import SpoolConfig
from small_site import HANG_S, RATE_HZ, started, wait_until, write_site

ARRAYS = 20
SOUND, PERIOD, RUN_UP, HANG_OVER = 16, 40, 8, 6
"""Lengths in frames: of a sound, from one sound to the next, and of the quiet that is sent before and after it."""

MOST_MB = 400
"""Most memory that an overloaded server may take, in megabytes."""

SLOW = '''
"""An estimator whose work on a frame takes 6 ms, as on a machine that is much too slow for 20 arrays."""

import time

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.locate.estimator import Localization


class FrontEnd:
    def __init__(self, sample_rate_hz):
        self.sample_rate_hz = sample_rate_hz

    def reset(self):
        pass

    def push(self, samples, *, quiet):
        time.sleep(0.006)
        return OnsetGCC(np.zeros((6, 3), np.float32), np.full(len(samples), float(not quiet)))


class Slow:
    name = "slow"

    def __init__(self, arrays, grid, c_m_s):
        pass

    def prepare(self, array, sample_rate_hz):
        pass

    def onset_front_end(self, array, sample_rate_hz):
        return FrontEnd(sample_rate_hz)

    def locate(self, sounds):
        return Localization(np.array([1.0, 1.0, 1.0]), 0.01 * np.eye(3), 0.9, ())
'''

CLOCK = SystemClock()


class Nodes:
    """Arrays that send the same sounds in real time, in a thread, over one link with the usual spool of a node."""

    def __init__(self, endpoint: str, directory: Path) -> None:
        self.sounds = 0
        """Number of sounds that have been sent to their end."""
        self._ending = threading.Event()
        self._rng = np.random.default_rng(3)
        self._sequence = dict.fromkeys((name_of(k) for k in range(ARRAYS)), 0)
        hello = wire.Hello("nodes", "run-1", dict.fromkeys(self._sequence, float(RATE_HZ)))
        usual = SpoolConfig()
        spool = Spool(directory, round(usual.max_mb * 1e6), usual.max_age_s)
        self._link = Link(endpoint, hello, CLOCK, spool=spool)
        self._quiet = threading.Event()
        self._thread = threading.Thread(target=self._play)

    def begin(self) -> None:
        self._thread.start()

    def fall_silent(self) -> None:
        """Send the present sound to its end, and no other."""
        self._quiet.set()

    def end(self) -> None:
        self._ending.set()
        self._thread.join(HANG_S)

    @property
    def dropped(self) -> int:
        return self._link.dropped

    def _play(self) -> None:
        frame_index = CLOCK.now_ns() // FRAME_NS + 1
        number = 0
        while not self._ending.is_set():
            while not CLOCK.sleep_until_ns((frame_index + 1) * FRAME_NS):
                pass
            if number or not self._quiet.is_set():
                self._link.send(m for k in range(ARRAYS) for m in self._messages(k, frame_index, number))
                number = (number + 1) % PERIOD
                self.sounds += number == RUN_UP + SOUND
            else:
                self._link.send(self._mark(name_of(k), frame_index) for k in range(ARRAYS))
            frame_index += 1
        self._link.close(bye=True)

    def _messages(self, k: int, frame_index: int, number: int) -> Iterator[Message]:
        """Yield what an array sends of a frame index; `number` counts from the beginning of the run-up."""
        if RUN_UP <= number < RUN_UP + SOUND:
            if number == RUN_UP:
                yield from (self._frame(k, frame_index - back, active=False) for back in range(RUN_UP, 0, -1))
            yield self._frame(k, frame_index, active=True)
        elif RUN_UP + SOUND <= number < RUN_UP + SOUND + HANG_OVER:
            yield self._frame(k, frame_index, active=False)
        else:
            yield self._mark(name_of(k), frame_index)

    def _frame(self, k: int, frame_index: int, *, active: bool) -> Frame:
        name = name_of(k)
        self._sequence[name] += 1
        power = 1e-2 / (1 + k) if active else 1e-7
        samples = (np.sqrt(power) * self._rng.standard_normal((4, RATE_HZ // 20))).astype(np.float32)
        time_ns = frame_index * FRAME_NS
        return Frame(name, self._sequence[name], frame_index, time_ns, float(RATE_HZ), samples, power, active)

    def _mark(self, name: str, frame_index: int) -> Mark:
        return Mark(name, self._sequence[name], frame_index, 1e-7, 1e-7, (1e-7,) * 4)


def name_of(k: int) -> str:
    return f"a{k:02d}"


@contextmanager
def slow_server(directory: Path) -> Iterator[tuple[str, str, int]]:
    """A server with the slow estimator as a process; yield its URL, its endpoint for nodes, and its process id."""
    (directory / "slow_estimator.py").write_text(SLOW, encoding="utf-8")
    endpoint, port = f"tcp://127.0.0.1:{free_port()}", free_port()
    spread = np.linspace(0.5, 3.5, ARRAYS)
    arrays = {
        name_of(k): {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [float(x), 2.0, 1.5]}
        for k, x in enumerate(spread)
    }
    site = write_site(
        directory,
        {
            "arrays": arrays,
            "nodes": {},
            "fusion": {"method": "slow_estimator:Slow"},
            "server.bind": endpoint,
            "server.http.port": port,
            "server.events_db": "events.sqlite",
        },
    )
    paths = os.pathsep.join([str(directory), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = (sys.executable, "-m", "livessl", "serve", "--site", site)
    url = f"http://127.0.0.1:{port}"
    with started(*command, env={**os.environ, "PYTHONPATH": paths}) as process:
        wait_until(lambda: answers(url), "the server", 3 * HANG_S)
        yield url, endpoint, process.pid


def answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/api/v1/health", timeout=HANG_S).status_code == 200
    except httpx.TransportError:
        return False


def health_of(url: str) -> dict[str, Any]:
    health: dict[str, Any] = httpx.get(f"{url}/api/v1/health", timeout=HANG_S).json()
    return health


def stored(url: str) -> list[dict[str, Any]]:
    events: list[dict[str, Any]] = httpx.get(f"{url}/api/v1/events?limit=500", timeout=HANG_S).json()["events"]
    return events


def lost(url: str) -> list[str]:
    """Names of the arrays that the server calls lost."""
    arrays = httpx.get(f"{url}/api/v1/arrays", timeout=HANG_S).json()["arrays"]
    return [array["name"] for array in arrays if array["state"] == "lost"]


def memory_mb(pid: int) -> float:
    """The greatest memory that a process has had, in megabytes: see proc(5)."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3


@pytest.mark.processes
@pytest.mark.timeout(1200)
def test_an_overloaded_server_says_so_keeps_up_and_stores_every_event(tmp_path: Path) -> None:
    with slow_server(tmp_path) as (url, endpoint, pid):
        nodes = Nodes(endpoint, tmp_path / "spool")
        nodes.begin()
        try:

            def sheds_arrays() -> bool:
                assert not lost(url), "an array is not lost while its sound waits for the server"
                return "arrays" in health_of(url)["load"]["shed"]

            wait_until(sheds_arrays, "an overload that sheds arrays")
            health = health_of(url)
            assert health["status"] == "overloaded"
            assert health["reasons"][0] == health["load"]["message"]
            assert "faster machine" in health["load"]["message"]  # the cure
            metrics = httpx.get(f"{url}/metrics", timeout=HANG_S).text
            assert "livessl_overload_level" in metrics

            def keeps_up() -> bool:
                load = health_of(url)["load"]
                return bool(load["state"] == "overloaded" and load["delay_s"] < 0.5)

            what = "a second of sound within half a second of its arrival, while work is shed"
            wait_until(keeps_up, what, 3 * HANG_S)
            nodes.fall_silent()
            wait_until(lambda: health_of(url)["status"] != "overloaded", "an end of the overload")
            wait_until(lambda: len(stored(url)) >= nodes.sounds, "all events in the store", 3 * HANG_S)
            events = stored(url)
            assert memory_mb(pid) < MOST_MB
        finally:
            nodes.end()
        assert len(events) == nodes.sounds
        assert nodes.dropped == 0
        assert all(len(event["heard_by"]) == ARRAYS for event in events)
        counters = [array["counters"] for array in httpx.get(f"{url}/api/v1/arrays", timeout=HANG_S).json()["arrays"]]
        assert sum(one["shed"] for one in counters) > 0
