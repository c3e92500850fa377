"""Makes the recordings that a node of device type `wav` or `scene` plays: files, or a simulated scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from livessl.errors import DeviceError
from livessl.recordings.assign import AssignedRecording, assign_files, looped
from livessl.recordings.recording import MemoryRecording
from livessl.site.models import Site
from livessl.site.node_models import SceneDeviceConfig, WavDeviceConfig


def scene_recordings(
    site: Site,
    arrays: Iterable[str],
    config: SceneDeviceConfig,
    start_ns: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[AssignedRecording]:
    """Simulate a scene as the arrays of one node would record it.

    Nodes with the same `config` simulate the same scene.

    Raises
    ------
    ValueError
        If there is no such scene.
    """
    from livessl.simulation.of_site import rendered, scene_of  # heavy, and no other device needs it

    scene = scene_of(
        site, rt60_s=config.rt60_s, count=config.events, sample_rate_hz=config.sample_rate_hz, seed=config.seed
    )
    recordings = []
    for spec, samples in rendered(site, scene, list(arrays), seed=config.seed, progress=progress):
        recording = MemoryRecording(f"scene {config.seed}", config.sample_rate_hz, samples)
        recordings.append(AssignedRecording(spec.name, recording, start_ns, tuple(range(1, len(samples) + 1))))
    return recordings


def node_recordings(
    site: Site, node: str, start_ns: int, progress: Callable[[int, int], None] | None = None
) -> list[AssignedRecording]:
    """Return what a node of device type `wav` or `scene` plays from `start_ns` on.

    Raises
    ------
    DeviceError
        If files do not fit (one line for each), or the scene cannot be simulated.
    """
    config = site.nodes[node].device
    arrays = site.nodes[node].arrays
    if isinstance(config, SceneDeviceConfig):
        try:
            recordings = scene_recordings(site, arrays, config, start_ns, progress)
        except ValueError as error:
            raise DeviceError(f"nodes.{node}.device: {error}") from error
    else:
        assert isinstance(config, WavDeviceConfig)
        missing = [array for array in arrays if array not in config.files]
        if missing:
            raise DeviceError(f"nodes.{node}.device.files: expected a file for array {missing[0]!r}; add it")
        named = {array: config.files[array] for array in arrays}
        files = {
            array: [site.file(name) for name in ([names] if isinstance(names, str) else names)]
            for array, names in named.items()
        }
        recordings = assign_files(site, files, start_ns=start_ns)
    return looped(recordings) if config.loop else recordings
