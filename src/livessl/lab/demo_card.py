"""Runs the demo with a virtual audio interface: it plays the scene, and one node records both arrays from it.

ALSA, PortAudio, the node with its device process, the server and the dashboard are the same as in a real set-up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
import soundfile
import yaml

from livessl.clock import Clock
from livessl.core.types import FRAME_NS
from livessl.lab import demo, processes
from livessl.lab.virtual_interface import Interface, Interfaces, built
from livessl.simulation.scene import Scene
from livessl.site.load import load_site
from livessl.site.models import Site

CHANNELS: Final = 18
"""Number of inputs of the virtual interface; a UMC1820 has as many."""

RATE_HZ: Final = 48000.0
PPM: Final = 35.0
"""Error of the virtual interface's sampling rate, in parts per million."""

NODE: Final = "lab-pc"

LEAD_NS: Final = 6_000_000_000
"""Time, in nanoseconds, from the start of the node to the first sample of the scene. Meanwhile the node opens the
interface and learns the background noise."""


def prepare(
    directory: Path, http_port: int, events: int, progress: Callable[[int, int], None]
) -> tuple[Site, Scene, Interfaces]:
    """Simulate the scene, connect an interface that plays it, and write a site file with one node.

    Raises
    ------
    NoInterfaceError
        If this machine cannot make a virtual interface.
    """
    built()  # before the simulation, which takes longer
    site, scene = demo.prepare(directory, http_port, events, progress, RATE_HZ)
    channels = {name: list(range(4 * k + 1, 4 * k + 5)) for k, name in enumerate(site.arrays)}
    sound = np.zeros((round(scene.duration_s * RATE_HZ), CHANNELS), dtype=np.float32)
    for name, numbers in channels.items():
        samples, _ = soundfile.read(directory / f"{name}.wav", dtype="float32", always_2d=True, frames=len(sound))
        sound[: len(samples), numbers[0] - 1 : numbers[-1]] = samples
    folder = directory / "interfaces"
    folder.mkdir()
    interfaces = Interfaces(folder)
    interface = interfaces.add(channels=CHANNELS, ppm=PPM)
    interface.play(sound.T)

    site_file = directory / "site.yaml"
    data = yaml.safe_load(site_file.read_text(encoding="utf-8"))
    device = {"name": interface.name, "sample_rate_hz": int(RATE_HZ)}
    data["nodes"] = {NODE: {"server": data["server"]["bind"], "device": device, "arrays": channels}}
    site_file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return load_site(site_file), scene, interfaces


@contextmanager
def running(
    directory: Path, site: Site, scene: Scene, interfaces: Interfaces, *, loop: bool, clock: Clock
) -> Iterator[demo.Running]:
    """Run server and node as processes while the context lasts; the node ends after the scene unless the scene repeats.

    Raises
    ------
    NotStartedError
        If one of the processes does not start.
    """
    http = site.server.http
    url = f"http://{http.host}:{http.port}"
    common = ["--site", str(directory / "site.yaml")]
    started = [processes.start("serve", *common)]
    try:
        processes.wait_until_ready(url, started, clock)
        start_ns = (clock.now_ns() + LEAD_NS) // FRAME_NS * FRAME_NS
        (interface,) = interfaces.connected
        _play_from(interface, scene, start_ns, clock)
        started.append(processes.start("capture", *common, "--node", NODE, environment=interfaces.environment))
        end_ns = None if loop else start_ns + round(1e9 * scene.duration_s)
        yield demo.Running(url, start_ns, started[1:], clock, end_ns)
    finally:
        processes.end(started)


def _play_from(interface: Interface, scene: Scene, start_ns: int, clock: Clock) -> None:
    """Make the scene begin at a future time; until then the interface plays the end of the scene, which is silent."""
    rounds = -(-LEAD_NS // round(1e9 * scene.duration_s))
    before_ns = round(rounds * 1e9 * scene.duration_s / (1.0 + 1e-6 * PPM))
    interface.begin(clock.monotonic_ns() + start_ns - clock.now_ns() - before_ns)
