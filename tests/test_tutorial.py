"""The commands of docs/tutorial.md lead to a verified set-up as they stand, and print what the page says."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from livessl.core.types import Float32Array
from livessl.lab.processes import free_port
from small_site import started, wait_until
from tutorial_page import WITH_ARRAYS, WITHOUT_HARDWARE, Step, is_printed, steps
from virtual_interface import Interfaces

TRIES = 3
"""Runs of the guided claps: a very busy machine asks for a clap too late."""

MISSED_S = 20.0
"""Seconds after the last clap from which a command that still waits has missed one."""

RATE_HZ = 48000


class Terminals:
    """The reader's terminals: runs the commands of the page in one folder, on ports that are free."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.http, self._nodes = free_port(), free_port()
        self.url = f"http://127.0.0.1:{self.http}"
        self._environment = {**os.environ, "PATH": f"{_livessl(folder)}:{os.environ['PATH']}"}
        self.running: dict[str, tuple[subprocess.Popen[str], Path]] = {}
        self.printed: list[str] = []

    def run(self, command: str) -> int:
        """Run a command to its end, and return its exit code."""
        done = subprocess.run(
            ["sh", "-c", self._on_own_ports(command)],
            cwd=self._folder,
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert "Traceback" not in done.stderr
        assert done.returncode in (0, 1), done.stderr
        self.printed.append(done.stdout + done.stderr)
        site = self._folder / "site.yaml"
        if command.startswith("livessl init --yes"):
            text = site.read_text(encoding="utf-8").replace("port: 8000", f"port: {self.http}")
            site.write_text(text.replace("127.0.0.1:5570", f"127.0.0.1:{self._nodes}"), encoding="utf-8")
        return done.returncode

    def begin(self, command: str) -> None:
        """Run a command in a terminal of its own."""
        path = self._folder / f"terminal-{len(self.running)}-{time.monotonic_ns()}.txt"
        words = shlex.split(self._on_own_ports(command))[1:]
        with path.open("w", encoding="utf-8") as output:
            options: dict[str, Any] = {"cwd": self._folder, "env": self._environment}
            process = self._stack.enter_context(
                started(sys.executable, "-m", "livessl", *words, stdout=output, stderr=subprocess.STDOUT, **options)
            )
        self.running[command] = process, path

    def output(self) -> str:
        """Everything printed since the last heading, and by commands that still run."""
        return "\n".join([*self.printed, *(path.read_text(encoding="utf-8") for _, path in self.running.values())])

    def _on_own_ports(self, command: str) -> str:
        command = command.replace(":8000", f":{self.http}")
        return f"{command} --url {self.url}" if command == "livessl events" else command


def _livessl(folder: Path) -> Path:
    """A folder with the command `livessl` of this Python."""
    (folder / "bin").mkdir()
    command = folder / "bin" / "livessl"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m livessl "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    return command.parent


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/api/v1/health").is_success
    except httpx.TransportError:
        return False


def _is_guided(command: str) -> bool:
    return "verify" in command and "--session" not in command


def _ask_for_claps(terminals: Terminals, command: str) -> None:
    terminals.begin(command)
    _, path = terminals.running[command]
    wait_until(lambda: "(1 of 4)" in path.read_text(encoding="utf-8"), "the request for the first clap")


def _clap(terminals: Terminals, command: str, guided: str) -> None:
    """Make the claps that a command asks for; if it misses one, start both again, as the page says."""
    for _ in range(TRIES):
        terminals.run(command)
        process, _ = terminals.running[guided]
        try:
            assert process.wait(timeout=MISSED_S) == 0, terminals.output()
        except subprocess.TimeoutExpired:
            process.kill()
            _ask_for_claps(terminals, guided)
        else:
            return
    pytest.fail(f"claps were missed in {TRIES} runs:\n{terminals.output()}")


def _doctor_is_content(terminals: Terminals, command: str, expected: tuple[str, ...]) -> bool:
    """Ask the doctor again: it examines after the sounds, on a busy machine some seconds later."""
    terminals.printed.clear()
    terminals.run(command)
    said = terminals.printed[-1]
    if expected:
        return all(is_printed(line, said) for line in expected)
    return "swapped" not in said and "inverted" not in said


def _executed(terminals: Terminals, step: Step, then: Step | None) -> None:
    for command in step.lines:
        guided = next((one for one in terminals.running if _is_guided(one)), None)
        if command.startswith("livessl serve"):
            terminals.begin(command)
            wait_until(lambda: _answers(terminals.url), "the server")
        elif command.startswith("livessl events"):
            terminals.begin(command)
        elif command.startswith("livessl doctor"):
            expected = then.lines if then is not None and then.kind == "text" else ()
            wait_until(lambda: _doctor_is_content(terminals, command, expected), f"{command}: {expected}")  # noqa: B023
        elif _is_guided(command):
            _ask_for_claps(terminals, command)
        elif guided is not None:
            _clap(terminals, command, guided)
        else:
            terminals.run(command)


def _of_the_shell(track: str) -> list[Step]:
    """The steps of a track without the installation, which has tests of its own."""
    return [step for step in steps(track) if not step.section.startswith("1. Install")]


@pytest.mark.processes
def test_track_without_hardware_ends_with_a_verified_set_up(tmp_path: Path) -> None:
    script = _of_the_shell(WITHOUT_HARDWARE)
    assert sum(len(step.lines) for step in script if step.kind == "sh") > 15
    with ExitStack() as stack:
        terminals = Terminals(tmp_path, stack)
        section = ""
        for step, then in zip(script, [*script[1:], None], strict=True):
            if step.section != section:
                section = step.section
                terminals.printed.clear()
            if step.kind == "sh":
                _executed(terminals, step, then)
            else:
                said = f"{section}: {step.lines}"
                wait_until(lambda: all(is_printed(one, terminals.output()) for one in step.lines), said)  # noqa: B023
            if section.startswith("7.") and step.kind == "text":
                assert _rise_m(terminals.output()) == pytest.approx(0.4, abs=0.05)
        [(guided, path)] = [of for command, of in terminals.running.items() if _is_guided(command)]
        assert guided.poll() == 0
        errors_m = [float(error) for error in re.findall(r"([\d.]+) m off", path.read_text(encoding="utf-8"))]
    assert len(errors_m) == 4
    assert max(errors_m) < 0.1


def _rise_m(printed: str) -> float:
    found = re.search(r"south: shifted by \(\S+, \S+, ([-+\d.]+)\) m", printed)
    assert found is not None
    return float(found[1])


def _knocks(order: tuple[int, ...]) -> Float32Array:
    """Noise on 18 inputs, and one knock after the other on the inputs of an order."""
    rng = np.random.default_rng(0)
    sound = (10 ** (-75 / 20) * rng.standard_normal((18, 12 * RATE_HZ))).astype(np.float32)
    for number, index in enumerate(order):
        begin, length = round((4.0 + 1.5 * number) * RATE_HZ), round(0.05 * RATE_HZ)
        knock = 0.5 * rng.standard_normal(length) * np.exp(-np.arange(length) / 400.0)
        sound[index, begin : begin + length] += knock.astype(np.float32)
    return sound


def _commands(track: str, word: str) -> Iterator[tuple[list[str], Step]]:
    for step in _of_the_shell(track):
        for line in step.lines:
            if step.kind == "sh" and line.startswith(word):
                yield shlex.split(line)[1:], step


@pytest.mark.sound_card
def test_interface_is_listed_and_taps_are_named_as_the_page_says(tmp_path: Path) -> None:
    (tmp_path / "interfaces").mkdir()
    interfaces = Interfaces(tmp_path / "interfaces")
    interfaces.add(name="UMC1820").play(_knocks((0, 2, 1, 3)))
    options: dict[str, Any] = {"cwd": tmp_path, "env": interfaces.environment}
    python = [sys.executable, "-m", "livessl"]
    [(init, _)] = [one for one in _commands(WITH_ARRAYS, "livessl init") if "--yes" in one[0]]
    subprocess.run([*python, *init], check=True, timeout=100, **options)
    [(devices, _)] = _commands(WITH_ARRAYS, "livessl devices")
    done = subprocess.run([*python, *devices], check=True, timeout=100, capture_output=True, text=True, **options)
    assert init[init.index("--interface") + 1] in done.stdout
    [(levels, step)] = _commands(WITH_ARRAYS, "livessl levels")
    [said] = [one for one in _of_the_shell(WITH_ARRAYS) if one.section == step.section and one.kind == "text"]
    output = tmp_path / "taps.txt"
    with output.open("w", encoding="utf-8") as file, started(*python, *levels, stdout=file, **options):
        wait_until(lambda: all(is_printed(one, output.read_text(encoding="utf-8")) for one in said.lines), "the taps")
