"""Hum and rumble do not hide sounds, and are no sounds themselves."""

from __future__ import annotations

import re
from typing import Final

import numpy as np
import pytest
import scipy.fft
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfilt

from livessl.core.correlate.band import band_power
from livessl.core.geometry import tetrahedron
from livessl.core.stream.activity import ActivityParameters, runs
from livessl.core.stream.array_health import HUM_MARKS, ArrayHealth, ArrayState, NodeReport
from livessl.core.stream.segmenter import Segmenter
from livessl.core.stream.steady_background import SteadyBackground
from livessl.core.stream.timeline import Cut, Framer
from livessl.core.types import FRAME_NS, ArraySpec, Float32Array, FloatArray, Frame, Mark, Message

BAND_HZ: Final = (100.0, 6000.0)
SPEC: Final = ArraySpec("north", tetrahedron(0.5), BAND_HZ)
BURSTS_S: Final = (1.5, 3.5, 5.5)
LENGTH_S: Final = 7.5
BURST_RMS: Final = 3e-3
NOISE_RMS: Final = 1e-4
"""30 dB below the bursts."""


def recording(rng: np.random.Generator, rate_hz: float, steady: FloatArray) -> Float32Array:
    """Three bursts of 0.2 s, each microphone's noise, and something steady that all microphones receive."""
    count = round(LENGTH_S * rate_hz)
    t = np.arange(count) / rate_hz
    sound = np.zeros(count)
    for start_s in BURSTS_S:
        sound += np.where((t >= start_s) & (t < start_s + 0.2), rng.standard_normal(count), 0.0)
    return np.asarray(
        BURST_RMS * sound + NOISE_RMS * rng.standard_normal((4, count)) + steady[:count], dtype=np.float32
    )


def messages_of(samples: Float32Array, rate_hz: float) -> list[Message]:
    """Frames are now and then a sample longer, as they are with a drifting clock."""
    segmenter, framer = Segmenter(SPEC, np.arange(4), rate_hz, ActivityParameters()), Framer(rate_hz)
    messages: list[Message] = []
    at = index = 0
    while (stop := round((index + 1) * 0.05 * rate_hz * 1.0001)) <= samples.shape[1]:
        messages += segmenter.push(Cut(index, index * FRAME_NS, samples[:, at:stop]), framer.state)
        at, index = stop, index + 1
    return messages + segmenter.flush(framer.state)


def active_runs(messages: list[Message]) -> list[tuple[int, int]]:
    active = np.zeros(1 + max(message.frame_index for message in messages), dtype=np.bool_)
    for message in messages:
        if isinstance(message, Frame):
            active[message.frame_index] = message.active
    return runs(active)


def is_burst(run: tuple[int, int]) -> bool:
    return any(start_s - 0.06 <= 0.05 * run[0] and 0.05 * run[1] <= start_s + 0.36 for start_s in BURSTS_S)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 1 << 30),
    hum_hz=st.sampled_from([50.0, 60.0, 100.0, 120.0, 150.0, 1000.0, 2345.6, 5000.0]),
    above_db=st.floats(-20.0, 40.0),
    harmonic=st.sampled_from([0.0, 0.3]),
    phase=st.floats(0.0, 6.28),
    rate_hz=st.sampled_from([16000.0, 44100.0, 48000.0]),
)
def test_sounds_are_found_in_a_hum_of_any_frequency_and_level(
    seed: int, hum_hz: float, above_db: float, harmonic: float, phase: float, rate_hz: float
) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(round(LENGTH_S * rate_hz)) / rate_hz
    wave = np.sin(2 * np.pi * hum_hz * t + phase) + harmonic * np.sin(6 * np.pi * min(hum_hz, 1900.0) * t)
    hum = BURST_RMS * 10.0 ** (above_db / 20.0) * np.sqrt(2.0) * wave
    found = active_runs(messages_of(recording(rng, rate_hz, hum), rate_hz))
    assert len(found) == len(BURSTS_S)
    assert all(map(is_burst, found))


@pytest.mark.parametrize("above_db", [0.0, 15.0, 30.0])
@pytest.mark.parametrize("seed", range(3))
def test_sounds_are_found_in_rumble(seed: int, above_db: float) -> None:
    rng = np.random.default_rng(seed)
    rate_hz = 16000.0
    low = sosfilt(butter(4, 110.0, fs=rate_hz, output="sos"), rng.standard_normal(round((LENGTH_S + 1) * rate_hz)))
    rumble = BURST_RMS * 10.0 ** (above_db / 20.0) * low / low.std()
    found = active_runs(messages_of(recording(rng, rate_hz, rumble[round(rate_hz) :]), rate_hz))
    for start_s in BURSTS_S:
        assert any(0.05 * start <= start_s + 0.06 and start_s < 0.05 * stop for start, stop in found)
    assert sum(not is_burst(run) for run in found) <= 1


def test_a_hum_that_begins_is_one_sound_and_then_background() -> None:
    rng, rate_hz = np.random.default_rng(5), 16000.0
    t = np.arange(round(14.0 * rate_hz)) / rate_hz
    samples = NOISE_RMS * rng.standard_normal((4, len(t))) + 0.03 * np.sin(2 * np.pi * 150.0 * t) * (t >= 2.0)
    samples += BURST_RMS * rng.standard_normal(len(t)) * ((t >= 10.0) & (t < 10.2))
    first, *others = active_runs(messages_of(samples.astype(np.float32), rate_hz))
    assert first[0] * 0.05 == pytest.approx(2.0, abs=0.06)
    assert first[1] * 0.05 <= 2.0 + 4.0
    assert [round(0.05 * start, 1) for start, _ in others] == [10.0]


@settings(max_examples=8)
@given(seed=st.integers(0, 1 << 30), level_db=st.floats(-15.0, 20.0), hum_hz=st.floats(90.0, 4000.0))
def test_a_sound_goes_on_while_a_hum_is_recognized(seed: int, level_db: float, hum_hz: float) -> None:
    """The hum begins at 2 s and is known before 6 s; the sound is weaker or louder than the hum."""
    rng, rate_hz = np.random.default_rng(seed), 16000.0
    t = np.arange(round(7.0 * rate_hz)) / rate_hz
    hum = np.sqrt(2.0) * BURST_RMS * np.sin(2 * np.pi * hum_hz * t) * (t >= 2.0)
    sound = BURST_RMS * 10.0 ** (level_db / 20.0) * rng.standard_normal(len(t)) * ((t >= 3.7) & (t < 6.2))
    samples = hum + sound + NOISE_RMS * rng.standard_normal((4, len(t)))
    active = np.zeros(141, dtype=np.bool_)
    for first, stop in active_runs(messages_of(samples.astype(np.float32), rate_hz)):
        active[first:stop] = True
    assert active[75:123].all()
    assert not active[130:].any()


@given(
    rate_hz=st.sampled_from([8000.0, 16000.0, 44100.0, 44120.0, 48000.0]),
    high_hz=st.floats(600.0, 3900.0),
    extra=st.integers(-1, 1),
    seed=st.integers(0, 1 << 30),
)
@settings(max_examples=15)
def test_the_spectrum_is_that_of_the_frame_with_a_hann_window(
    rate_hz: float, high_hz: float, extra: int, seed: int
) -> None:
    """At any rate, up to the highest bin, and for frames that are a sample longer or shorter than usual."""
    count = round(0.05 * rate_hz)
    samples = np.random.default_rng(seed).standard_normal((3, count + extra)).astype(np.float32)
    background = SteadyBackground(rate_hz, (100.0, high_hz), 3.0, 0.95)
    fitted = np.pad(samples, ((0, 0), (0, 1)))[:, :count]
    plain_power = band_power(fitted, rate_hz, (100.0, high_hz)).mean()[None]
    (found,) = background.spectra(samples[None], scipy.fft.rfft(samples[None], axis=2), plain_power)
    window = scipy.signal.get_window("hann", count)
    spectra = np.abs(np.fft.rfft(fitted * window, axis=1)) ** 2
    expected = 2.0 * spectra.mean(axis=0) / (count**2 * np.mean(window**2))
    np.testing.assert_allclose(found[:-1], expected[: len(found) - 1], rtol=1e-3, atol=1e-6 * expected.max())
    assert found[-1] == pytest.approx(band_power(fitted, rate_hz, (100.0, high_hz)).mean(), rel=1e-3)


@given(
    at=st.floats(0.05, 0.95),
    length_s=st.floats(0.001, 0.01),
    level_db=st.floats(45.0, 60.0),
    seed=st.integers(0, 1 << 30),
)
@settings(max_examples=25)
def test_level_of_a_pulse_beside_a_hum_is_its_plain_power_in_the_inner_nine_tenths_of_a_frame(
    at: float, length_s: float, level_db: float, seed: int
) -> None:
    """A window would raise the level of a pulse in the middle of a frame, and lower it by 25 dB at `at` = 0.05."""
    rng, rate_hz = np.random.default_rng(seed), 16000.0
    background = SteadyBackground(rate_hz, BAND_HZ, 3.0, 0.95)
    t = np.arange(91 * 800) / rate_hz
    samples = (1e-4 * rng.standard_normal((4, len(t))) + 3e-4 * np.sin(2 * np.pi * 200.0 * t)).astype(np.float32)
    count = round(length_s * rate_hz)
    pulse = scipy.signal.sosfilt(
        butter(4, (500.0, 4000.0), "band", fs=rate_hz, output="sos"), rng.standard_normal(count)
    )
    pulse *= 1e-4 * 10.0 ** (level_db / 20.0) * np.sqrt(800.0 / count) / np.sqrt(np.mean(pulse**2))
    first = 90 * 800 + round(at * (800 - count))
    samples[:, first : first + count] += pulse.astype(np.float32)
    frames = samples.reshape(4, 91, 800).swapaxes(0, 1)
    powers = np.array([band_power(frame, rate_hz, BAND_HZ).mean() for frame in frames])
    spectra = background.spectra(frames, scipy.fft.rfft(frames, axis=2), powers)
    for spectrum in spectra[:-1]:
        background.learn(spectrum)
    power = float(powers[-1])
    level = background.changing_power(spectra[-1])
    assert abs(10.0 * np.log10(level / power)) < 1.0


@pytest.mark.parametrize("level", [0.0, 1e-4, 1e-2])
@given(seed=st.integers(0, 1 << 30))
@settings(max_examples=10)
def test_without_hum_the_level_is_the_plain_power_in_the_band(level: float, seed: int) -> None:
    rng, rate_hz = np.random.default_rng(seed), 16000.0
    background = SteadyBackground(rate_hz, BAND_HZ, 3.0, 0.95)
    for _ in range(70):
        samples = (level * rng.standard_normal((4, 800))).astype(np.float32)
        power = float(band_power(samples, rate_hz, BAND_HZ).mean())
        (spectrum,) = background.spectra(samples[None], scipy.fft.rfft(samples[None], axis=2), np.array([power]))
        background.learn(spectrum)
        assert background.changing_power(spectrum) == power


def test_the_state_of_the_array_names_the_hum() -> None:
    rng, rate_hz = np.random.default_rng(6), 16000.0
    t = np.arange(round(LENGTH_S * rate_hz)) / rate_hz
    messages = messages_of(recording(rng, rate_hz, 0.1 * np.sin(2 * np.pi * 150.0 * t)), rate_hz)
    health = ArrayHealth(4)
    for message in messages:
        if isinstance(message, Mark):
            health.take_mark(message, 0, is_newest=True)
        else:
            health.take_frame(message, BAND_HZ, 0)
    assert health.hum_marks < HUM_MARKS or health.hum_hz is not None
    state, reason = health.state(0, age_ns=0, has_left=False, votes=(), clock_offset=None, node=NodeReport())
    assert state is ArrayState.HEALTHY
    assert reason is not None
    assert reason.startswith("steady hum or rumble at -23 dBFS")
    named = re.search(r"strongest near (\d+) Hz", reason)
    assert named is not None
    assert int(named[1]) == pytest.approx(150, abs=5)


def test_nothing_is_said_without_hum() -> None:
    rate_hz = 16000.0
    health = ArrayHealth(4)
    for message in messages_of(recording(np.random.default_rng(7), rate_hz, np.zeros(1 << 20)), rate_hz):
        if isinstance(message, Mark):
            health.take_mark(message, 0, is_newest=True)
            assert health.hum_marks < HUM_MARKS
    state = health.state(0, age_ns=0, has_left=False, votes=(), clock_offset=None, node=NodeReport())
    assert state == (ArrayState.HEALTHY, None)


def test_a_tail_stays_a_tail_when_a_hum_is_recognized_meanwhile() -> None:
    """What remains 18 dB below a loud sound, soon after it, is its reverberation, whatever is learned in between."""
    rng, rate_hz = np.random.default_rng(8), 16000.0
    t = np.arange(round(5.0 * rate_hz)) / rate_hz
    hum = 0.01 * np.sin(2 * np.pi * 120.0 * t) * np.where(t < 0.5, 0.0, 1.0)
    loud = 0.05 * rng.standard_normal(len(t)) * ((t >= 0.6) & (t < 3.0))
    tail = 0.005 * rng.standard_normal(len(t)) * ((t >= 3.4) & (t < 3.7))
    samples = NOISE_RMS * rng.standard_normal((4, len(t))) + hum + loud + tail
    found = active_runs(messages_of(samples.astype(np.float32), rate_hz))
    assert not any(start * 0.05 >= 3.2 for start, _ in found)
