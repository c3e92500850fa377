"""Through the whole pipeline: sounds without any noise, and noise of arrays whose driver drops out again and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.types import Event, Float32Array
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import Scene, make_scene, render
from small_site import RATE_HZ, hiss, site_of

START_NS: Final = 1_767_225_600_000_000_000
ARRAYS: Final = ("north", "south")
SITE: Final = site_of(
    {
        "nodes": {
            name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
            for name, array in zip("ab", ARRAYS, strict=True)
        }
    }
)


def scene(sound: Float32Array, *, rt60_s: float, noise_dbfs: float, seed: int, lead_s: float) -> Scene:
    """Two equal sounds at random places in the small room."""
    made = make_scene(
        SITE.room.size_m,
        rt60_s=rt60_s,
        sounds=[("sound", sound)],
        count=2,
        sample_rate_hz=RATE_HZ,
        c_m_s=SITE.c_m_s,
        keep_away_m=[spec.centre_m for spec in SITE.specs],
        seed=seed,
        lead_s=lead_s,
        gap_s=1.5,
    )
    return replace(made, noise_dbfs=noise_dbfs)


def recordings(of: Scene) -> dict[str, Float32Array]:
    return {
        name: render(of, SITE.array(name).microphones_m, seed=number).copy()
        for number, name in enumerate(ARRAYS, start=1)
    }


def events(samples: dict[str, Float32Array]) -> list[Event]:
    parts = [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), samples[name]), START_NS, (1, 2, 3, 4))
        for name in samples
    ]
    return [output for output in offline.run(SITE, parts, UnpacedClock()) if isinstance(output, Event)]


def begins_s(event: Event) -> float:
    return (event.start_ns - START_NS) / 1e9


def ring(length_s: float) -> Float32Array:
    """A steady sound of many tones."""
    t_s = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
    tones = [np.sin(2 * np.pi * hz * t_s + hz) for hz in (620.0, 870.0, 1430.0, 2110.0, 2920.0, 3790.0, 4640.0)]
    return np.asarray(0.1 * sum(tones), dtype=np.float32)


@pytest.mark.parametrize(("length_s", "rt60_s", "seed"), [(0.8, 0.3, 11), (2.0, 0.6, 12), (2.7, 0.2, 13)])
def test_steady_sound_is_an_event_although_nothing_was_received_before(
    length_s: float, rt60_s: float, seed: int
) -> None:
    simulated = scene(ring(length_s), rt60_s=rt60_s, noise_dbfs=-np.inf, seed=seed, lead_s=0.6)
    found = events(recordings(simulated))
    assert len(found) == len(simulated.sources)
    for event, source in zip(found, simulated.sources, strict=True):
        assert begins_s(event) == pytest.approx(source.start_s, abs=0.1)
        assert set(event.heard_by) == set(ARRAYS)


@pytest.mark.parametrize("muted", [("north",), ARRAYS])
@pytest.mark.parametrize("seed", [21, 22])
def test_noise_of_arrays_that_drop_out_is_no_event(muted: Sequence[str], seed: int) -> None:
    simulated = scene(hiss(0.4, 1)[0], rt60_s=0.3, noise_dbfs=-45.0, seed=seed, lead_s=8.0)
    samples, rng = recordings(simulated), np.random.default_rng(seed)
    for name in muted:
        at_s = 0.0
        while at_s < 7.0:
            gap_s, noise_s = rng.choice([0.02, 0.2, 1.5]) * rng.uniform(0.5, 1.0, 2)
            samples[name][:, round(at_s * RATE_HZ) : round((at_s + gap_s) * RATE_HZ)] = 0.0
            at_s += gap_s + noise_s
    found = events(samples)
    assert len(found) == len(simulated.sources)
    for event, source in zip(found, simulated.sources, strict=True):
        assert begins_s(event) == pytest.approx(source.start_s, abs=0.1)
