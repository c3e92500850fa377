"""Messages as bytes: encoding, decoding, version, limits and validation. It knows no socket.

A message is one ZeroMQ part: a fixed little-endian header (magic, version, kind, time of sending), then the body of its
kind. Samples travel as float32, so that a frame arrives bit for bit as it was cut.

A mark may end with sections: levels, the error of the drift, and the state of the node's machine. A node sends them
only to a server that has said in a `Welcome` that it reads sections, because older servers would refuse the mark. A
server skips sections that it does not know, so that later ones need no other agreement.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from livessl.core.types import FRAME_NS, MAX_MICROPHONES, MAX_SAMPLE, MIN_MICROPHONES, ClockState, Frame, Mark
from livessl.wire_sections import SectionError, Sections, decode_sections, encode_sections

VERSION: Final = 2

MAX_NAME_BYTES: Final = 64
"""Longest array or node name, in bytes: the limit of the site file, which keeps headers short."""

MAX_FRAME_SAMPLES: Final = 19_200
"""Most samples of a frame: twice the 9 600 samples of 50 ms at 192 kHz."""

MAX_RATE_HZ: Final = 384_000.0
"""Highest sampling rate, in Hz: no sound card is faster."""

MAX_POWER: Final = 1e80
"""Largest power: above any that float32 samples can have, and small enough that sums do not overflow."""

MAX_FRAME_INDEX: Final = (2**63 - 1) // FRAME_NS - 1
"""Largest frame index: site times are 64-bit nanoseconds, which end in the year 2262."""

MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body, in bytes: greetings and acknowledgements take a few hundred."""

MAX_EXTENSIONS: Final = 64
"""Most extensions that a server may name."""

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


class WireError(ValueError):
    """Bytes that are not a valid message: what was expected, and what was got."""


@dataclass(frozen=True, slots=True)
class Hello:
    """A node's greeting.

    Parameters
    ----------
    node : str
        The node's name in the site file.
    run_id : str
        A new one at every start, after which sequence numbers begin again.
    arrays : dict of str to float
        The node's arrays and their sampling rates in Hz.
    replay : bool
        True if the frames carry past times, which the server shall follow instead of its clock.
    problem : str or None
        The present problem of the node's device, in words.
    backlog : dict of str to (int, int)
        For each array with frames from before this connection, the frame index of the oldest, and that of the first
        live frame. Frames between them come in order of time in the bandwidth that live sound leaves; another greeting
        reports that all of them have been sent.
    answers : bool
        True if the node answers backfill requests. It is sent only to a server that has made one, because an older
        server would reject the greeting.
    """

    node: str
    run_id: str
    arrays: dict[str, float]
    replay: bool = False
    problem: str | None = None
    backlog: dict[str, tuple[int, int]] = field(default_factory=dict)
    answers: bool = False


@dataclass(frozen=True, slots=True)
class Ack:
    """The server's acknowledgement, which is also its sign of life.

    Parameters
    ----------
    run_id : str
        The run of the node that is addressed.
    received : dict of str to int
        For each array, the frame index up to which the server has all frames that the node sent: they need not be
        sent again while this server runs.
    settled : int or None
        Frame index before which all sound has become stored events: no frame before it is needed again.
    who_are_you : bool
        True if the server does not know this connection, or misses frames of it: the node shall greet and send again.
    refused : str or None
        Reason for which the server refuses the node.
    """

    run_id: str
    received: dict[str, int]
    settled: int | None = None
    who_are_you: bool = False
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """A request of the server for frames that a node did not send. They are sent with the sequence number 0.

    An empty request, after a greeting, announces that others may follow. Nodes that do not know requests ignore them.

    Parameters
    ----------
    run_id : str
        The run of the node that is addressed.
    wanted : dict of str to (int, int)
        For each array, by its own clock, the first frame index and the one after the last.
    """

    run_id: str
    wanted: dict[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Bye:
    """A node's good-bye: it ends on purpose."""

    node: str
    run_id: str


@dataclass(frozen=True, slots=True)
class Welcome:
    """A server's statement of what it reads beyond this version of the protocol. Older nodes ignore it.

    Parameters
    ----------
    run_id : str
        The run of the node that is addressed.
    reads : tuple of str
        Names of extensions, such as `SECTIONS`; nodes ignore those that they do not know.
    """

    run_id: str
    reads: tuple[str, ...] = ()


SECTIONS: Final = "mark-sections"
"""Extension: marks may end with sections."""

WireMessage = Frame | Mark | Hello | Ack | Bye | Request | Welcome
_Json = Hello | Ack | Bye | Request | Welcome
_JSON_KINDS: Final[dict[int, type[_Json]]] = {3: Hello, 4: Ack, 5: Bye, 6: Request, 7: Welcome}
_FRAME_KIND: Final = 1
_MARK_KIND: Final = 2


def encode(message: WireMessage) -> bytes:
    """Return a message as bytes."""
    if isinstance(message, Frame):
        return _encode_frame(message)
    if isinstance(message, Mark):
        return _encode_mark(message)
    kind = next(number for number, type_ in _JSON_KINDS.items() if isinstance(message, type_))
    fields = asdict(message)
    if isinstance(message, Hello) and not message.answers:
        del fields["answers"]
    return _head(kind) + json.dumps(fields, separators=(",", ":")).encode()


def decode(data: bytes) -> WireMessage:
    """Return the message that some bytes hold.

    Raises
    ------
    WireError
        If they are not a whole, valid message of this version; no other exception is ever raised.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"message of {len(data)} bytes: expected at most {MAX_MESSAGE_BYTES}")
    if len(data) < _HEAD.size:
        raise WireError(f"message of {len(data)} bytes: expected at least a header of {_HEAD.size}")
    magic, version, kind, _ = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise WireError(f"expected a message of livessl beginning with {_MAGIC!r}, got {magic!r}")
    if version != VERSION:
        raise WireError(f"expected wire version {VERSION}, got {version}; run the same livessl on nodes and server")
    body = memoryview(data)[_HEAD.size :]
    if kind == _FRAME_KIND:
        return _decode_frame(body)
    if kind == _MARK_KIND:
        return _decode_mark(body)
    if kind in _JSON_KINDS:
        return _decode_json(_JSON_KINDS[kind], bytes(body))
    raise WireError(f"expected a known kind of message, got {kind}")


def stamped(data: bytes, sent_ns: int) -> bytes:
    """Return an encoded message with the time of its sending, in ns of site time by the sender's clock."""
    return b"".join([data[:_SENT_AT], _SENT.pack(sent_ns), data[_HEAD.size :]])


def sent_ns(data: bytes) -> int:
    """Return the time at which an encoded message was sent, in ns by the sender's clock; 0 if it is unknown."""
    return int(_SENT.unpack_from(data, _SENT_AT)[0])


def _head(kind: int) -> bytes:
    return _HEAD.pack(_MAGIC, VERSION, kind, 0)


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


def _decode_json(type_: type[_Json], body: bytes) -> WireMessage:
    what = type_.__name__.lower()
    if len(body) > MAX_JSON_BYTES:
        raise WireError(f"{what} of {len(body)} bytes: expected at most {MAX_JSON_BYTES}")
    try:
        fields = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise WireError(f"{what}: not valid JSON") from error
    checks = _FIELDS[type_]
    if type_ is Hello and isinstance(fields, dict):
        fields.setdefault("answers", False)
    if not isinstance(fields, dict) or set(fields) != set(checks):
        raise WireError(f"{what}: expected the fields {', '.join(checks)}")
    for name, valid in checks.items():
        if not valid(fields[name]):
            raise WireError(f"{what}: field {name!r} has a wrong type or value")
    for name in {"backlog", "wanted"} & fields.keys():
        fields[name] = {array: tuple(frame_indices) for array, frame_indices in fields[name].items()}
    if type_ is Welcome:
        fields["reads"] = tuple(fields["reads"])
    return type_(**fields)


def _check_frame_index(frame_index: int, what: str) -> None:
    if abs(frame_index) > MAX_FRAME_INDEX:
        raise WireError(
            f"{what}: expected a frame index from -{MAX_FRAME_INDEX} to {MAX_FRAME_INDEX}, got {frame_index}"
        )


def _is_unicode(value: Any) -> bool:
    """Return True for text without lone surrogates, which are valid in JSON but cannot be encoded again."""
    return isinstance(value, str) and not any("\ud800" <= character <= "\udfff" for character in value)


def _is_name(value: Any) -> bool:
    return _is_unicode(value) and 0 < len(value.encode()) <= MAX_NAME_BYTES


def _is_text(value: Any) -> bool:
    return value is None or (_is_unicode(value) and len(value) <= 1000)


def _is_rate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= MAX_RATE_HZ


def _is_frame_index(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_FRAME_INDEX


def _is_span(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_frame_index, value)) and value[0] < value[1]


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool)


def _is_map_of(valid: Any) -> Any:
    return lambda value: isinstance(value, dict) and all(_is_name(k) and valid(v) for k, v in value.items())


_FIELDS: Final[dict[type[_Json], dict[str, Any]]] = {
    Hello: {
        "node": _is_name,
        "run_id": _is_name,
        "arrays": _is_map_of(_is_rate),
        "replay": _is_flag,
        "problem": _is_text,
        "backlog": _is_map_of(_is_span),
        "answers": _is_flag,
    },
    Ack: {
        "run_id": _is_name,
        "received": _is_map_of(_is_frame_index),
        "settled": lambda value: value is None or _is_frame_index(value),
        "who_are_you": _is_flag,
        "refused": _is_text,
    },
    Bye: {"node": _is_name, "run_id": _is_name},
    Request: {"run_id": _is_name, "wanted": _is_map_of(_is_span)},
    Welcome: {
        "run_id": _is_name,
        "reads": lambda value: isinstance(value, list) and len(value) <= MAX_EXTENSIONS and all(map(_is_name, value)),
    },
}


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
