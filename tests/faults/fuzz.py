"""Coverage-guided fuzzing of the wire: what goes from one line to another for the first time is kept.

The tracer of the interpreter tells which lines of `livessl.wire` a message passes; no other library is needed. What is
kept is damaged further, so the messages work their way past one check after the other.
"""

from __future__ import annotations

import random
import re
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Final

from mutation import mutated, originals

from livessl import wire

Edge = tuple[int, int, int]
"""A function's first line, a line of it, and the line before."""

Decode = Callable[[bytes], wire.WireMessage]

NUMBERS: Final = (
    b"\x00",
    b"\x01",
    b"\x7f",
    b"\x80",
    b"\xff",
    b"\xff" * 4,
    b"\xff" * 8,
    b"\x00\x00\xc0\x7f",
    b"\x00" * 8,
)
WORDS: Final = (
    *(b"null", b"true", b"[]", b"{}", b'""', b"0", b"-1", b"1e999", b"NaN", b"9" * 30, b"1.5", b"[1, 2]", b"[2, 1]"),
    *(
        b'"x"',
        b'{"x": 1}',
        b'{"x": [1, 2]}',
        b'{"x": null}',
        b'"\\ud800"',
        b'"\\u0000"',
        b"[" * 2000,
        b'"' + b"y" * 70 + b'"',
    ),
)
"""What breaks readers of numbers and of JSON."""

TOO_LONG: Final = (wire.MAX_JSON_BYTES, wire.MAX_MESSAGE_BYTES)
"""Bytes put at the end, now and then."""

MOST_KEPT: Final = 10_000
"""Bytes of a message that is damaged further."""

DECODING: Final = (wire.decode, wire._decode_frame, wire._decode_mark, wire._decode_json, wire._name, wire._unpack)
"""What takes bytes apart."""

WORD: Final = re.compile(rb'"[^"]*"|-?[0-9.]+|true|false|null|\[[^]]*\]|\{[^{}]*\}')
"""A value or key of JSON."""


@dataclass
class Found:
    """What came of it: messages tried, edges passed, the messages kept for them, and how often each outcome."""

    tried: int = 0
    edges: set[Edge] = field(default_factory=set)
    kept: list[bytes] = field(default_factory=list)
    outcomes: Counter[str] = field(default_factory=Counter)


def fuzz(count: int, seed: int, decode: Decode = wire.decode) -> Found:
    """Try so many messages, each a damaged one of those kept; all that decode must encode to what decodes to the same.

    Anything but a message or a `WireError` is an exception that ends it.
    """
    rng = random.Random(seed)
    whole = originals()
    found = Found()
    for data in whole:
        _try(data, decode, found)
    while found.tried < count:
        data = rng.choice(whole if rng.random() < 0.5 else found.kept)
        data = mutated(rng, [data, *whole]) if rng.random() < 0.5 else _replaced(rng, data)
        if rng.random() < 0.001:
            data += bytes(rng.choice(TOO_LONG))
        _try(data, decode, found)
    return found


def lines_missed(found: Found) -> list[int]:
    """The lines that decoding can come to, and has not."""
    seen = [_frames(function) for function in DECODING]
    there = {line for lines in seen for line in lines}
    return sorted(there - {line for _, line, _ in found.edges})


def _frames(function: Callable[..., Any]) -> set[int]:
    """Lines of a function, but for its head."""
    code = function.__code__
    return {line for _, _, line in code.co_lines() if line is not None} - {code.co_firstlineno}


def _replaced(rng: random.Random, data: bytes) -> bytes:
    """With a word of it, or as many bytes as a number has, replaced by something that is hard to read."""
    words = [match.span() for match in WORD.finditer(data)]
    if words and rng.random() < 0.5:
        start, end = rng.choice(words)
        return data[:start] + rng.choice(WORDS) + data[end:]
    start, put = rng.randrange(len(data) + 1), rng.choice(NUMBERS)
    return data[:start] + put + data[start + len(put) :]


def _try(data: bytes, decode: Decode, found: Found) -> None:
    edges: set[Edge] = set()
    before = sys.gettrace()
    sys.settrace(_tracer(edges))
    try:
        message = decode(data)
        outcome = type(message).__name__
    except wire.WireError:
        message, outcome = None, "refused"
    finally:
        sys.settrace(before)
    if message is not None:
        again = wire.encode(message)
        assert wire.encode(wire.decode(again)) == again, data
    found.tried += 1
    found.outcomes[outcome] += 1
    if not edges <= found.edges:
        found.edges |= edges
        if 0 < len(data) < MOST_KEPT:
            found.kept.append(data)


def _tracer(edges: set[Edge]) -> Callable[[FrameType, str, Any], Any]:
    """For `sys.settrace`: follows the functions of the wire, and of nothing else."""

    def call(frame: FrameType, event: str, value: Any) -> Any:
        if frame.f_code.co_filename != wire.__file__:
            return None
        first, last = frame.f_code.co_firstlineno, 0

        def line(frame: FrameType, event: str, value: Any) -> Any:
            nonlocal last
            edges.add((first, frame.f_lineno, last))
            last = frame.f_lineno
            return line

        return line

    return call
