"""Copied, shared and inverted channels are recognized by the sound, and real sound fields are not taken for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC
from livessl.core.geometry import posed, tetrahedron
from livessl.core.stream.channel_faults import INVERTED_SOUNDS, QUIET_FRAMES, SHARED_FRAMES, ChannelFaults, polarity
from livessl.core.types import ArraySpec, Float32Array, FloatArray, Frame

FRAME: Final = 800
SOURCE_M: Final = (3.1, 4.4, 1.3)


def framed(array: str, frame_index: int, samples: Float32Array, *, active: bool = False) -> Frame:
    return Frame(array, 1, frame_index, frame_index * 50_000_000, RATE_HZ, samples, 1e-6, active)


def hiss(rng: np.random.Generator, channels: int, level: float = 1e-3) -> Float32Array:
    return np.asarray(level * rng.standard_normal((channels, FRAME)), dtype=np.float32)


def as_16_bits(samples: Float32Array) -> Float32Array:
    return np.asarray(np.rint(samples * 32768.0) / 32768.0, dtype=np.float32)


def after_quiet(faults: ChannelFaults, frames: Sequence[Float32Array], array: str = "north") -> str | None:
    for index, samples in enumerate(frames):
        faults.take(framed(array, index, samples, active=index >= QUIET_FRAMES))
    return faults.of(array)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 1 << 30),
    taken=st.lists(st.integers(0, 5), min_size=2, max_size=8),
    gain=st.sampled_from([1.0, -1.0, 0.5]),
    level=st.floats(1e-4, 0.1),
    hum=st.sampled_from([0.0, 0.1]),
)
def test_copies_are_named_as_the_first_sound_begins(
    seed: int, taken: list[int], gain: float, level: float, hum: float
) -> None:
    rng = np.random.default_rng(seed)
    frames = []
    for index in range(QUIET_FRAMES + SHARED_FRAMES):
        t = (index * FRAME + np.arange(FRAME)) / RATE_HZ
        inputs = hiss(rng, 6, level) + hum * np.sin(2.0 * np.pi * 50.0 * t)
        samples = inputs[taken]
        samples[-1] *= gain
        frames.append(as_16_bits(samples.astype(np.float32)) if gain == 1.0 else samples.astype(np.float32))
    fault = after_quiet(ChannelFaults(["north"]), frames)
    copied = {k + 1 for k, one in enumerate(taken) if taken.count(one) > 1}
    if not copied:
        assert fault is None
        return
    assert fault is not None
    assert "are the same signal" in fault
    named = fault.split("; check")[0]
    assert {int(word) for word in named.replace(",", " ").replace(";", " ").split() if word.isdigit()} == copied


@settings(max_examples=20)
@given(
    seed=st.integers(0, 1 << 30),
    hum_hz=st.sampled_from([50.0, 60.0, 100.0, 120.0, 1000.0, 5000.0]),
    hum=st.floats(1e-3, 0.3),
    edge_m=st.floats(0.03, 0.5),
)
def test_distinct_microphones_are_not_taken_for_copies(seed: int, hum_hz: float, hum: float, edge_m: float) -> None:
    """A common hum far above the noise, and loud sounds that reach two or more microphones at the same time."""
    rng = np.random.default_rng(seed)
    spec = ArraySpec("north", posed(tetrahedron(edge_m), (2.0, 2.0, 1.2), 0.0, 0.0, 0.0), BAND_HZ)
    above_m = spec.centre_m + np.array([0.0, 0.0, 2.0])  # the three lower microphones receive it at once
    faults = ChannelFaults(["north"])
    for index in range(20):
        t = (index * FRAME + np.arange(FRAME)) / RATE_HZ
        samples = hiss(rng, 4) + np.float32(hum) * np.sin(2.0 * np.pi * hum_hz * t).astype(np.float32)
        active = index % 10 >= 5
        if active:
            samples = samples + heard(spec, above_m, 3.0 * burst(2 * FRAME, seed=index))[:, 400 : 400 + FRAME]
        faults.take(framed("north", index, as_16_bits(samples), active=active))
    assert faults.of("north") is None


def test_a_single_sound_in_digital_silence_is_no_proof_of_copies() -> None:
    spec = ArraySpec("north", posed(tetrahedron(0.5), (2.0, 2.0, 1.2), 0.0, 0.0, 0.0), BAND_HZ)
    faults = ChannelFaults(["north"])
    for index in range(8):
        sound = heard(spec, spec.centre_m + np.array([0.0, 0.0, 2.0]), burst(2 * FRAME))[:, 400 : 400 + FRAME]
        faults.take(framed("north", index, sound if index >= 4 else 0.0 * sound, active=index >= 4))
    assert faults.of("north") is None


def test_copies_in_digital_silence_are_named_after_a_few_sounds() -> None:
    faults = ChannelFaults(["north"])
    rng = np.random.default_rng(3)
    for index in range(3):
        assert faults.of("north") is None
        for frame_index in (20 * index, 20 * index + 1):
            faults.take(framed("north", frame_index, hiss(rng, 4)[[0, 1, 0, 1]], active=True))
    assert faults.of("north") is not None
    for index in range(5):
        faults.take(framed("north", 100 + index, np.zeros((4, FRAME), dtype=np.float32)))
    assert faults.of("north") is not None


def test_a_fault_ends_when_the_channels_differ_again() -> None:
    rng = np.random.default_rng(4)
    faults = ChannelFaults(["north"])
    assert after_quiet(faults, [hiss(rng, 4)[[0, 0, 1, 2]] for _ in range(6)]) is not None
    faults.take(framed("north", 8, hiss(rng, 4)))
    assert faults.of("north") is None


@settings(max_examples=15)
@given(seed=st.integers(0, 1 << 30), arrays=st.integers(2, 12), order=st.permutations(range(4)))
def test_two_arrays_on_the_same_channels_are_named(seed: int, arrays: int, order: list[int]) -> None:
    """In whatever order the channels and the messages are, and beside any number of other arrays."""
    rng = np.random.default_rng(seed)
    names = [f"array-{k}" for k in range(arrays)]
    faults = ChannelFaults(names)
    for index in range(QUIET_FRAMES + SHARED_FRAMES):
        frames = {name: hiss(rng, 4) for name in names}
        frames[names[-1]] = frames[names[0]][order].copy()
        for name in rng.permutation(names).tolist():
            faults.take(framed(name, index, frames[name], active=index >= QUIET_FRAMES))
    assert set(faults.among(names)) == {names[0], names[-1]}
    fault = faults.of(names[0])
    assert fault is not None
    assert f"channels 1, 2, 3 and 4 are the same signal as channels 1, 2, 3 and 4 of '{names[-1]}'" in fault.replace(
        "its ", ""
    )
    for name in names:
        faults.take(framed(name, 50, hiss(rng, 4)))
    assert faults.among(names) == {}


def test_arrays_that_share_one_channel_are_named_with_it() -> None:
    rng = np.random.default_rng(6)
    faults = ChannelFaults(["north", "south"])
    for index in range(QUIET_FRAMES + SHARED_FRAMES):
        inputs, active = hiss(rng, 7), index >= QUIET_FRAMES
        faults.take(framed("north", index, inputs[[0, 1, 2, 3]], active=active))
        faults.take(framed("south", index, inputs[[4, 5, 3, 6]], active=active))
    fault = faults.of("north")
    assert fault is not None
    assert "its channel 4 is the same signal as channel 3 of 'south'" in fault


def test_arrays_with_the_same_background_and_other_sounds_share_no_channels() -> None:
    """As in a simulation that draws the noise of all arrays from one seed."""
    rng = np.random.default_rng(7)
    faults = ChannelFaults(["north", "south"])
    for index in range(60):
        noise, active = hiss(rng, 4), 10 <= index % 20 < 16
        for name in ("north", "south"):
            sound = hiss(rng, 4, 0.1) if active else 0.0
            faults.take(framed(name, index, noise + sound, active=active))
            assert faults.of(name) is None


def onsets_of(spec: ArraySpec, signs: Sequence[int], rng: np.random.Generator, rms: float = 1e-4) -> list[OnsetGCC]:
    front = OnsetFrontEnd(spec, RATE_HZ, LagSampling(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S))
    sound = np.zeros(16 * FRAME)
    sound[8 * FRAME :] = burst(8 * FRAME, seed=int(rng.integers(1 << 30)))
    samples = heard(spec, SOURCE_M, sound) + rms * rng.standard_normal((len(signs), len(sound)))
    received = np.asarray(samples * np.array(signs)[:, None], dtype=np.float32)
    return [front.push(received[:, k * FRAME : (k + 1) * FRAME], quiet=k < 8) for k in range(16)]


def shape(microphones: int, radius_m: float) -> ArraySpec:
    angle = 2.0 * np.pi * np.arange(microphones) / microphones
    circle_m = np.stack(
        [radius_m * np.cos(angle), radius_m * np.sin(angle), 0.3 * radius_m * np.sin(2 * angle)], axis=1
    )
    return ArraySpec("north", posed(circle_m, (1.4, 2.1, 1.5), 31.0, 5.0, -7.0), BAND_HZ)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 1 << 30),
    microphones=st.integers(3, 8),
    radius_m=st.floats(0.05, 0.4),
    data=st.data(),
)
def test_inverted_channels_are_named(seed: int, microphones: int, radius_m: float, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    inverted = data.draw(st.sets(st.integers(0, microphones - 1), max_size=(microphones - 1) // 2))
    signs = [-1 if k in inverted else 1 for k in range(microphones)]
    spec = shape(microphones, radius_m)
    faults = ChannelFaults(["north"])
    for sound in range(INVERTED_SOUNDS):
        onsets = onsets_of(spec, signs, rng)
        assert polarity(onsets[0]) is None
        assert (faults.of("north") is None) or sound >= INVERTED_SOUNDS
        fault = faults.examine("north", 100 * sound, onsets)
        if not inverted:
            assert fault is None
            continue
        assert fault is not None
        assert ("inverted against the others" in fault) == (2 * len(inverted) < microphones)
        named = fault.split(" inverted")[0]
        assert {int(word) for word in named.replace(",", "").split() if word.isdigit()} == {k + 1 for k in inverted}
    assert (faults.of("north") is not None) == bool(inverted)


def test_one_sound_examined_twice_is_counted_once() -> None:
    onsets = onsets_of(shape(4, 0.2), [1, 1, -1, 1], np.random.default_rng(1))
    faults = ChannelFaults(["north"])
    for _ in range(4):
        assert faults.examine("north", 7, onsets) is not None
    assert faults.of("north") is None


def test_a_pair_of_opposite_polarity_is_named_after_two_sounds() -> None:
    rng = np.random.default_rng(3)
    spec = ArraySpec("north", shape(4, 0.2).microphones_m[:2].copy(), BAND_HZ)
    faults = ChannelFaults(["north"])
    assert faults.examine("north", 1, onsets_of(spec, [1, -1], rng)) is None
    fault = faults.examine("north", 2, onsets_of(spec, [1, -1], rng))
    assert fault is not None
    assert fault.startswith("channel 2 and channel 1 have opposite polarity")


def test_polarity_recovers_when_the_channel_is_turned_back() -> None:
    rng, spec = np.random.default_rng(2), shape(5, 0.2)
    faults = ChannelFaults(["north"])
    for start in range(INVERTED_SOUNDS):
        faults.examine("north", start, onsets_of(spec, [1, 1, 1, -1, 1], rng))
    assert faults.of("north") is not None
    assert faults.examine("north", 90, onsets_of(spec, [1] * 5, rng)) is None
    assert faults.of("north") is None


@pytest.mark.parametrize("radius_m", [0.03, 0.1, 0.3])
def test_noise_and_tones_show_no_polarity(radius_m: float) -> None:
    rng, spec = np.random.default_rng(8), shape(4, radius_m)
    front = OnsetFrontEnd(spec, RATE_HZ, LagSampling(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S))
    t = np.arange(FRAME) / RATE_HZ
    for tone in (0.0, 0.1):
        front.reset()
        onsets = []
        for k in range(12):
            samples: FloatArray = hiss(rng, 4).astype(np.float64)
            if tone and k >= 8:
                delays_s = np.linalg.norm(spec.microphones_m - np.array(SOURCE_M), axis=1) / C_M_S
                samples = samples + tone * np.sin(2 * np.pi * 3000.0 * (t - delays_s[:, None] + k * 0.05))
            onsets.append(front.push(samples.astype(np.float32), quiet=k < 8))
        total = onsets[0]
        for one in onsets[1:]:
            total = total + one
        assert polarity(total) in (None, (1, 1, 1, 1))
