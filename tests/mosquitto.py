"""A real MQTT broker on a free port."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from conftest import require
from livessl.lab.processes import free_port
from small_site import started, wait_until

MOSQUITTO: Final = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


@contextmanager
def running_mosquitto(folder: Path, port: int | None = None, further: str = "allow_anonymous true") -> Iterator[int]:
    """Run Mosquitto, which keeps nothing on the disk; yields its port."""
    require(MOSQUITTO is not None, "Mosquitto is not installed (Debian: apt install mosquitto)")
    assert MOSQUITTO is not None
    port = free_port() if port is None else port
    configuration = folder / "mosquitto.conf"
    user = "user root" if os.getuid() == 0 else ""  # otherwise root's broker cannot read a test's files
    lines = (f"listener {port} 127.0.0.1", "persistence false", "log_dest none", user, further, "")
    configuration.write_text("\n".join(lines), encoding="utf-8")
    with started(MOSQUITTO, "-c", configuration) as process:

        def answers() -> bool:
            assert process.poll() is None, "Mosquitto has ended"
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", port)) == 0

        wait_until(answers, "Mosquitto")
        yield port
