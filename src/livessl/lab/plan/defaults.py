"""Defaults of a plan. It imports nothing that takes time, so that the help of a command may use it."""

from __future__ import annotations

from typing import Final

CALIBRATION_M: Final = 0.002
"""Default error, in metres, of a microphone's position: a careful tape measurement. That of the paper left an
error of 0.7 mm."""
