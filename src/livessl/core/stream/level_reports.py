"""Makes a node's reports of channel levels, one for each second, which marks carry to the server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from livessl.core.commission.levels import LevelMeter
from livessl.core.types import ChannelLevel, Float32Array, IntArray

REPORT_S: Final = 1.0
"""Interval of reports, in seconds of sound. Each report has the levels of this interval, so that no sound is left
out."""


class LevelReports:
    """Meters a device's channels for the arrays on it.

    Parameters
    ----------
    arrays : mapping of array name to (K,) int64
        Device channels (from 0) of each array, in the order of its microphones.
    sample_rate_hz : float
    """

    def __init__(self, arrays: Mapping[str, IntArray], sample_rate_hz: float) -> None:
        used = sorted({index for channels in arrays.values() for index in channels.tolist()})
        self._used = used
        self._channels = {name: [used.index(index) for index in of.tolist()] for name, of in arrays.items()}
        self._meter = LevelMeter(len(used), sample_rate_hz, list(self._channels.values()))
        self._every = round(REPORT_S * sample_rate_hz)
        self._parts: list[Float32Array] = []  # metered together, because metering each by itself takes twice as long
        self._samples = 0
        self._waiting: dict[str, tuple[ChannelLevel, ...]] = {}

    def push(self, samples: Float32Array) -> None:
        """Take in the next samples (channels, n) of the device."""
        self._parts.append(samples[self._used])
        self._samples += samples.shape[1]
        if self._samples < self._every:
            return
        self._meter.push(np.concatenate(self._parts, axis=1))
        self._parts.clear()
        self._samples = 0
        levels = self._meter.recent()
        for array, channels in self._channels.items():
            new = [_reported(levels[index]) for index in channels]
            before = self._waiting.get(array, new)
            self._waiting[array] = tuple(
                replace(now, peak_dbfs=max(now.peak_dbfs, then.peak_dbfs))
                for now, then in zip(new, before, strict=True)
            )

    def take(self, array: str) -> tuple[ChannelLevel, ...]:
        """Return the report of an array that was not taken yet; an empty report if there is none."""
        return self._waiting.pop(array, ())


def _reported(level: ChannelLevel) -> ChannelLevel:
    """Return the figures of a level that are reported: all but the words for its faults, which the server chooses."""
    return ChannelLevel(
        level.peak_dbfs,
        level.rms_dbfs,
        level.clipped,
        level.mean,
        level.hum_hz,
        level.hum_dbfs,
        level.noise_dbfs,
        level.noise_over_db,
    )
