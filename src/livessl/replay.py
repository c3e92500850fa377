"""All arrays in one process, no sockets: recordings through the whole pipeline, as fast as the clock given allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from livessl import wire
from livessl.capture.devices import DeviceError, Placed, WavRecording, played
from livessl.capture.line import Line, recording_channels
from livessl.clock import Clock
from livessl.config import Site
from livessl.core.types import Frame, Mark, Message, Output


@dataclass(frozen=True)
class Part:
    """One array's recording: what is heard on which channels, and when it began."""

    array: str
    placed: Placed
    channels: tuple[int, ...]


def parts_from_wavs(
    site: Site, wavs: Mapping[str, Path], channels: Mapping[str, Sequence[int]] | None = None, start_ns: int = 0
) -> list[Part]:
    """Recordings that begin together at `start_ns`, but for each array's `wav_offset_s` in the site file.

    Raises
    ------
    DeviceError
        With every file that does not fit, one a line.
    """
    parts: list[Part] = []
    faults: list[str] = []
    for array, path in wavs.items():
        if array not in site.arrays:
            faults.append(f"--wav {array}={path}: no such array; arrays are {', '.join(site.arrays)}")
            continue
        try:
            recording = WavRecording(path)
            chosen = recording_channels(site, array, recording, (channels or {}).get(array))
        except DeviceError as error:
            faults.append(str(error))
            continue
        offset_ns = round(site.arrays[array].wav_offset_s * 1e9)
        parts.append(Part(array, Placed(recording, start_ns + offset_ns), tuple(chosen)))
    if faults:
        raise DeviceError("\n".join(faults))
    return parts


def messages(site: Site, parts: Sequence[Part], clock: Clock) -> Iterator[tuple[int, list[Message]]]:
    """What the capture nodes would send, block by block: site time at which it is known, and the messages."""
    lines = [Line(site, {part.array: part.channels}, part.placed.recording.sample_rate_hz) for part in parts]
    end_ns = 0
    for end_ns, index, block in played([part.placed for part in parts], clock):
        yield end_ns, lines[index].push(block)
    yield end_ns, [message for line in lines for message in line.flush()]


def over_the_wire(batch: Iterable[Message]) -> list[Message]:
    """Each message to bytes and back: replay takes the live path's every step but the socket."""
    decoded = (wire.decode(wire.encode(message)) for message in batch)
    return [message for message in decoded if isinstance(message, Frame | Mark)]


def run(
    site: Site,
    parts: Sequence[Part],
    clock: Clock,
    *,
    method: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Output]:
    """Localize everything in the recordings: events, in order of time."""
    fusion = site.make_fusion(method, updates=False)
    now_ns = 0
    for now_ns, batch in messages(site, parts, clock):
        yield from fusion.step(over_the_wire(batch), now_ns)
        if progress is not None:
            progress(now_ns)
    yield from fusion.flush(now_ns)
