"""The cost of many WebSocket clients, some of them stalled: the server's memory and the delay of healthy clients.

The server is the real one, in a process of its own; updates enter where its engine would publish them. Clients are bare
sockets in this process, so that reading costs little. The output is a table, or one object with `--json`. The exit
status is 1 if the delay of healthy clients or the server's memory exceeds its limit.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import socket
import statistics
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from livessl.clock import SystemClock, utc_text
from livessl.server.api.encode import JsonObject
from livessl.server.app import Server
from livessl.site.load import parse_site

SITE: Final = """
site: many-clients
room: {size_m: [8.0, 10.0, 4.0]}
grid: {spacing_m: 0.5}
arrays:
  north: {geometry: {tetrahedron: {edge_m: 0.5}}, position_m: [4.0, 2.5, 2.0]}
  south: {geometry: {tetrahedron: {edge_m: 0.5}}, position_m: [4.0, 7.5, 2.0]}
server: {bind: "tcp://127.0.0.1:*", http: {port: 0}}
"""
STALLED_WINDOW_BYTES: Final = 4096
"""Receive buffer of a stalled client, in bytes: small, so that unread messages soon pile up at the server."""

WARM_UP_S: Final = 2.0

MAX_DELAY_P95_MS: Final = 100.0
"""Largest 95th percentile of the delay, in milliseconds, of healthy clients."""

MAX_CLIENT_KB: Final = 200.0
"""Largest memory of the server per client, stalled or not, in kilobytes: 64 kB in its output buffer, a socket, and a
queue of messages that all clients share."""


STAMP: Final = b'"published_ns":'
"""The last field of an update."""


@dataclass
class Log:
    """Delays of the messages that the listeners received while the log was open."""

    open: bool = False
    delays_ms: list[float] = field(default_factory=list)
    message_bytes: int = 0


@dataclass(frozen=True)
class Outcome:
    """The measurement."""

    clients: int
    stalled: int
    updates_per_s: float
    seconds: float
    message_bytes: int
    delay_p50_ms: float
    delay_p95_ms: float
    delay_p99_ms: float
    delay_max_ms: float
    received: int
    expected: int
    rss_before_mb: float
    rss_connected_mb: float
    rss_peak_mb: float
    cpu_share: float
    stalled_cut: int


def measure(clients: int, stalled: int, updates_per_s: float, seconds: float) -> Outcome:
    """Connect the clients, publish updates, and measure their delays and the server's resources."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_serve, args=(theirs, updates_per_s), daemon=True)
    process.start()
    try:
        url = ours.recv()
        return asyncio.run(_watch(ours, int(process.pid or 0), url, clients, stalled, updates_per_s, seconds))
    finally:
        ours.send("end")
        process.join(timeout=10)
        process.close()
        ours.close()
        theirs.close()


def _serve(control: Connection, updates_per_s: float) -> None:
    clock = SystemClock()
    server = Server(parse_site(SITE), clock)
    publishing = threading.Event()
    ended = threading.Event()

    def publish() -> None:
        publishing.wait()
        begun_ns, number = time.monotonic_ns(), 0
        while not ended.is_set():
            number += 1
            # the entry point of the engine's results
            server.publish(_update(number, clock))
            due_ns = begun_ns + round(number / updates_per_s * 1e9)
            ended.wait(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))

    def control_server() -> None:
        while not server.parts.engine.has_turned:  # what computes is loaded after the server listens
            time.sleep(0.05)
        control.send(server.url)
        while control.recv() != "end":
            publishing.set()
        ended.set()
        publishing.set()
        server.stop()

    for work in (publish, control_server):
        threading.Thread(target=work, daemon=True).start()
    server.run()


def _update(number: int, clock: SystemClock) -> JsonObject:
    """Return an update like that of a sound at two arrays, with the time of its publication."""
    contribution = {"active_s": 0.2, "level_dbfs": -31.2, "azimuth_deg": 12.3, "elevation_deg": -4.5, "distance_m": 3.2}
    return {
        "kind": "update",
        "event_id": f"many-clients-{number}",
        "time_utc": utc_text(clock.now_ns()),
        "start_s": number / 20,
        "position_m": [3.1234, 4.5678, 1.2345],
        "covariance_m2": [[0.01, 0.001, 0.0], [0.001, 0.02, 0.0], [0.0, 0.0, 0.05]],
        "confidence": 0.61,
        "arrays": ["north", "south"],
        "status": "located",
        "contributions": [{"array": name, **contribution} for name in ("north", "south")],
        "zones": [],
        "level_dbfs": -29.8,
        "published_ns": time.monotonic_ns(),
    }


async def _watch(
    control: Connection, pid: int, url: str, clients: int, stalled: int, updates_per_s: float, seconds: float
) -> Outcome:
    host, port = url.removeprefix("http://").split(":")
    rss_before = _rss_mb(pid)
    log, loop = Log(), asyncio.get_running_loop()
    lazy = [open_client(host, int(port), STALLED_WINDOW_BYTES) for _ in range(stalled)]
    keen = [open_client(host, int(port), None) for _ in range(clients - stalled)]
    listeners = [(await loop.create_connection(lambda: Listener(log), sock=each))[1] for each in keen]
    rss_connected = _rss_mb(pid)
    control.send("publish")
    await asyncio.sleep(WARM_UP_S)
    log.open = True
    cpu_s, begun = _cpu_s(pid), time.monotonic()
    peak = rss_connected
    while (left_s := begun + seconds - time.monotonic()) > 0:
        await asyncio.sleep(min(0.5, left_s))
        peak = max(peak, _rss_mb(pid))
    log.open = False
    share = (_cpu_s(pid) - cpu_s) / (time.monotonic() - begun)
    cut = sum(_is_cut(each) for each in lazy)
    for listener in listeners:
        listener.close()
    for lazy_one in lazy:
        lazy_one.close()
    percentiles = statistics.quantiles(log.delays_ms, n=100)
    return Outcome(
        clients,
        stalled,
        updates_per_s,
        seconds,
        log.message_bytes,
        delay_p50_ms=round(percentiles[49], 1),
        delay_p95_ms=round(percentiles[94], 1),
        delay_p99_ms=round(percentiles[98], 1),
        delay_max_ms=round(max(log.delays_ms), 1),
        received=len(log.delays_ms),
        expected=round((clients - stalled) * updates_per_s * seconds),
        rss_before_mb=rss_before,
        rss_connected_mb=rss_connected,
        rss_peak_mb=peak,
        cpu_share=round(share, 2),
        stalled_cut=cut,
    )


def open_client(host: str, port: int, window_bytes: int | None, kinds: str = "update") -> socket.socket:
    """Open a WebSocket for messages of some kinds by hand."""
    connection = socket.socket()
    if window_bytes is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window_bytes)
    connection.settimeout(10)
    connection.connect((host, port))
    lines = [
        f"GET /api/v1/live?kinds={kinds} HTTP/1.1",
        f"Host: {host}:{port}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    ]
    connection.sendall("\r\n".join([*lines, "", ""]).encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += connection.recv(1)
    if b" 101 " not in answer:
        raise OSError(f"expected a WebSocket, got {answer!r}")
    connection.setblocking(False)
    return connection


class Listener(asyncio.Protocol):
    """Splits WebSocket frames as they arrive, and records the delay of each update."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._rest = b""
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport for pongs."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Process the bytes of any number of frames."""
        now_ns = time.monotonic_ns()
        data, at = self._rest + data, 0
        while len(data) >= at + 4:
            length, body = data[at + 1] & 127, at + 2
            if length == 126:
                length, body = int.from_bytes(data[at + 2 : at + 4], "big"), at + 4
            if len(data) < body + length:
                break
            if data[at] & 15 == 9 and self._transport is not None:  # answer a ping by a pong, masked with zeros
                self._transport.write(bytes([0x8A, 0x80 | length, 0, 0, 0, 0]) + data[body : body + length])
            self.note(data, body, length, now_ns)
            at = body + length
        self._rest = data[at:]

    def note(self, data: bytes, body: int, length: int, now_ns: int) -> None:
        """Record the delay of a frame's body."""
        stamp = data.rfind(STAMP, body, body + length)
        if stamp >= 0 and self._log.open:
            sent_ns = int(data[stamp + len(STAMP) : body + length].rstrip(b"}"))
            self._log.delays_ms.append((now_ns - sent_ns) / 1e6)
            self._log.message_bytes = length

    def close(self) -> None:
        """Close the connection."""
        if self._transport is not None:
            self._transport.abort()


def _is_cut(connection: socket.socket) -> bool:
    """Return whether the server has closed the connection; messages from before are read and discarded."""
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    return True


def _rss_mb(pid: int) -> float:
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return round(int(fields["VmRSS"].split()[0]) / 1024, 1)


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=500, help="number of clients (default: 500)")
    parser.add_argument("--stalled", type=int, default=50, help="number of clients that never read (default: 50)")
    parser.add_argument("--rate", type=float, default=20.0, metavar="HZ", help="updates per second (default: 20)")
    parser.add_argument("--seconds", type=float, default=60.0, help="measured time, after a warm-up (default: 60)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    found: dict[str, Any] = asdict(measure(options.clients, options.stalled, options.rate, options.seconds))
    if options.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:<18} {value}")
    grown_kb = 1000 * (found["rss_peak_mb"] - found["rss_before_mb"]) / options.clients
    return 1 if found["delay_p95_ms"] > MAX_DELAY_P95_MS or grown_kb > MAX_CLIENT_KB else 0


if __name__ == "__main__":
    sys.exit(main())
