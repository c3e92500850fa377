"""Types of command-line arguments: each function turns a text into a value.

They are passed to argparse as `type`, and raise `ArgumentTypeError` with what was expected and what was given. Modules
that they need are imported when there is a value, so that help takes no time.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

T = TypeVar("T")

AXES: Final = 3
"""Number of coordinates of a place."""

MAX_RT60_S: Final = 5.0
"""Longest reverberation time that is simulated, in seconds.

The number of image sources grows with its cube: a longer one would take hours, and few rooms reverberate longer."""


MOST_COUNT: Final = 1_000_000_000
"""Largest count that is understood; a larger one is a slip."""

MOST_SEED: Final = 2**63 - 1
"""Largest random seed."""

RATES_HZ: Final = (100.0, 1e6)
"""Lowest and highest sampling rate, in hertz, that recorders have."""


def assignment(text: str) -> tuple[str, tuple[Path, ...]]:
    """Return the array name and the paths of `ARRAY=FILE` or `ARRAY=FILE,FILE,…`.

    The name of an existing file may have commas in it.
    """
    name, equals, paths = text.partition("=")
    files = (paths,) if os.path.lexists(paths) else tuple(paths.split(","))
    if not (name and equals and all(files)):
        raise argparse.ArgumentTypeError(f"expected ARRAY=FILE, got {text!r}")
    return name, tuple(map(Path, files))


def joint(text: str) -> tuple[str, list[str]]:
    """Return the name of a joint array and the names of its arrays from `NAME=ARRAY,ARRAY,…`."""
    name, _, members = text.partition("=")
    arrays = members.split(",")
    if not (name and len(arrays) > 1 and all(arrays)):
        raise argparse.ArgumentTypeError(f"expected NAME=ARRAY,ARRAY with two arrays or more, got {text!r}")
    return name, arrays


def channels(text: str) -> tuple[str, list[int]]:
    """Return the array name and the channel numbers of `ARRAY=1,2,3,4`."""
    name, equals, numbers = text.partition("=")
    try:
        channels = [int(number) for number in numbers.split(",")]
    except ValueError:
        channels = []
    if not (name and equals and channels):
        raise argparse.ArgumentTypeError(f"expected ARRAY=1,2,3,4, got {text!r}")
    return name, channels


def method(text: str) -> str:
    """Return the name of a localization method after checking that it is registered or has the form `MODULE:NAME`."""
    from livessl.core.methods import is_method, unknown_method

    if not is_method(text):
        raise argparse.ArgumentTypeError(unknown_method(text))
    return text


def endpoint(text: str) -> str:
    """Return a ZeroMQ address after checking that a socket can connect to it."""
    from livessl.site.addresses import check_endpoint

    return _read(text, check_endpoint)


def key(text: str) -> bytes:
    """Return the bytes of a public key in the form that `livessl keys` prints."""
    from livessl.site.keys import as_key

    return _read(text, as_key)


def time(text: str) -> int:
    """Return an RFC 3339 time as nanoseconds UTC."""
    from livessl.clock import recordable_ns

    return _read(text, recordable_ns)


def positive(text: str) -> int:
    """Return a whole number >= 1."""
    return _or_complain(_whole(text, MOST_COUNT) or None, text, "a whole number >= 1")


def place(text: str) -> tuple[float, float, float]:
    """Return a place in the form `x,y,z`, in metres."""
    parts = text.split(",")
    if len(parts) != AXES:
        raise argparse.ArgumentTypeError(f"expected x,y,z in metres, such as 2.5,3,1.2, got {text!r}")
    x, y, z = (_number(part, math.isfinite, "metres") for part in parts)
    return x, y, z


def count(text: str) -> int:
    """Return a whole number >= 0."""
    return _or_complain(_whole(text, MOST_COUNT), text, "a whole number >= 0")


def seed(text: str) -> int:
    """Return a random seed, which numpy wants to be 0 or more."""
    return _or_complain(_whole(text, MOST_SEED), text, f"a seed from 0 to {MOST_SEED}")


def sample_rate(text: str) -> float:
    """Return a sampling rate in hertz, within `RATES_HZ`."""
    low, high = RATES_HZ
    return _number(text, lambda value: low <= value <= high, f"a sampling rate from {low:g} to {high:,.0f} Hz")


def probability(text: str) -> float:
    """Return a number from 0 to 1."""
    return _number(text, lambda value: 0 <= value <= 1, "a number from 0 to 1")


def rt60(text: str) -> float:
    """Return a reverberation time in seconds, 0 to `MAX_RT60_S`."""
    return _number(text, lambda value: 0 <= value <= MAX_RT60_S, f"seconds from 0 to {MAX_RT60_S:g}")


def not_negative(text: str) -> float:
    """Return a finite number >= 0."""
    return _number(text, lambda value: value >= 0, "a number >= 0")


def above_zero(text: str) -> float:
    """Return a finite number > 0."""
    return _number(text, lambda value: value > 0, "a number > 0")


def speed(text: str) -> float:
    """Return a replay speed as a multiple of real time; 'max' gives infinity."""
    return float("inf") if text == "max" else _number(text, lambda value: value > 0, "a number > 0 or 'max'")


def _read(text: str, read: Callable[[str], T]) -> T:
    try:
        return read(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _whole(text: str, most: int) -> int | None:
    """Return a whole number from 0 to `most`; None for any other text."""
    digits = text.lstrip("0") or text[:1]  # Python refuses to read thousands of digits
    is_number = text.isascii() and text.isdigit() and len(digits) <= len(str(most))
    return int(digits) if is_number and int(digits) <= most else None


def _or_complain(value: int | None, text: str, expected: str) -> int:
    if value is None:
        raise argparse.ArgumentTypeError(f"expected {expected}, got {_shown(text)}")
    return value


def _shown(text: str) -> str:
    """Return a text as an error shows it: a very long one is cut."""
    longest = 40
    return repr(text) if len(text) <= longest else f"{text[:longest]!r}…"


def _number(text: str, valid: Callable[[float], bool], expected: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (valid(value) and value < float("inf")):
        raise argparse.ArgumentTypeError(f"expected {expected}, got {_shown(text)}")
    return value
