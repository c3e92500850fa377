"""Estimates the steady background of a sound, such as a fan, from the frames before it.

The pre-roll shows the part of the evidence that comes from the background. If the background is not far below the
sound, frames that are much weaker than the loudest one are mostly background, but their onsets count as much as others.
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
"""Power of a background relative to the sound, -13 dB and -10 dB, from which the background counts, and counts in full.
The reverberation of an earlier sound from the same place is usually weaker."""

LOUD: Final = 0.3
"""Least power of a loud frame relative to the loudest frame of the array: -5 dB."""


class _Known(NamedTuple):
    """Frames of the pre-roll with the background, the first frame that may have sound, and the background's weight."""

    frames: list[int]
    first: int
    counted: float


def background_lags(sound: Sound, frames: Sequence[int] | None = None) -> Float32Array | None:
    """Return the summed lags that frames of the background alone would have; None if the background is not known.

    A background that is `FAR_BELOW` these frames is ignored, because the weights of onsets say little about power.

    Parameters
    ----------
    sound : Sound
        The sound of one array.
    frames : sequence of int or None
        Which of the sound's `onsets`; None for all from the beginning of the sound on.
    """
    known = _known(sound, frames)
    if known is None:
        return None
    count = len(sound.onsets) - known.first if frames is None else len(frames)
    share = known.counted * count / len(known.frames)
    return np.float32(share) * np.asarray(summed([sound.onsets[k] for k in known.frames]).lags, dtype=np.float32)


def loud_frames(sound: Sound) -> Sequence[int]:
    """Return which of a sound's `onsets` are loud; none if the background is unknown, or `FAR_BELOW` the sound."""
    known = _known(sound)
    if known is None or sound.course is None:
        return ()
    powers = sound.course.powers[known.first :]
    return [known.first + int(k) for k in np.flatnonzero(powers >= LOUD * powers.max())]


def _known(sound: Sound, among: Sequence[int] | None = None) -> _Known | None:
    """Return the background in the pre-roll, without the last frames, in which the sound may begin; None if unknown.

    Its weight depends on the power of some of the sound's frames, or of all.

    It is unknown for envelopes: these are magnitudes, which do not cancel in noise and contain no place.
    """
    course = sound.course
    if course is None or not sound.onsets:
        return None
    first = int(np.searchsorted(course.frame_indices, course.begin - BEGINNING))
    frames = [k for k in range(first) if sound.onsets[k].weight > 0.0]  # not those in which the noise was learned
    if not frames or first == len(sound.onsets) or np.iscomplexobj(sound.onsets[0].lags):
        return None
    powers = course.powers[first:] if among is None else course.powers[list(among)]
    level = float(course.powers[frames].mean()) / max(float(powers.mean()), 1e-30)
    counted = min(1.0, (level - FAR_BELOW) / (COMPARABLE - FAR_BELOW))
    return _Known(frames, first, counted) if counted > 0.0 else None
