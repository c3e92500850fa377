"""Commands: what a program gets, and what counts as a failure."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from alert_desk import PATIENT, Desk, alert_site, key_of, running_desk, sound
from livessl.site.models import Site
from small_site import wait_until

RULE = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["run"]}


def command_site(directory: Path, *command: str, **action: Any) -> Site:
    settings = {**PATIENT, **action, "command": list(command)}
    return alert_site(directory, actions={"run": settings}, rules={"door": RULE})


def script(directory: Path, text: str) -> str:
    path = directory / "alarm.sh"
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    return "./alarm.sh"


def states(desk: Desk) -> dict[str, int]:
    return {state: count for (_, state), count in desk.alerts.outbox.counts().items()}


def test_program_gets_the_alert_on_standard_input_and_in_its_environment(tmp_path: Path) -> None:
    text = 'cat > "$1/alert.json"; env > "$1/environment"'
    with running_desk(command_site(tmp_path, script(tmp_path, text), str(tmp_path))) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert json.loads((tmp_path / "alert.json").read_text(encoding="utf-8")) == desk.published[0]
    environment = (tmp_path / "environment").read_text(encoding="utf-8").splitlines()
    assert f"LIVESSL_ALERT_KEY={key_of(sound(1))}" in environment
    assert "LIVESSL_ALERT_RULE=door" in environment
    assert "LIVESSL_ALERT_TITLE=livessl small: door" in environment
    assert f"PWD={tmp_path}" in environment


def test_a_program_may_leave_another_running(tmp_path: Path) -> None:
    with running_desk(command_site(tmp_path, script(tmp_path, "sleep 300 & echo $! > left; exit 0"))) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    os.kill(int((tmp_path / "left").read_text(encoding="utf-8")), signal.SIGKILL)


def test_arguments_are_passed_without_a_shell(tmp_path: Path) -> None:
    text = 'printf "%s" "$1" > argument'
    with running_desk(command_site(tmp_path, script(tmp_path, text), "$(date); a b")) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert (tmp_path / "argument").read_text(encoding="utf-8") == "$(date); a b"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("echo no siren >&2; exit 3", "exited with 3, expected 0: no siren"),
        ("kill -9 $$", "exited with -9, expected 0"),
        ("exec sleep 60", "did not end within 0.3 s"),
    ],
)
def test_program_that_fails_or_hangs_is_a_failed_attempt(tmp_path: Path, text: str, reason: str) -> None:
    program = script(tmp_path, f"echo $$ > pid; {text}")
    with running_desk(command_site(tmp_path, program, attempts=1, timeout_s=0.3 if "sleep" in text else 30)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"dead": 1}, "the failure")
        [(dead, _)] = desk.alerts.outbox.dead(1)
    assert dead.error is not None
    assert dead.error.endswith(reason)
    if "sleep" in text:
        with pytest.raises(ProcessLookupError):
            os.kill(int((tmp_path / "pid").read_text(encoding="utf-8")), 0)


def test_program_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with running_desk(command_site(tmp_path, "no-such-program", attempts=1)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"dead": 1}, "the failure")
        [(dead, _)] = desk.alerts.outbox.dead(1)
    assert dead.error == "cannot run no-such-program: No such file or directory"


def test_server_that_stops_does_not_wait_for_a_program(tmp_path: Path) -> None:
    program = script(tmp_path, "echo $$ > pid; exec sleep 60")
    with running_desk(command_site(tmp_path, program, timeout_s=50)) as desk:
        desk.finish(sound(1))
        pid_file = tmp_path / "pid"
        wait_until(lambda: pid_file.exists() and pid_file.read_text(encoding="utf-8").strip(), "the program")
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text(encoding="utf-8")), 0)
