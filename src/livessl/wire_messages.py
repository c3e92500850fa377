"""Messages whose body is JSON: greeting, acknowledgement, backfill request, good-bye; which of their fields are valid.

`wire` adds the header, and encodes the messages that carry samples and levels.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from livessl.core.types import FRAME_NS

MAX_NAME_BYTES: Final = 64
"""Longest name of an array or node, in bytes. The site file has the same limit, which keeps headers short."""

MAX_RATE_HZ: Final = 384_000.0
"""Highest sampling rate, in Hz; no sound card is faster."""

MAX_FRAME_INDEX: Final = (2**63 - 1) // FRAME_NS - 1
"""Largest frame index. Site times are 64-bit integers of nanoseconds, which reach to the year 2262."""

MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body, in bytes. Greetings and acknowledgements have a few hundred bytes."""

FIRST_LASTING_VERSION: Final = 2
"""First version whose header, acknowledgement, and `node`, `run_id` and `arrays` of a greeting stay as they are in all
later versions, so that a server can inform a node of another version that it is refused. A node of version 1 gets the
refusal in the server's version, and logs that the versions differ."""

MAX_EXTENSIONS: Final = 64
"""Largest number of extensions that a server may list."""

SECTIONS: Final = "mark-sections"
"""Name of the extension by which marks may end with sections."""


class WireError(ValueError):
    """Bytes that are not a valid message. The text says what was expected, and what was received."""


class OtherVersionError(WireError):
    """A message of another version of the format.

    Parameters
    ----------
    expected, version : int
        Version of this side, and of the message.
    greeting : bytes or None
        Body of the message if it is a greeting.

    Attributes
    ----------
    node, run_id : str
        Names in the greeting; "?" where it cannot be read.
    arrays : tuple of str
        Arrays in the greeting; empty where it cannot be read.
    """

    def __init__(self, expected: int, version: int, greeting: bytes | None) -> None:
        super().__init__(f"expected wire version {expected}, got {version}; run the same livessl on nodes and server")
        self.version = version
        self.reply_version = version if version >= FIRST_LASTING_VERSION else expected
        self.is_greeting = greeting is not None
        try:
            fields = json.loads(greeting) if greeting is not None and len(greeting) <= MAX_JSON_BYTES else None
        except (ValueError, RecursionError):
            fields = None
        known = fields if isinstance(fields, dict) else {}
        self.node, self.run_id = (known[key] if _is_name(known.get(key)) else "?" for key in ("node", "run_id"))
        arrays = known.get("arrays")
        self.arrays = tuple(filter(_is_name, arrays)) if isinstance(arrays, dict) else ()


@dataclass(frozen=True, slots=True)
class Hello:
    """A node's greeting.

    Parameters
    ----------
    node : str
        The node's name in the site file.
    run_id : str
        Identifier of the run. Every start of the node has a new one, and sequence numbers then begin again.
    arrays : dict of str to float
        The node's arrays and their sampling rates in Hz.
    replay : bool
        True if the frames have times in the past; the server then uses these times instead of its clock.
    problem : str or None
        The current problem of the node's device, in words; None if it has none.
    backlog : dict of str to (int, int)
        For each array that has frames from before this connection: the frame index of the oldest frame, and the frame
        index of the first live frame. The frames between the two are sent in order of time, in the bandwidth that live
        sound leaves. A further greeting reports that all of them have been sent.
    answers : bool
        True if the node answers backfill requests. The field is sent only to a server that has made such a request,
        because an older server would reject the greeting.
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
        The run of the node to which the message is addressed.
    received : dict of str to int
        For each array, the frame index up to which the server has all frames that the node sent. The node does not send
        these frames again while this server runs.
    settled : int or None
        Frame index before which all sound has become stored events, so that earlier frames are not needed again; None
        if there is no such frame index yet.
    who_are_you : bool
        True if the server does not know this connection, or if frames of the connection are missing. The node then
        greets and sends its frames again.
    refused : str or None
        Reason why the server refuses the node, in words; None if it does not refuse the node.
    """

    run_id: str
    received: dict[str, int]
    settled: int | None = None
    who_are_you: bool = False
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """The server's request for frames that a node did not send. The node sends these frames with sequence number 0.

    An empty request after a greeting announces that requests may follow. Nodes of older releases ignore requests.

    Parameters
    ----------
    run_id : str
        The run of the node to which the message is addressed.
    wanted : dict of str to (int, int)
        For each array, the first requested frame index and the frame index after the last requested one, both by the
        array's own clock.
    """

    run_id: str
    wanted: dict[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Bye:
    """A node's good-bye, sent when the node ends on purpose."""

    node: str
    run_id: str


@dataclass(frozen=True, slots=True)
class Welcome:
    """The server's list of the extensions of the protocol that it can read. Nodes of older releases ignore the message.

    Parameters
    ----------
    run_id : str
        The run of the node to which the message is addressed.
    reads : tuple of str
        Names of extensions, such as `SECTIONS`. Nodes ignore extensions that they do not know.
    """

    run_id: str
    reads: tuple[str, ...] = ()


JsonMessage = Hello | Ack | Bye | Request | Welcome


def encode_json(message: JsonMessage) -> bytes:
    """Encode a message as JSON, the body on the wire."""
    fields = asdict(message)
    if isinstance(message, Hello) and not message.answers:
        del fields["answers"]
    return json.dumps(fields, separators=(",", ":")).encode()


def decode_json(type_: type[JsonMessage], body: bytes) -> JsonMessage:
    """Decode a message of a given type from its body.

    Raises
    ------
    WireError
        If the body is not a complete and valid message of that type.
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
    """Return whether a value is text without lone surrogates, which JSON permits but UTF-8 cannot encode."""
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
