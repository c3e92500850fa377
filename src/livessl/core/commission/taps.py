"""Decides which microphone was tapped (`levels --tap`): sudden peaks of one input, far above all other inputs."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray

FRAME_S: Final = 0.01
"""Length of a frame in seconds. A tap begins within one."""

BACKGROUND_FRAMES: Final = 200
"""Frames before a tap whose median peak is the background: two seconds."""

LEAST_BACKGROUND_FRAMES: Final = 50
"""Frames after the beginning, or after a lasting change of level, in which nothing is reported."""

RISE_DB: Final = 20.0
"""Rise over the background, in decibels, that a tap exceeds. The largest peak of steady noise in an hour rises 6 dB."""

LEAST_DBFS: Final = -50.0
"""Least peak of a tap, dB re full scale."""

RISEN_DB: Final = 6.0
"""Rise from which another input counts as reached by the same sound."""

MARGIN_DB: Final = 10.0
"""Least difference, in decibels, between the tapped input and all others that the sound reached. A clap in the room
reaches all microphones of an array about equally."""

TAP_FRAMES: Final = 10
"""Frames from the onset in which peaks are compared: 0.1 s."""

SETTLED_DB: Final = 10.0
"""Rise below which the sound of a tap counts as over."""

LONGEST_FRAMES: Final = 100
"""Frames after a tap in which its sound must be over; a change of level that lasts longer is a new background."""


@dataclass(frozen=True, slots=True)
class Tap:
    """A sudden sound at one input, or at several.

    Parameters
    ----------
    time_s : float
        Its onset, in seconds of sound since the first sample.
    inputs : tuple of int
        Inputs within 10 dB of the loudest, counted from 0, the loudest first. One input is a tap; several are a sound
        in the room, or one signal on several inputs.
    peak_dbfs : float
        Peak of the loudest input, without its constant part, dB re full scale.
    rise_db : float
        Rise of the loudest input over its background, dB.
    margin_db : float or None
        Peak of the loudest input over that of the next input that the sound reached, dB; None if the sound reached no
        other input.
    """

    time_s: float
    inputs: tuple[int, ...]
    peak_dbfs: float
    rise_db: float
    margin_db: float | None


class TapDetector:
    """Finds taps in the samples of a device's inputs.

    Parameters
    ----------
    count : int
        Number of inputs, K.
    sample_rate_hz : float
    """

    def __init__(self, count: int, sample_rate_hz: float) -> None:
        self._frame = max(2, round(FRAME_S * sample_rate_hz))
        self._frame_s = self._frame / sample_rate_hz
        self._rest: Float32Array = np.zeros((count, 0), dtype=np.float32)
        self._background: deque[FloatArray] = deque(maxlen=BACKGROUND_FRAMES)
        self._before_db: FloatArray = np.zeros(count)
        self._tap: list[FloatArray] = []
        self._settling = 0
        self._frames = 0

    def push(self, samples: Float32Array) -> list[Tap]:
        """Take in the next samples (K, n); return the taps that they complete."""
        joined = np.concatenate([self._rest, samples], axis=1)
        whole = joined.shape[1] // self._frame
        self._rest = joined[:, whole * self._frame :].copy()
        frames = joined[:, : whole * self._frame].reshape(len(joined), whole, self._frame)
        half = 0.5 * (frames.max(axis=2, initial=-np.inf) - frames.min(axis=2, initial=np.inf)) if whole else None
        if half is None:
            return []
        peaks_db = 20.0 * np.log10(np.maximum(half, 1e-10))
        return [tap for column in peaks_db.T if (tap := self._take(column.astype(np.float64))) is not None]

    def _take(self, peaks_db: FloatArray) -> Tap | None:
        """Take in the peaks (K,) of the next frame; return the tap that it completes."""
        self._frames += 1
        if self._tap:
            self._tap.append(peaks_db)
            return self._judge() if len(self._tap) == TAP_FRAMES else None
        if self._settling:
            self._settling -= 1
            if (peaks_db < self._before_db + SETTLED_DB).all():
                self._settling = 0
            elif self._settling == 0:
                self._background.clear()
            return None
        if len(self._background) >= LEAST_BACKGROUND_FRAMES:
            median_db = np.median(self._background, axis=0)
            if ((peaks_db > median_db + RISE_DB) & (peaks_db > LEAST_DBFS)).any():
                self._before_db, self._tap = median_db, [peaks_db]
                return None
        self._background.append(peaks_db)
        return None

    def _judge(self) -> Tap:
        peaks_db = np.max(self._tap, axis=0)
        onset_s = (self._frames - TAP_FRAMES) * self._frame_s
        self._tap, self._settling = [], LONGEST_FRAMES
        rise_db = peaks_db - self._before_db
        # a channel that is loud all the time, such as one that hums, does not compete with the one that rose
        rank_db = np.where(rise_db > RISEN_DB, peaks_db, -np.inf)
        order = np.argsort(-rank_db, kind="stable")
        loudest = int(order[0])
        inputs = tuple(int(index) for index in order if rank_db[index] > rank_db[loudest] - MARGIN_DB)
        next_db = float(rank_db[order[1]]) if len(order) > 1 else -np.inf
        return Tap(
            onset_s,
            inputs,
            float(peaks_db[loudest]),
            float(rise_db[loudest]),
            float(peaks_db[loudest]) - next_db if np.isfinite(next_db) else None,
        )
