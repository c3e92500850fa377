"""Finds the frames in which a sound begins, by which it was detected. It sees how loud frames were, and when.

Music, and a noise that begins after the sound, have onsets as clear as those of the sound, and nothing before the sound
shows that they are not it. The first frames of the sound do: a place from which nothing came when it began is that of
something else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from livessl.core.locate.estimator import Sound

FRAMES: Final = 4
"""Frames, 0.2 s, that a beginning has from the first active frame of any array on. They hold the first onset at every
array of a room, and little of what comes later."""

BEFORE: Final = 1
"""Frames before the first active one that belong to the beginning: the first foot of an onset is in them."""


def first_frame(sounds: Mapping[str, Sound]) -> int | None:
    """Return the frame index at which a sound begins at the first of the arrays; None if that is not known.

    It is not known without a pre-roll: the first frame of a window of a longer sound is no beginning.
    """
    courses = [sound.course for sound in sounds.values() if sound.course is not None and sound.onsets]
    begun = [course.begin for course in courses if course.frame_indices[0] < course.begin]
    return min(begun, default=None)


def beginning(sound: Sound, first: int | None) -> slice | None:
    """Return which of a sound's `onsets` belong to its beginning; None if that is not known, or if all of them do.

    Parameters
    ----------
    sound : Sound
        The sound of one array.
    first : int or None
        The `first_frame` of all arrays.
    """
    if first is None or sound.course is None:
        return None
    begin, end = np.searchsorted(sound.course.frame_indices, [first - BEFORE, first + FRAMES])
    return slice(int(begin), int(end)) if begin < end < len(sound.onsets) else None
