"""Helpers of tests that run commands of `livessl` in this process."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from small_site import RATE_HZ

COMMANDS = (
    "demo", "serve", "hub", "events", "capture", "locate", "relocate", "replay", "record", "simulate", "evaluate",
    "bench", "plan", "doctor", "calibrate", "support-bundle", "keys", "init", "check", "config", "devices", "levels",
)  # fmt: skip


@dataclass
class Done:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def objects(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines()]


Run = Callable[..., Done]


def simulate_arguments(site: Path, out: Path, seed: int = 5) -> list[str]:
    options = f"--rt60 0 --count 2 --rate {RATE_HZ} --seed {seed}".split()
    return ["simulate", "--site", str(site), "--out", str(out), *options]


@dataclass
class Recorded:
    """A simulated session and its site file."""

    directory: Path
    site: Path

    def wavs(self, **others: Path) -> list[str]:
        names = {name: self.directory / f"{name}.wav" for name in ("north", "south")} | others
        return [part for name, path in names.items() for part in ("--wav", f"{name}={path}")]


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"
