"""Estimates the background of a sound from the frames before it. It sees the power of frames, and their correlations.

What a background adds to the evidence is known from the pre-roll. Where it is not far below the sound, frames that are
much weaker than the loudest are mostly background, but their onsets count as much as those of loud frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from livessl.core.correlate.onset_gcc import summed
from livessl.core.locate.estimator import Sound
from livessl.core.locate.frame_gccs import BEGINNING
from livessl.core.types import Float32Array

FAR_BELOW: Final = 0.05
COMPARABLE: Final = 0.1
"""Power of a background relative to that of the sound, 13 and 10 dB below, from which on it counts, and counts in full.
What a room still gives of an earlier sound from the same place is usually weaker."""

LOUD: Final = 0.3
"""Least power of a loud frame, relative to the loudest frame of the array: 5 dB below it."""


class _Known(NamedTuple):
    """Frames of the pre-roll that show the background, the first frame that may have sound, and how much it counts."""

    frames: list[int]
    first: int
    counted: float


def background_lags(sound: Sound, frames: int | None = None) -> Float32Array | None:
    """Lags that frames of a sound would add up to if its background had gone on alone; None if it is not known.

    The weights of onsets say little about power, so that a background `FAR_BELOW` the sound is left out.

    Parameters
    ----------
    sound : Sound
        The sound of one array.
    frames : int or None
        The number of these frames; None for all from the beginning of the sound on.
    """
    known = _known(sound)
    if known is None:
        return None
    share = known.counted * (frames or len(sound.onsets) - known.first) / len(known.frames)
    return np.float32(share) * np.asarray(summed([sound.onsets[k] for k in known.frames]).lags, dtype=np.float32)


def loud_frames(sound: Sound) -> Sequence[int]:
    """Return which of a sound's `onsets` are loud; none where the background is unknown, or `FAR_BELOW` the sound."""
    known = _known(sound)
    if known is None or sound.course is None:
        return ()
    powers = sound.course.powers[known.first :]
    return [known.first + int(k) for k in np.flatnonzero(powers >= LOUD * powers.max())]


def _known(sound: Sound) -> _Known | None:
    """Return what is known of the background, from the pre-roll without its last frames, in which the sound may begin.

    Envelopes are magnitudes: those of noise do not cancel, and say nothing about a place.
    """
    course = sound.course
    if course is None or not sound.onsets:
        return None
    first = int(np.searchsorted(course.frame_indices, course.begin - BEGINNING))
    frames = [k for k in range(first) if sound.onsets[k].weight > 0.0]  # not those in which the noise was learned
    if not frames or first == len(sound.onsets) or np.iscomplexobj(sound.onsets[0].lags):
        return None
    level = float(course.powers[frames].mean()) / max(float(course.powers[first:].mean()), 1e-30)
    counted = min(1.0, (level - FAR_BELOW) / (COMPARABLE - FAR_BELOW))
    return _Known(frames, first, counted) if counted > 0.0 else None
