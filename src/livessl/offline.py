"""`livessl.locate` and `power_map`: the whole pipeline on recordings in one process, without sockets.

It also checks samples and files that a caller passes: their shape, rate and type.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from livessl import wire
from livessl.clock import UnpacedClock
from livessl.core.locate.estimator import Sound
from livessl.core.types import (
    MAX_SAMPLE,
    BackfillRequest,
    Event,
    Float32Array,
    FloatArray,
    Frame,
    Mark,
    Message,
    Output,
    read_only,
)
from livessl.errors import DeviceError
from livessl.recordings.assign import AssignedRecording, assign_files, make_pipelines, recording_channels
from livessl.recordings.play import unpaced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.site.build.fusion import make_estimator, make_fusion
from livessl.site.load import load_site
from livessl.site.models import Site

SiteOrPath = Site | Path | str
"""A site, or the path of a site file."""

Samples = NDArray[Any]
"""Samples (channels, n): floats with full scale at 1, or integers of a converter."""

Given = Samples | Path | str | Sequence[Path | str]
"""The recording of one array: samples, the path of a WAV or FLAC file, or the paths of several files that hold its
channels, such as one for each microphone."""

_WIDEST: Final = 64
"""Most rows of samples that can be channels; with more rows, the array is likely transposed."""


@dataclass(frozen=True, slots=True)
class PowerMap:
    """Power over the search volume, with its coordinates.

    Parameters
    ----------
    power : (nx, ny, nz) float32
        Sum of the arrays' maps; the highest point is the likeliest position.
    arrays : mapping of array name to (nx, ny, nz) float32
        The map of each array.
    x_m, y_m, z_m : (nx,), (ny,), (nz,) float64
        Coordinates of the grid points along each axis, metres.
    """

    power: Float32Array
    arrays: Mapping[str, Float32Array]
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray


def locate(
    site: SiteOrPath,
    recordings: Mapping[str, Given],
    sample_rate_hz: float | None = None,
    method: str | None = None,
) -> list[Event]:
    """Locate the sounds in recordings by the live pipeline, from activity detection to events, without waiting.

    Parameters
    ----------
    site : Site, Path or str
        A site, or the path of a site file.
    recordings : mapping of array name to (channels, n) array, Path, str or sequence of paths
        One recording for each array, its channels in the order of the microphones. All begin at the same time. A file
        may have more channels; then the node in the site file says which of them belong to the array. Several files
        are one recording: the channels of the first, then of the second, ….
    sample_rate_hz : float or None
        Sampling rate of recordings that are given as samples; None takes the rate of the site's device.
    method : str or None
        Name of a registered method, or the import path `MODULE:NAME` of one; None takes the site's.

    Returns
    -------
    list of Event
        In order of time. The times of an event count from the beginning of the recordings.

    Raises
    ------
    ConfigError
        If the site file is invalid, or there is no such method.
    DeviceError
        If a recording does not fit the site.
    """
    loaded, parts = assigned(site, recordings, sample_rate_hz)
    outputs = run(loaded, parts, UnpacedClock(), method=method)
    return [output for output in outputs if isinstance(output, Event)]


def power_map(
    site: SiteOrPath,
    recordings: Mapping[str, Given],
    start_s: float = 0.0,
    stop_s: float | None = None,
    sample_rate_hz: float | None = None,
    method: str | None = None,
) -> PowerMap:
    """Map the power of one sound, a segment of the recordings, over the search volume.

    Parameters
    ----------
    site, recordings, sample_rate_hz, method
        As in `locate`.
    start_s, stop_s : float, float or None
        Begin and end of the segment, seconds after the beginning of the recordings; None is their end.

    Raises
    ------
    ConfigError, DeviceError
        As in `locate`; `DeviceError` also if the segment is silent.
    """
    loaded, parts = assigned(site, recordings, sample_rate_hz)
    sounds = {}
    for part in parts:
        rate_hz = part.recording.sample_rate_hz
        samples = np.concatenate([block.samples for block in part.recording.blocks(0)], axis=1)
        stop = None if stop_s is None else round(stop_s * rate_hz)
        segment = samples[np.array(part.channels) - 1, round(start_s * rate_hz) : stop]
        if not segment.any():
            end = "the end" if stop_s is None else f"{stop_s:g} s"
            raise DeviceError(f"array {part.array!r}: expected sound from {start_s:g} s to {end}, got none there")
        sounds[part.array] = Sound([np.ascontiguousarray(segment)], rate_hz)
    estimator = make_estimator(loaded, method)
    maps = estimator.power_maps(estimator.locate(sounds).evidence)
    grid = maps.grid
    shape = grid.shape
    x_m, y_m, z_m = (
        np.linspace(low, high, count) for low, high, count in zip(grid.lower_m, grid.upper_m, shape, strict=True)
    )
    arrays = {name: power.reshape(shape) for name, power in maps.arrays.items()}
    return PowerMap(maps.fused.reshape(shape), arrays, x_m, y_m, z_m)


def assigned(
    site: SiteOrPath, recordings: Mapping[str, Given], sample_rate_hz: float | None = None
) -> tuple[Site, list[AssignedRecording]]:
    """Return the site, and the recordings assigned to its arrays: see `locate`."""
    loaded = _site(site)
    return loaded, _parts(loaded, recordings, sample_rate_hz)


def run(
    site: Site,
    recordings: Sequence[AssignedRecording],
    clock: UnpacedClock,
    *,
    method: str | None = None,
    backfill: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Output]:
    """Yield all outputs of the fusion for recordings; events are in order of time.

    With `backfill`, frames of a sound are requested from arrays that did not detect it, as a live server does. `clock`
    has the time of the sound that is processed.

    Raises
    ------
    DeviceError
        If recordings of arrays that the site joins do not belong together.
    """
    fusion = make_fusion(site, method, updates=False)
    pipelines, inputs = make_pipelines(site, recordings)
    if backfill:
        for pipeline in pipelines:
            for array in pipeline.arrays:
                fusion.set_answers(array, True)
    now_ns = 0
    for now_ns, batch in _together(unpaced_messages(pipelines, inputs)):
        clock.sleep_until_ns(now_ns)
        outputs = fusion.step(_over_the_wire(batch), now_ns)
        while requests := [output for output in outputs if isinstance(output, BackfillRequest)]:
            yield from (output for output in outputs if not isinstance(output, BackfillRequest))
            answers = [
                message for request in requests for pipeline in pipelines for message in pipeline.backfill(request)
            ]
            outputs = fusion.step(_over_the_wire(answers), now_ns)
        yield from outputs
        if progress is not None:
            progress(now_ns)
    yield from fusion.flush(now_ns)


def _together(batches: Iterable[tuple[int, list[Message]]]) -> Iterator[tuple[int, list[Message]]]:
    """Join the messages of one time: a step for each block of each array would take as long as locating."""
    for now_ns, same in groupby(batches, key=lambda batch: batch[0]):
        if messages := [message for _, some in same for message in some]:
            yield now_ns, messages


def _over_the_wire(batch: Iterable[Message]) -> list[Message]:
    """Turn each message into bytes and back: every step of the live path but the socket."""
    decoded = (wire.decode(wire.encode(message)) for message in batch)
    return [message for message in decoded if isinstance(message, Frame | Mark)]


def _site(site: SiteOrPath) -> Site:
    return site if isinstance(site, Site) else load_site(site)


def _parts(site: Site, recordings: Mapping[str, Given], sample_rate_hz: float | None) -> list[AssignedRecording]:
    if not recordings:
        raise DeviceError(f"recordings: expected one for each of {', '.join(site.arrays)}, got none")
    files = {name: found for name, given in recordings.items() if (found := _files(given))}
    samples = {name: np.asarray(given) for name, given in recordings.items() if name not in files}
    parts = {part.array: part for part in assign_files(site, files)}
    parts |= {name: _part(site, name, given, sample_rate_hz) for name, given in samples.items()}
    return [parts[name] for name in recordings]


def _files(given: Given) -> tuple[Path, ...]:
    """Return the files of one array; nothing if samples are given."""
    if isinstance(given, str | Path):
        return (Path(given),)
    if isinstance(given, np.ndarray):
        return ()
    return tuple(Path(name) for name in given if isinstance(name, str | Path))


def _part(site: Site, array: str, samples: Samples, sample_rate_hz: float | None) -> AssignedRecording:
    known = (*site.arrays, *site.joint)
    if array not in known:
        raise DeviceError(f"recordings: no array {array!r}; arrays are {', '.join(known)}")
    node = site.node_of(array)
    rate_hz = sample_rate_hz or (site.nodes[node].device.sample_rate_hz if node else None)
    if rate_hz is None:
        raise DeviceError(f"array {array!r}: expected the sampling rate of its samples; pass sample_rate_hz")
    recording = MemoryRecording(f"array {array!r}", float(rate_hz), _checked(array, samples))
    return AssignedRecording(array, recording, 0, tuple(recording_channels(site, array, recording)))


def _checked(array: str, samples: Samples) -> Float32Array:
    """Return samples as float32 with full scale at 1."""
    if samples.ndim != 2 or 0 in samples.shape:
        raise DeviceError(f"array {array!r}: expected samples (channels, n), got shape {samples.shape}")
    if len(samples) > _WIDEST >= samples.shape[1]:
        raise DeviceError(f"array {array!r}: expected samples (channels, n), got {samples.shape}; pass samples.T")
    if np.issubdtype(samples.dtype, np.signedinteger):
        samples = samples / np.float32(-float(np.iinfo(samples.dtype).min))
    checked = np.array(samples, dtype=np.float32)
    largest = float(np.abs(checked).max())  # NaN where there is any
    if not largest <= MAX_SAMPLE:
        raise DeviceError(
            f"array {array!r}: expected finite samples with full scale at 1, got {largest:g} among them; "
            "divide by the full scale of the converter"
        )
    read_only(checked)
    return checked
