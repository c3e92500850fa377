"""Clocks that differ by more than a sound's length: found by what rises in recordings, and only where it fits."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.commission.clocks import LEAST_SOUNDS, Rises, find_clock_faults
from livessl.core.commission.envelopes import INTERVAL_S, MOST_GAP_S, EnvelopeMeter
from livessl.core.commission.finding import Finding
from livessl.core.types import FloatArray
from livessl.examination import examine_parts
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import render
from small_site import RATE_HZ, scene, site_of

OFFSETS_S = st.floats(0.35, 40.0) | st.floats(-40.0, -0.35)
seeds = st.integers(0, 10_000)
few = settings(deadline=None, max_examples=20)


def starts_s(seed: int, count: int = 10) -> FloatArray:
    """When some sounds began, at irregular intervals."""
    return np.cumsum(0.8 + np.random.default_rng(seed).exponential(4.0, count))


def heard(sounds_s: FloatArray, rng: np.random.Generator, start_s: float = -50.0) -> Rises:
    """What one array records of sounds: it rises by different amounts, at most one piece earlier or later."""
    values = np.zeros(round((max(sounds_s, default=0.0) - start_s + 5.0) / INTERVAL_S))
    at = np.round((sounds_s - start_s) / INTERVAL_S).astype(int) + rng.integers(-1, 2, len(sounds_s))
    np.add.at(values, at, rng.uniform(1.0, 5.0, len(sounds_s)))
    return Rises(start_s, values)


def told_s(finding: Finding) -> float:
    """By how many seconds the clock is said to be ahead."""
    off_s = float(finding.message.split(" is ")[1].split(" s ")[0])
    return off_s if "ahead of" in finding.message else -off_s


@few
@given(seed=seeds, off_s=OFFSETS_S, lost=st.sets(st.integers(0, 9), max_size=2), later_s=st.floats(-30.0, 30.0))
def test_clocks_that_differ_are_named_with_the_difference(
    seed: int, off_s: float, lost: set[int], later_s: float
) -> None:
    """Either array may miss some sounds, and their recordings may begin at any times."""
    rng = np.random.default_rng(seed)
    sounds_s = starts_s(seed)
    other = heard(np.delete(sounds_s, sorted(lost)) + off_s, rng, -80.0 + later_s)
    [finding] = find_clock_faults({"hall-pc": heard(sounds_s, rng), "lab-pc": other})
    assert (finding.fault, finding.array) == ("clock", None)
    assert "the clock of 'lab-pc' is" in finding.message
    assert told_s(finding) == pytest.approx(off_s, abs=0.1)


@few
@given(seed=seeds, off_s=st.floats(-0.25, 0.25), count=st.integers(0, 20))
def test_clocks_that_agree_are_not_named(seed: int, off_s: float, count: int) -> None:
    rng, sounds_s = np.random.default_rng(seed), starts_s(seed, count)
    assert list(find_clock_faults({"hall-pc": heard(sounds_s, rng), "lab-pc": heard(sounds_s + off_s, rng)})) == []


@few
@given(seed=seeds, one=st.integers(0, 12), other=st.integers(0, 12))
def test_unrelated_sounds_say_nothing_about_clocks(seed: int, one: int, other: int) -> None:
    rng = np.random.default_rng(seed)
    sounds = {"hall-pc": heard(starts_s(seed, one), rng), "lab-pc": heard(starts_s(seed + 20_000, other), rng)}
    assert list(find_clock_faults(sounds)) == []


@few
@given(seed=seeds, period_s=st.floats(0.4, 5.0), off_s=OFFSETS_S)
def test_sounds_at_equal_intervals_never_show_a_wrong_difference(seed: int, period_s: float, off_s: float) -> None:
    """Where loud and soft ones follow each other in a way of their own, they may show the right one."""
    rng, sounds_s = np.random.default_rng(seed), np.linspace(0.0, 11.0 * period_s, 12)
    for finding in find_clock_faults({"hall-pc": heard(sounds_s, rng), "lab-pc": heard(sounds_s + off_s, rng)}):
        assert told_s(finding) == pytest.approx(off_s, abs=0.1)


@few
@given(seed=seeds, off_s=OFFSETS_S, late=st.sampled_from(["hall-pc", "lab-pc", "yard-pc"]))
def test_of_three_clocks_the_one_that_differs_from_the_others_is_named_once(seed: int, off_s: float, late: str) -> None:
    rng, sounds_s = np.random.default_rng(seed), starts_s(seed)
    names = ("hall-pc", "lab-pc", "yard-pc")
    recorded = {name: heard(sounds_s + (off_s if name == late else 0.0), rng, -60.0) for name in names}
    [finding] = find_clock_faults(recorded)
    assert f"the clock of {late!r} is" in finding.message
    assert told_s(finding) == pytest.approx(off_s, abs=0.1)


def test_a_long_session_takes_little_memory() -> None:
    sounds_s = np.cumsum(0.3 + np.random.default_rng(1).exponential(1.5, 2_000))
    rng = np.random.default_rng(2)
    recorded = {"hall-pc": heard(sounds_s, rng), "lab-pc": heard(sounds_s + 1.0, rng)}
    nbytes = sum(one.values.nbytes for one in recorded.values())
    tracemalloc.start()
    [finding] = find_clock_faults(recorded)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * nbytes + 10e6
    assert told_s(finding) == pytest.approx(1.0, abs=0.05)


@few
@given(
    seed=seeds,
    rate_hz=st.sampled_from([8000.0, 11025.0, 16000.0, 22050.0]),
    cuts=st.lists(st.integers(1, 9_999), max_size=6),
)
def test_rises_do_not_depend_on_how_samples_are_cut_into_blocks(seed: int, rate_hz: float, cuts: list[int]) -> None:
    rng = np.random.default_rng(seed)
    samples = (1e-3 * rng.standard_normal((4, 10_000))).astype(np.float32)
    samples[:, 6_000:] *= 50.0
    whole, pieces = EnvelopeMeter(rate_hz), EnvelopeMeter(rate_hz)
    whole.push(0, samples)
    edges = [0, *sorted(set(cuts)), samples.shape[1]]
    for first, last in pairwise(edges):
        pieces.push(first, samples[:, first:last])
    assert pieces.rises() == pytest.approx(whole.rises(), rel=1e-5)
    assert abs(float(whole.rises().argmax()) * INTERVAL_S - 6_000 / rate_hz) <= INTERVAL_S


@few
@given(seed=seeds, gap_s=st.floats(0.0, 3.0))
def test_gap_keeps_time_and_is_no_rise(seed: int, gap_s: float) -> None:
    rng = np.random.default_rng(seed)
    quiet = (1e-3 * rng.standard_normal((4, 8_000))).astype(np.float32)
    loud = quiet * np.where(np.arange(8_000) < 4_000, 1.0, 60.0).astype(np.float32)
    meter, later = EnvelopeMeter(8_000.0), 8_000 + round(gap_s * 8_000.0)
    meter.push(0, quiet)
    meter.push(later, loud)
    rises = meter.rises()
    assert abs(float(rises.argmax()) * INTERVAL_S - (later + 4_000) / 8_000.0) <= INTERVAL_S
    assert np.count_nonzero(rises > 1.0) <= 2


@pytest.mark.parametrize("gap_s", [MOST_GAP_S + 1.0, 1.8e9])
def test_recording_is_measured_up_to_a_gap_of_decades(gap_s: float) -> None:
    """As of a machine whose clock begins in 1970 and is set while it records."""
    sound = (1e-3 * np.random.default_rng(3).standard_normal((4, 8_000))).astype(np.float32)
    meter = EnvelopeMeter(8_000.0)
    meter.push(0, sound)
    before = meter.rises()
    meter.push(8_000 + round(gap_s * 8_000.0), sound)
    meter.push(16_000 + round(gap_s * 8_000.0), sound)
    assert meter.rises().tolist() == before.tolist()


def test_one_noisy_and_one_dead_channel_do_not_hide_the_rises() -> None:
    rng = np.random.default_rng(5)
    samples = (1e-3 * rng.standard_normal((4, 16_000))).astype(np.float32)
    samples[:, 8_000:] *= 30.0
    samples[0], samples[1] = 0.0, 0.3 * rng.standard_normal(16_000)
    meter = EnvelopeMeter(16_000.0)
    meter.push(0, samples)
    assert abs(float(meter.rises().argmax()) * INTERVAL_S - 0.5) <= INTERVAL_S


def test_recordings_of_a_clock_that_is_off_are_told_as_such() -> None:
    """The difference is about as long as the pauses, so that events of different sounds overlap."""
    nodes = {
        name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
        for name, array in (("hall-pc", "north"), ("lab-pc", "south"))
    }
    even = scene(2 * LEAST_SOUNDS)
    pauses_s = np.cumsum(np.random.default_rng(4).uniform(0.0, 0.4, len(even.sources)))
    sources = [replace(one, start_s=one.start_s + pause_s) for one, pause_s in zip(even.sources, pauses_s, strict=True)]
    sounding = replace(even, sources=tuple(sources), duration_s=even.duration_s + float(pauses_s[-1]))
    parts = []
    for number, spec in enumerate(site_of().specs):
        recording = MemoryRecording(spec.name, float(RATE_HZ), render(sounding, spec.microphones_m, seed=number))
        parts.append(AssignedRecording(spec.name, recording, 2_100_000_000 * number, (1, 2, 3, 4)))
    examined = examine_parts(site_of({"nodes": nodes}), parts)
    assert [finding.fault for finding in examined.findings if finding.severity == "error"] == ["clock"]
    assert "'lab-pc' is 2.1 s ahead of that of 'hall-pc'" in examined.findings[0].message
