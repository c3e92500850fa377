"""A site of real processes over real sockets, with proxies in between: to kill, stop, cut and start again."""

from __future__ import annotations

import json
import math
import random
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import soundfile
import yaml
from namespaces import Cable
from proxy import Proxy
from websockets.sync.client import connect

from livessl.clock import utc_ns, utc_text
from livessl.lab.processes import free_port
from livessl.simulation.export import write_scene
from livessl.simulation.scene import make_scene
from livessl.site import keys
from livessl.site.load import load_site
from small_site import HANG_S, RATE_HZ, Changes, hiss, small

Event = dict[str, Any]

FRAME_S = 0.05
TAIL_S = 120.0
"""Quiet after the last sound: a node does not end because its server is away, and here it shall not either."""

LEAST_LEAD_S = 8.0
"""Least time from the start of the nodes to the recordings' first sample, in seconds."""

LEAD = 4.0
"""That time relative to the one that the server took to start, if that is longer."""

NODES = {"a": "north", "b": "south"}

WEST = {"arrays.west": {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [0.7, 2.4, 1.6]}}
"""A third array, for what an array's death costs two others."""


def make_recordings(
    directory: Path,
    count: int,
    gap_s: float,
    seed: int = 5,
    changes: Changes | None = None,
    lead_s: float = 2.0,
) -> None:
    """A WAV for each array: bursts of noise at random places of the small room, without reverberation."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "scene.yaml"
    path.write_text(yaml.safe_dump(small(changes)), encoding="utf-8")
    site = load_site(path)
    scene = make_scene(
        site.room.size_m,
        rt60_s=0.0,
        sounds=[(f"burst-{k}", hiss(0.3 + 0.1 * k, 1, seed=k)[0]) for k in range(5)],
        count=count,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=seed,
        lead_s=lead_s,
        gap_s=gap_s,
    )
    write_scene(directory, site, scene, seed=seed)
    for k, array in enumerate(site.arrays):
        samples, rate = soundfile.read(directory / f"{array}.wav", always_2d=True)
        hum = 1e-4 * np.random.default_rng(k).standard_normal((round(TAIL_S * rate), samples.shape[1]))
        soundfile.write(directory / f"{array}.wav", np.concatenate([samples, hum]), rate, subtype="PCM_16")


@dataclass
class Playing:
    """A site that plays the recordings of a folder, from `start_ns` on; its processes end with the context.

    Parameters
    ----------
    recordings : Path
        Where the recordings are.
    directory : Path
        For site file, database, spools and what the processes say.
    nodes : dict of str to str
        The nodes, and each one's array.
    changes : dict
        Of the small site.
    cables : mapping of node to Cable
        Nodes in network namespaces: no proxy is between them and the server, and both have keys, as a server needs
        that others can reach.
    """

    recordings: Path
    directory: Path
    seed: int = 0
    nodes: dict[str, str] = field(default_factory=lambda: dict(NODES))
    changes: Changes = field(default_factory=dict)
    cables: Mapping[str, Cable] = field(default_factory=dict)
    proxies: dict[str, Proxy] = field(default_factory=dict)
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    start_ns: int = 0
    http: int = 0

    def __enter__(self) -> Self:
        self._open = ExitStack()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._log = self._open.enter_context((self.directory / "said.txt").open("ab"))
        port, self.http = free_port(), free_port()
        for k, name in enumerate(self.nodes):
            if name not in self.cables:
                self.proxies[name] = self._open.enter_context(Proxy(("127.0.0.1", port), self.seed + k))
        data = small({**self.changes, "server.bind": f"tcp://127.0.0.1:{port}", "server.http.port": self.http})
        if self.cables:
            folder = self.directory / "keys"
            keys.make_server_keys(folder)
            for name in self.nodes:
                keys.enrol(folder, name, keys.make_node_keys(folder, name))
            data["server"]["bind"], data["keys"] = f"tcp://*:{port}", "keys"
        data["server"]["events_db"] = str(self.directory / "events.db")
        data["nodes"] = {
            name: {
                "server": f"tcp://{self.cables[name].host}:{port}" if self.cables else self.proxies[name].endpoint,
                "device": {"type": "wav", "files": {array: f"{array}.wav"}},
                "arrays": {array: [1, 2, 3, 4]},
                "spool": {"directory": str(self.directory / "spool")},
            }
            for name, array in self.nodes.items()
        }
        self.site = self.directory / "site.yaml"
        self.site.write_text(yaml.safe_dump(data), encoding="utf-8")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name in list(self.processes):
            self.kill(name)
        self._open.close()

    def start(self) -> None:
        """Start the server and then the nodes, which take no longer; the busier the machine, the later they play."""
        began_s = time.monotonic()
        self.start_server()
        self.wait_ready(HANG_S)
        lead_s = max(LEAST_LEAD_S, LEAD * (time.monotonic() - began_s))
        self.start_ns = math.ceil((time.time() + lead_s) / 5) * 5_000_000_000
        for name in self.nodes:
            self.start_node(name)

    def start_server(self) -> None:
        """Start it; it may take seconds to answer."""
        self._start("server", "serve")

    def start_node(self, name: str) -> None:
        """Start a node; it plays what is left of its recording, for what is past nobody hears any more."""
        array = self.nodes[name]
        late_s = max(0.0, time.time() + 0.5 - self.start_ns / 1e9)
        skip = math.ceil(late_s / FRAME_S)
        path = self.directory / f"{array}-{skip}.wav"
        samples, rate = soundfile.read(self.recordings / f"{array}.wav", start=round(skip * FRAME_S * RATE_HZ))
        soundfile.write(path, samples, rate, subtype="PCM_16")
        start = utc_text(self.start_ns + skip * 50_000_000)
        self._start(name, "capture", "--node", name, "--wav", f"{array}={path}", "--start-at", start)

    def _start(self, name: str, command: str, *arguments: str) -> None:
        inside = self.cables[name].inside if name in self.cables else []
        self.processes[name] = subprocess.Popen(
            [*inside, sys.executable, "-m", "livessl", command, "--site", str(self.site), *arguments],
            stdout=self._log,
            stderr=self._log,
        )

    def kill(self, name: str) -> None:
        """With -9."""
        process = self.processes.pop(name)
        process.kill()
        process.wait()

    def stop(self, name: str, seconds: float) -> None:
        """With SIGSTOP, for a while."""
        self.processes[name].send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self.processes[name].send_signal(signal.SIGCONT)

    def get(self, what: str) -> Any:
        """From the API; None where it does not answer."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.http}/api/v1/{what}", timeout=2.0) as answer:
                return json.load(answer)
        except OSError:
            return None

    def wait_ready(self, within_s: float = 60.0) -> None:
        """Until the server answers."""
        wait_for(lambda: self.get("health") is not None, "the server", within_s)

    def sleep_until(self, seconds: float) -> None:
        """Until so many seconds of the recordings have passed."""
        time.sleep(max(0.0, self.start_ns / 1e9 + seconds - time.time()))

    def now_s(self) -> float:
        """Seconds of the recordings that have passed."""
        return time.time() - self.start_ns / 1e9

    def is_settled(self) -> bool:
        """Whether both nodes are well again, and all that they had kept has come: late, again or out of order."""
        before = self.get("arrays")
        time.sleep(3.0)
        after = self.get("arrays")
        if before is None or after is None:
            return False
        counted = [[array["counters"] | {"marks": 0} for array in both["arrays"]] for both in (before, after)]
        return {array["state"] for array in after["arrays"]} == {"healthy"} and counted[0] == counted[1]

    def events(self) -> list[Event]:
        """What is stored, oldest first, whether or not a server runs; `at_s` counts from the recordings' start."""
        with closing(sqlite3.connect(self.directory / "events.db", timeout=HANG_S)) as db:
            rows = db.execute("SELECT body FROM events ORDER BY time_ns").fetchall()
        events = [json.loads(text) for (text,) in rows]
        return [{**event, "at_s": (utc_ns(event["time_utc"]) - self.start_ns) / 1e9} for event in events]

    def awaits_final_results(self) -> bool:
        """Whether the final pass may still replace a stored event."""
        with closing(sqlite3.connect(self.directory / "events.db", timeout=HANG_S)) as db:
            return bool(db.execute("SELECT 1 FROM early LIMIT 1").fetchall())


class Hearer:
    """Subscribes to events and notes how long after each sound's end the first word of it came.

    Parameters
    ----------
    http : int
        The server's port on this machine.
    """

    def __init__(self, http: int) -> None:
        self._url = f"ws://127.0.0.1:{http}/api/v1/live?kinds=event"
        self.delays_s: dict[str, float] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._socket = connect(self._url)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._thread.join(timeout=HANG_S)

    def _run(self) -> None:
        for text in self._socket:
            event = json.loads(text)
            if event["kind"] == "event":
                end_s = utc_ns(event["time_utc"]) / 1e9 + event["duration_s"]
                self.delays_s.setdefault(event["id"], time.time() - end_s)


def wait_for(condition: Callable[[], object], what: str, within_s: float) -> None:
    """Until it is so; fail where it does not become so in time."""
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {within_s:g} s in vain for {what}")
        time.sleep(0.05)


def duration_s(recordings: Path) -> float:
    """Of the recordings, without the quiet at their end."""
    info = soundfile.info(recordings / "north.wav")
    return float(info.frames / info.samplerate) - TAIL_S


def play(
    recordings: Path,
    directory: Path,
    disturb: Callable[[Playing, random.Random, float], None],
    seed: int = 0,
    *,
    cabled: bool = False,
) -> list[Event]:
    """Play the recordings to their end while something disturbs them; then let everything settle.

    `cabled` puts the nodes into network namespaces instead of behind proxies.
    """
    end_s = duration_s(recordings)
    with ExitStack() as open_cables:
        cables = {name: open_cables.enter_context(Cable(k)) for k, name in enumerate(NODES)} if cabled else {}
        site = open_cables.enter_context(Playing(recordings, directory, seed=seed, cables=cables))
        site.start()
        disturb(site, random.Random(seed), end_s)
        for proxy in site.proxies.values():
            proxy.weather.cut = False
        for cable in cables.values():
            cable.plug()
        if "server" not in site.processes:
            site.start_server()
        site.sleep_until(end_s)
        site.wait_ready()
        wait_for(lambda: site.is_settled(), "the last events", 90)
        return site.events()
