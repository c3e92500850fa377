"""The demo: plays a simulated scene through server and nodes, and pairs each event with its true source."""

from __future__ import annotations

import json
import math
import socket
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from livessl.clock import Clock, utc_ns, utc_text
from livessl.core.types import FRAME_NS
from livessl.errors import RunError
from livessl.lab import processes
from livessl.server.api.encode import JsonObject
from livessl.simulation.export import TRUTH_FILE, write_scene
from livessl.simulation.of_site import scene_of
from livessl.simulation.scene import Scene
from livessl.site.load import load_site, parse_site
from livessl.site.models import Site

SITE_FILE: Final = Path(__file__).with_name("demo.yaml")

LEAD_NS: Final = 5_000_000_000
"""Time, in nanoseconds, from the command to the scene's first sample, in which the nodes start."""

MATCH_S: Final = 1.0
"""Longest time, in seconds, between the starts of a source and of its event."""

LAST_NS: Final = 10_000_000_000
"""Time, in nanoseconds, that a busy server gets for its final results after the nodes have ended."""

RATE_HZ: Final = 44100.0
SEED: Final = 1


class DemoError(RunError):
    """The demo could not run."""


@dataclass(frozen=True)
class Outcome:
    """One source of the scene and its event, if there is one."""

    name: str
    start_s: float
    true_position_m: tuple[float, float, float]
    event: JsonObject | None

    @property
    def located(self) -> bool:
        """True if the event has a position."""
        return self.event is not None and self.event["status"] == "located"

    @property
    def error_m(self) -> float | None:
        """Distance from the true position, in metres; None without a position."""
        return (
            None
            if self.event is None or self.event["position_m"] is None
            else math.dist(self.event["position_m"], self.true_position_m)
        )


@dataclass
class Running:
    """The demo's processes.

    Parameters
    ----------
    url : str
        The dashboard's address.
    start_ns : int
        Site time at which the scene begins, in nanoseconds.
    nodes : sequence of Popen
        The capture nodes.
    clock : Clock
    end_ns : int or None
        Site time at which the nodes are to end, nanoseconds; None if they end by themselves, or never.
    """

    url: str
    start_ns: int
    nodes: Sequence[subprocess.Popen[bytes]]
    clock: Clock
    end_ns: int | None = None
    _ended_ns: int | None = field(default=None, init=False)

    def silent_ns(self) -> int:
        """Return how long ago all nodes had ended, in nanoseconds; 0 while one plays."""
        if self.end_ns is not None and self.clock.now_ns() > self.end_ns and self._ended_ns is None:
            processes.end(self.nodes)
        if any(node.poll() is None for node in self.nodes):
            return 0
        if self._ended_ns is None:
            self._ended_ns = self.clock.monotonic_ns()
        return self.clock.monotonic_ns() - self._ended_ns


def prepare(
    directory: Path, http_port: int, events: int, progress: Callable[[int, int], None], rate_hz: float = RATE_HZ
) -> tuple[Site, Scene]:
    """Simulate the demo's scene into a folder, with a site file on free ports."""
    _need_free("127.0.0.1", http_port)
    data = yaml.safe_load(SITE_FILE.read_text(encoding="utf-8"))
    endpoint = f"tcp://127.0.0.1:{processes.free_port()}"
    data["server"] = {"bind": endpoint, "http": {"host": "127.0.0.1", "port": http_port}}
    for node in data["nodes"].values():
        node["server"] = endpoint
        (array,) = node["arrays"]
        node["device"] = {"type": "wav", "files": {array: f"{array}.wav"}}
    site = parse_site(yaml.safe_dump(data), str(SITE_FILE))
    rt60_s = load_site(SITE_FILE).nodes["north-pc"].device.rt60_s  # type: ignore[union-attr]
    scene = scene_of(site, rt60_s=rt60_s, count=events, sample_rate_hz=rate_hz, seed=SEED)
    write_scene(directory, site, scene, seed=SEED, progress=progress)
    (directory / "site.yaml").write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return site, scene


@contextmanager
def running(directory: Path, site: Site, *, loop: bool, clock: Clock) -> Iterator[Running]:
    """Run server and nodes as processes while the context lasts.

    The scene starts when the server is ready, which takes some seconds at the first start on a machine.

    Raises
    ------
    NotStartedError
        If one of the processes does not start.
    """
    http = site.server.http
    url = f"http://{http.host}:{http.port}"
    common = ["--site", str(directory / "site.yaml")]
    server = processes.start("serve", *common)
    nodes: list[subprocess.Popen[bytes]] = []
    try:
        processes.wait_until_ready(url, [server], clock)
        start_ns = (clock.now_ns() + LEAD_NS) // FRAME_NS * FRAME_NS
        for node in site.nodes:
            extra = ["--loop"] if loop else []
            at = utc_text(start_ns)
            nodes.append(processes.start("capture", *common, "--node", node, "--start-at", at, *extra))
        yield Running(url, start_ns, nodes, clock)
    finally:
        processes.end([server, *nodes])


def events_of(url: str, is_over: Callable[[], bool]) -> Iterator[JsonObject]:
    """Yield events from the WebSocket, as any client receives them; end in a pause in which `is_over()` is true."""
    with connect(f"ws{url.removeprefix('http')}/api/v1/live?kinds=event", open_timeout=10) as live:
        while True:
            try:
                message = json.loads(live.recv(timeout=0.5))
            except TimeoutError:
                if is_over():
                    return
                continue
            except ConnectionClosed as error:
                raise DemoError("the server ended") from error
            if message["kind"] == "event":
                yield message


def is_of_scene(event: JsonObject, start_ns: int) -> bool:
    """Return whether an event began after the scene had, at a site time in nanoseconds."""
    return utc_ns(event["time_utc"]) >= start_ns


def read_truth(directory: Path) -> list[dict[str, Any]]:
    """Read the sources of the scene."""
    return [json.loads(line) for line in (directory / TRUTH_FILE).read_text(encoding="utf-8").splitlines()]


def match(
    truth: Sequence[dict[str, Any]], events: Sequence[JsonObject], start_ns: int, period_s: float
) -> list[Outcome]:
    """Pair each source with the event nearest in time, within `MATCH_S`; scene time repeats after `period_s`."""
    outcomes = []
    for source in truth:
        near = [(abs(_scene_time_s(event, start_ns, period_s) - source["start_s"]), event) for event in events]
        best = min(near, key=lambda pair: pair[0], default=None)
        event = best[1] if best is not None and best[0] <= MATCH_S else None
        x, y, z = source["position_m"]
        outcomes.append(Outcome(source["name"], source["start_s"], (x, y, z), event))
    return outcomes


def nearest_source(truth: Sequence[dict[str, Any]], event: JsonObject, start_ns: int, period_s: float) -> Outcome:
    """Pair an event with the source that is nearest in time."""
    time_s = _scene_time_s(event, start_ns, period_s)
    source = min(truth, key=lambda entry: abs(entry["start_s"] - time_s))
    x, y, z = source["position_m"]
    return Outcome(source["name"], source["start_s"], (x, y, z), event)


def _scene_time_s(event: JsonObject, start_ns: int, period_s: float) -> float:
    return ((utc_ns(event["time_utc"]) - start_ns) / 1e9) % period_s


def _need_free(host: str, port: int) -> None:
    """Fail early if the port is in use, so that results of another server are never mistaken for the demo's."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise DemoError(
                f"--port {port}: cannot be used: {reason}; stop the program that uses it or choose another port"
            ) from error
