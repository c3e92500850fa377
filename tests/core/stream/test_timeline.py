"""Time from jittering stamps, and frames from blocks: nothing is lost, doubled or moved unseen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.stream.timeline import LOCKED_S, MEMORY_S, STEP_BLOCKS, STEP_NS, Cut, Framer, Timeline
from livessl.core.types import FRAME_NS, Block, ClockState, Float32Array

RATE_HZ = 16000.0
START_NS = 1_700_000_000 * 10**9 + 12_345_678
HOUR_NS = 3600 * 10**9
JITTER_NS = 5_000_000


def ideal_ns(index: int, rate_hz: float = RATE_HZ, start_ns: int = START_NS, ppm: float = 0.0) -> int:
    """When sample `index` was taken, by a clock that runs `ppm` fast: it has taken more samples than it should."""
    return start_ns + round(index * 1e9 / (rate_hz * (1.0 + ppm * 1e-6)))


def numbered(first: int, count: int) -> Float32Array:
    """Two channels that number the samples; float32 counts exactly to 16 million."""
    index = np.arange(first, first + count, dtype=np.float32)
    return np.stack([index, -index])


def stream(blocks: int, stamp: Callable[[int], int] = ideal_ns, block: int = 480, first: int = 0) -> Iterator[Block]:
    for k in range(blocks):
        index = first + k * block
        yield Block(index, numbered(index, block), stamp(index))


def cut_all(framer: Framer, blocks: Iterator[Block]) -> list[Cut]:
    return [cut for block in blocks for cut in framer.push(block)]


def state_of(framer: Framer) -> ClockState:
    return framer.timeline.state


def assert_contiguous(cuts: list[Cut]) -> None:
    for earlier, later in pairwise(cuts):
        assert later.frame_index == earlier.frame_index + 1
        assert later.samples[0, 0] == earlier.samples[0, -1] + 1


@pytest.mark.parametrize("rate_hz", [16000.0, 22050.0, 44100.0, 48000.0])
@pytest.mark.parametrize("offset", [0, 1, 17, 300])
def test_ideal_stamps_give_exact_boundaries(rate_hz: float, offset: int) -> None:
    start_ns = 1_700_000_000 * 10**9 + round(offset * 1e9 / rate_hz)  # the grid of frames begins at whole seconds
    framer = Framer(rate_hz)
    cuts = cut_all(framer, stream(400, lambda index: ideal_ns(index, rate_hz, start_ns)))
    assert_contiguous(cuts)
    for cut in cuts:
        # sample n is taken (n + offset) / rate after the whole second, frame index r begins r / 20 after it;
        # at 22.05 kHz every other one begins half-way between two samples, and takes in the earlier
        assert cut.samples[0, 0] == (cut.frame_index - 20 * 1_700_000_000) * int(rate_hz) // 20 - offset
        assert cut.time_ns == pytest.approx(ideal_ns(int(cut.samples[0, 0]), rate_hz, start_ns), abs=2)
        assert 0 <= cut.time_ns - cut.frame_index * FRAME_NS + 1e9 / rate_hz < 1.01e9 / rate_hz
    assert cuts[0].frame_index == 1_700_000_000 * 10**9 // FRAME_NS + (offset > 0)
    assert {cut.samples.shape[1] for cut in cuts} <= {int(0.05 * rate_hz), int(np.ceil(0.05 * rate_hz))}
    assert framer.lost_frames == framer.overflows == 0


@settings(deadline=None)
@given(
    sizes=st.lists(st.integers(0, 3000), min_size=1, max_size=12),
    offset=st.integers(0, 3000),
    rate_hz=st.sampled_from([16000.0, 22050.0, 44100.0, 48000.0]),
)
def test_frames_do_not_depend_on_the_size_of_blocks(sizes: list[int], offset: int, rate_hz: float) -> None:
    start_ns = 1_700_000_000 * 10**9 + round(offset * 1e9 / rate_hz)

    def push(counts: list[int]) -> list[Cut]:
        framer, cuts, index = Framer(rate_hz), [], 0
        for count in counts:
            cuts += framer.push(Block(index, numbered(index, count), ideal_ns(index, rate_hz, start_ns)))
            index += count
        return cuts

    whole, cut_up = push([sum(sizes)]), push(sizes)
    assert len(whole) >= (sum(sizes) - 0.05 * rate_hz) // (0.05 * rate_hz + 1)
    assert [cut.frame_index for cut in cut_up] == [cut.frame_index for cut in whole]
    for one, other in zip(whole, cut_up, strict=True):
        assert abs(one.time_ns - other.time_ns) <= 1  # stamps are whole nanoseconds
        np.testing.assert_array_equal(one.samples, other.samples)


def test_one_sided_jitter_leaves_frames_whole() -> None:
    rng = np.random.default_rng(1)
    framer = Framer(RATE_HZ)
    cuts: list[Cut] = []
    drifts_ppm = []
    for block in stream(2000, lambda index: ideal_ns(index) + int(rng.uniform(0, JITTER_NS))):
        cuts += framer.push(block)
        # With a sum S of squared x, jitter of sd 1.44 ms makes 1.44 ms sqrt(S) / (S + 1e4 s^2) of drift, at its most
        # 7.2 ppm (1 sd): the prior holds it down while a line through a second of stamps would be 800 ppm off.
        drifts_ppm.append(abs(framer.timeline.drift_ppm))
    assert framer.lost_frames == 0
    assert max(drifts_ppm) < 4 * 7.2
    assert_contiguous(cuts)
    settled = cuts[200:]
    lengths = np.array([cut.samples.shape[1] for cut in settled])
    assert set(lengths) <= {799, 800, 801}
    assert np.mean(lengths == 800) > 0.5
    # Jitter of 0 to 5 ms is 2.5 ms late in the mean, +-1.4 ms: after n = 300 blocks of the line's two parameters,
    # sd 2 * 1.4 ms / sqrt(300) = 0.17 ms.
    late_ns = [cut.time_ns - ideal_ns(int(cut.samples[0, 0])) for cut in settled]
    assert np.abs(np.array(late_ns) - JITTER_NS / 2).max() < 5 * 170_000


def test_single_stamps_move_the_line_little() -> None:
    rng = np.random.default_rng(2)
    timeline = Timeline(RATE_HZ)
    errors_ns = []
    for block in stream(1000, lambda index: ideal_ns(index) + int(rng.uniform(-JITTER_NS, JITTER_NS))):
        timeline.update(block.first_index, block.stamp_ns)
        errors_ns.append(abs(timeline.time_ns(block.first_index) - ideal_ns(block.first_index)))
    assert max(errors_ns[:3]) > 500_000
    # sd of a uniform jitter 2.9 ms; the end of a line through 1000 points: 2 * 2.9 ms / sqrt(1000) = 0.18 ms
    assert max(errors_ns[-100:]) < 4 * 180_000


@pytest.mark.parametrize("ppm", [100.0, -60.0])
def test_drift_is_found(ppm: float) -> None:
    rng = np.random.default_rng(3)
    block, blocks = 800, 1200  # of 50 ms: 60 s
    framer = Framer(RATE_HZ)
    cuts = cut_all(
        framer, stream(blocks, lambda index: ideal_ns(index, ppm=ppm) + int(rng.uniform(0, JITTER_NS)), block)
    )
    # Forgetting over 60 s weighs the squares of x from 0 to 60 s to sum w (x - mean)^2 = 2.1e5 s^2 (exponential weight,
    # cut at one time constant). The prior of 1e4 s^2 then takes 4.6 % off; jitter of sd 1.44 ms adds 3 ppm (1 sd).
    x_s = np.arange(blocks) * 0.05
    weight = np.exp((x_s - x_s[-1]) / MEMORY_S)
    spread_s2 = float((weight * (x_s - np.average(x_s, weights=weight)) ** 2).sum())
    expected = ppm * spread_s2 / (spread_s2 + 1e4)
    jitter = JITTER_NS / np.sqrt(12.0) / np.sqrt(spread_s2) / 1e3
    assert framer.timeline.drift_ppm == pytest.approx(expected, abs=4 * jitter)
    assert 4 * jitter < 0.3 * abs(ppm)
    assert_contiguous(cuts)
    # 100 ppm is a sample more in every 12th frame
    longer = np.mean([cut.samples.shape[1] for cut in cuts[600:]]) - 800
    assert longer == pytest.approx(800 * ppm * 1e-6, abs=0.04)


def test_drift_is_found_exactly_without_jitter_and_with_time() -> None:
    timeline = Timeline(RATE_HZ)
    for block in stream(8000, lambda index: ideal_ns(index, ppm=100.0), 800):
        timeline.update(block.first_index, block.stamp_ns)
    assert timeline.drift_ppm == pytest.approx(100.0, abs=0.6)  # the prior's 1e4 s^2 of 60^2 * 60 / 0.05 = 4e6 s^2


def test_index_is_the_inverse_of_time() -> None:
    timeline = Timeline(48000.0)
    rng = np.random.default_rng(4)
    for block in stream(500, lambda index: ideal_ns(index, 48000.0, ppm=80.0) + int(rng.uniform(0, JITTER_NS))):
        timeline.update(block.first_index, block.stamp_ns)
    assert timeline.drift_ppm != 0.0
    for index in (0, 12_345, 240_000, 10**7):
        # times are whole nanoseconds: 5e-5 samples; float64 keeps 1e-16 of the 10^7 samples' 2e11 ns
        assert timeline.index_at(timeline.time_ns(index)) == pytest.approx(index, abs=1e-4)


def test_time_before_the_first_stamp_is_an_error() -> None:
    timeline = Timeline(RATE_HZ)
    assert not timeline.started
    with pytest.raises(RuntimeError, match="expected a stamp before the first query"):
        timeline.time_ns(0)
    timeline.update(0, START_NS)
    assert timeline.started


def test_clock_is_locked_after_two_seconds() -> None:
    timeline = Timeline(RATE_HZ)
    states = []
    for block in stream(100):
        timeline.update(block.first_index, block.stamp_ns)
        states.append(timeline.state)
    settling = int(np.ceil(LOCKED_S * RATE_HZ / 480))
    assert states == [ClockState.SETTLING] * settling + [ClockState.LOCKED] * (100 - settling)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, STEP_NS + 2 * JITTER_NS])
def test_step_of_the_clock_is_found_after_three_blocks(step_ns: int) -> None:
    framer = Framer(RATE_HZ)
    before = cut_all(framer, stream(200))
    assert state_of(framer) is ClockState.LOCKED
    cuts_after: list[Cut] = []
    for count, block in enumerate(stream(100, lambda index: ideal_ns(index) + step_ns, first=200 * 480), start=1):
        cuts = framer.push(block)
        if count < STEP_BLOCKS:
            before += cuts
            assert state_of(framer) is ClockState.LOCKED
        else:
            cuts_after += cuts
        if count == STEP_BLOCKS:
            assert framer.timeline.steps == 1
            assert state_of(framer) is ClockState.STEPPED
    assert framer.lost_frames == 1  # the one that the step tore
    assert state_of(framer) is ClockState.LOCKED  # again
    assert framer.timeline.steps == 1
    assert_contiguous(before)
    assert_contiguous(cuts_after)
    for cuts, offset_ns in ((before, 0), (cuts_after, step_ns)):
        for cut in cuts:
            right_ns = ideal_ns(int(cut.samples[0, 0])) + offset_ns
            assert cut.time_ns == pytest.approx(right_ns, abs=2)
            assert abs(cut.frame_index * FRAME_NS - right_ns) < 1e9 / RATE_HZ
    assert cuts_after[0].samples[0, 0] - before[-1].samples[0, -1] <= 3 * 800


def test_leap_second_smeared_over_a_day_is_no_step() -> None:
    """The system's clock runs 11.6 ppm slow for a day, from some moment on: five minutes before it and ten after."""
    slow = 1.0 / 86_400.0
    begins = round(300.0 * RATE_HZ)
    framer = Framer(RATE_HZ)
    smeared = stream(18_000, lambda index: ideal_ns(index) - round(max(0, index - begins) / RATE_HZ * slow * 1e9), 800)
    cuts = cut_all(framer, smeared)
    assert framer.timeline.steps == framer.lost_frames == 0
    assert state_of(framer) is ClockState.LOCKED
    assert_contiguous(cuts)
    # after ten memories the line runs as slow as the clock does, up to the prior's share and what is left of before
    assert framer.timeline.drift_ppm == pytest.approx(1e6 * slow, rel=0.1)
    for cut in cuts:
        index = int(cut.samples[0, 0])
        right_ns = ideal_ns(index) - max(0, index - begins) / RATE_HZ * slow * 1e9
        assert abs(cut.time_ns - right_ns) < 700_000  # of 6.9 ms: 11.6 ppm for a memory of a minute


def test_late_callbacks_are_no_step() -> None:
    framer = Framer(RATE_HZ)
    late = {100 * 480, 150 * 480, 151 * 480}
    cuts = cut_all(framer, stream(300, lambda index: ideal_ns(index) + (10**9 if index in late else 0)))
    assert framer.timeline.steps == 0
    assert framer.lost_frames == 0
    assert_contiguous(cuts)
    assert {cut.samples.shape[1] for cut in cuts} == {800}
    assert cuts[-1].time_ns == pytest.approx(ideal_ns(int(cuts[-1].samples[0, 0])), abs=2)


def test_gap_drops_the_torn_frame_and_no_other() -> None:
    framer = Framer(RATE_HZ)
    before = cut_all(framer, stream(100))
    gap = 1000
    after = cut_all(framer, stream(100, first=100 * 480 + gap))
    assert framer.lost_frames == 1
    assert framer.overflows == 0
    assert framer.timeline.steps == 0
    assert_contiguous(before)
    assert_contiguous(after)
    # the torn frame, and the one that the gap's far end lies in
    torn = int(before[-1].samples[0, -1]) + 1
    assert torn <= 48_000 < torn + 800
    whole = int(after[0].samples[0, 0])
    assert 49_000 <= whole < 49_000 + 800
    assert (whole - torn) % 800 == 0
    assert after[0].frame_index - before[-1].frame_index == (whole - torn) // 800 + 1
    assert all(abs(cut.frame_index * FRAME_NS - ideal_ns(int(cut.samples[0, 0]))) < 1e9 / RATE_HZ for cut in after)


def test_gap_before_the_first_frame_tears_none() -> None:
    framer = Framer(RATE_HZ)
    assert framer.push(Block(0, numbered(0, 10), ideal_ns(0))) == []
    cuts = cut_all(framer, stream(20, first=500))
    assert framer.lost_frames == 0
    assert_contiguous(cuts)


def test_overflow_drops_the_torn_frame_and_starts_a_new_line() -> None:
    framer = Framer(RATE_HZ)
    before = cut_all(framer, stream(100))
    # 700 samples were lost, but the device counts on as if none were
    rest = stream(100, lambda index: ideal_ns(index + 700), first=100 * 480)
    block = next(rest)
    after = framer.push(Block(block.first_index, block.samples, block.stamp_ns, overflow=True))
    assert framer.timeline.state is ClockState.SETTLING
    after += cut_all(framer, rest)
    assert framer.overflows == 1
    assert framer.lost_frames == 1
    assert_contiguous(before)
    assert_contiguous(after)
    assert after[0].samples[0, 0] >= 48_000
    assert all(
        abs(cut.frame_index * FRAME_NS - ideal_ns(int(cut.samples[0, 0]) + 700)) < 1e9 / RATE_HZ for cut in after
    )


def test_empty_blocks_change_nothing() -> None:
    framer = Framer(RATE_HZ)
    cuts: list[Cut] = []
    for block in stream(60):
        cuts += framer.push(block)
        assert framer.push(Block(0, numbered(0, 0), 0, overflow=True)) == []
    assert framer.overflows == framer.lost_frames == 0
    assert_contiguous(cuts)


@settings(max_examples=20, deadline=None)
@given(
    ppm=st.floats(-250.0, 250.0),
    jitter_ms=st.floats(0.01, 0.5),
    block_s=st.sampled_from([0.02, 0.05]),
    seed=st.integers(0, 1000),
)
def test_drift_is_within_the_error_that_is_told_and_settles(
    ppm: float, jitter_ms: float, block_s: float, seed: int
) -> None:
    """Also while the fit still holds back most of it; a stamp is late by what the machine was busy, never early."""
    block, rng = round(block_s * RATE_HZ), np.random.default_rng(seed)
    late_ns = rng.exponential(1e6 * jitter_ms, round(120.0 / block_s)).round().astype(int)
    timeline = Timeline(RATE_HZ)
    assert timeline.drift_error_ppm is None
    settled_s = None
    for number, late in enumerate(late_ns.tolist()):
        timeline.update(number * block, ideal_ns(number * block, ppm=ppm) + late)
        error_ppm = timeline.drift_error_ppm
        assert (error_ppm is None) == (number * block / RATE_HZ < LOCKED_S)
        if error_ppm is not None:
            # the jitter that the first stamps show is not quite that of all
            assert abs(timeline.drift_ppm - ppm) <= 1.2 * error_ppm + 0.01
            settled_s = settled_s or (number * block_s if error_ppm <= 5.0 else None)
    assert settled_s is not None
    assert settled_s <= 100.0  # the prior fades as fast for any drift


def test_drift_error_begins_anew_after_a_step_of_the_clock() -> None:
    timeline = Timeline(RATE_HZ)
    for number in range(3000):
        timeline.update(number * 320, ideal_ns(number * 320, ppm=40.0))
    assert (timeline.drift_error_ppm or 99.0) < 5.0
    for number in range(3000, 3000 + STEP_BLOCKS):
        timeline.update(number * 320, ideal_ns(number * 320, ppm=40.0) + 2 * STEP_NS)
    assert timeline.drift_error_ppm is None
