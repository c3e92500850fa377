"""A background that sounded before: it lowers the confidence of its own place, and the sound is found beneath it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.geometry import Grid
from livessl.core.locate.background import FAR_BELOW, LOUD, loud_frames
from livessl.core.locate.confidence import LEAST_CONFIDENCE, ConfidenceFeatures
from livessl.core.locate.estimator import Course, Localization, Sound
from livessl.core.locate.frame_gccs import BEGINNING
from livessl.core.locate.onset import Onset
from livessl.core.types import FRAME_S, Float32Array, FloatArray

ARRAYS = (tetra("north", [2.7, 4.2, 1.3]), tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0))
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
SOURCE_M, BACKGROUND_M = np.array([1.13, 3.31, 1.47]), np.array([3.2, 2.3, 0.8])
FRAME = round(FRAME_S * RATE_HZ)
QUIET, ACTIVE = 8, 8


def strokes(rng: np.random.Generator) -> FloatArray:
    """Short strokes of noise every 60 ms: each is an onset, so that none is learned as steady noise."""
    times_s = np.arange((QUIET + ACTIVE) * FRAME) / RATE_HZ
    return np.asarray(rng.standard_normal(len(times_s)) * np.exp(-(times_s % 0.06) / 0.01))


def located(seed: int, *, background: float, sound: float = 1.0, known: bool = True) -> Localization:
    """Locate a burst in strokes from another place, with this root mean square of either."""
    rng = np.random.default_rng(seed)
    beat = strokes(rng)
    beat *= 0.03 * background / np.sqrt(np.square(beat).mean())
    own = np.zeros_like(beat)
    own[QUIET * FRAME :] = burst(ACTIVE * FRAME, seed + 1)
    own *= 0.03 * sound / max(1e-9, np.sqrt(np.square(own[QUIET * FRAME :]).mean()))
    estimator = Onset(ARRAYS, GRID, C_M_S)
    sounds = {}
    for spec in ARRAYS:
        clean = heard(spec, BACKGROUND_M, beat) + heard(spec, SOURCE_M, own)
        samples: Float32Array = clean + np.float32(1e-3) * rng.standard_normal(clean.shape, dtype=np.float32)
        frames = np.split(samples, QUIET + ACTIVE, axis=1)
        listener = estimator.onset_front_end(spec.name, RATE_HZ)
        onsets = [listener.push(frame, quiet=k < QUIET) for k, frame in enumerate(frames)]
        powers = np.array([float(np.square(frame).mean()) for frame in frames])
        course = Course(np.arange(len(frames)), powers, QUIET) if known else None
        sounds[spec.name] = Sound((samples[:, QUIET * FRAME :],), RATE_HZ, onsets, course=course)
    return estimator.locate(sounds)


def apart_m(found: Localization, place_m: FloatArray) -> float:
    return float(np.linalg.norm(found.position_m - place_m))


@given(background=st.floats(0.5, 1.0), seed=st.integers(1, 100))
@settings(max_examples=3, deadline=None)
def test_a_sound_is_found_beneath_a_background_with_onsets(background: float, seed: int) -> None:
    without = located(seed, background=background, known=False)
    assert apart_m(without, BACKGROUND_M) < 0.2  # where the background is not known, it is taken for the sound
    assert without.refused is None
    found = located(seed, background=background)
    assert apart_m(found, SOURCE_M) < 0.2
    assert found.refused is None


def test_a_background_alone_is_refused() -> None:
    found = located(3, background=1.0, sound=0.0)
    assert found.refused is not None
    assert found.confidence < LEAST_CONFIDENCE
    assert located(3, background=1.0, sound=0.0, known=False).refused is None


def test_a_background_far_below_the_sound_changes_nothing() -> None:
    """An earlier sound from the same place still sounds in the pre-roll; only its level says that it is none."""
    found, without = (located(4, background=0.03, known=known) for known in (True, False))
    assert found.confidence == pytest.approx(without.confidence, abs=0.01)
    np.testing.assert_allclose(found.position_m, without.position_m, atol=1e-6)


def test_the_confidence_falls_with_the_share_of_the_background() -> None:
    clear = ConfidenceFeatures(0.3, 8.0, crossing_deg=60.0, second_array=3.0)
    shares = [replace(clear, background=share).confidence for share in (0.0, 0.1, 0.3, 1.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] == clear.confidence
    assert shares[2] < LEAST_CONFIDENCE < shares[0]
    assert not replace(clear, background=1.0).is_sure
    assert replace(clear, background=1e6).confidence < 1e-9  # and no warning of an overflow


def weighing(powers: list[float], quiet: int) -> Sound:
    """Return a sound with these powers of its frames, of which the first are quiet."""
    course = Course(np.arange(len(powers)), np.array(powers), quiet)
    onset = OnsetGCC(np.zeros((6, 3), dtype=np.float32), np.ones(4))
    return Sound((), RATE_HZ, [onset] * len(powers), course=course)


@given(
    quiet=st.integers(BEGINNING + 1, 10),
    powers=st.lists(st.floats(0.2, 5.0), min_size=1, max_size=30),
    background=st.floats(2.0 * FAR_BELOW, 10.0),
)
def test_loud_frames_are_those_that_are_nearly_as_loud_as_the_loudest(
    quiet: int, powers: list[float], background: float
) -> None:
    level = background * float(np.mean(powers))
    chosen = set(loud_frames(weighing([level] * (quiet - BEGINNING) + [0.0] * BEGINNING + powers, quiet)))
    least = LOUD * max(powers)
    assert chosen == {quiet + k for k, power in enumerate(powers) if power >= least}


def test_no_frame_is_loud_beside_a_weak_or_unknown_background() -> None:
    powers = [1.0, 0.1, 1.0]
    assert list(loud_frames(weighing([0.2] * 8 + powers, 8))) == [8, 10]
    assert not loud_frames(weighing([0.01 * FAR_BELOW] * 8 + powers, 8))
    assert not loud_frames(weighing(powers, 0))
    assert not loud_frames(replace(weighing([0.2] * 8 + powers, 8), course=None))


def doubtful(seed: int, *, noise: float, looks: bool) -> Localization:
    """Locate a burst of two frames in noise of this root mean square, 48 frames long; that of the burst is 0.03."""
    rng = np.random.default_rng(seed)
    frames = QUIET + 3 * ACTIVE
    own = np.zeros(frames * FRAME)
    sounding = slice(QUIET * FRAME, (QUIET + 2) * FRAME)
    own[sounding] = burst(2 * FRAME, seed + 1)
    own *= 0.03 / np.sqrt(np.square(own[sounding]).mean())
    estimator, sounds = Onset(ARRAYS, GRID, C_M_S), {}
    for spec in ARRAYS:
        clean = heard(spec, SOURCE_M, own)
        samples: Float32Array = clean + np.float32(noise) * rng.standard_normal(clean.shape, dtype=np.float32)
        parts = np.split(samples, frames, axis=1)
        listener = estimator.onset_front_end(spec.name, RATE_HZ)
        onsets = [listener.push(part, quiet=k < QUIET) for k, part in enumerate(parts)]
        course = Course(np.arange(frames), np.array([float(np.square(part).mean()) for part in parts]), QUIET)
        active = samples[:, QUIET * FRAME :]
        sounds[spec.name] = Sound((active,), RATE_HZ, onsets, course=course, second_looks=looks)
    return estimator.locate(sounds)


def test_a_doubtful_sound_in_noise_is_found_by_its_loud_frames() -> None:
    without, found = (doubtful(2, noise=0.08, looks=looks) for looks in (False, True))
    assert without.refused is not None
    assert apart_m(without, SOURCE_M) > 1.0
    assert found.refused is None
    assert apart_m(found, SOURCE_M) < 0.2
    assert found.features is not None
    assert not found.features.whole  # loud frames, not whole segments


@given(seed=st.integers(1, 100), noise=st.floats(0.04, 0.1))
@settings(max_examples=3, deadline=None)
def test_another_look_never_makes_a_sound_less_certain(seed: int, noise: float) -> None:
    without, found = (doubtful(seed, noise=noise, looks=looks) for looks in (False, True))
    assert found.refused is None or without.refused is not None
    assert found.confidence >= without.confidence or without.refused is not None
