"""Taps are found on the right input, and nothing else is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.commission.taps import MARGIN_DB, Tap, TapDetector
from livessl.core.types import Float32Array

RATE_HZ = 16000


def noise(levels_dbfs: list[float], seconds: float, seed: int = 0) -> Float32Array:
    rng = np.random.default_rng(seed)
    levels = 10.0 ** (np.array(levels_dbfs)[:, None] / 20.0)
    return (levels * rng.standard_normal((len(levels_dbfs), round(seconds * RATE_HZ)))).astype(np.float32)


def knock(peak_dbfs: float) -> Float32Array:
    """A thump of 300 Hz that dies away within 20 ms."""
    t = np.arange(round(0.06 * RATE_HZ)) / RATE_HZ
    shape = np.exp(-t / 0.006) * np.cos(2.0 * np.pi * 300.0 * t)
    return np.asarray(10.0 ** (peak_dbfs / 20.0) * shape, dtype=np.float32)


def detected(samples: Float32Array, block: int = 320) -> list[Tap]:
    detector = TapDetector(len(samples), RATE_HZ)
    return [
        tap for first in range(0, samples.shape[1], block) for tap in detector.push(samples[:, first : first + block])
    ]


def add(samples: Float32Array, channel: int, time_s: float, sound: Float32Array) -> None:
    first = round(time_s * RATE_HZ)
    samples[channel, first : first + len(sound)] += sound


@settings(max_examples=25)
@given(
    levels_dbfs=st.lists(st.floats(-90.0, -50.0), min_size=1, max_size=18),
    tapped=st.integers(0, 17),
    time_s=st.floats(0.8, 1.6),
    constant=st.floats(-0.3, 0.3),
    block=st.integers(40, 4000),
    seed=st.integers(0, 99),
)
def test_tapped_input_is_named_whatever_the_others_receive(
    levels_dbfs: list[float], tapped: int, time_s: float, constant: float, block: int, seed: int
) -> None:
    channel = tapped % len(levels_dbfs)
    samples = noise(levels_dbfs, 2.0, seed)
    for other in range(len(samples)):  # its sound through the air and the frame, 20 dB less
        add(samples, other, time_s, knock(-12.0 if other == channel else -32.0))
    samples[channel] += np.float32(constant)
    [tap] = detected(samples, block)
    assert tap.inputs == (channel,)
    assert tap.time_s == pytest.approx(time_s, abs=0.02)
    assert tap.margin_db is None or tap.margin_db > MARGIN_DB
    assert tap.rise_db > 20.0
    assert detected(samples, 320) == [tap]


@settings(max_examples=10)
@given(
    levels_dbfs=st.lists(st.floats(-200.0, -6.0), min_size=1, max_size=8),
    period=st.integers(8, 400),
    seed=st.integers(0, 99),
)
def test_steady_sound_is_no_tap(levels_dbfs: list[float], period: int, seed: int) -> None:
    samples = noise(levels_dbfs, 6.0, seed)
    samples[0] += 0.3 * np.sin(2.0 * np.pi * np.arange(samples.shape[1]) / period).astype(np.float32)
    assert detected(samples) == []


@pytest.mark.parametrize("differences_db", [(0.0, -3.0, -6.0, -2.0), (-4.0, 0.0, -1.0, -5.0)])
def test_sound_in_the_room_is_told_from_a_tap(differences_db: tuple[float, ...]) -> None:
    samples = noise([-70.0] * 4, 2.0)
    for channel, difference_db in enumerate(differences_db):
        add(samples, channel, 1.0, knock(-10.0 + difference_db))
    [sound] = detected(samples)
    assert sorted(sound.inputs) == [0, 1, 2, 3]
    assert sound.inputs[0] == int(np.argmax(differences_db))


def test_several_taps_are_told_apart() -> None:
    samples = noise([-70.0] * 4, 5.0)
    for number, channel in enumerate([2, 0, 3, 3]):
        add(samples, channel, 1.0 + number, knock(-15.0))
    assert [tap.inputs for tap in detected(samples)] == [(2,), (0,), (3,), (3,)]


def test_input_that_hums_loudly_does_not_hide_a_tap() -> None:
    samples = noise([-70.0] * 3, 3.0)
    samples[1] += 0.5 * np.sin(2.0 * np.pi * 50.0 * np.arange(samples.shape[1]) / RATE_HZ).astype(np.float32)
    add(samples, 2, 1.5, knock(-20.0))
    assert [tap.inputs for tap in detected(samples)] == [(2,)]


def test_lasting_change_of_level_is_reported_once() -> None:
    samples = noise([-80.0, -80.0], 8.0)
    samples[0, 2 * RATE_HZ :] *= 100.0
    assert [tap.inputs for tap in detected(samples)] == [(0,)]


def test_quiet_click_is_no_tap() -> None:
    samples = noise([-100.0, -100.0], 2.0)
    add(samples, 0, 1.0, knock(-55.0))
    assert detected(samples) == []
    add(samples, 0, 1.5, knock(-40.0))
    assert [tap.inputs for tap in detected(samples)] == [(0,)]
