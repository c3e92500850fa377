"""The wire format between node and server: its bytes, its `VERSION`, its limits, and which messages are malformed.

A message of another version does not pass `decode`; `server/ingest.py` handles what does not.

A message is one ZeroMQ part: a fixed little-endian header (magic, version, kind, time of sending), then the body of its
kind. Samples travel as float32, so that a frame arrives bit for bit as it was cut. Messages with a JSON body are in
`wire_messages`.

A mark may end with sections: levels, the error of the drift, and the state of the node's machine. A node sends them
only to a server that has said in a `Welcome` that it reads sections, because older servers would refuse the mark. A
server skips sections that it does not know, so that later ones need no other agreement.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

import numpy as np

from livessl.core.types import MAX_MICROPHONES, MAX_SAMPLE, MIN_MICROPHONES, ClockState, Frame, Mark
from livessl.wire_messages import (
    MAX_FRAME_INDEX,
    MAX_JSON_BYTES,
    MAX_NAME_BYTES,
    MAX_RATE_HZ,
    SECTIONS,
    Ack,
    Bye,
    Hello,
    JsonMessage,
    OtherVersionError,
    Request,
    Welcome,
    WireError,
    decode_json,
    encode_json,
)
from livessl.wire_sections import SectionError, Sections, decode_sections, encode_sections

__all__ = [
    "MAX_FRAME_INDEX",
    "MAX_FRAME_SAMPLES",
    "MAX_JSON_BYTES",
    "MAX_MESSAGE_BYTES",
    "MAX_NAME_BYTES",
    "MAX_POWER",
    "MAX_RATE_HZ",
    "SECTIONS",
    "VERSION",
    "Ack",
    "Bye",
    "Hello",
    "OtherVersionError",
    "Request",
    "Welcome",
    "WireError",
    "WireMessage",
    "decode",
    "encode",
    "sent_ns",
    "stamped",
]

VERSION: Final = 2
"""Version of the format. Raise it with a change of the bytes that nodes and servers of the version before cannot read.
A server then refuses the greeting of a node of another version by an acknowledgement in that version
(`FIRST_LASTING_VERSION`); it drops the node's other messages. A new section of a mark needs no higher version, because
servers skip unknown ones."""

MAX_FRAME_SAMPLES: Final = 19_200
"""Most samples of a frame: twice the 9 600 samples of 50 ms at 192 kHz."""

MAX_POWER: Final = 1e80
"""Largest power: above any that float32 samples can have, and small enough that sums do not overflow."""

MAX_MESSAGE_BYTES: Final = 256 + 4 * MAX_MICROPHONES * MAX_FRAME_SAMPLES
"""Longest message, in bytes: a frame of 16 channels."""

_MAGIC: Final = b"LSSL"
_HEAD: Final = struct.Struct("<4sBBq")
_SENT: Final = struct.Struct("<q")
_SENT_AT: Final = _HEAD.size - _SENT.size
# name length, sequence, frame index, time, rate, power, active, channels, samples a channel
_FRAME: Final = struct.Struct("<BQqqdd?BI")
# name length, sequence, frame index, powers, overflows, lost frames, drift, clock state, channels
_MARK: Final = struct.Struct("<BQqddQQdBB")
_CLOCK_STATES: Final = tuple(ClockState)


WireMessage = Frame | Mark | Hello | Ack | Bye | Request | Welcome
_JSON_KINDS: Final[dict[int, type[JsonMessage]]] = {3: Hello, 4: Ack, 5: Bye, 6: Request, 7: Welcome}
_FRAME_KIND: Final = 1
_MARK_KIND: Final = 2
_HELLO_KIND: Final = 3


def encode(message: WireMessage, version: int = VERSION) -> bytes:
    """Return a message as bytes; another `version` is for the acknowledgement that refuses a node of that version."""
    if isinstance(message, Frame):
        return _encode_frame(message)
    if isinstance(message, Mark):
        return _encode_mark(message)
    kind = next(number for number, type_ in _JSON_KINDS.items() if isinstance(message, type_))
    return _head(kind, version) + encode_json(message)


def decode(data: bytes) -> WireMessage:
    """Return the message that some bytes hold.

    Raises
    ------
    WireError
        If they are not a whole, valid message of this version, `OtherVersionError` if they are of another version; no
        other exception is ever raised.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"message of {len(data)} bytes: expected at most {MAX_MESSAGE_BYTES}")
    if len(data) < _HEAD.size:
        raise WireError(f"message of {len(data)} bytes: expected at least a header of {_HEAD.size}")
    magic, version, kind, _ = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise WireError(f"expected a message of livessl beginning with {_MAGIC!r}, got {magic!r}")
    if version != VERSION:
        raise OtherVersionError(VERSION, version, data[_HEAD.size :] if kind == _HELLO_KIND else None)
    body = memoryview(data)[_HEAD.size :]
    if kind == _FRAME_KIND:
        return _decode_frame(body)
    if kind == _MARK_KIND:
        return _decode_mark(body)
    if kind in _JSON_KINDS:
        return decode_json(_JSON_KINDS[kind], bytes(body))
    raise WireError(f"expected a known kind of message, got {kind}")


def stamped(data: bytes, sent_ns: int) -> bytes:
    """Return an encoded message with the time of its sending, in ns of site time by the sender's clock."""
    return b"".join([data[:_SENT_AT], _SENT.pack(sent_ns), data[_HEAD.size :]])


def sent_ns(data: bytes) -> int:
    """Return the time at which an encoded message was sent, in ns by the sender's clock; 0 if it is unknown."""
    return int(_SENT.unpack_from(data, _SENT_AT)[0])


def _head(kind: int, version: int = VERSION) -> bytes:
    return _HEAD.pack(_MAGIC, version, kind, 0)


def _encode_frame(frame: Frame) -> bytes:
    name = _name_bytes(frame.array)
    channels, n = frame.samples.shape
    fixed = _FRAME.pack(
        len(name),
        0 if frame.requested else frame.sequence,
        frame.frame_index,
        frame.time_ns,
        frame.sample_rate_hz,
        frame.power,
        frame.active,
        channels,
        n,
    )
    return b"".join([_head(_FRAME_KIND), fixed, name, frame.samples.astype("<f4", copy=False).tobytes()])


def _decode_frame(body: memoryview) -> Frame:
    fixed = _unpack(_FRAME, body, "frame")
    name_length, sequence, frame_index, time_ns, rate, power, active, channels, n = fixed
    if not MIN_MICROPHONES <= channels <= MAX_MICROPHONES:
        raise WireError(f"frame: expected 2 to 16 channels, got {channels}")
    if not 0 < n <= MAX_FRAME_SAMPLES:
        raise WireError(f"frame: expected 1 to {MAX_FRAME_SAMPLES} samples, got {n}")
    if not (0 < rate <= MAX_RATE_HZ and 0 <= power <= MAX_POWER):
        raise WireError(
            f"frame: expected 0 < rate <= {MAX_RATE_HZ:g} Hz and 0 <= power <= {MAX_POWER:g}, got {rate} and {power}"
        )
    _check_frame_index(frame_index, "frame")
    name, start = _name(body, _FRAME.size, name_length)
    if len(body) - start != 4 * channels * n:
        raise WireError(f"frame: expected {4 * channels * n} bytes of samples, got {len(body) - start}")
    # copied once, so that the samples are aligned and the message can be freed
    samples = np.frombuffer(body, dtype="<f4", offset=start).reshape(channels, n).astype(np.float32)
    largest = max(float(samples.max()), -float(samples.min()))  # NaN if any sample is NaN
    if not math.isfinite(largest):
        raise WireError(f"frame of array {name!r}: samples hold NaN or infinity")
    if largest > MAX_SAMPLE:
        raise WireError(f"frame of array {name!r}: expected samples up to {MAX_SAMPLE:g}, got {largest:g}")
    return Frame(name, sequence, frame_index, time_ns, rate, samples, power, active, requested=sequence == 0)


def _encode_mark(mark: Mark) -> bytes:
    name = _name_bytes(mark.array)
    fixed = _MARK.pack(
        len(name),
        mark.sequence,
        mark.frame_index,
        mark.power,
        mark.noise_power,
        mark.overflows,
        mark.lost_frames,
        mark.drift_ppm,
        _CLOCK_STATES.index(mark.clock),
        len(mark.channel_power),
    )
    sections = Sections(mark.levels, mark.drift_error_ppm, mark.host)
    powers = np.asarray(mark.channel_power, dtype="<f8").tobytes()
    return b"".join([_head(_MARK_KIND), fixed, name, powers, encode_sections(sections)])


def _decode_mark(body: memoryview) -> Mark:
    fixed = _unpack(_MARK, body, "mark")
    name_length, sequence, frame_index, power, noise, overflows, lost, drift, clock, channels = fixed
    if clock >= len(_CLOCK_STATES) or channels > MAX_MICROPHONES:
        raise WireError(f"mark: expected a known clock state and at most 16 channels, got {clock} and {channels}")
    _check_frame_index(frame_index, "mark")
    name, start = _name(body, _MARK.size, name_length)
    end = start + 8 * channels
    if len(body) < end:
        raise WireError(f"mark: expected {8 * channels} bytes of channel powers, got {len(body) - start}")
    channel_power = tuple(np.frombuffer(body[start:end], dtype="<f8").tolist())
    if not all(0 <= value <= MAX_POWER for value in (power, noise, *channel_power)):
        raise WireError(f"mark of array {name!r}: expected powers from 0 to {MAX_POWER:g}")
    if not math.isfinite(drift):
        raise WireError(f"mark of array {name!r}: expected a finite drift, got {drift}")
    try:
        found = decode_sections(body[end:])
    except SectionError as error:
        raise WireError(f"mark of array {name!r}: {error}") from error
    return Mark(
        array=name,
        sequence=sequence,
        frame_index=frame_index,
        power=power,
        noise_power=noise,
        channel_power=channel_power,
        overflows=overflows,
        lost_frames=lost,
        drift_ppm=drift,
        clock=_CLOCK_STATES[clock],
        levels=found.levels,
        drift_error_ppm=found.drift_error_ppm,
        host=found.host,
    )


def _check_frame_index(frame_index: int, what: str) -> None:
    if abs(frame_index) > MAX_FRAME_INDEX:
        raise WireError(
            f"{what}: expected a frame index from -{MAX_FRAME_INDEX} to {MAX_FRAME_INDEX}, got {frame_index}"
        )


def _unpack(form: struct.Struct, body: memoryview, what: str) -> tuple[Any, ...]:
    if len(body) < form.size:
        raise WireError(f"{what} of {len(body)} bytes: expected at least {form.size}")
    return form.unpack_from(body)


def _name_bytes(name: str) -> bytes:
    data = name.encode()
    if not 0 < len(data) <= MAX_NAME_BYTES:
        raise ValueError(f"name {name!r}: expected 1 to {MAX_NAME_BYTES} bytes")
    return data


def _name(body: memoryview, start: int, length: int) -> tuple[str, int]:
    if not 0 < length <= MAX_NAME_BYTES or len(body) < start + length:
        raise WireError(f"expected a name of 1 to {MAX_NAME_BYTES} bytes, got {length}")
    try:
        return str(body[start : start + length], "utf-8"), start + length
    except UnicodeDecodeError as error:
        raise WireError("expected a name in UTF-8") from error
