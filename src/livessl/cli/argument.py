"""What the words of a command line stand for: each takes a text and gives a value, or tells what was expected.

They are types of argparse, and raise its `ArgumentTypeError`.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from livessl.clock import utc_ns
from livessl.site import keys as keyring
from livessl.site.addresses import check_endpoint

T = TypeVar("T")

MAX_RT60_S: Final = 5.0
"""Images grow with the cube of the reverberation time: more would take hours, and few rooms ring longer."""


def assignment(text: str) -> tuple[str, tuple[Path, ...]]:
    """ARRAY=FILE or ARRAY=FILE,FILE,…: the array's name, and the files. A file may have commas in its name."""
    name, equals, paths = text.partition("=")
    files = (paths,) if os.path.lexists(paths) else tuple(paths.split(","))
    if not (name and equals and all(files)):
        raise argparse.ArgumentTypeError(f"expected ARRAY=FILE, got {text!r}")
    return name, tuple(map(Path, files))


def joint(text: str) -> tuple[str, list[str]]:
    """NAME=ARRAY,ARRAY,…: the name, and the arrays' names."""
    name, _, members = text.partition("=")
    arrays = members.split(",")
    if not (name and len(arrays) > 1 and all(arrays)):
        raise argparse.ArgumentTypeError(f"expected NAME=ARRAY,ARRAY with two arrays or more, got {text!r}")
    return name, arrays


def channels(text: str) -> tuple[str, list[int]]:
    """ARRAY=1,2,3,4: the array's name, and the numbers."""
    name, equals, numbers = text.partition("=")
    try:
        channels = [int(number) for number in numbers.split(",")]
    except ValueError:
        channels = []
    if not (name and equals and channels):
        raise argparse.ArgumentTypeError(f"expected ARRAY=1,2,3,4, got {text!r}")
    return name, channels


def endpoint(text: str) -> str:
    """A ZeroMQ address that one can connect to."""
    return _read(text, check_endpoint)


def key(text: str) -> bytes:
    """A public key of CURVE, as `livessl keys` tells it."""
    return _read(text, keyring.as_key)


def time(text: str) -> int:
    """RFC 3339: nanoseconds UTC."""
    return _read(text, utc_ns)


def positive(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 on, got {text!r}")
    return int(text)


def count(text: str) -> int:
    """A whole number from 0 on."""
    return int(_number(text, lambda value: value >= 0 and value.is_integer(), "a whole number from 0 on"))


def rt60(text: str) -> float:
    """A reverberation time, seconds."""
    return _number(text, lambda value: 0 <= value <= MAX_RT60_S, f"seconds from 0 to {MAX_RT60_S:g}")


def not_negative(text: str) -> float:
    """A number from 0 on."""
    return _number(text, lambda value: value >= 0, "a number >= 0")


def above_zero(text: str) -> float:
    """A number above 0."""
    return _number(text, lambda value: value > 0, "a number > 0")


def speed(text: str) -> float:
    """Times real time; 'max' is without end."""
    return float("inf") if text == "max" else _number(text, lambda value: value > 0, "a number > 0 or 'max'")


def _read(text: str, read: Callable[[str], T]) -> T:
    try:
        return read(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _number(text: str, valid: Callable[[float], bool], expected: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (valid(value) and value < float("inf")):
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")
    return value
