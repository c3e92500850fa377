"""A voice in the room of the small site, as its arrays record it."""

from __future__ import annotations

import numpy as np

from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import make_scene, render
from livessl.simulation.sounds import voice
from small_site import RATE_HZ, site_of


def voiced(start_ns: int) -> list[AssignedRecording]:
    """What the arrays of the small site record of a voice in its room."""
    site = site_of()
    scene = make_scene(
        site.room.size_m,
        rt60_s=0.0,
        sounds=[("voice", voice(np.random.default_rng(1), RATE_HZ))],
        count=1,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=2,
        lead_s=0.7,
    )
    return [
        AssignedRecording(
            spec.name,
            MemoryRecording(spec.name, float(RATE_HZ), render(scene, spec.microphones_m, seed=n)),
            start_ns,
            (1, 2, 3, 4),
        )
        for n, spec in enumerate(site.specs)
    ]
