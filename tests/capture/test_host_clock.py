"""The state of the machine's clock, from what time services and the kernel say."""

from __future__ import annotations

import shutil
import sys
import threading
from pathlib import Path

import pytest

from livessl.capture.host_clock import (
    Command,
    HostClock,
    from_chrony,
    from_kernel,
    kernel_clock,
    read_host_clock,
    run_command,
)
from livessl.capture.host_watch import HostWatch, load, machine
from small_site import HANG_S, wait_until

FOLLOWS = (
    "C0000201,192.0.2.1,3,1767225600.123,-0.000250,0.000012,0.000031,-9.5,0.001,0.02,0.012000,0.000900,64.2,Normal\n"
)
ALONE = "7F7F0101,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,1.0,1.0,0.0,Not synchronized\n"
TIMESYNC = (
    "FallbackNTPServers=0.debian.pool.ntp.org 1.debian.pool.ntp.org\nServerName=ntp.example\nServerAddress=192.0.2.7\n"
    "NTPMessage={ Leap=0, Version=4, Mode=4, Stratum=2, Jitter=1.018ms }\n"
)
KERNEL = HostClock(True, "kernel", error_s=0.25)


def services(**answers: str) -> Command:
    return lambda command: answers.get(command[0])


def test_chrony_that_follows_a_server_gives_it_and_the_largest_error() -> None:
    clock = read_host_clock(services(chronyc=FOLLOWS, timedatectl=TIMESYNC), lambda: KERNEL)
    assert clock.synchronized
    assert (clock.service, clock.reference) == ("chrony", "192.0.2.1")
    assert clock.error_s == pytest.approx(0.00025 + 0.006 + 0.0009)


def test_chrony_without_a_server_is_not_synchronized() -> None:
    assert from_chrony(ALONE) == HostClock(False, "chrony")
    was = FOLLOWS.replace("Normal", "Not synchronised")  # it keeps the stratum of the server that it has lost
    assert from_chrony(was) == from_chrony(was.replace("ised", "ized")) == HostClock(False, "chrony")


@pytest.mark.parametrize("text", ["", "506 Cannot talk to daemon\n", FOLLOWS.replace("0.012000", "?"), "1,2,3\n"])
def test_chrony_that_does_not_answer_leaves_it_to_the_others(text: str) -> None:
    assert from_chrony(text) is None
    clock = read_host_clock(services(chronyc=text, timedatectl=TIMESYNC), lambda: KERNEL)
    assert clock == HostClock(True, "systemd-timesyncd", "ntp.example", 0.25)


@pytest.mark.parametrize("shown", [None, "", "ServerName=\nPollIntervalUSec=0\n", "no line of it"])
def test_kernel_is_the_base_that_always_exists(shown: str | None) -> None:
    assert read_host_clock(services(**({} if shown is None else {"timedatectl": shown})), lambda: KERNEL) == KERNEL


def test_kernel_says_whether_its_clock_follows_another() -> None:
    assert from_kernel(0, 0x2001, 2500) == HostClock(True, "kernel", error_s=0.0025)
    assert from_kernel(5, 0x2001, 2500) == HostClock(False, "kernel")
    assert from_kernel(0, 0x0041, 16_000_000) == HostClock(False, "kernel")


@pytest.mark.skipif(sys.platform != "linux", reason="adjtimex is a system call of Linux")
def test_this_kernel_answers() -> None:
    clock = kernel_clock()
    assert clock.service == "kernel"
    assert clock.synchronized in (True, False)
    assert clock.synchronized is False or (clock.error_s is not None and 0.0 <= clock.error_s < 20.0)
    assert len(machine()) == 16
    assert machine() == machine()
    assert (load() or 0.0) >= 0.0


def test_program_that_is_absent_fails_or_floods_is_no_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_command(("livessl-no-such-program",)) is None
    for name, body, expected in (
        ("chronyc", "echo '506 Cannot talk to daemon'; exit 1", None),
        ("timedatectl", "printf 'ServerName=\\377x\\n'", "ServerName=\ufffdx\n"),
    ):
        program = tmp_path / name
        program.write_text(f"#!/bin/sh\n{body}\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:{Path(shutil.which('sh') or '/bin/sh').parent}")
        assert run_command((name,)) == expected


def test_watch_reads_the_clock_again_and_again_and_ends_at_once() -> None:
    read: list[HostClock] = []

    def clock() -> HostClock:
        read.append(HostClock(len(read) > 2, "kernel"))
        return read[-1]

    with HostWatch(clock, interval_s=0.001) as watch:
        wait_until(lambda: (state := watch.state(7)) is not None and state.synchronized, "the third reading")
        state = watch.state(7)
        assert state is not None
        assert (state.service, state.lost_blocks, state.machine) == ("kernel", 7, machine())
    count = len(read)
    assert count > 2


def test_watch_that_waits_for_a_program_does_not_hold_its_node() -> None:
    released = threading.Event()

    def hang() -> HostClock:
        released.wait(HANG_S)
        return HostClock()

    with HostWatch(hang) as watch:
        assert watch.state() is None
    assert not released.is_set()
    released.set()
