"""Clocks that differ by more than a sound's length: found by the sounds that come again, and only where they do."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.core.commission.clocks import LEAST_MATCHES, find_clock_faults
from livessl.examination import examine_parts
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import render
from small_site import RATE_HZ, scene, site_of

OFFSETS_S = st.floats(0.35, 40.0) | st.floats(-40.0, -0.35)


def starts_s(seed: int, count: int = 10) -> np.ndarray:
    """When some sounds began, at irregular intervals."""
    return np.cumsum(0.8 + np.random.default_rng(seed).exponential(4.0, count))


@given(seed=st.integers(0, 10_000), off_s=OFFSETS_S, lost=st.sets(st.integers(0, 9), max_size=2))
def test_clocks_that_differ_are_named_with_the_difference(seed: int, off_s: float, lost: set[int]) -> None:
    """Either array may miss some sounds, and detects the others up to a frame earlier or later."""
    rng = np.random.default_rng(seed)
    sounds_s = starts_s(seed)
    other_s = np.delete(sounds_s, sorted(lost)) + off_s + rng.choice([0.0, 0.05], 10 - len(lost))
    [finding] = find_clock_faults({"hall-pc": sounds_s.tolist(), "lab-pc": other_s.tolist()})
    assert finding.fault == "clock"
    assert f"clock of 'lab-pc' is {abs(off_s):.0f}"[:-2] in finding.message
    told_s = float(finding.message.split(" is ")[1].split(" s ")[0])
    assert told_s == pytest.approx(abs(off_s), abs=0.15)
    assert ("ahead of" if off_s > 0.0 else "behind") in finding.message


@given(seed=st.integers(0, 10_000), off_s=st.floats(-0.25, 0.25), count=st.integers(0, 20))
def test_clocks_that_agree_are_not_named(seed: int, off_s: float, count: int) -> None:
    sounds_s = starts_s(seed, count)
    assert list(find_clock_faults({"hall-pc": sounds_s.tolist(), "lab-pc": (sounds_s + off_s).tolist()})) == []


def test_a_long_session_takes_little_memory_and_its_sounds_are_counted_once() -> None:
    sounds_s = np.cumsum(0.3 + np.random.default_rng(1).exponential(1.5, 20_000))
    tracemalloc.start()
    [finding] = find_clock_faults({"hall-pc": sounds_s.tolist(), "lab-pc": (sounds_s + 1.0).tolist()})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100e6
    assert "20000 sounds come again" in finding.message


@given(seed=st.integers(0, 10_000), one=st.integers(0, 12), other=st.integers(0, 12))
def test_unrelated_sounds_say_nothing_about_clocks(seed: int, one: int, other: int) -> None:
    sounds = {"hall-pc": starts_s(seed, one).tolist(), "lab-pc": starts_s(seed + 20_000, other).tolist()}
    assert list(find_clock_faults(sounds)) == []


@given(period_s=st.floats(0.4, 5.0), off_s=OFFSETS_S)
def test_sounds_at_equal_intervals_say_nothing_about_clocks(period_s: float, off_s: float) -> None:
    sounds_s = period_s * np.arange(12)
    found = list(find_clock_faults({"hall-pc": sounds_s.tolist(), "lab-pc": (sounds_s + off_s).tolist()}))
    assert found == [] or abs(off_s) < 0.3 * 12 * period_s


def test_recordings_of_a_clock_that_is_off_are_told_as_such() -> None:
    nodes = {
        name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
        for name, array in (("hall-pc", "north"), ("lab-pc", "south"))
    }
    even = scene(2 * LEAST_MATCHES)
    pauses_s = np.cumsum(np.random.default_rng(4).exponential(1.5, len(even.sources)))
    sources = [replace(one, start_s=one.start_s + pause_s) for one, pause_s in zip(even.sources, pauses_s, strict=True)]
    sounding = replace(even, sources=tuple(sources), duration_s=even.duration_s + float(pauses_s[-1]))
    parts = []
    for number, spec in enumerate(site_of().specs):
        recording = MemoryRecording(spec.name, float(RATE_HZ), render(sounding, spec.microphones_m, seed=number))
        parts.append(AssignedRecording(spec.name, recording, 2_100_000_000 * number, (1, 2, 3, 4)))
    examined = examine_parts(site_of({"nodes": nodes}), parts)
    assert [finding.fault for finding in examined.findings if finding.severity == "error"] == ["clock"]
    assert "'lab-pc' is 2.1 s ahead of that of 'hall-pc'" in examined.findings[0].message
