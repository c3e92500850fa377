"""Reports to a service manager: what is sent when, and a real systemd that acts on them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event as Flag

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hub_desk import make_hub, running_hub
from livessl.clock import SystemClock, UnpacedClock
from livessl.lab.processes import free_port
from livessl.server.app import Server
from livessl.server.engine import Engine
from livessl.server.sign_of_life import SignOfLife
from livessl.service_manager import MAX_STATUS, SIGNS, STATUS_NS, ServiceManager
from notify_socket import NotifySocket, listening
from small_site import HANG_S, running_server, site_of, wait_until


class SteppedClock(UnpacedClock):
    """A clock that goes only when it is told to."""

    passed_ns = 0

    def monotonic_ns(self) -> int:
        return self.passed_ns


@given(
    silence_ms=st.integers(100, 60_000),
    steps=st.lists(st.tuples(st.integers(0, 300), st.sampled_from(["", "ok", "a\nb", "x" * 900])), min_size=1),
)
def test_loop_that_turns_is_never_silent_for_long_and_says_nothing_twice(
    silence_ms: int, steps: list[tuple[int, str]]
) -> None:
    """Steps are of at most 0.3 of the longest silence, as those of a loop that is far from hanging."""
    with TemporaryDirectory() as folder, listening(Path(folder)) as manager:
        clock, silence_ns = SteppedClock(), silence_ms * 1_000_000
        service = ServiceManager(clock, manager.address, silence_ns)
        signs_ns: list[int] = []
        looks_ns: list[int] = []
        shown = ""
        for permille, status in steps:
            clock.passed_ns += silence_ns * permille // 1000

            def describe(status: str = status) -> str:
                looks_ns.append(clock.passed_ns)
                return status

            before = len(manager.said)
            service.turn(describe)
            new = manager.said[before:]
            signs_ns += [clock.passed_ns] * new.count("WATCHDOG=1")
            for line in new:
                if line.startswith("STATUS="):
                    assert line != f"STATUS={shown}"
                    shown = line.removeprefix("STATUS=")
                    assert shown == status.replace("\n", " ")[:MAX_STATUS]
        assert manager.said[0] == "READY=1"
        assert manager.count("READY=1") == 1
        assert signs_ns[0] == silence_ns * steps[0][0] // 1000, "the first turn is a sign of life"
        gaps_ns = [later - sooner for sooner, later in pairwise(signs_ns)]
        assert all(silence_ns // SIGNS <= gap <= silence_ns * 0.56 for gap in gaps_ns)  # 1/4, and a step of 0.3
        assert all(later - sooner >= STATUS_NS for sooner, later in pairwise(looks_ns))


def test_without_a_limit_no_signs_of_life_are_sent(tmp_path: Path) -> None:
    with listening(tmp_path) as manager:
        service = ServiceManager(SystemClock(), manager.address)
        for _ in range(3):
            service.turn(lambda: "ok")
        assert manager.said == ["READY=1", "STATUS=ok"]
        assert not service.watches


def test_environment_names_the_manager_and_keeps_nothing_for_programs_that_are_started() -> None:
    manager = NotifySocket(f"@livessl-{os.getpid()}")
    try:
        environment = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "4000000", "PATH": "/bin"}
        service = ServiceManager.of_environment(SteppedClock(), environment)
        assert environment == {"PATH": "/bin"}
        assert service.watches
        service.turn(lambda: "")
        assert manager.said == ["READY=1", "WATCHDOG=1"]
    finally:
        manager.close()


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "4000000"},
        {"NOTIFY_SOCKET": "", "WATCHDOG_USEC": "4000000"},
        {"NOTIFY_SOCKET": "/none", "WATCHDOG_USEC": "4000000", "WATCHDOG_PID": str(os.getpid() + 1)},
        {"NOTIFY_SOCKET": "/none", "WATCHDOG_USEC": "soon"},
        {"NOTIFY_SOCKET": "/none", "WATCHDOG_USEC": "0"},
    ],
)
def test_process_that_nobody_watches_knows_it(environment: dict[str, str]) -> None:
    assert not ServiceManager.of_environment(SystemClock(), environment).watches


def test_report_that_cannot_be_sent_is_logged_once_and_sent_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    clock = SteppedClock()
    service = ServiceManager(clock, str(tmp_path / "notify"), 4_000_000_000)
    for _ in range(3):
        service.turn(lambda: "ok")
        clock.passed_ns += STATUS_NS
    assert len(caplog.messages) == 1
    assert f"NOTIFY_SOCKET: cannot report to the service manager at {tmp_path}/notify" in caplog.text
    with listening(tmp_path) as manager:
        service.turn(lambda: "ok")
        assert manager.said == ["READY=1", "WATCHDOG=1", "STATUS=ok"]


def test_manager_that_reads_nothing_holds_nobody_up(tmp_path: Path) -> None:
    """Its socket is full soon; the reports come when it reads again."""
    with listening(tmp_path) as manager:
        clock = SteppedClock()
        service = ServiceManager(clock, manager.address, 4_000_000_000)
        for _ in range(2000):
            clock.passed_ns += 1_000_000_000
            service.turn(lambda: "ok")
        assert 0 < manager.count("WATCHDOG=1") < 2000
        clock.passed_ns += 1_000_000_000
        before = manager.count("WATCHDOG=1")
        service.turn(lambda: "ok")
        assert manager.count("WATCHDOG=1") == before + 1


def test_reload_is_reported_only_once_the_process_is_ready_and_nothing_after_its_end(tmp_path: Path) -> None:
    with listening(tmp_path) as manager:
        clock = SteppedClock()
        service = ServiceManager(clock, manager.address)
        with service.reloading():
            pass
        assert manager.said == []
        service.turn(lambda: "ok")
        clock.passed_ns = 7_123_456
        with service.reloading():
            assert manager.said[2:] == ["RELOADING=1", "MONOTONIC_USEC=7123"]
        assert manager.said[4:] == ["READY=1"]
        service.stopping()
        service.stopping()
        service.turn(lambda: "late")
        with service.reloading():
            pass
        assert manager.said[5:] == ["STOPPING=1", "STATUS=stopping"]


def test_process_that_is_watched_shows_where_it_hangs(tmp_path: Path) -> None:
    """By the same call as the commands: a process that is killed by SIGABRT prints the stacks of its threads."""
    hangs = "from livessl.cli.service import service_manager as s; import time; s(); print(flush=True)\ntime.sleep(100)"
    with listening(tmp_path) as manager:
        process = subprocess.Popen(
            [sys.executable, "-c", hangs],
            env=manager.environment(30),
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGABRT)
        _, said = process.communicate(timeout=HANG_S)
    assert process.returncode == -signal.SIGABRT
    assert "Fatal Python error: Aborted" in said
    assert 'File "<string>", line ' in said


class Fusion:
    """Makes the fusion thread of servers hang, and counts how often their event loops look at it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        turn, give = Engine.turn, SignOfLife.give
        self.hangs, self.looks = Flag(), 0
        self._goes_on = Flag()
        self._goes_on.set()

        def turn_or_hang(engine: Engine) -> None:
            if not self._goes_on.is_set():
                self.hangs.set()
                self._goes_on.wait(HANG_S)
            turn(engine)

        def counted(sign: SignOfLife) -> None:
            give(sign)
            self.looks += 1

        monkeypatch.setattr(Engine, "turn", turn_or_hang)
        monkeypatch.setattr(SignOfLife, "give", counted)

    def hang(self) -> None:
        """Return when the thread hangs, and the loop has seen all of its turns."""
        self._goes_on.clear()
        assert self.hangs.wait(HANG_S)
        self.wait_for_looks()

    def go_on(self) -> None:
        self._goes_on.set()

    def wait_for_looks(self) -> None:
        """Return after some more looks of the event loop."""
        before = self.looks
        wait_until(lambda: self.looks > before + 3, "looks at the fusion")


def test_hung_fusion_gives_no_sign_of_life_although_http_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fusion = Fusion(monkeypatch)
    with listening(tmp_path, reads=True) as manager:
        service = ServiceManager(SystemClock(), manager.address, 4_000)  # every look at a turn is a sign of life
        with running_server(site_of(), service=service) as server:
            wait_until(lambda: manager.count("WATCHDOG=1") > 1, "signs of life")
            assert manager.said[0] == "READY=1"
            wait_until(
                lambda: any(line.startswith("STATUS=starting: north: ") for line in manager.said), "the condition"
            )
            fusion.hang()
            before = manager.count("WATCHDOG=1")
            fusion.wait_for_looks()
            assert httpx.get(f"{server.url}/api/v1/health", timeout=HANG_S).status_code == 200
            assert manager.count("WATCHDOG=1") == before
            fusion.go_on()
            wait_until(lambda: manager.count("WATCHDOG=1") > before, "a sign of life again")
        assert manager.said[-2:] == ["STOPPING=1", "STATUS=stopping"]


def test_database_that_is_slow_holds_up_neither_signs_of_life_nor_http(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The condition is asked from the outbox of the alerts, among others, which a disk may hold for seconds."""
    asked, held = Flag(), Flag()

    def slow(*_: object) -> str:
        asked.set()
        held.wait(HANG_S)
        raise OSError("the disk is gone")

    monkeypatch.setattr("livessl.server.sign_of_life.condition", slow)
    with listening(tmp_path, reads=True) as manager:
        service = ServiceManager(SystemClock(), manager.address, 4_000)
        with running_server(site_of(), service=service) as server:
            assert asked.wait(HANG_S)
            before = manager.count("WATCHDOG=1")
            wait_until(lambda: manager.count("WATCHDOG=1") > before + 3, "signs of life")
            assert httpx.get(f"{server.url}/api/v1/events", timeout=HANG_S).status_code == 200
            held.set()
            before = manager.count("WATCHDOG=1")
            wait_until(lambda: manager.count("WATCHDOG=1") > before + 3, "signs of life after an error")


def test_state_that_cannot_be_told_is_logged_and_the_sign_of_life_is_sent(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with listening(tmp_path) as manager:
        service = ServiceManager(SteppedClock(), manager.address, 4_000_000_000)

        def fails() -> str:
            raise ValueError("no words")

        service.turn(fails)
        assert manager.said == ["READY=1", "WATCHDOG=1"]
        assert "no words" in caplog.text


def test_server_ends_with_the_error_of_a_task_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(sign: SignOfLife) -> None:
        raise ValueError("nobody would know")

    monkeypatch.setattr(SignOfLife, "give", fails)
    server = Server(site_of(), SystemClock())
    with pytest.raises(ValueError, match="nobody would know"):
        server.run()


def test_hub_is_ready_when_it_serves_and_says_what_it_waits_for(tmp_path: Path) -> None:
    hub = make_hub("hub.sqlite", [f"nats://127.0.0.1:{free_port()}"], tmp_path)
    with listening(tmp_path, reads=True) as manager:
        service = ServiceManager(SystemClock(), manager.address, 4_000)
        with running_hub(hub, service) as server:
            wait_until(lambda: manager.count("WATCHDOG=1") > 1, "signs of life")
            assert manager.said[0] == "READY=1"
            assert httpx.get(f"{server.url}/api/v1/health", timeout=HANG_S).status_code == 200
            wait_until(lambda: any(line.startswith("STATUS=nats: ") for line in manager.said), "the problem")
        assert manager.said[-2:] == ["STOPPING=1", "STATUS=stopping"]
