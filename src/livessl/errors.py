"""Errors that commands report, each with a complete message, and "did you mean …?" for a misspelt name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Return the known name that is most like a wrong one, as the end of a sentence; empty if none is."""
    from difflib import get_close_matches

    by_lower = {name.lower(): name for name in known}
    similar = get_close_matches(given.lower(), by_lower, 1)
    return f"; did you mean {by_lower[similar[0]]!r}?" if similar else ""


class UseError(Exception):
    """Arguments, a site file or recordings that cannot be used; a command exits with 2."""


class RunError(Exception):
    """A failure while a command runs; it exits with 1."""


class DeviceError(UseError):
    """A device or a recording that cannot be used: what, expected, got, cure."""


@dataclass(frozen=True)
class Fault:
    """One fault of a configuration: its place, and a sentence with what was expected, what was got, and the cure."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


class ConfigError(UseError):
    """All faults of a configuration at once."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        super().__init__("\n".join(str(fault) for fault in faults))
        self.faults = tuple(faults)
