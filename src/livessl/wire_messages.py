"""Messages whose body is JSON: greetings, acknowledgements and requests, with the checks of their fields.

`wire` puts the header before them, and has the messages that carry samples and levels.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from livessl.core.types import FRAME_NS

MAX_NAME_BYTES: Final = 64
"""Longest array or node name, in bytes: the limit of the site file, which keeps headers short."""

MAX_RATE_HZ: Final = 384_000.0
"""Highest sampling rate, in Hz: no sound card is faster."""

MAX_FRAME_INDEX: Final = (2**63 - 1) // FRAME_NS - 1
"""Largest frame index: site times are 64-bit nanoseconds, which end in the year 2262."""

MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body, in bytes: greetings and acknowledgements take a few hundred."""

MAX_EXTENSIONS: Final = 64
"""Most extensions that a server may name."""

SECTIONS: Final = "mark-sections"
"""Extension: marks may end with sections."""


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


JsonMessage = Hello | Ack | Bye | Request | Welcome


def encode_json(message: JsonMessage) -> bytes:
    """Return the body of a message."""
    fields = asdict(message)
    if isinstance(message, Hello) and not message.answers:
        del fields["answers"]
    return json.dumps(fields, separators=(",", ":")).encode()


def decode_json(type_: type[JsonMessage], body: bytes) -> JsonMessage:
    """Return the message that a body holds.

    Raises
    ------
    WireError
        If it is not a whole, valid message of that type.
    """
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


_FIELDS: Final[dict[type[JsonMessage], dict[str, Any]]] = {
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
