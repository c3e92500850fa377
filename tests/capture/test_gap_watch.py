"""Gaps that no driver flags."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.capture.gap_watch import HARDWARE, SOUND_SERVER, GapWatch

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
    watch = GapWatch(rate_hz, block_s, HARDWARE)
    for k in range(blocks):
        true_s = k * size / rate_hz / (1 + 1e-6 * ppm) + (gap_s if k >= blocks // 2 else 0.0)
        late_s = 0.0 if rng.random() < 0.2 else rng.exponential(jitter_s)
        gap_ns = watch.push(k * size, 10**18 + round(1e9 * (true_s + late_s)))
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


def bursts(seed: int, gap_s: float, blocks: int = 700) -> dict[int, float]:
    """Return the gaps found in sound that comes in bursts of one to four blocks, from a machine that pauses.

    While the machine pauses, nothing comes; then all that has waited comes at once. `gap_s` are lost at half time.
    """
    rng = np.random.default_rng(seed)
    watch, found = GapWatch(48000.0, 0.02, SOUND_SERVER), {}
    arrival_s, left, calm = 0.0, 0, 0
    for k in range(blocks):
        end_s = 0.02 * (k + 1) + (gap_s if k >= blocks // 2 else 0.0)
        if left == 0:
            left = int(rng.integers(1, 5))
            pauses = k >= calm and rng.random() < 0.1
            pause_s = rng.uniform(0.1, 0.8) if pauses else 0.0
            calm = k + 100 if pauses else calm  # a machine that never catches up cannot be told from one that loses
            arrival_s = max(arrival_s, end_s + 0.02 * (left - 1) + pause_s)
        left -= 1
        gap_ns = watch.push(960 * k, round(1e9 * (max(arrival_s, end_s) - 0.02)))
        if gap_ns:
            found[k] = gap_ns / 1e9
    return found


@given(seeds)
def test_pause_of_the_machine_is_no_gap(seed: int) -> None:
    """Blocks that were delayed catch up; a gap never does."""
    assert bursts(seed, 0.0) == {}


@given(st.floats(0.2, 5.0), seeds)
def test_gap_through_a_sound_server_is_found(gap_s: float, seed: int) -> None:
    [(block, found_s)] = bursts(seed, gap_s).items()
    assert 350 <= block <= 350 + 120
    assert 0.1 <= found_s <= gap_s + 0.07  # blocks from before the gap may have been late, too
