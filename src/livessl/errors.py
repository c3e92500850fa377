"""Errors that commands report: each message is complete, for the person who ran the command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


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
