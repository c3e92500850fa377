"""A campaign's job: its settings and sounds, and how they become rows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
from scipy.signal import butter, sosfilt

from livessl.lab.evaluate import localizer, noise, sessions, unit
from livessl.lab.evaluate.localizer import LocalizerSettings
from livessl.lab.evaluate.noise import NoiseSettings
from livessl.lab.evaluate.paper import Settings
from livessl.lab.evaluate.sessions import SessionSettings
from livessl.lab.evaluate.unit import Clips, Row
from livessl.simulation.scene import read_sounds

HIGH_PASS_HZ: Final = 100.0
"""Corner frequency of the clips' high-pass filter, in hertz: as in Allen and Berkley's rooms. Correlations begin there,
so the filter affects only which frames are active."""


class Unit(Protocol):
    """Turns the number of a position into its rows."""

    def rows(self, number: int) -> list[Row]:
        """Return all rows of a position."""
        ...


@dataclass(frozen=True)
class Job:
    """All that a worker needs; small enough to be sent to each worker once.

    Parameters
    ----------
    settings : Settings, LocalizerSettings, SessionSettings or NoiseSettings
    clips : Clips
    """

    settings: Settings | LocalizerSettings | SessionSettings | NoiseSettings
    clips: Clips

    @property
    def schema(self) -> pa.Schema:
        """Schema of the rows that `unit` makes."""
        match self.settings:
            case Settings():
                return unit.SCHEMA
            case LocalizerSettings():
                return localizer.SCHEMA
            case SessionSettings():
                return sessions.SCHEMA
            case NoiseSettings():
                return noise.SCHEMA

    def unit(self) -> Unit:
        """Prepare what turns the number of a position into its rows."""
        match self.settings:
            case Settings() as settings:
                return unit.Position(settings, self.clips)
            case LocalizerSettings() as settings:
                return localizer.LocalizerPosition(settings, self.clips)
            case SessionSettings() as settings:
                return sessions.SessionPosition(settings, self.clips)
            case NoiseSettings() as settings:
                return noise.NoisePosition(settings, self.clips)

    @property
    def digest(self) -> str:
        """Fingerprint of the sounds and of all settings except the number of positions."""
        known = self.settings.as_dict() | {"positions": None}
        hashed = hashlib.sha256(json.dumps(known, sort_keys=True).encode())
        for name, clips in sorted(self.clips.items()):
            for clip, samples in clips:
                hashed.update(f"{name}/{clip}".encode())
                hashed.update(samples.tobytes())
        return hashed.hexdigest()


def read_clips(directory: Path, classes: Iterable[str], sample_rate_hz: float) -> Clips:
    """Read the clips of each class: files named by class and number, as in `doorslam001.wav`.

    The clips are high-passed below the band. At 0 Hz all images of a room add up, and without the filter rumble would
    decide which frames are active.

    Raises
    ------
    ValueError
        If the folder holds no sound, or none of a class.
    """
    if not directory.is_dir():
        raise ValueError(f"--sounds {directory}: expected a folder of sounds, got no such folder")
    high_pass = butter(2, HIGH_PASS_HZ, "highpass", fs=sample_rate_hz, output="sos")
    found: dict[str, list[Any]] = {}
    for name, samples in read_sounds(directory, sample_rate_hz):
        filtered = np.asarray(sosfilt(high_pass, samples), dtype=np.float32)
        found.setdefault(name.rstrip("0123456789_-"), []).append((name, filtered))
    missing = [name for name in classes if name not in found]
    if missing:
        raise ValueError(
            f"--sounds {directory}: expected clips of {', '.join(missing)} (such as {missing[0]}001.wav), got the "
            f"classes {', '.join(sorted(found))}; name others with --classes"
        )
    return {name: tuple(found[name]) for name in classes}
