"""Through the whole pipeline: hum and a fan hide no sound, move none, and are no sources themselves."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.types import Event, Float32Array, Status
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.noise import fan
from livessl.simulation.scene import Source, render
from small_site import RATE_HZ, scene, site_of

SOUNDS = 3
START_S = 0.2
"""Seconds that are cut off, so that the fan runs already when the recording begins."""


@cache
def sounds(array: str) -> Float32Array:
    return render(scene(SOUNDS), site_of().array(array).microphones_m, seed=len(array))


@cache
def beside(array: str, seed: int) -> Float32Array:
    """A fan somewhere in the room, (4, n), with a root mean square of 1 at this array."""
    rng = np.random.default_rng(seed)
    place_m = rng.uniform([0.3, 0.3, 0.3], [3.7, 4.7, 2.7])
    blowing = Source("fan", 0.0, place_m, fan(rng, sounds(array).shape[1], RATE_HZ))
    alone = replace(scene(SOUNDS), sources=(blowing,), noise_dbfs=-200.0)
    samples = render(alone, site_of().array(array).microphones_m, seed=1)
    return np.asarray(samples / samples.std(), dtype=np.float32)


def located(noise: dict[str, Float32Array]) -> list[Event]:
    first = round(START_S * RATE_HZ)
    parts = [
        AssignedRecording(
            array,
            MemoryRecording(array, float(RATE_HZ), (sounds(array) + noise[array])[:, first:]),
            1_767_225_600_000_000_000,
            (1, 2, 3, 4),
        )
        for array in ("north", "south")
    ]
    return [event for event in offline.run(site_of(), parts, UnpacedClock()) if isinstance(event, Event)]


def check(events: list[Event], within_m: float) -> None:
    """Each sound is located where it was, and nothing else is."""
    assert [event.status for event in events] == [Status.LOCATED] * SOUNDS
    for event, source in zip(events, scene(SOUNDS).sources, strict=True):
        assert event.source == 1
        assert event.estimate is not None
        assert np.linalg.norm(event.estimate.position_m - source.position_m) < within_m


@pytest.mark.parametrize(
    ("hum_hz", "above_db"), [((50.0, 150.0), 0.0), ((60.0, 120.0, 180.0), 10.0), ((1000.0,), -10.0)], ids=str
)
def test_sounds_in_a_hum_are_located(hum_hz: tuple[float, ...], above_db: float) -> None:
    """The hum is the same at all microphones, as that of cables is, and up to 10 dB above the sounds' peaks."""
    times_s = np.arange(sounds("north").shape[1]) / RATE_HZ
    wave = sum(np.sin(2 * np.pi * each * times_s) for each in hum_hz) / len(hum_hz)
    level = float(np.abs(sounds("north")).max()) * 10.0 ** (above_db / 20.0)
    assert level < 5.0
    hum = np.asarray(level * wave, dtype=np.float32)
    check(located({"north": hum, "south": hum}), 0.1)


@pytest.mark.parametrize(("seed", "below_db"), [(1, 26.0), (2, 36.0), (3, 46.0)])
def test_a_fan_is_no_source(seed: int, below_db: float) -> None:
    level = float(sounds("north").std()) * 10.0 ** (-below_db / 20.0) * 3.0  # the sounds fill a ninth of the time
    check(located({array: level * beside(array, seed) for array in ("north", "south")}), 0.1)
