"""Coverage-guided fuzzing of the wire: what goes from one line to another for the first time is kept.

The tracer of the interpreter tells which lines of `livessl.wire` and `livessl.wire_messages` a message passes; no other
library is needed. What is kept is damaged further, so the messages work their way past one check after the other.
"""

from __future__ import annotations

import random
import re
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import CodeType, FrameType
from typing import Any, Final

from mutation import mutated, originals

from livessl import wire, wire_messages

Function = tuple[str, int]
"""The file of a function and its first line."""

Edge = tuple[Function, int, int]
"""A function, a line of it, and the line before."""

TRACED: Final = (wire.__file__, wire_messages.__file__)
"""The files whose lines are followed."""

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

WORD: Final = re.compile(rb'"[^"]*"|-?[0-9.]+|true|false|null|\[[^]]*\]|\{[^{}]*\}')
"""A value or key of JSON."""


@dataclass
class Found:
    """Result: messages tried, edges passed, functions called, messages kept, and how often there was each outcome."""

    tried: int = 0
    edges: set[Edge] = field(default_factory=set)
    called: dict[Function, CodeType] = field(default_factory=dict)
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


def lines_missed(found: Found) -> list[tuple[str, int]]:
    """Return the lines, with their files, of the functions that were called that no message has passed."""
    seen = {(file, line) for (file, _), line, _ in found.edges}
    lines = {(file, line) for (file, first), code in found.called.items() for line in _lines(code) if line != first}
    return sorted(lines - seen)


def _lines(code: CodeType) -> set[int]:
    return {line for _, _, line in code.co_lines() if line is not None}


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
    sys.settrace(_tracer(edges, found.called))
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


def _tracer(edges: set[Edge], called: dict[Function, CodeType]) -> Callable[[FrameType, str, Any], Any]:
    """Return a tracer for `sys.settrace` that follows the functions of the wire, and of nothing else."""

    def call(frame: FrameType, event: str, value: Any) -> Any:
        code = frame.f_code
        if code.co_filename not in TRACED:
            return None
        function, last = (code.co_filename, code.co_firstlineno), 0
        called[function] = code

        def line(frame: FrameType, event: str, value: Any) -> Any:
            nonlocal last
            edges.add((function, frame.f_lineno, last))
            last = frame.f_lineno
            return line

        return line

    return call
