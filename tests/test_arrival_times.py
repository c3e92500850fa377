"""Times between arrays of one clock are measured for no more arrays than one array may have microphones."""

from __future__ import annotations

import numpy as np

from livessl.arrival_times import arrival_times
from livessl.core.types import MAX_MICROPHONES
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from small_site import RATE_HZ, hiss


def test_a_node_may_have_more_arrays_than_are_compared() -> None:
    names = [f"array-{number}" for number in range(MAX_MICROPHONES + 1)]
    parts = [AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), hiss(1.0, 2)), 0, (1, 2)) for name in names]
    microphones = {name: np.array([[x, 0.0, 1.0], [x, 0.2, 1.0]]) for x, name in enumerate(names)}
    found = arrival_times(parts, microphones, [0.4], np.array([[4.0, 3.0, 1.0]]), 343.0, (300.0, 6000.0))
    assert found.arrays == tuple(names[:MAX_MICROPHONES])
    assert found.times_s.shape == (1, MAX_MICROPHONES)
