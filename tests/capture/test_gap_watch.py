"""Gaps that no driver flags."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.capture.gap_watch import HARDWARE_GAP_NS, SERVER_GAP_NS, GapWatch

seeds = st.integers(0, 2**32)


def gaps(
    block_s: float, rate_hz: float, ppm: float, jitter_s: float, seed: int, gap_s: float = 0.0, blocks: int = 200
) -> dict[int, int]:
    """Return the gaps found, by number of block; `gap_s` are lost at half time.

    Most stamps are late by an exponential time, and one in five is not.
    """
    rng = np.random.default_rng(seed)
    size = round(block_s * rate_hz)
    found: dict[int, int] = {}
    watch = GapWatch(rate_hz, block_s)
    for k in range(blocks):
        true_s = k * size / rate_hz / (1 + 1e-6 * ppm) + (gap_s if k >= blocks // 2 else 0.0)
        late_s = 0.0 if rng.random() < 0.2 else rng.exponential(jitter_s)
        gap_ns = watch.push(k * size, 10**18 + round(1e9 * (true_s + late_s)), HARDWARE_GAP_NS)
        if gap_ns:
            found[k] = gap_ns
    return found


@given(
    st.sampled_from([0.005, 0.02, 0.1]),
    st.sampled_from([16000.0, 44100.0, 96000.0]),
    st.floats(-500.0, 500.0),
    st.floats(1e-5, 5e-4),
    seeds,
)
def test_jitter_and_drift_are_no_gap(block_s: float, rate_hz: float, ppm: float, jitter_s: float, seed: int) -> None:
    assert gaps(block_s, rate_hz, ppm, jitter_s, seed) == {}


@given(st.floats(0.006, 5.0), st.floats(-300.0, 300.0), st.floats(1e-5, 5e-4), seeds)
def test_gap_is_found_once_within_a_quarter_of_a_second_with_its_length(
    gap_s: float, ppm: float, jitter_s: float, seed: int
) -> None:
    [(block, gap_ns)] = gaps(0.02, 48000.0, ppm, jitter_s, seed, gap_s).items()
    assert 100 <= block <= 112
    assert gap_ns / 1e9 == pytest.approx(gap_s, abs=0.0025)


@given(st.integers(1, 8), st.floats(0.005, 0.2), seeds)
def test_pause_of_the_machine_is_no_gap(length: int, late_s: float, seed: int) -> None:
    """Blocks that were delayed together catch up; a gap never does."""
    watch, rng = GapWatch(48000.0, 0.02), np.random.default_rng(seed)
    begin = int(rng.integers(60, 100))
    for k in range(200):
        late = late_s if begin <= k < begin + length else rng.exponential(1e-4)
        assert watch.push(960 * k, round(1e9 * (0.02 * k + late)), SERVER_GAP_NS) == 0
