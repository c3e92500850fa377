"""Finds the frames in which a sound begins, which show its source before music or a later noise mixes in.

Music, or a noise that starts after the sound, can have onsets just as clear, and the pre-roll does not reveal it. The
first frames do: if a place emitted nothing when the sound began, another source is there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from livessl.core.locate.estimator import Sound

FRAMES: Final = 4
"""Number of frames in a beginning, counted from the first active frame of any array: 0.2 s. They contain the first
onset at every array of a room, and little of the sound after it."""

BEFORE: Final = 1
"""Number of frames before the first active one that belong to the beginning, because an onset may start in them."""


def first_frame(sounds: Mapping[str, Sound]) -> int | None:
    """Return the frame index at which a sound begins at the array that it reaches first; None if it is not known.

    The frame index is not known if there is no pre-roll, because the first frame of a window can be in the middle of a
    longer sound.
    """
    courses = [sound.course for sound in sounds.values() if sound.course is not None and sound.onsets]
    begun = [course.begin for course in courses if course.frame_indices[0] < course.begin]
    return min(begun, default=None)


def beginning(sound: Sound, first: int | None) -> slice | None:
    """Return the slice of a sound's `onsets` that belong to its beginning; None if it is not known, or if all do.

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
