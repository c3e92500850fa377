"""Through the whole pipeline: a sound that begins softly is no background of its own loud part."""

from __future__ import annotations

import numpy as np
import pytest

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.types import Event, Float32Array
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import make_scene, render
from small_site import RATE_HZ, site_of

RT60_S = 0.4
COUNT = 4
NEAR_M = 0.3


def swelling(seed: int, soft_s: float, below_db: float) -> Float32Array:
    """Soft strokes, each an onset, and then loud ones, which decay."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(round((soft_s + 0.4) * RATE_HZ)) / RATE_HZ
    strokes = rng.standard_normal(len(times_s)) * np.exp(-(times_s % 0.06) / 0.01)
    loud = np.exp(-(times_s - soft_s) / 0.15)
    samples = 0.3 * strokes * np.where(times_s < soft_s, 10.0 ** (-below_db / 20.0), loud)
    return np.asarray(samples, dtype=np.float32)


@pytest.mark.parametrize("below_db", [11.0, 14.0, 18.0])
@pytest.mark.parametrize("soft_s", [0.3, 0.7])
def test_sounds_that_begin_softly_are_located(soft_s: float, below_db: float) -> None:
    site, seed = site_of(), round(10 * (soft_s + below_db))
    scene = make_scene(
        site.room.size_m,
        rt60_s=RT60_S,
        sounds=[(f"swelling-{k}", swelling(seed + k, soft_s, below_db)) for k in range(COUNT)],
        count=COUNT,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=seed,
    )
    parts = [
        AssignedRecording(
            spec.name,
            MemoryRecording(spec.name, float(RATE_HZ), render(scene, spec.microphones_m, seed=number)),
            0,
            (1, 2, 3, 4),
        )
        for number, spec in enumerate(site.specs)
    ]
    events = [each for each in offline.run(site, parts, UnpacedClock()) if isinstance(each, Event)]
    for source in scene.sources:
        event = min(events, key=lambda each: abs(each.start_ns / 1e9 - source.start_s))
        assert event.estimate is not None, event.reason
        assert np.linalg.norm(event.estimate.position_m - source.position_m) < NEAR_M
