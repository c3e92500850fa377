"""Write the wire bytes of one message of each kind as JSON; run by unchanged.py with the code of either tree.

    python benchmarks/unchanged_wire.py [FILE]

FILE holds what another tree wrote: its bytes are decoded and encoded again here. Only `livessl.wire` is imported, and
fields are filled by their order, because modules and fields change their names between versions.
"""

from __future__ import annotations

import hashlib
import json
import random
import sys
from contextlib import suppress
from dataclasses import MISSING, fields
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

import livessl.wire

wire: Any = livessl.wire  # its names may move, and then this fails with a clear error

REQUESTED: Final = "requested frame"
"""Name of the frame that the server requested: its sequence number on the wire is 0, whatever field the class has."""

DAMAGED: Final = 100
"""Damaged variants of each message: enough to meet every check of the decoder with most messages."""

CHANNELS: Final = 4
SAMPLES: Final = 2205
"""A frame of 50 ms at 44.1 kHz."""


def main() -> int:
    """Print the messages by name in hexadecimal digits, and the outcome of decoding damaged ones."""
    built = {name: data.hex() for name, data in messages().items()}
    given = json.loads(Path(sys.argv[1]).read_text(encoding="ascii"))["built"] if sys.argv[1:] else built
    foreign = {name: bytes.fromhex(digits) for name, digits in given.items()}
    again = {name: wire.encode(wire.decode(data)).hex() for name, data in foreign.items()}
    print(json.dumps({"built": built, "again": again, "damaged": {n: damaged(n, d) for n, d in foreign.items()}}))
    return 0


def messages() -> dict[str, bytes]:
    """Return the bytes of each message; the requested frame is left out where this tree builds it in its own way."""
    samples = np.random.default_rng(1).uniform(-1.0, 1.0, (CHANNELS, SAMPLES)).astype(np.float32)
    frame = ("north", 7, 35_344_512_345, 1_767_225_617_250_000_123, 44_100.0, samples, 0.0123, True)
    powers = (1e-6, 2e-6, 0.0, 3.5e-6)
    built = {
        "frame": _filled(wire.Frame, frame),
        "mark": _filled(wire.Mark, ("south", 12, 35_344_512_346, 1.5e-6, 1e-6, powers, 3, 4, -12.5), "locked"),
        "mark, least": _filled(wire.Mark, ("süd", 0, -3, 0.0, 0.0, ())),
        "hello": wire.Hello("lab-pc", "run-1", {"north": 44_100.0, "south": 48_000.5}),
        "hello with answers": wire.Hello(
            "lab-pc", "run-1", {"north": 44_100.0}, True, "device is gone", {"north": (5, 17)}, True
        ),
        "ack": wire.Ack("run-1", {"north": 17, "south": 3}),
        "ack, all set": wire.Ack("run-1", {"north": 17}, 12, True, "unknown node"),
        "bye": wire.Bye("lab-pc", "run-1"),
        "request": wire.Request("run-1", {"north": (5, 17), "south": (-2, 3)}),
        "request, empty": wire.Request("run-1"),
    }
    encoded = {name: wire.encode(message) for name, message in built.items()}
    # if neither fits the class, this message is compared by decoding alone
    for sequence in (0, None):
        with suppress(Exception):
            encoded[REQUESTED] = wire.encode(_filled(wire.Frame, (frame[0], sequence, *frame[2:]), flag=True))
            break
    return encoded


def _filled(kind: type[Any], values: tuple[Any, ...], clock: str | None = None, *, flag: bool = False) -> Any:
    """Build a message of these values in the order of its fields.

    Parameters
    ----------
    clock : str or None
        Value of the field that is an enumeration; None leaves its default.
    flag : bool
        Value of a boolean field other than `active`, should the class have one.
    """
    given: dict[str, Any] = {}
    rest = iter(values)
    for field in fields(kind):
        if field.type in ("bool", bool) and field.name != "active":
            given[field.name] = flag
        elif isinstance(field.default, Enum):
            given[field.name] = field.default if clock is None else type(field.default)(clock)
        else:
            value = next(rest, MISSING)
            if value is not MISSING:
                given[field.name] = value
    return kind(**given)


def damaged(name: str, data: bytes) -> str:
    """Return a word for each damaged variant of a message: "refused", or the digest of what it is decoded to."""
    rng = random.Random(name)  # noqa: S311 - to repeat, not to hide
    return " ".join(_taken(_damage(rng, data)) for _ in range(DAMAGED))


def _damage(rng: random.Random, data: bytes) -> bytes:
    """Change one byte, mostly among the first, or cut or extend the message."""
    at = rng.randrange(min(len(data), rng.choice((20, 100, len(data)))))
    return rng.choice(
        (data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :],) * 4 + (data[:at], data + data[:at], data[at:])
    )


def _taken(data: bytes) -> str:
    try:
        return hashlib.sha256(wire.encode(wire.decode(data))).hexdigest()[:8]
    except ValueError:
        return "refused"


if __name__ == "__main__":
    sys.exit(main())
