"""What commands may fail of: each error says it in words for whoever ran the command, and tells the exit code."""

from __future__ import annotations


class UseError(Exception):
    """What the user gave cannot be: arguments, a site file, recordings."""


class RunError(Exception):
    """What was asked for went wrong when it ran."""


class DeviceError(UseError):
    """A device or recording that cannot be used: what, expected, got, cure."""
