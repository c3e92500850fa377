"""Play a session to the server of a tree, and collect the names of all that its HTTP API offers."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from unchanged_trees import Keys, ProbeError, Tree, keys_of, load_json

READY_S: Final = 900.0
"""Longest wait for a server or its messages, in seconds. Its first start compiles, which takes a minute of processor
time, and many times longer at a low priority beside other work. Only a hang reaches this."""

QUIET_S: Final = 2.0
"""The server has taken in a session when its list of events has not grown for so long, in seconds."""

REQUEST_S: Final = 100.0
"""Longest wait for one answer of a server, and for its end, in seconds; only a hang reaches this."""

KINDS: Final = {"hello", "update", "event", "track", "arrays"}
"""Kinds of live messages that a session brings about."""

SITE: Final = """\
site: unchanged
room: {{size_m: [8, 10, 4]}}
grid: {{spacing_m: 0.2}}
arrays:
  north: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4, 2.5, 2]}}
  south: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4, 7.5, 2], orientation_deg: {{yaw: 180}}}}
nodes:
  pc:
    server: tcp://127.0.0.1:{frames}
    device: {{name: any, sample_rate_hz: 44100}}
    arrays: {{north: [1, 2, 3, 4], south: [5, 6, 7, 8]}}
zones: {{all: {{bounds_m: [[0, 8], [0, 10], [0, 4]]}}}}
server: {{bind: "tcp://127.0.0.1:{frames}", http: {{host: 127.0.0.1, port: {http}}}}}
"""
"""The demo's arrays, so that its recordings can be played to it; events are kept in memory."""


def served(tree: Tree, session: Path, folder: Path) -> tuple[set[str], Keys]:
    """Play a session to a server; return the names of what it offers, and the fields of its answers and messages."""
    frames, http = _free_port(), _free_port()
    site = folder / f"{tree.name}-served.yaml"
    site.write_text(SITE.format(frames=frames, http=http), encoding="utf-8")
    base = f"http://127.0.0.1:{http}"
    with _serving(tree, site, base, folder), connect(f"ws://127.0.0.1:{http}/api/v1/live") as live:
        played = ("replay", session, "--site", site, "--server", f"tcp://127.0.0.1:{frames}", "--speed", "max")
        tree.must(tree.livessl(*played, folder=folder), "replay")
        keys: Keys = {}
        seen: set[str] = set()
        deadline_s = time.monotonic() + READY_S
        while not seen >= KINDS and time.monotonic() < deadline_s:
            message = load_json(str(live.recv(timeout=READY_S)).encode(), f"{tree.name}: live")
            seen.add(message["kind"])
            keys_of(message, f"live {message['kind']}", keys)
        if not seen >= KINDS:
            raise ProbeError(f"{tree.name}: live: expected messages of kinds {sorted(KINDS)}, got {sorted(seen)}")
        _wait_for_events(tree, f"{base}/api/v1/events")
        for name in ("site", "arrays", "events", "tracks", "health", "access"):
            keys_of(load_json(_fetched(f"{base}/api/v1/{name}"), f"{tree.name}: {name}"), name, keys)
        described = load_json(_fetched(f"{base}/api/v1/openapi.json"), f"{tree.name}: OpenAPI")
        metrics = re.findall(r"^# TYPE (\S+ \S+)$", _fetched(f"{base}/metrics").decode(), re.MULTILINE)
    return {*_operations(described), *(f"metric {name}" for name in metrics)}, keys


def _operations(described: dict[str, Any]) -> Iterator[str]:
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            yield f"{method.upper()} {path}"
            yield from (f"{method.upper()} {path}, {p['in']} {p['name']}" for p in operation.get("parameters", ()))


@contextmanager
def _serving(tree: Tree, site: Path, url: str, folder: Path) -> Iterator[None]:
    said = folder / f"{tree.name}-serve.txt"
    process = tree.start("-m", "livessl", "serve", "--site", site, folder=folder, said=said)
    try:
        deadline_s = time.monotonic() + READY_S
        while not _answers(f"{url}/api/v1/health"):
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise ProbeError(f"{tree.name}: serve: does not answer: {said.read_text(errors='replace').strip()}")
            time.sleep(0.1)
        yield
    except (WebSocketException, TimeoutError, OSError) as error:
        raise ProbeError(f"{tree.name}: serve: {error!r}") from error
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=REQUEST_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _wait_for_events(tree: Tree, url: str) -> None:
    """Return when the list of events is there and grows no more."""
    deadline_s, before = time.monotonic() + READY_S, 0
    while time.monotonic() < deadline_s:
        count = len(load_json(_fetched(url), f"{tree.name}: events")["events"])
        if count and count == before:
            return
        before = count
        time.sleep(QUIET_S)
    raise ProbeError(f"{tree.name}: serve: expected events of the session, got {before} within {READY_S:g} s")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _fetched(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=REQUEST_S) as answer:  # noqa: S310 - our own address
        return bytes(answer.read())


def _answers(url: str) -> bool:
    try:
        _fetched(url)
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
    return True
