"""Samples become messages: one for every frame index, in order, and no sound is lost at its beginning or end."""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.segmenter import RECENT_S, WARM_UP_FRAMES, Segmenter
from livessl.core.stream.timeline import Framer
from livessl.core.types import (
    FRAME_NS,
    FRAME_S,
    ArraySpec,
    Block,
    ClockState,
    Float32Array,
    FloatArray,
    Frame,
    Mark,
    Message,
)

RATE_HZ = 16000.0
N = 800
START = 20 * 1_700_000_000
SPEC = ArraySpec("north", np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), (100.0, 6000.0))
CHANNELS = np.array([2, 0, 1])
PRE_ROLL, HANG_OVER = 4, 3
"""Frames of 50 ms."""
PARAMETERS = ActivityParameters(pre_roll_s=0.05 * PRE_ROLL, hang_over_s=0.05 * HANG_OVER)
QUIET, LOUD = 1e-3, 0.2


def sound(levels: list[float], seed: int = 1) -> Float32Array:
    """Four channels of white noise, of a standard deviation for each 50 ms."""
    samples = np.random.default_rng(seed).standard_normal((4, N * len(levels)))
    return np.asarray(samples * np.repeat(levels, N), dtype=np.float32)


def segmenter() -> Segmenter:
    return Segmenter(SPEC, CHANNELS, RATE_HZ, PARAMETERS)


def run(samples: Float32Array, sizes: list[int] | None = None) -> list[Message]:
    """Every message of samples that begin on the grid of frames, cut into blocks of the given sizes, then of 480."""
    framer, made = Framer(RATE_HZ), segmenter()
    messages: list[Message] = []
    index, total, left = 0, samples.shape[1], list(sizes or [])
    while index < total:
        count = min(left.pop(0) if left else 480, total - index)
        block = Block(index, samples[:, index : index + count].copy(), START * FRAME_NS + index * 62_500)
        messages += [message for cut in framer.push(block) for message in made.push(cut, framer.state)]
        index += count
    return messages + made.flush(framer.state)


def frame_indices(messages: list[Message], kind: type[Frame] | type[Mark]) -> list[int]:
    return [message.frame_index - START for message in messages if isinstance(message, kind)]


def frames_of(messages: list[Message]) -> list[Frame]:
    return [message for message in messages if isinstance(message, Frame)]


def test_every_quiet_frame_index_gives_a_mark() -> None:
    messages = run(sound([QUIET] * 40))
    assert frame_indices(messages, Mark) == list(range(40))
    assert {message.sequence for message in messages} == {0}
    assert {message.array for message in messages} == {"north"}


def test_sound_gives_frames_with_pre_roll_and_hang_over() -> None:
    messages = run(sound([QUIET] * 20 + [LOUD] * 5 + [QUIET] * 20))
    assert frame_indices(messages, Frame) == list(range(20 - PRE_ROLL, 25 + HANG_OVER))
    assert frame_indices(messages, Mark) == [*range(20), *range(25 + HANG_OVER, 45)]  # the pre-roll was marked as quiet
    assert [f.frame_index - START for f in frames_of(messages) if f.active] == list(range(20, 25))
    assert [m.sequence for m in messages] == list(accumulate(isinstance(m, Frame) for m in messages))
    # every interval's first mention is in order
    first = list(dict.fromkeys(message.frame_index - START for message in messages))
    assert first == list(range(45))


def test_pre_roll_is_sent_once() -> None:
    pause = HANG_OVER + 2  # 2 quiet intervals beyond the hang-over: the next pre-roll has no more
    messages = run(sound([QUIET] * 20 + [LOUD] * 3 + [QUIET] * pause + [LOUD] * 3 + [QUIET] * 10))
    sent = frame_indices(messages, Frame)
    assert sent == list(range(20 - PRE_ROLL, 23 + pause + 3 + HANG_OVER))
    assert frame_indices(messages, Mark) == [*range(20), 26, 27, *range(34, 41)]


def test_pause_within_the_hang_over_gives_frames() -> None:
    messages = run(sound([QUIET] * 20 + [LOUD] * 3 + [QUIET] * HANG_OVER + [LOUD] * 3 + [QUIET] * 10))
    assert frame_indices(messages, Frame) == list(range(20 - PRE_ROLL, 29 + HANG_OVER))


def test_sound_in_the_very_first_frames_is_not_lost() -> None:
    messages = run(sound([LOUD] * 4 + [QUIET] * 26))
    assert frame_indices(messages, Frame) == list(range(4 + HANG_OVER))
    assert frame_indices(messages, Mark) == list(range(4 + HANG_OVER, 30))


def test_steady_noise_from_the_start_is_quiet() -> None:
    assert frame_indices(run(sound([LOUD] * 60)), Frame) == []
    # and it is the warm-up that sees to it: without one, the first frame would be a sound
    assert WARM_UP_FRAMES == 10
    framer, made = Framer(RATE_HZ), segmenter()
    cuts = framer.push(Block(0, sound([LOUD] * 2), START * FRAME_NS))
    made.flush(framer.state)
    assert [isinstance(message, Frame) for cut in cuts for message in made.push(cut, framer.state)] == [True, True]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1 << 30), begin=st.floats(0.8, 1.0), slope=st.floats(0.0, 0.8))
def test_steady_noise_is_quiet_although_the_device_fades_in(seed: int, begin: float, slope: float) -> None:
    """The noise begins towards the end of the first frame; it is white, or the low noise of a fan."""
    count = 80 * N
    frequency_hz = np.fft.rfftfreq(count, 1.0 / RATE_HZ)
    spectrum = np.fft.rfft(sound([1.0] * 80, seed)) / np.maximum(frequency_hz, 100.0) ** slope
    noise = np.fft.irfft(spectrum, count)
    noise[:, : round(begin * N)] = 0.0
    assert frame_indices(run((1e-2 * noise / noise.std()).astype(np.float32)), Frame) == []


def after_silence(*parts: Float32Array | float) -> Float32Array:
    """Join sound (4, n); a number is digital silence of as many seconds."""
    joined = [np.zeros((4, round(part * RATE_HZ))) if isinstance(part, float) else part for part in parts]
    return np.asarray(np.concatenate(joined, axis=1), dtype=np.float32)


def decaying(level: float, rt60_s: float, duration_s: float, seed: int) -> Float32Array:
    """A burst (4, n) that decays by 60 dB in `rt60_s`."""
    times_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    wave = np.random.default_rng(seed).standard_normal((4, len(times_s)))
    return np.asarray(level * wave * 10.0 ** (-3.0 * times_s / rt60_s), dtype=np.float32)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    silence_s=st.floats(0.01, 4.5),
    level_db=st.floats(-85.0, -20.0),
    constant=st.sampled_from([0.0, 2.0**-15, -(2.0**-15)]),
)
def test_steady_noise_after_digital_silence_is_no_sound_and_hides_none(
    seed: int, silence_s: float, level_db: float, constant: float
) -> None:
    """The silence is at the start, in the middle and both; a burst 5 s after it is found."""
    level = 10.0 ** (level_db / 20.0)
    noise = sound([level] * 100, seed)
    burst = noise.copy()
    burst[:, : round(0.3 * RATE_HZ)] += decaying(20.0 * level, 0.3, 0.3, seed + 1)
    for parts in ((silence_s, noise), (noise, silence_s, noise), (silence_s, noise, silence_s, noise)):
        samples = after_silence(*parts, burst)
        messages = run(samples + np.float32(constant) * (samples == 0.0))
        begin = samples.shape[1] - burst.shape[1]
        active = [frame.frame_index - START for frame in frames_of(messages) if frame.active]
        assert active
        assert begin // N <= min(active) <= begin // N + 1
        assert list(dict.fromkeys(m.frame_index - START for m in messages)) == list(range(samples.shape[1] // N))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    silence_s=st.floats(0.06, 4.0),
    level_db=st.floats(-50.0, -10.0),
    rt60_s=st.floats(0.1, 2.5),
)
def test_bursts_between_digital_silences_are_found(seed: int, silence_s: float, level_db: float, rt60_s: float) -> None:
    """They decay into silence, as those of a simulation without noise."""
    burst = decaying(10.0 ** (level_db / 20.0), rt60_s, 1.5 * rt60_s, seed)
    messages = run(after_silence(silence_s, burst, 1.0, 0.5 * burst, 4.0, burst, 1.0))
    active = {frame.frame_index - START for frame in frames_of(messages) if frame.active}
    begins_s = np.cumsum([silence_s, burst.shape[1] / RATE_HZ + 1.0, burst.shape[1] / RATE_HZ + 4.0])
    for begin_s in begins_s:
        assert active & {int(begin_s / FRAME_S), int(begin_s / FRAME_S) + 1}


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1 << 30), silence_s=st.floats(0.1, 4.0), lead_s=st.floats(0.0, 0.4))
def test_burst_in_noise_just_after_digital_silence_is_found_and_ends(
    seed: int, silence_s: float, lead_s: float
) -> None:
    noise = sound([1e-3] * 80, seed)
    first = round(lead_s * RATE_HZ)
    noise[:, first : first + N * 10] += decaying(0.1, 0.4, 0.5, seed + 1)
    messages = run(after_silence(silence_s, noise))
    active = [frame.frame_index - START for frame in frames_of(messages) if frame.active]
    begin = int((silence_s + lead_s) / FRAME_S)
    assert active
    assert begin <= min(active) <= begin + 1
    assert max(active) <= begin + 10


def test_digital_silence_is_marked_at_once() -> None:
    framer, made = Framer(RATE_HZ), segmenter()
    (cut,) = framer.push(Block(0, np.zeros((4, N), dtype=np.float32), START * FRAME_NS))
    (mark,) = made.push(cut, framer.state)
    assert isinstance(mark, Mark)
    assert (mark.power, mark.noise_power) == (0.0, 0.0)


@pytest.mark.parametrize("lead", [1, 2, 3])
def test_sound_that_begins_soon_is_found_however_long_it_lasts(lead: int) -> None:
    messages = run(sound([QUIET] * lead + [LOUD] * 60 + [QUIET] * 20))
    assert [frame.frame_index - START for frame in frames_of(messages) if frame.active] == list(range(lead, lead + 60))


def test_short_stream_gives_its_messages_at_its_end() -> None:
    assert frame_indices(run(sound([QUIET, QUIET, LOUD, QUIET])), Frame) == [0, 1, 2, 3]
    assert run(sound([QUIET])[:, :400]) == []


def test_samples_are_in_the_order_of_the_microphones() -> None:
    samples = sound([QUIET] * 20 + [LOUD] * 3 + [QUIET] * 10)
    for frame in frames_of(run(samples)):
        first = (frame.frame_index - START) * N
        np.testing.assert_array_equal(frame.samples, samples[CHANNELS, first : first + N])
        assert frame.time_ns == pytest.approx(frame.frame_index * FRAME_NS, abs=1)
        assert frame.sample_rate_hz == RATE_HZ
        assert frame.power == pytest.approx(in_band(samples[CHANNELS, first : first + N]).mean(), rel=1e-4)


def in_band(samples: Float32Array) -> FloatArray:
    spectrum = np.fft.rfft(samples.astype(np.float64), axis=1)
    frequency_hz = np.fft.rfftfreq(samples.shape[1], 1 / RATE_HZ)
    spectrum[:, (frequency_hz < 100) | (frequency_hz > 6000)] = 0.0
    return np.asarray((np.fft.irfft(spectrum, samples.shape[1], axis=1) ** 2).mean(axis=1))


def test_mark_holds_powers_noise_and_the_state_of_the_device() -> None:
    samples = sound([QUIET] * 30)
    samples[0] *= 2.0
    samples[1] = 0.0
    messages = run(samples)
    mark = messages[-1]
    assert isinstance(mark, Mark)
    expected = in_band(samples[CHANNELS, -N:])
    assert mark.channel_power == pytest.approx(expected, rel=1e-4, abs=1e-15)
    assert mark.channel_power[2] == 0.0  # device channel 1 is the third microphone
    assert mark.power == pytest.approx(expected.mean(), rel=1e-4)
    # White noise of 0.75 QUIET^2 in the band, 4, 0 and 1 times that over three microphones. The least of the means of 5
    # intervals: at most 2 % low by 3 sd of 1/sqrt(5 * 590).
    assert mark.noise_power == pytest.approx(0.7375 * QUIET**2 * 5 / 3, rel=0.15)
    assert (mark.overflows, mark.lost_frames, mark.clock) == (0, 0, ClockState.SETTLING)


def test_mark_counts_the_losses_of_the_device() -> None:
    framer, made = Framer(RATE_HZ), segmenter()
    samples = sound([QUIET] * 100)
    messages: list[Message] = []
    for index in range(0, samples.shape[1], 400):
        block = Block(
            index, samples[:, index : index + 400].copy(), START * FRAME_NS + index * 62_500, index == 400 * 5
        )
        messages += [message for cut in framer.push(block) for message in made.push(cut, framer.state)]
    mark = messages[-1]
    assert isinstance(mark, Mark)
    assert (mark.overflows, mark.lost_frames, mark.clock) == (1, 1, ClockState.LOCKED)


def test_wrong_number_of_channels_is_refused() -> None:
    with pytest.raises(ValueError, match="array 'north': has 3 microphones, given 2 channels"):
        Segmenter(SPEC, CHANNELS[:2], RATE_HZ, PARAMETERS)


@settings(deadline=None, max_examples=20)
@given(
    loud=st.lists(st.booleans(), min_size=WARM_UP_FRAMES, max_size=50),
    sizes=st.lists(st.integers(1, 3000), max_size=20),
)
def test_messages_do_not_depend_on_the_size_of_blocks(loud: list[bool], sizes: list[int]) -> None:
    samples = sound([LOUD if one else QUIET for one in loud])
    whole, parted = run(samples, [samples.shape[1]]), run(samples, sizes)
    assert [(type(m), m.frame_index, m.sequence, m.power) for m in parted] == [
        (type(m), m.frame_index, m.sequence, m.power) for m in whole
    ]
    for one, other in zip(frames_of(whole), frames_of(parted), strict=True):
        assert (one.active, abs(one.time_ns - other.time_ns) <= 1) == (other.active, True)
        np.testing.assert_array_equal(one.samples, other.samples)
    # and what holds for every stream
    assert [m.sequence for m in whole] == list(accumulate(isinstance(m, Frame) for m in whole))
    assert list(dict.fromkeys(m.frame_index - START for m in whole)) == list(range(len(loud)))
    sent = frame_indices(whole, Frame)
    assert all(earlier < later for earlier, later in pairwise(sent))  # no frame twice
    assert len(frame_indices(whole, Mark)) + len(set(sent) - set(frame_indices(whole, Mark))) == len(loud)


def test_recent_frames_can_be_requested() -> None:
    framer, made = Framer(RATE_HZ), segmenter()
    samples = sound([QUIET] * 20 + [LOUD] * 2 + [QUIET] * (round(RECENT_S / FRAME_S) + 30))
    messages: list[Message] = []
    for k in range(samples.shape[1] // N):
        block = Block(k * N, samples[:, k * N : (k + 1) * N].copy(), (START + k) * FRAME_NS)
        messages += [message for cut in framer.push(block) for message in made.push(cut, framer.state)]
        if k == 30:
            asked = frames_of(made.backfill(START + 12, START + 21))
            assert [frame.frame_index - START for frame in asked] == list(range(12, 22))
            assert {(frame.sequence, frame.active) for frame in asked} == {(0, False)}
            sent = {frame.frame_index: frame for frame in frames_of(messages)}
            for frame in asked:
                np.testing.assert_array_equal(
                    frame.samples, samples[CHANNELS, (frame.frame_index - START) * N :][:, :N]
                )
                assert frame.frame_index not in sent or sent[frame.frame_index].power == frame.power
    last = messages[-1].frame_index
    assert made.backfill(START, START + 40) == []
    remembered = frames_of(made.backfill(START, last))
    assert len(remembered) == round(RECENT_S / FRAME_S)
    assert remembered[-1].frame_index == last
    # asking takes nothing from what is sent by itself
    assert [frame.sequence for frame in frames_of(messages)] == list(range(1, len(frames_of(messages)) + 1))


def test_frames_before_a_gap_cannot_be_requested() -> None:
    framer, made = Framer(RATE_HZ), segmenter()
    samples = sound([QUIET] * 40)
    for k in (*range(15), *range(18, 40)):
        block = Block(k * N, samples[:, k * N : (k + 1) * N].copy(), (START + k) * FRAME_NS)
        for cut in framer.push(block):
            made.push(cut, framer.state)
    assert [frame.frame_index - START for frame in frames_of(made.backfill(START, START + 25))] == list(range(18, 26))
