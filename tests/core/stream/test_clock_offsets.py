"""Offsets of clocks from sounds: their size, their uncertainty, and the corrections made of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, burst, delayed, tetra
from livessl.core.stream.clock_offsets import INTERVAL_S, LEAST_SOUNDS, ClockOffsets, lateness_s
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, FloatArray, Frame

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
EAST = tetra("east", [6.0, 1.1, 1.2], yaw_deg=33.0)
SOURCE_M = np.array([1.13, 3.31, 1.47])
SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS


def frames_of(spec: ArraySpec, sound: FloatArray, ahead_s: float = 0.0, noise: float = 1e-4) -> list[Frame]:
    """A sound from the source as an array receives it after its travel, in frames of a clock that is ahead."""
    travel_s = np.linalg.norm(spec.microphones_m - SOURCE_M, axis=1) / C_M_S
    samples = delayed(sound, travel_s)
    samples += (noise * np.random.default_rng(len(spec.name)).standard_normal(samples.shape)).astype(np.float32)
    n = round(FRAME_S * RATE_HZ)
    first_ns = START_NS + round(ahead_s * 1e9)
    return [
        Frame(spec.name, k, first_ns // FRAME_NS + k, first_ns + k * FRAME_NS, RATE_HZ, piece, 1e-3, True)
        for k, piece in enumerate(np.ascontiguousarray(samples[:, at : at + n]) for at in range(0, samples.shape[1], n))
        if piece.shape[1] == n
    ]


def knocks() -> FloatArray:
    """Three knocks that keep no beat, after half a second of quiet."""
    sound = np.zeros(round(2.0 * RATE_HZ))
    for k, at_s in enumerate((0.55, 0.83, 1.27)):
        begin, knock = round(at_s * RATE_HZ), burst(1200, seed=k)
        sound[begin : begin + len(knock)] += knock
    return sound


def travel_s(specs: Iterable[ArraySpec]) -> dict[str, float]:
    return {spec.name: float(np.linalg.norm(spec.centre_m - SOURCE_M)) / C_M_S for spec in specs}


@pytest.mark.parametrize("ahead_s", [0.0, 0.0137, -0.15, 0.31])
def test_difference_of_arrival_is_the_offset_of_the_clocks(ahead_s: float) -> None:
    heard = {"north": frames_of(NORTH, knocks()), "south": frames_of(SOUTH, knocks(), ahead_s)}
    late = lateness_s(heard, travel_s([NORTH, SOUTH]))
    # a rise is known to the piece it falls into; three of them, interpolated, to half a piece
    assert late["south"] - late["north"] == pytest.approx(ahead_s, abs=INTERVAL_S / 2)


def test_travel_time_is_subtracted() -> None:
    heard = {"north": frames_of(NORTH, knocks()), "east": frames_of(EAST, knocks())}
    true_s = travel_s([NORTH, EAST])
    assert true_s["east"] - true_s["north"] > 2 * INTERVAL_S
    assert lateness_s(heard, true_s)["east"] == pytest.approx(0.0, abs=INTERVAL_S / 2)
    without = lateness_s(heard, {"north": 0.0, "east": 0.0})
    assert without["east"] == pytest.approx(true_s["east"] - true_s["north"], abs=INTERVAL_S / 2)


def test_periodic_sound_gives_no_offset() -> None:
    """Six knocks each half a second: by one of them later or earlier, five fit."""
    sound = np.zeros(round(3.0 * RATE_HZ))
    for k in range(6):
        begin = round((0.1 + 0.5 * k) * RATE_HZ)
        sound[begin : begin + 1200] += burst(1200)
    # so much noise that the first rises no more than the others, out of what is left of the one before
    heard = {"north": frames_of(NORTH, sound, noise=0.01), "south": frames_of(SOUTH, sound, noise=0.01)}
    assert lateness_s(heard, travel_s([NORTH, SOUTH])) == {}
    once = {name: frames[:10] for name, frames in heard.items()}
    assert len(lateness_s(once, travel_s([NORTH, SOUTH]))) == 2


def test_noise_gives_no_offset() -> None:
    silence = np.zeros(round(2.0 * RATE_HZ))
    heard = {"north": frames_of(NORTH, silence), "south": frames_of(SOUTH, silence)}
    assert lateness_s(heard, travel_s([NORTH, SOUTH])) == {}


def learned(
    ahead_s: Sequence[float], sounds: int = 12, drift: float = 0.0, wrong: Iterable[int] = (), every_s: float = 20.0
) -> ClockOffsets:
    """Offsets learned from sounds that are so late at the clocks `a`, `b`, …, to 3 ms; the last one drifts."""
    names = "abcdef"[: len(ahead_s)]
    clocks = ClockOffsets({name: name for name in names}, C_M_S)
    rng = np.random.default_rng(1)
    for k in range(sounds):
        late = {name: off + rng.normal(0.0, 0.003) for name, off in zip(names, ahead_s, strict=True)}
        late[names[-1]] += drift * k * every_s + (0.4 if k in wrong else 0.0)
        clocks.learn(START_NS + round(k * every_s * 1e9), late)
    return clocks


def test_offset_is_unknown_before_three_sounds() -> None:
    assert learned([0.0, 0.15], sounds=LEAST_SOUNDS - 1).of("b") is None
    known = learned([0.0, 0.15], sounds=LEAST_SOUNDS).of("b")
    assert known is not None
    assert known.sounds == LEAST_SOUNDS


@pytest.mark.parametrize("wrong", [(), (0, 1, 5, 9)])
def test_offset_lies_within_its_uncertainty(wrong: tuple[int, ...]) -> None:
    known = learned([0.0, 0.15], wrong=wrong).of("b")
    assert known is not None
    assert known.reference == "a"
    assert abs(known.offset_s - 0.15) < 4 * known.std_s
    assert known.std_s < 0.006


@pytest.mark.parametrize("drift", [100e-6, -100e-6])
def test_drift_is_followed(drift: float) -> None:
    """A clock of 100 ppm is 62 ms off after 31 sounds in ten minutes; without the line's slope half of it is missed."""
    known = learned([0.0, 0.0], sounds=32, drift=drift).of("b")
    assert known is not None
    assert known.offset_s == pytest.approx(drift * 31 * 20, abs=0.006)


def test_offset_of_a_clock_that_was_set_is_known_after_three_sounds() -> None:
    clocks = learned([0.0, 0.15])
    for k in range(LEAST_SOUNDS):
        clocks.learn(START_NS + (300 + k) * SECOND_NS, {"a": 0.0, "b": 0.01})
    known = clocks.of("b")
    assert known is not None
    assert known.offset_s == pytest.approx(0.01, abs=0.003)


def test_median_clock_is_the_reference() -> None:
    clocks = learned([0.15, 0.0, 0.003])
    known = {name: clocks.of(name) for name in "abc"}
    assert all(offset is not None and offset.reference == "c" for offset in known.values())
    assert [clocks.frames_ahead(name) for name in "abc"] == [3, 0, 0]


def test_clocks_without_common_sounds_are_compared_over_a_third() -> None:
    clocks = ClockOffsets({name: name for name in "abc"}, C_M_S)
    for k in range(8):
        late = {"a": 0.0, "b": 0.1} if k % 2 else {"b": 0.1, "c": -0.1}
        clocks.learn(START_NS + k * SECOND_NS, late)
    a, b, c = (clocks.of(name) for name in "abc")
    assert a is not None and b is not None and c is not None  # noqa: PT018 - one thing
    assert b.offset_s - a.offset_s == pytest.approx(0.1, abs=0.002)
    assert c.offset_s - b.offset_s == pytest.approx(-0.2, abs=0.002)


def test_arrays_of_one_node_give_no_offset() -> None:
    clocks = ClockOffsets({"north": "pc", "south": "pc", "east": "other"}, C_M_S)
    assert not clocks.differ(["north", "south"])
    assert clocks.differ(["north", "east"])
    for k in range(LEAST_SOUNDS):
        clocks.learn(START_NS + k * SECOND_NS, {"north": 0.0, "south": 0.004, "east": 0.102})
    assert clocks.of("north") == clocks.of("south")
    known = clocks.of("east")
    assert known is not None
    assert known.offset_s == pytest.approx(0.1, abs=1e-3)


def test_correction_has_a_hysteresis() -> None:
    """30 ms are left alone; 40 ms are a frame; and a frame stays one until an offset is 35 ms off it."""
    clocks = ClockOffsets({"a": "a", "b": "b"}, C_M_S)
    frames = []
    for k, off_s in enumerate([0.03] * 8 + [0.04] * 40 + [0.03] * 40 + [0.01] * 40):
        clocks.learn(START_NS + k * SECOND_NS, {"a": 0.0, "b": off_s})
        frames.append(clocks.frames_ahead("b"))
    assert [frames[k] for k in (7, 47, 87, 127)] == [0, 1, 1, 0]
    assert clocks.rest_s("a") == 0.0


def test_state_survives_json() -> None:
    clocks = learned([0.0, 0.15])
    again = ClockOffsets({"a": "a", "b": "b"}, C_M_S)
    again.restore(json.loads(json.dumps(clocks.state())))
    assert again.of("b") == clocks.of("b")
    assert again.frames_ahead("b") == 3
    for each in (clocks, again):
        each.learn(START_NS + 1000 * SECOND_NS, {"a": 0.0, "b": 0.151})
    assert again.of("b") == clocks.of("b")


def test_state_of_other_nodes_is_left_out() -> None:
    other = ClockOffsets({"a": "a", "z": "z"}, C_M_S)
    other.restore(learned([0.0, 0.15]).state())
    assert other.of("z") is None
