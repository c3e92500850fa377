"""Real NATS servers on free ports: one, or a cluster of three, each of which can be killed and started again."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from conftest import require
from livessl.lab.processes import free_port
from small_site import HANG_S, wait_until

NATS_SERVER: Final = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")


class NatsServer:
    """One server.

    Parameters
    ----------
    folder : Path
        Its folder; what JetStream keeps is there, and outlives the process.
    name : str
    further : str
        Lines for its configuration.
    whole : str or None
        Its configuration instead, without the port of its clients and of its monitor.
    """

    def __init__(self, folder: Path, name: str = "n1", further: str = "", whole: str | None = None) -> None:
        self.name, self.port, self.monitor = name, free_port(), free_port()
        self._configuration = folder / f"{name}.conf"
        self._configuration.parent.mkdir(parents=True, exist_ok=True)
        addresses = (f"listen: 127.0.0.1:{self.port}", f"http: 127.0.0.1:{self.monitor}")
        own = (
            f"server_name: {name}",
            f'jetstream {{store_dir: "{folder / name}", max_file_store: 10GB, max_memory_store: 100MB}}',
            further,
        )
        lines = (*addresses, *(own if whole is None else (whole,)))
        self._configuration.write_text("\n".join(lines), encoding="utf-8")
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"nats://127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        """Process id."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start the process; `is_healthy` says when it serves."""
        assert NATS_SERVER is not None
        command = [NATS_SERVER, "-c", str(self._configuration)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def is_healthy(self) -> bool:
        """Whether it serves, JetStream included."""
        assert self._process is not None
        assert self._process.poll() is None, "nats-server has ended"
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.monitor}/healthz", timeout=2.0) as answer:
                return bool(json.load(answer)["status"] == "ok")
        except OSError:
            return False

    def kill(self) -> None:
        """Kill the process; what it has stored stays."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait(timeout=HANG_S)
            self._process = None


@contextmanager
def running_nats(folder: Path, further: str = "") -> Iterator[NatsServer]:
    """Run one server."""
    with running_servers([make_server(folder, "n1", further)]) as [server]:
        yield server


@contextmanager
def running_cluster(folder: Path, size: int = 3) -> Iterator[list[NatsServer]]:
    """Run a cluster, whose clients learn of no other server than those that they are told."""
    ports = [free_port() for _ in range(size)]
    routes = ", ".join(f"nats://127.0.0.1:{port}" for port in ports)
    servers = [
        make_server(
            folder,
            f"n{number}",
            f"cluster {{name: hub, listen: 127.0.0.1:{port}, no_advertise: true, routes: [{routes}]}}",
        )
        for number, port in enumerate(ports, 1)
    ]
    with running_servers(servers):
        yield servers


def make_server(folder: Path, name: str, further: str = "") -> NatsServer:
    """Return a server that is not started yet; skip the test where there is none."""
    require(NATS_SERVER is not None, "NATS is not installed (Debian: apt install nats-server)")
    return NatsServer(folder, name, further)


@contextmanager
def running_servers(servers: list[NatsServer]) -> Iterator[list[NatsServer]]:
    """Run servers until the context ends."""
    try:
        for server in servers:
            server.start()
        for server in servers:
            wait_until(server.is_healthy, f"NATS server {server.name}")
        yield servers
    finally:
        for server in servers:
            server.kill()
