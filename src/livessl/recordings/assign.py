"""Assigns recordings to a site's arrays: which channels are an array's, and when its recording begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from livessl.core.joint_array import require_one_clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import FRAME_NS
from livessl.errors import DeviceError, did_you_mean
from livessl.recordings.open_files import OpenFiles
from livessl.recordings.recording import (
    EmptyFileError,
    LoopedRecording,
    Recording,
    SplicedRecording,
    StackedRecording,
    TimedRecording,
)
from livessl.recordings.session import Session
from livessl.site.build.pipeline import make_pipeline
from livessl.site.models import Site

COMMON_START_NS: Final = 5_000_000_000
"""Grid of common start times, in nanoseconds: longer than two processes take to start one after the other, and short
enough for a user to wait."""


@dataclass(frozen=True)
class AssignedRecording:
    """The recording of one array.

    Parameters
    ----------
    array : str
        Name of the array, joint or not.
    recording : Recording
        It may have more channels than the array has microphones.
    start_ns : int
        Site time at which the recording begins.
    channels : tuple of int
        Channels of the recording, counted from 1, in the order of the array's microphones.
    """

    array: str
    recording: Recording
    start_ns: int
    channels: tuple[int, ...]

    @property
    def timed(self) -> TimedRecording:
        """The recording and its start, without the array."""
        return TimedRecording(self.recording, self.start_ns)


def make_pipelines(
    site: Site, recordings: Iterable[AssignedRecording], *, reports_levels: bool = False
) -> tuple[list[Pipeline], list[TimedRecording]]:
    """Return the pipelines that turn recordings into messages, and the recording that feeds each pipeline.

    Recordings of arrays that the site joins are stacked into one, as if one device had recorded them. With
    `reports_levels`, marks carry the levels of the channels.

    Raises
    ------
    DeviceError
        If some of a joint array's recordings are missing, or differ in start, length or sampling rate.
    """
    by_array = {assigned.array: assigned for assigned in recordings}
    pipelines: list[Pipeline] = []
    inputs: list[TimedRecording] = []
    for spec in site.processed:
        members = _members_of(site, spec.name, by_array)
        if not members:
            continue
        first = members[0].timed
        channels: dict[str, list[int]] = {}
        before = 0
        for member in members:
            channels[member.array] = [before + number for number in member.channels]
            before += member.recording.channels
        rate_hz = first.recording.sample_rate_hz
        pipelines.append(make_pipeline(site, channels, rate_hz, reports_levels=reports_levels))
        stacked = StackedRecording(tuple(member.recording for member in members))
        inputs.append(first if len(members) == 1 else TimedRecording(stacked, first.start_ns))
    return pipelines, inputs


def _members_of(site: Site, name: str, by_array: Mapping[str, AssignedRecording]) -> list[AssignedRecording]:
    """Return the recordings that make up one processed array; an empty list if it has none."""
    members = site.members(name)
    found = [by_array[member] for member in members if member in by_array]
    if name in by_array and name in site.joint:
        if found:
            raise DeviceError(
                f"array {name!r}: expected a recording of it or of {found[0].array!r}, got both; leave one out"
            )
        return [by_array[name]]
    if len(found) not in (0, len(members)):
        missing = next(member for member in members if member not in by_array)
        raise DeviceError(
            f"array {name!r}: joint processing expects a recording of each of {', '.join(members)}, got none of "
            f"{missing!r}; add it, or remove joint.{name}"
        )
    if len(found) > 1:
        _require_one_device(site, name, found)
    return found


def _require_one_device(site: Site, name: str, members: Sequence[AssignedRecording]) -> None:
    """Raise unless the members of a joint array were recorded together: one clock, start, length and rate."""
    nodes = {member.array: site.node_of(member.array) for member in members}
    try:  # an array without a node is known to share a clock only with arrays in the same file
        require_one_clock(name, {member.array: nodes[member.array] or member.recording.name for member in members})
    except ValueError as error:
        raise DeviceError(str(error)) from error
    first_ns = members[0].start_ns
    spans = [
        (member.start_ns - first_ns, member.recording.duration_s, member.recording.sample_rate_hz) for member in members
    ]
    if len(set(spans)) > 1:
        each = ", ".join(
            f"{member.recording.name} ({start_ns / 1e9:g} s, {duration_s:g} s, {rate_hz:g} Hz)"
            for member, (start_ns, duration_s, rate_hz) in zip(members, spans, strict=True)
        )
        raise DeviceError(
            f"array {name!r}: joint processing expects recordings of one start, length and sampling rate, "
            f"got {each}; record them through one device, or remove joint.{name}"
        )


def assign_files(
    site: Site,
    files: Mapping[str, Path | Sequence[Path]],
    channels: Mapping[str, Sequence[int]] | None = None,
    start_ns: int = 0,
) -> list[AssignedRecording]:
    """Return the recordings of arrays from files that begin at `start_ns` plus each array's `wav_offset_s`.

    Parameters
    ----------
    site : Site
    files : mapping of array name to Path or sequence of Path
        WAV or FLAC files. Several files of one array are its channels, such as one file for each microphone.
    channels : mapping of array name to channels, or None
        Channels counted from 1; `recording_channels` chooses them for arrays that are not named.
    start_ns : int
        Site time.

    Raises
    ------
    DeviceError
        One line for each file that does not fit.
    """
    wanted = channels or {}
    unknown = sorted(set(wanted) - set(files))
    if unknown:
        raise DeviceError(
            f"channels of array {unknown[0]!r}: expected an array with a recording ({', '.join(files)})"
            f"{did_you_mean(unknown[0], files) or '; give its recording, or leave its channels out'}"
        )
    given = [
        (name, (paths,) if isinstance(paths, Path) else tuple(paths), start_ns + _wav_offset_ns(site, name))
        for name, paths in files.items()
    ]
    return _assign(site, given, wanted, OpenFiles())


def _wav_offset_ns(site: Site, array: str) -> int:
    """Return an array's offset; all members of a joint array have the same one. 0 for an unknown array."""
    config = site.arrays.get(site.members(array)[0])
    return round(config.wav_offset_s * 1e9) if config else 0


def assign_sessions(site: Site, sessions: Iterable[Session]) -> list[AssignedRecording]:
    """Return the recordings of one or more sessions at their original times; each node records a session of its own.

    If the site file gives the inputs that an array was recorded from in another order than the session's own site file,
    its channels are taken in the order of the site file. Files without any sound, as a recorder leaves them that is
    killed just after a gap, are left out.

    Raises
    ------
    DeviceError
        One line for each file that does not fit.
    """
    sessions = list(sessions)
    files, given, skipped = OpenFiles(), [], []
    for session in sessions:
        for piece in session.pieces:
            path = session.path(piece)
            try:
                files.open(path)
            except EmptyFileError:
                skipped.append((piece.array, (path,), piece.start_ns))
                continue
            except DeviceError:
                pass  # it is reported together with the faults of the others
            given.append((piece.array, (path,), piece.start_ns))
    heard = {array for array, _, _ in given}
    for array, (path,), _ in skipped:
        if array in heard:
            files.notes.append(f"{path}: it holds no sound and is left out")
    given += [entry for entry in skipped if entry[0] not in heard]
    joint = {member for name in site.joint for member in site.members(name)}
    files.match_ends([(path, start_ns) for array, (path,), start_ns in given if array in joint])
    orders = _reordered(site, sessions, files)
    return _assign(site, given, {}, files, orders)


def _reordered(site: Site, sessions: Sequence[Session], files: OpenFiles) -> dict[str, list[int]]:
    """Return the channels of sessions, by array, where the site file gives the recorded inputs in another order.

    Raises
    ------
    DeviceError
        If sessions of one array were recorded in different orders, and the site file gives another than the session's.
    """
    wanted = {name: inputs for node in site.nodes.values() for name, inputs in node.arrays.items()}
    found: dict[str, list[int]] = {}
    for session in sessions:
        recorded = session.inputs()
        for array in dict.fromkeys(piece.array for piece in session.pieces):
            if array not in wanted:
                continue
            inputs = recorded.get(array, wanted[array])  # if they are not known, channels are as they were recorded
            if sorted(inputs) == sorted(wanted[array]) and len(set(inputs)) == len(inputs):
                order = [inputs.index(number) + 1 for number in wanted[array]]
            else:
                order = list(range(1, len(inputs) + 1))
                files.notes.append(
                    f"{session.directory}: array {array!r} was recorded from the inputs {_listed(inputs)}, and the "
                    f"site file gives {_listed(wanted[array])}; channels are taken as they were recorded: record again "
                    "to use the inputs of the site file"
                )
            if found.setdefault(array, order) != order:
                raise DeviceError(
                    f"{session.directory}: expected array {array!r} recorded in the order of the other sessions, got "
                    f"the inputs {_listed(inputs)}; give sessions of different wirings one by one"
                )
    return {array: order for array, order in found.items() if order != sorted(order)}


def _listed(inputs: Iterable[int]) -> str:
    return ", ".join(map(str, inputs))


def common_start_ns(now_ns: int, nodes: int) -> int:
    """Return the site time at which recordings begin when they are played in place of devices.

    It lies on the 50 ms grid of frames, so that frames are cut exactly as they are offline. With several nodes, which
    are separate processes, it is the next multiple of `COMMON_START_NS`: nodes started together begin together.
    """
    step_ns = FRAME_NS if nodes <= 1 else COMMON_START_NS
    return -(-now_ns // step_ns) * step_ns


def span_ns(recordings: Iterable[AssignedRecording]) -> tuple[int, int | None]:
    """Return the site times of the first start and of the last end; the end is None if a recording is looped."""
    assigned = list(recordings)
    begin_ns = min(item.start_ns for item in assigned)
    if any(item.recording.duration_s == float("inf") for item in assigned):
        return begin_ns, None
    return begin_ns, max(item.start_ns + round(item.recording.duration_s * 1e9) for item in assigned)


def looped(recordings: Iterable[AssignedRecording]) -> list[AssignedRecording]:
    """Return the same recordings, each repeated without end."""
    return [replace(assigned, recording=LoopedRecording(assigned.recording)) for assigned in recordings]


def recording_channels(site: Site, array: str, recording: Recording, wanted: Sequence[int] | None = None) -> list[int]:
    """Choose the channels (from 1) of a recording that are an array's microphones.

    These are the `wanted` channels, if given; all channels, if there are as many as microphones; else the array's
    channels on its node's device, if the recording has them; else the first channels.

    Raises
    ------
    DeviceError
        If channels or sampling rate do not fit the site.
    """
    expected = len(site.array(array).microphones_m)
    node = site.node_of(array)
    _check_rate(site, array, node, recording)
    if wanted is not None:
        if not len(wanted) == len(set(wanted)) == expected or min(wanted) < 1 or max(wanted) > recording.channels:
            from_zero = "; channels count from 1" if 0 in wanted else ""
            raise DeviceError(
                f"{recording.name}: expected {expected} different channel numbers from 1 to {recording.channels} "
                f"for array {array!r}, got {list(wanted)}{from_zero}"
            )
        return list(wanted)
    if recording.channels < expected:
        raise DeviceError(
            f"{recording.name}: expected {expected} channels, one for each microphone of array {array!r}, "
            f"got {recording.channels}{_several_files(array, expected) if recording.channels == 1 else ''}"
        )
    return _node_channels(site, array, recording) or list(range(1, expected + 1))


def _node_channels(site: Site, array: str, recording: Recording) -> list[int] | None:
    """Return an array's channels on its node's device; None if it has no node or the recording lacks channels."""
    node = site.node_of(array)
    if node is None or recording.channels <= len(site.array(array).microphones_m):
        return None
    captured = site.nodes[node].arrays
    numbers = [number for member in site.members(array) for number in captured[member]]
    return numbers if max(numbers) <= recording.channels else None


def _check_rate(site: Site, array: str, node: str | None, recording: Recording) -> None:
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


def _several_files(array: str, expected: int) -> str:
    names = ",".join(f"{number}.wav" for number in range(1, expected + 1))
    return f"; if each microphone has a file of its own, give them all: {array}={names}"


def _assign(
    site: Site,
    given: Sequence[tuple[str, tuple[Path, ...], int]],
    channels: Mapping[str, Sequence[int]],
    files: OpenFiles,
    orders: Mapping[str, Sequence[int]] | None = None,
) -> list[AssignedRecording]:
    """Open `given` (array, its files, start in ns); recordings of one array at several times become one with gaps.

    `orders` are channels of recordings that have no others.
    """
    segments: dict[str, list[TimedRecording]] = {}
    chosen: dict[str, tuple[int, ...]] = {}
    faults: list[str] = []
    for array, paths, start_ns in given:
        known = (*site.arrays, *site.joint)
        if array not in known:
            names = ",".join(map(str, paths))
            faults.append(f"{array}={names}: no such array; arrays are {', '.join(known)}{did_you_mean(array, known)}")
            continue
        try:
            recording = files.stacked(array, paths)
            order = (orders or {}).get(array)
            wanted = channels.get(array, order if order and len(order) == recording.channels else None)
            chosen[array] = tuple(recording_channels(site, array, recording, wanted))
            files.use(array, paths, chosen[array])
        except DeviceError as error:
            faults.append(str(error))
            continue
        if wanted is None and recording.channels > len(chosen[array]) and not _node_channels(site, array, recording):
            files.notes.append(
                f"{recording.name}: it has {recording.channels} channels; array {array!r} takes the first "
                f"{len(chosen[array])}, unless --channels {array}=… or a node of the site file names others"
            )
        first = segments.setdefault(array, [TimedRecording(recording, start_ns)])[0].recording
        if recording.sample_rate_hz != first.sample_rate_hz:
            faults.append(
                f"{recording.name}: expected {first.sample_rate_hz:g} Hz as in {first.name}, also of array {array!r}, "
                f"got {recording.sample_rate_hz:g} Hz; resample one of them"
            )
        elif recording is not first:
            segments[array].append(TimedRecording(recording, start_ns))
    if faults:
        raise DeviceError("\n".join(faults))
    files.log_notes()
    whole = {array: _spliced(found) for array, found in segments.items()}
    return [AssignedRecording(array, timed.recording, timed.start_ns, chosen[array]) for array, timed in whole.items()]


def _spliced(segments: Sequence[TimedRecording]) -> TimedRecording:
    if len(segments) == 1:
        return segments[0]
    ordered = sorted(segments, key=lambda segment: segment.start_ns)
    return TimedRecording(SplicedRecording(tuple(ordered)), ordered[0].start_ns)
