"""What a node plays when its device is no audio interface: recorded files, or a simulated scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from livessl.errors import DeviceError
from livessl.recordings.assign import Part, parts_from_wavs, repeated
from livessl.recordings.recording import ArrayRecording, Placed
from livessl.site.models import SceneDeviceConfig, Site, WavDeviceConfig


def parts_from_scene(
    site: Site,
    arrays: Iterable[str],
    config: SceneDeviceConfig,
    start_ns: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Part]:
    """A simulated scene as the arrays of one node would record it; every node with the same numbers hears the same."""
    from livessl.simulation.of_site import rendered, scene_of  # heavy, and no other device needs it

    scene = scene_of(
        site, rt60_s=config.rt60_s, count=config.events, sample_rate_hz=config.sample_rate_hz, seed=config.seed
    )
    parts = []
    for spec, samples in rendered(site, scene, list(arrays), seed=config.seed, progress=progress):
        recording = ArrayRecording(f"scene {config.seed}", config.sample_rate_hz, samples)
        parts.append(Part(spec.name, Placed(recording, start_ns), tuple(range(1, len(samples) + 1))))
    return parts


def parts_from_node(
    site: Site,
    node: str,
    start_ns: int,
    base: Path,
    progress: Callable[[int, int], None] | None = None,
) -> list[Part]:
    """What a node whose device is no audio interface plays: its WAV files (relative to `base`), or its scene.

    Raises
    ------
    DeviceError
        With every file that does not fit, one a line; or why there is no such scene.
    """
    config = site.nodes[node].device
    arrays = site.nodes[node].arrays
    if isinstance(config, SceneDeviceConfig):
        try:
            parts = parts_from_scene(site, arrays, config, start_ns, progress)
        except ValueError as error:
            raise DeviceError(f"nodes.{node}.device: {error}") from error
    else:
        assert isinstance(config, WavDeviceConfig)
        missing = [array for array in arrays if array not in config.files]
        if missing:
            raise DeviceError(f"nodes.{node}.device.files: expected a file for array {missing[0]!r}; add it")
        wavs = {array: base / config.files[array] for array in arrays}
        parts = parts_from_wavs(site, wavs, start_ns=start_ns)
    return repeated(parts) if config.loop else parts
