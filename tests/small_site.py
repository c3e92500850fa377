"""A small site that tests share, sound for it, and how to wait for something without sleeping through it."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import cache
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import soundfile
import yaml

from livessl.clock import SystemClock
from livessl.core.types import Float32Array, Frame, Mark
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.app import Server
from livessl.service_manager import ServiceManager
from livessl.simulation.scene import Scene, make_scene, render
from livessl.site.load import parse_site
from livessl.site.models import Site

RATE_HZ = 16000
SMALL: dict[str, Any] = {
    "site": "small",
    "room": {"size_m": [4.0, 5.0, 3.0]},
    "grid": {"spacing_m": 0.25},
    "arrays": {
        "north": {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [1.9, 1.3, 1.4]},
        "south": {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [2.2, 3.8, 1.5]},
    },
    "nodes": {
        "lab-pc": {
            "server": "tcp://127.0.0.1:5570",
            "device": {"name": "UMC1820", "sample_rate_hz": RATE_HZ},
            "arrays": {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]},
        }
    },
    "zones": {"door": {"bounds_m": [[0.0, 1.0], [0.0, 1.0], [0.0, 2.5]]}},
    "server": {"bind": "tcp://127.0.0.1:*", "http": {"host": "127.0.0.1", "port": 0}},
}
"""Two tetrahedra in a small room at a low rate: quick to localize in. Addresses are chosen by the system."""

FIRST_FRAME_INDEX = 999
"""A frame's frame index is its number beyond this, where a test does not say otherwise."""

HANG_S = 100.0
"""Seconds after which a test gives up waiting: on a slow and busy machine only a hang lasts so long."""

Changes = dict[str, Any]
"""Dotted path to value; `...` takes the key away."""


def small(changes: Changes | None = None) -> dict[str, Any]:
    """The small site's data, changed."""
    data = deepcopy(SMALL)
    for dotted, value in (changes or {}).items():
        *parents, key = dotted.split(".")
        holder = data
        for parent in parents:
            holder = holder.setdefault(parent, {})
        if value is ...:
            del holder[key]
        else:
            holder[key] = value
    return data


def text_of(changes: Changes | None = None) -> str:
    """The small site's YAML, changed."""
    return yaml.safe_dump(small(changes), sort_keys=False, allow_unicode=True)


def site_of(changes: Changes | None = None, directory: Path | None = None) -> Site:
    """The small site, changed."""
    return parse_site(text_of(changes), directory=directory)


def write_site(directory: Path, changes: Changes | None = None) -> Path:
    """The small site as a file, changed."""
    path = directory / "site.yaml"
    path.write_text(text_of(changes), encoding="utf-8")
    return path


def hiss(seconds: float = 1.0, channels: int = 4, seed: int = 0, level: float = 0.1) -> Float32Array:
    """Noise (channels, n), different on each channel."""
    rng = np.random.default_rng(seed)
    return (level * rng.standard_normal((channels, round(seconds * RATE_HZ)))).astype(np.float32).clip(-1, 1)


def write_wav(path: Path, samples: Float32Array, rate_hz: int = RATE_HZ, subtype: str = "FLOAT") -> Path:
    """Samples (channels, n) as a file; returns its path."""
    soundfile.write(path, samples.T, rate_hz, subtype=subtype)
    return path


@cache
def scene(count: int = 2) -> Scene:
    """Bursts of noise in the small room, without reverberation."""
    site = site_of()
    return make_scene(
        site.room.size_m,
        rt60_s=0.0,
        sounds=[("burst", hiss(0.4, 1)[0])],
        count=count,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=2,
        lead_s=0.7,
    )


@cache
def heard(array: str, count: int = 2) -> Float32Array:
    """What an array's microphones record of the scene, (4, n)."""
    return render(scene(count), site_of().array(array).microphones_m, seed=3 + len(array))


def scene_recordings(start_ns: int, count: int = 2) -> list[AssignedRecording]:
    """The scene's recordings, begun at a site time."""
    return [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), heard(name, count)), start_ns, (1, 2, 3, 4))
        for name in SMALL["arrays"]
    ]


def frame(
    sequence: int = 1, frame_index: int | None = None, array: str = "north", *, active: bool = True, seed: int = 0
) -> Frame:
    """A frame of noise as the small site's nodes send it; each later in time than the one numbered before it."""
    samples = hiss(0.05, seed=seed)
    frame_index = FIRST_FRAME_INDEX + sequence if frame_index is None else frame_index
    return Frame(array, sequence, frame_index, frame_index * 50_000_000, float(RATE_HZ), samples, 0.01, active)


def mark(sequence: int = 1, frame_index: int = 1000, array: str = "north", power: float = 1e-6) -> Mark:
    """A mark of quiet."""
    return Mark(array, sequence, frame_index, power, power, (power,) * 4)


def wait_until(condition: Callable[[], object], what: str, seconds: float = HANG_S) -> None:
    """Return as soon as `condition` holds; fail if it does not within some seconds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited {seconds:g} s in vain: {what}"
        time.sleep(0.005)


@contextmanager
def started(*command: str | Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A process, ended with all that it has started when the context ends; options are those of `Popen`."""
    process = subprocess.Popen([str(word) for word in command], text=True, start_new_session=True, **options)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@contextmanager
def running_server(
    site: Site,
    method: str | None = None,
    read_site: Callable[[], Site] | None = None,
    service: ServiceManager | None = None,
) -> Iterator[Server]:
    """A whole server in a thread, answering."""
    server = Server(site, SystemClock(), method=method, read_site=read_site, service=service)
    thread = Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(timeout=HANG_S)
        assert not thread.is_alive(), "the server does not end"
