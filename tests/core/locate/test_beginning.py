"""The beginning of a sound: what joins later, louder and from elsewhere, is not taken for the sound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.geometry import Grid
from livessl.core.locate.beginning import BEFORE, FRAMES, beginning, first_frame
from livessl.core.locate.confidence import LEAST_CONFIDENCE, ConfidenceFeatures
from livessl.core.locate.estimator import Course, Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.types import FRAME_S, Float32Array, FloatArray

ARRAYS = (tetra("north", [2.7, 4.2, 1.3]), tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0))
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
SOURCE_M, LATER_M = np.array([1.13, 3.31, 1.47]), np.array([3.2, 2.3, 0.8])
FRAME = round(FRAME_S * RATE_HZ)
QUIET, SOUNDING, ACTIVE = 8, 3, 16
NOTHING = OnsetGCC(np.zeros((6, 3), dtype=np.float32), np.zeros(4))


def strokes(rng: np.random.Generator, first: int) -> FloatArray:
    """Short strokes of noise every 60 ms from a frame on: each is an onset."""
    times_s = np.arange((QUIET + ACTIVE) * FRAME) / RATE_HZ
    later = rng.standard_normal(len(times_s)) * np.exp(-(times_s % 0.06) / 0.01)
    later[: first * FRAME] = 0.0
    return np.asarray(later)


def located(seed: int, *, louder: float, first: int, pre_roll: int = QUIET) -> Localization:
    """Locate a burst of three frames, to which strokes from elsewhere are added from a frame on."""
    rng = np.random.default_rng(seed)
    later = 0.03 * louder * strokes(rng, first)
    own = np.zeros_like(later)
    own[QUIET * FRAME : (QUIET + SOUNDING) * FRAME] = 0.03 * burst(SOUNDING * FRAME, seed + 1)
    estimator, sounds = Onset(ARRAYS, GRID, C_M_S), {}
    for spec in ARRAYS:
        clean = heard(spec, LATER_M, later) + heard(spec, SOURCE_M, own)
        samples: Float32Array = clean + np.float32(1e-3) * rng.standard_normal(clean.shape, dtype=np.float32)
        frames = np.split(samples, QUIET + ACTIVE, axis=1)
        listener = estimator.onset_front_end(spec.name, RATE_HZ)
        onsets = [listener.push(frame, quiet=k < QUIET) for k, frame in enumerate(frames)][QUIET - pre_roll :]
        powers = np.array([float(np.square(frame).mean()) for frame in frames])[QUIET - pre_roll :]
        course = Course(np.arange(QUIET - pre_roll, len(frames)), powers, QUIET)
        sounds[spec.name] = Sound((samples[:, QUIET * FRAME :],), RATE_HZ, onsets, course=course)
    return estimator.locate(sounds)


def apart_m(found: Localization, place_m: FloatArray) -> float:
    return float(np.linalg.norm(found.position_m - place_m))


@given(louder=st.floats(1.0, 2.0), first=st.integers(QUIET + FRAMES + 1, QUIET + 7), seed=st.integers(1, 100))
@settings(max_examples=3, deadline=None)
def test_what_joins_a_sound_later_is_not_taken_for_it(louder: float, first: int, seed: int) -> None:
    unknown = located(seed, louder=louder, first=first, pre_roll=0)
    assert apart_m(unknown, LATER_M) < 0.2  # without a pre-roll the louder source is the answer
    found = located(seed, louder=louder, first=first)
    assert apart_m(found, SOURCE_M) < 0.2
    assert found.refused is None


def test_a_sound_that_nothing_joins_stays_where_it_was() -> None:
    found, unknown = (located(4, louder=0.0, first=QUIET, pre_roll=frames) for frames in (QUIET, 0))
    assert apart_m(found, SOURCE_M) < 0.1
    assert apart_m(unknown, SOURCE_M) < 0.1
    assert found.features is not None
    assert found.features.beginning is not None
    assert unknown.features is not None
    assert unknown.features.beginning is None


def test_confidence_falls_with_what_a_beginning_lacks() -> None:
    clear = ConfidenceFeatures(0.3, 8.0, crossing_deg=60.0, second_array=3.0)
    began = [replace(clear, beginning=ratio).confidence for ratio in (8.0, 2.0, 1.0, 0.0)]
    assert began == sorted(began, reverse=True)
    assert began[0] == clear.confidence  # an unknown beginning lacks nothing
    assert began[-1] < LEAST_CONFIDENCE < began[0]


def sound(begin: int, first: int, last: int, *, known: bool = True) -> Sound:
    """A sound with silent onsets in the frames from `first` to before `last`."""
    indices = np.arange(first, last)
    course = Course(indices, np.ones(len(indices)), begin) if known else None
    return Sound((), RATE_HZ, [NOTHING] * len(indices), course=course)


@given(begin=st.integers(-1000, 1000), pre_roll=st.integers(1, 10), later=st.integers(0, 5), after=st.integers(1, 40))
def test_the_beginning_is_around_the_first_active_frame_of_any_array(
    begin: int, pre_roll: int, later: int, after: int
) -> None:
    last = begin + FRAMES + after
    sounds = {
        "near": sound(begin, begin - pre_roll, last),
        "far": sound(begin + later, begin - pre_roll, last),
    }
    first = first_frame(sounds)
    assert first == begin
    for each in sounds.values():
        chosen = beginning(each, first)
        assert chosen is not None
        assert each.course is not None
        indices = each.course.frame_indices[chosen].tolist()
        assert indices == list(range(begin - min(BEFORE, pre_roll), begin + FRAMES))


@pytest.mark.parametrize(
    "alone",
    [sound(5, 5, 30), sound(5, 0, 30, known=False), sound(5, 0, 5 + FRAMES)],
    ids=["no pre-roll", "no course", "nothing after it"],
)
def test_a_beginning_may_be_unknown(alone: Sound) -> None:
    assert beginning(alone, first_frame({"only": alone})) is None
