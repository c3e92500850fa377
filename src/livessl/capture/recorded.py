"""Recordings that stand in for devices: whose they are, on which channels, and when they began."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from livessl.capture.devices import ArrayRecording, DeviceError, Looped, Placed, Spliced, WavRecording
from livessl.capture.line import Line, recording_channels
from livessl.config import SceneDeviceConfig, Site, WavDeviceConfig
from livessl.core.types import FRAME_NS
from livessl.session import Session
from livessl.simulate.scene import make_scene, render, synthesised_sounds

TOGETHER_NS: Final = 5_000_000_000
"""Long against the difference between two processes' starts, short against a user's patience."""


@dataclass(frozen=True)
class Part:
    """One array's recording: what is heard on which channels, and when it began."""

    array: str
    placed: Placed
    channels: tuple[int, ...]

    def line(self, site: Site) -> Line:
        """The line that cuts it into messages."""
        return Line(site, {self.array: self.channels}, self.placed.recording.sample_rate_hz)


def parts_from_wavs(
    site: Site, wavs: Mapping[str, Path], channels: Mapping[str, Sequence[int]] | None = None, start_ns: int = 0
) -> list[Part]:
    """Recordings that begin together at `start_ns`, but for each array's `wav_offset_s` in the site file.

    Raises
    ------
    DeviceError
        With every file that does not fit, one a line.
    """
    wanted = channels or {}
    strangers = sorted(set(wanted) - set(wavs))
    if strangers:
        raise DeviceError(
            f"channels of array {strangers[0]!r}: no recording of it is given; there are {', '.join(wavs)}"
        )
    return _parts(
        site,
        [
            (name, path, start_ns + (round(site.arrays[name].wav_offset_s * 1e9) if name in site.arrays else 0))
            for name, path in wavs.items()
        ],
        wanted,
    )


def parts_from_sessions(site: Site, sessions: Iterable[Session]) -> list[Part]:
    """Sessions' recordings at their original times, as one: each node records its own.

    Raises
    ------
    DeviceError
        With every file that does not fit, one a line.
    """
    return _parts(
        site,
        [(piece.array, session.path(piece), piece.start_ns) for session in sessions for piece in session.pieces],
        {},
    )


def common_start_ns(now_ns: int, nodes: int) -> int:
    """When files that stand in for devices begin: on the time raster, so that frames are cut as they are offline.

    With several nodes, each a process that knows nothing of the others, at the next full `TOGETHER_NS` of the clock:
    nodes started together begin together.
    """
    step_ns = FRAME_NS if nodes <= 1 else TOGETHER_NS
    return -(-now_ns // step_ns) * step_ns


def span_ns(parts: Iterable[Part]) -> tuple[int, int | None]:
    """Site time at which the first recording begins and the last one ends; None where one is repeated for ever."""
    placed = [part.placed for part in parts]
    begin_ns = min(item.start_ns for item in placed)
    if any(item.recording.duration_s == float("inf") for item in placed):
        return begin_ns, None
    return begin_ns, max(item.start_ns + round(item.recording.duration_s * 1e9) for item in placed)


def repeated(parts: Iterable[Part]) -> list[Part]:
    """The same recordings, again and again."""
    return [
        Part(part.array, Placed(Looped(part.placed.recording), part.placed.start_ns), part.channels) for part in parts
    ]


def parts_from_scene(
    site: Site,
    arrays: Iterable[str],
    config: SceneDeviceConfig,
    start_ns: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Part]:
    """A simulated scene as the arrays of one node would record it; every node with the same numbers hears the same."""
    scene = make_scene(
        site.room.size_m,
        rt60_s=config.rt60_s,
        sounds=synthesised_sounds(config.sample_rate_hz, config.seed),
        count=config.events,
        sample_rate_hz=config.sample_rate_hz,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=config.seed,
    )
    order = list(site.arrays)
    parts = []
    for array in arrays:
        microphones = site.array(array).microphones_m
        samples = render(scene, microphones, seed=config.seed + 1 + order.index(array), progress=progress)
        recording = ArrayRecording(f"scene {config.seed}", config.sample_rate_hz, samples)
        parts.append(Part(array, Placed(recording, start_ns), tuple(range(1, len(microphones) + 1))))
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


def _parts(site: Site, files: Sequence[tuple[str, Path, int]], channels: Mapping[str, Sequence[int]]) -> list[Part]:
    stretches: dict[str, list[Placed]] = {}
    chosen: dict[str, tuple[int, ...]] = {}
    faults: list[str] = []
    for array, path, start_ns in files:
        if array not in site.arrays:
            faults.append(f"{array}={path}: no such array; arrays are {', '.join(site.arrays)}")
            continue
        try:
            recording = WavRecording(path)
            chosen[array] = tuple(recording_channels(site, array, recording, channels.get(array)))
        except DeviceError as error:
            faults.append(str(error))
            continue
        first = stretches.setdefault(array, [Placed(recording, start_ns)])[0].recording
        if recording.sample_rate_hz != first.sample_rate_hz:
            faults.append(
                f"{path}: expected {first.sample_rate_hz:g} Hz as in {first.name}, of array {array!r}, too; "
                f"got {recording.sample_rate_hz:g} Hz; resample one of them"
            )
        elif recording is not first:
            stretches[array].append(Placed(recording, start_ns))
    if faults:
        raise DeviceError("\n".join(faults))
    return [Part(array, _spliced(placed), chosen[array]) for array, placed in stretches.items()]


def _spliced(stretches: Sequence[Placed]) -> Placed:
    if len(stretches) == 1:
        return stretches[0]
    ordered = sorted(stretches, key=lambda stretch: stretch.start_ns)
    return Placed(Spliced(tuple(ordered)), ordered[0].start_ns)
