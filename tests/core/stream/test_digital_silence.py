"""A sound out of digital silence is found, however steady it is; noise that a driver switches on and off is none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import tetra
from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.digital_silence import sound_shares
from livessl.core.stream.segmenter import Segmenter
from livessl.core.stream.timeline import Framer
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, Block, Float32Array, FloatArray, Frame

START: Final = 20 * 1_700_000_000
C_M_S: Final = 343.0
SPEC: Final = tetra("north", [4.0, 3.0, 1.0], 0.5)


def active_s(spec: ArraySpec, samples: FloatArray, rate_hz: float) -> list[float]:
    """The starts of all active frames, in seconds from the first sample."""
    framer = Framer(rate_hz)
    segmenter = Segmenter(spec, np.arange(len(samples)), rate_hz, ActivityParameters())
    size, messages = round(0.03 * rate_hz), []
    for index in range(0, samples.shape[1], size):
        stamp_ns = START * FRAME_NS + round(index * 1e9 / rate_hz)
        block = Block(index, samples[:, index : index + size].astype(np.float32), stamp_ns)
        messages += [message for cut in framer.push(block) for message in segmenter.push(cut, framer.state)]
    messages += segmenter.flush(framer.state)
    return [FRAME_S * (m.frame_index - START) for m in messages if isinstance(m, Frame) and m.active]


def steady(rng: np.random.Generator, count: int, rate_hz: float, *, tonal: bool) -> FloatArray:
    """A ring of two tones, or noise, of an RMS of 1 (n,), that begins and ends at once."""
    if not tonal:
        return rng.standard_normal(count)
    t_s = np.arange(count) / rate_hz
    tones = sum(np.sin(2 * np.pi * hz * t_s + rng.uniform(0, 6)) for hz in rng.uniform(400.0, 3000.0, 2))
    return np.asarray(tones)


def in_a_room(
    rng: np.random.Generator, spec: ArraySpec, source_m: FloatArray, sound: FloatArray, rate_hz: float, rt60_s: float
) -> FloatArray:
    """The sound at each microphone, with the time that it travels and, unless `rt60_s` is 0, a tail that decays."""
    delays = np.linalg.norm(spec.microphones_m - source_m, axis=1) / C_M_S * rate_hz
    length = 1 + round(rt60_s * rate_hz)
    rows = []
    for delay in np.round(delays).astype(int):
        tail = 0.05 * rng.standard_normal(length) * 10.0 ** (-3.0 * np.arange(length) / max(length, 2))
        tail[0] = 1.0
        size = len(sound) + length - 1
        wet = np.fft.irfft(np.fft.rfft(sound, size) * np.fft.rfft(tail, size), size)
        rows.append(np.concatenate([np.zeros(delay), wet]))
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row))) for row in rows])


def fan(rng: np.random.Generator, duration_s: float, rate_hz: float, slope: float) -> FloatArray:
    """The noise of a fan at four microphones, of an RMS of 1: white, or stronger at low frequencies."""
    count = round(duration_s * rate_hz)
    frequency_hz = np.fft.rfftfreq(count, 1.0 / rate_hz)
    spectrum = np.fft.rfft(rng.standard_normal((4, count))) / np.maximum(frequency_hz, 100.0) ** slope
    noise = np.fft.irfft(spectrum, count)
    return np.asarray(noise / noise.std())


levels_db = st.floats(-70.0, -20.0)
rates_hz = st.sampled_from([16000.0, 22050.0])


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    silence_s=st.floats(0.3, 5.0),
    length_s=st.floats(0.6, 7.0),
    level_db=levels_db,
    rt60_s=st.one_of(st.just(0.0), st.floats(0.1, 2.0)),
    edge_m=st.floats(0.25, 0.6),
    room_m=st.floats(3.0, 20.0),
    rate_hz=rates_hz,
    tonal=st.booleans(),
)
def test_first_sound_of_a_simulation_is_found_at_once_however_steady_and_long_it_is(
    seed: int,
    silence_s: float,
    length_s: float,
    level_db: float,
    rt60_s: float,
    edge_m: float,
    room_m: float,
    rate_hz: float,
    tonal: bool,
) -> None:
    rng = np.random.default_rng(seed)
    spec = tetra("north", np.array([0.4, 0.6, 0.4]) * room_m, edge_m, rng.uniform(0.0, 120.0))
    source_m = rng.uniform(0.05, 0.95, 3) * room_m
    sound = steady(rng, round(length_s * rate_hz), rate_hz, tonal=tonal)
    wet = in_a_room(rng, spec, source_m, sound, rate_hz, rt60_s)
    silence = np.zeros((4, round(silence_s * rate_hz)))
    samples = np.concatenate([silence, 10.0 ** (level_db / 20.0) * wet, silence], axis=1)
    active = active_s(spec, samples, rate_hz)
    arrives_s = silence_s + float(np.linalg.norm(spec.microphones_m - source_m, axis=1).min()) / C_M_S
    assert active
    assert arrives_s - FRAME_S <= min(active) <= arrives_s + 2 * FRAME_S
    assert max(active) <= arrives_s + length_s + rt60_s + FRAME_S


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    silence_s=st.floats(0.1, 5.0),
    length_s=st.floats(0.6, 2.5),
    level_db=levels_db,
    rt60_s=st.floats(0.05, 2.0),
    rate_hz=rates_hz,
    tonal=st.booleans(),
)
def test_first_sound_that_reaches_all_microphones_together_is_found_when_it_ends(
    seed: int, silence_s: float, length_s: float, level_db: float, rt60_s: float, rate_hz: float, tonal: bool
) -> None:
    """The array is small, or turned so that the sound comes from broadside: its edges are those of a driver."""
    rng = np.random.default_rng(seed)
    spec = tetra("north", [4.0, 3.0, 1.0], 0.04)
    sound = steady(rng, round(length_s * rate_hz), rate_hz, tonal=tonal)
    wet = in_a_room(rng, ArraySpec("north", np.zeros((4, 3)), spec.band_hz), np.zeros(3), sound, rate_hz, rt60_s)
    silence = np.zeros((4, round(silence_s * rate_hz)))
    active = active_s(
        spec, np.concatenate([silence, 10.0 ** (level_db / 20.0) * wet, silence, silence], axis=1), rate_hz
    )
    assert any(silence_s <= one < silence_s + length_s for one in active)
    assert max(active) <= silence_s + length_s + rt60_s + FRAME_S


def dropped_out(noise: FloatArray, spans_s: Sequence[tuple[float, float]], rate_hz: float, constant: float) -> int:
    """Replace parts of noise (4, n) by a constant: each so long after the one before. Return where the last ends."""
    at_s = 0.0
    for noise_s, gap_s in spans_s:
        begin_s = at_s + noise_s
        at_s = begin_s + gap_s
        noise[:, round(begin_s * rate_hz) : round(at_s * rate_hz)] = constant
    return round(at_s * rate_hz)


spans = st.lists(
    st.tuples(
        st.one_of(st.floats(0.01, 0.3), st.floats(0.0, 4.0)), st.one_of(st.floats(0.003, 0.3), st.floats(0.0, 5.0))
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    spans_s=spans,
    level_db=st.floats(-80.0, -20.0),
    slope=st.floats(0.0, 0.8),
    rate_hz=rates_hz,
    bits=st.sampled_from([16, 24, 32]),
    constant=st.sampled_from([0.0, 2.0**-15]),
)
def test_noise_of_a_driver_that_drops_out_again_and_again_is_no_sound_and_hides_none(
    seed: int,
    spans_s: list[tuple[float, float]],
    level_db: float,
    slope: float,
    rate_hz: float,
    bits: int,
    constant: float,
) -> None:
    rng = np.random.default_rng(seed)
    level = 10.0 ** (level_db / 20.0)
    total_s = sum(map(sum, spans_s)) + 6.0
    samples = level * fan(rng, total_s, rate_hz, slope)
    after = dropped_out(samples, spans_s, rate_hz, constant)
    begin = after + round(5.0 * rate_hz)
    t_s = np.arange(round(0.3 * rate_hz)) / rate_hz
    samples[:, begin : begin + len(t_s)] += 20.0 * level * rng.standard_normal(len(t_s)) * 10.0 ** (-10.0 * t_s)
    if bits < 32:
        samples = np.round(samples * 2.0 ** (bits - 1)) / 2.0 ** (bits - 1)
    active = active_s(SPEC, samples, rate_hz)
    assert active
    assert begin / rate_hz - FRAME_S <= min(active) <= begin / rate_hz + FRAME_S


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 1 << 30),
    spans_s=st.lists(st.tuples(st.floats(0.5, 2.0), st.floats(0.06, 2.0)), min_size=2, max_size=5),
    level_db=st.floats(-60.0, -30.0),
    wait_s=st.floats(0.0, 1.5),
)
def test_burst_between_dropouts_is_found_and_ends(
    seed: int, spans_s: list[tuple[float, float]], level_db: float, wait_s: float
) -> None:
    rng, rate_hz, level = np.random.default_rng(seed), 16000.0, 10.0 ** (level_db / 20.0)
    samples = level * fan(rng, 2 * sum(map(sum, spans_s)) + 4.0, rate_hz, 0.3)
    after = dropped_out(samples, [*spans_s, (wait_s + 0.6, 0.2), *spans_s], rate_hz, 0.0)
    begin = round((sum(map(sum, spans_s)) + wait_s) * rate_hz)
    t_s = np.arange(round(0.3 * rate_hz)) / rate_hz
    samples[:, begin : begin + len(t_s)] += 20.0 * level * rng.standard_normal(len(t_s)) * 10.0 ** (-10.0 * t_s)
    active = active_s(SPEC, samples, rate_hz)
    assert after < samples.shape[1]
    assert active
    assert begin / rate_hz - FRAME_S <= min(active) <= begin / rate_hz + FRAME_S
    assert max(active) <= begin / rate_hz + 0.35


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1 << 30), release_s=st.floats(0.15, 1.0), level_db=levels_db)
def test_steady_sounds_of_a_noise_gate_are_all_found(seed: int, release_s: float, level_db: float) -> None:
    """A gate closes gradually, by 60 dB in its release."""
    rng, rate_hz = np.random.default_rng(seed), 16000.0
    falls = 10.0 ** (-3.0 * np.arange(round(release_s * rate_hz)) / (release_s * rate_hz))
    gain = np.concatenate([np.ones(round(1.2 * rate_hz)), falls])
    gap = np.zeros(round(2.0 * rate_hz))
    parts = np.concatenate([gap, gain, gap, gain, gap, gap, gain, gap])
    samples = 10.0 ** (level_db / 20.0) * fan(rng, len(parts) / rate_hz, rate_hz, 0.2) * parts
    active = active_s(SPEC, samples, rate_hz)
    for begin_s in (2.0, 5.2 + release_s, 10.4 + 2 * release_s):
        assert any(begin_s <= one < begin_s + 1.2 for one in active)


@pytest.mark.parametrize("kind", ["fades in", "weak", "joint"])
def test_fan_after_digital_silence_is_no_sound(kind: str) -> None:
    """The device fades in; its noise is hardly more than the last bit; or the array is several metres wide."""
    for seed in range(6):
        rng, rate_hz = np.random.default_rng(seed), 48000.0
        noise = 10.0 ** (-88.0 / 20.0 if kind == "weak" else -50.0 / 20.0) * fan(rng, 8.0, rate_hz, 0.6)
        silence = rng.uniform(0.3, 4.0)
        noise[:, : round(silence * rate_hz)] = 0.0
        if kind == "fades in":
            ramp = np.clip((np.arange(noise.shape[1]) / rate_hz - silence) / 0.04, 0.0, 1.0)
            noise *= ramp
        samples = np.round(noise * 2.0**15) / 2.0**15
        spec = tetra("north", [4.0, 3.0, 1.0], 4.0 if kind == "joint" else 0.5)
        assert active_s(spec, samples, rate_hz) == []


@pytest.mark.parametrize("silence_s", [0.3, 2.0])
def test_noise_after_silence_is_late_by_less_than_others_wait_and_in_time_after_five_seconds(silence_s: float) -> None:
    rate_hz = 16000.0
    samples = 1e-3 * fan(np.random.default_rng(4), 9.0, rate_hz, 0.5).astype(np.float32)
    samples[:, : round(silence_s * rate_hz)] = 0.0
    framer, segmenter = Framer(rate_hz), Segmenter(SPEC, np.arange(4), rate_hz, ActivityParameters())
    for index in range(samples.shape[1] // 800):
        block = Block(800 * index, samples[:, 800 * index : 800 * (index + 1)], (START + index) * FRAME_NS)
        (cut,) = framer.push(block)
        late = [index - (message.frame_index - START) for message in segmenter.push(cut, framer.state)]
        since_s = FRAME_S * index - silence_s
        assert max(late, default=0) < 10
        assert late or 0.0 <= since_s < 0.5  # the warm-up
        if 0.5 < since_s < 4.9:
            assert late == [7]
        elif since_s > 5.1:
            assert late == [0]


def test_share_of_a_frame_without_dropouts() -> None:
    frames = np.random.default_rng(1).standard_normal((4, 2, 800)).astype(np.float32)
    frames[1, :, 200:400] = 0.25
    frames[2] = 0.0
    frames[3, 0] = 0.0  # a dead microphone is no dropout
    np.testing.assert_allclose(sound_shares(frames), [1.0, 0.75, 0.0, 1.0], atol=2e-3)
    assert isinstance(sound_shares(frames), np.ndarray)


def test_share_of_frames_with_weak_noise_of_16_bits_is_one() -> None:
    noise: Float32Array = (np.round(0.7 * np.random.default_rng(2).standard_normal((3, 4, 800))) / 2**15).astype(
        np.float32
    )
    np.testing.assert_array_equal(sound_shares(noise), 1.0)
