"""Recordings that stand in for devices: whose they are, on which channels, and when they began."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from livessl.core.joint_array import require_one_clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import FRAME_NS
from livessl.errors import DeviceError
from livessl.recordings.recording import Looped, Placed, Recording, Spliced, Stacked, WavRecording
from livessl.recordings.session import Session
from livessl.site.build.pipeline import make_pipeline
from livessl.site.models import Site

TOGETHER_NS: Final = 5_000_000_000
"""Long against the difference between two processes' starts, short against a user's patience."""


@dataclass(frozen=True)
class Part:
    """One array's recording: what is heard on which channels, and when it began."""

    array: str
    placed: Placed
    channels: tuple[int, ...]


def pipelines_of(site: Site, parts: Iterable[Part]) -> tuple[list[Pipeline], list[Placed]]:
    """The pipelines that cut recordings into messages, and what each of them plays.

    Recordings of arrays that the site joins are played side by side, as one device recorded them.

    Raises
    ------
    DeviceError
        Where some of them are missing, or were not recorded so.
    """
    given = {part.array: part for part in parts}
    pipelines: list[Pipeline] = []
    placed: list[Placed] = []
    for spec in site.processed:
        played = _played_together(site, spec.name, given)
        if not played:
            continue
        first = played[0].placed
        channels: dict[str, list[int]] = {}
        before = 0
        for part in played:
            channels[part.array] = [before + number for number in part.channels]
            before += part.placed.recording.channels
        pipelines.append(make_pipeline(site, channels, first.recording.sample_rate_hz))
        together = tuple(part.placed.recording for part in played)
        placed.append(first if len(played) == 1 else Placed(Stacked(together), first.start_ns))
    return pipelines, placed


def _played_together(site: Site, name: str, given: Mapping[str, Part]) -> list[Part]:
    """The recordings that make up one array as it is processed; none where none is given."""
    members = site.members(name)
    played = [given[member] for member in members if member in given]
    if name in given and name in site.joint:
        if played:
            raise DeviceError(
                f"array {name!r}: expected its recording or {played[0].array!r}'s, got both; take one away"
            )
        return [given[name]]
    if len(played) not in (0, len(members)):
        missing = next(member for member in members if member not in given)
        raise DeviceError(
            f"array {name!r}: joint processing expects a recording of each of {', '.join(members)}, got none of "
            f"{missing!r}; add it, or take joint.{name} away"
        )
    if len(played) > 1:
        _require_together(site, name, played)
    return played


def _require_together(site: Site, name: str, played: Sequence[Part]) -> None:
    nodes = {part.array: site.node_of(part.array) for part in played}
    try:  # without a node, one file is known to have one clock
        require_one_clock(name, {part.array: nodes[part.array] or part.placed.recording.name for part in played})
    except ValueError as error:
        raise DeviceError(str(error)) from error
    first_ns = played[0].placed.start_ns
    spans = [
        (part.placed.start_ns - first_ns, part.placed.recording.duration_s, part.placed.recording.sample_rate_hz)
        for part in played
    ]
    if len(set(spans)) > 1:
        each = ", ".join(
            f"{part.placed.recording.name} ({start_ns / 1e9:g} s, {duration_s:g} s, {rate_hz:g} Hz)"
            for part, (start_ns, duration_s, rate_hz) in zip(played, spans, strict=True)
        )
        raise DeviceError(
            f"array {name!r}: joint processing expects recordings of one beginning, length and sampling rate, "
            f"got {each}; record them through one device, or take joint.{name} away"
        )


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
        [(name, path, start_ns + (round(_wav_offset_s(site, name) * 1e9))) for name, path in wavs.items()],
        wanted,
    )


def _wav_offset_s(site: Site, array: str) -> float:
    """Of a joint array, that of those it joins: they have one; 0 for an array that is not there."""
    config = site.arrays.get(site.members(array)[0])
    return config.wav_offset_s if config else 0.0


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
    """When files that stand in for devices begin: on the grid of frames, so that frames are cut as they are offline.

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


def recording_channels(site: Site, array: str, recording: Recording, wanted: Sequence[int] | None = None) -> list[int]:
    """Which channels (from 1) of a recording are an array's microphones.

    As wanted; else as many channels as microphones, in order; else the channels that the site file gives the array on
    its node's device; else the first ones.

    Raises
    ------
    DeviceError
        Where channels or sampling rate do not fit the site.
    """
    expected = len(site.array(array).microphones_m)
    node = site.node_of(array)
    rate = site.nodes[node].device.sample_rate_hz if node else None
    if rate is not None and rate != recording.sample_rate_hz:
        raise DeviceError(
            f"{recording.name}: expected {rate:g} Hz for array {array!r}, got {recording.sample_rate_hz:g} Hz; "
            f"resample the file or correct nodes.{node}.device.sample_rate_hz"
        )
    high = site.array(array).band_hz[1]
    if high >= recording.sample_rate_hz / 2:
        raise DeviceError(
            f"{recording.name}: array {array!r} uses up to {high:g} Hz and needs more than {2 * high:g} Hz, got "
            f"{recording.sample_rate_hz:g} Hz; lower band_hz or use a recording with a higher rate"
        )
    if wanted is not None:
        if not len(wanted) == len(set(wanted)) == expected or min(wanted) < 1 or max(wanted) > recording.channels:
            raise DeviceError(
                f"{recording.name}: expected {expected} different channel numbers from 1 to {recording.channels} "
                f"for array {array!r}, got {list(wanted)}"
            )
        return list(wanted)
    if recording.channels < expected:
        raise DeviceError(
            f"{recording.name}: expected {expected} channels, one for each microphone of array {array!r}, "
            f"got {recording.channels}"
        )
    if recording.channels > expected and node:
        captured = site.nodes[node].arrays
        numbers = [number for member in site.members(array) for number in captured[member]]
        if max(numbers) <= recording.channels:
            return numbers
    return list(range(1, expected + 1))


def _parts(site: Site, files: Sequence[tuple[str, Path, int]], channels: Mapping[str, Sequence[int]]) -> list[Part]:
    stretches: dict[str, list[Placed]] = {}
    chosen: dict[str, tuple[int, ...]] = {}
    faults: list[str] = []
    for array, path, start_ns in files:
        known = (*site.arrays, *site.joint)
        if array not in known:
            faults.append(f"{array}={path}: no such array; arrays are {', '.join(known)}")
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
