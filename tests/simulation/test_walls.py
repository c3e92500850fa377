"""Rooms with unequal walls and sources that face a direction, against an independent program and against geometry."""

from __future__ import annotations

import numpy as np
import pytest
import rir_generator
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from livessl.core.types import FloatArray
from livessl.simulation.room import absorption, impulse_responses
from livessl.simulation.walls import CROSSOVERS_HZ, MOST_ABSORPTION, TALKER, wall_absorption, wall_responses

ROOM_M = np.array([4.3, 5.2, 2.9])
SOURCE_M = np.array([1.13, 3.31, 1.47])
MICROPHONES_M = np.array([[3.1, 2.2, 1.03], [3.3, 2.35, 1.2]])
RATE_HZ = 16000.0
C_M_S = 343.0
DURATION_S = 0.25
SHARES = ((0.3, 1.7), (2.2, 0.9), (1.4, 0.5))


def in_band(signals: FloatArray) -> FloatArray:
    spectra = np.fft.rfft(signals.astype(np.float64), axis=-1)
    frequency_hz = np.fft.rfftfreq(signals.shape[-1], 1 / RATE_HZ)
    return np.asarray(spectra[..., (frequency_hz >= 150) & (frequency_hz <= 6000)])


def error(found: FloatArray, expected: FloatArray) -> float:
    wanted = in_band(expected)
    return float(np.linalg.norm(in_band(found) - wanted) / np.linalg.norm(wanted))


def made(
    absorptions: FloatArray, facing: FloatArray | None = None, microphones_m: FloatArray = MICROPHONES_M
) -> FloatArray:
    found = wall_responses(
        ROOM_M,
        SOURCE_M,
        microphones_m,
        absorptions,
        duration_s=DURATION_S,
        sample_rate_hz=RATE_HZ,
        c_m_s=C_M_S,
        facing=facing,
    )
    return found.astype(np.float64)


@given(rt60_s=st.floats(0.3, 1.5))
@settings(max_examples=4, deadline=None)
def test_equal_walls_give_the_room_with_equal_walls(rt60_s: float) -> None:
    absorptions = wall_absorption(rt60_s, ROOM_M, np.ones((3, 2)))
    (expected,) = impulse_responses(
        ROOM_M, SOURCE_M, MICROPHONES_M, [rt60_s], sample_rate_hz=RATE_HZ, duration_s=DURATION_S, compiled=True
    )
    assert error(made(absorptions), expected.astype(np.float64)) < 1e-4  # single precision


def test_unequal_walls_give_what_another_program_gives() -> None:
    absorptions = wall_absorption(0.4, ROOM_M, SHARES)
    expected = np.asarray(
        rir_generator.generate(
            C_M_S,
            int(RATE_HZ),
            MICROPHONES_M,
            SOURCE_M,
            ROOM_M,
            beta=np.sqrt(1.0 - absorptions).ravel(),
            nsample=round(DURATION_S * RATE_HZ),
            hp_filter=False,
        )
    ).T
    assert error(made(absorptions), expected) < 0.005  # the other program interpolates by short windowed sincs
    exchanged = np.ascontiguousarray(absorptions[:, ::-1])
    assert error(made(exchanged), expected) > 0.1  # walls opposite to each other are not the same


@pytest.mark.parametrize("turn", [0.0, 180.0, 90.0])
def test_a_talker_is_weaker_behind_him_at_high_frequencies(turn: float) -> None:
    """Without reflections, the level is that of the pattern at the angle between facing and microphone."""
    ahead = MICROPHONES_M[0] - SOURCE_M
    aside = np.cross(ahead, [0.0, 0.0, 1.0])
    facing = np.cos(np.radians(turn)) * ahead / np.linalg.norm(ahead)
    facing = facing + np.sin(np.radians(turn)) * aside / np.linalg.norm(aside)
    dead = np.ones((3, 2, 1))
    all_around, faced = (made(dead, facing=way, microphones_m=MICROPHONES_M[:1])[0] for way in (None, facing))
    frequency_hz = np.fft.rfftfreq(len(faced), 1 / RATE_HZ)
    gain = np.abs(np.fft.rfft(faced) / np.fft.rfft(all_around))
    edges_hz = (100.0, *CROSSOVERS_HZ, 6000.0)
    for share, low_hz, high_hz in zip(TALKER, edges_hz[:-1], edges_hz[1:], strict=True):
        inside = (frequency_hz > 1.5 * low_hz) & (frequency_hz < high_hz / 1.5)
        expected = 1.0 - share + share * np.cos(np.radians(turn))
        np.testing.assert_allclose(gain[inside], expected, atol=0.01)


@pytest.mark.parametrize(("axis", "far"), [(0, True), (1, False), (2, True)])
def test_a_reflection_has_the_level_of_the_direction_in_which_its_sound_left(axis: int, far: bool) -> None:
    """One hard wall: the talker faces it, or turns his back to it."""
    absorptions = np.full((3, 2, 1), 1.0)
    absorptions[axis, int(far), 0] = 0.0
    image_m, wall = SOURCE_M.copy(), float(ROOM_M[axis] if far else 0.0)
    image_m[axis] = 2.0 * wall - image_m[axis]
    seen = MICROPHONES_M[0] - image_m
    leaving = seen.copy()
    leaving[axis] = -leaving[axis]  # the wall has turned it
    high_pass = butter(4, 2.0 * CROSSOVERS_HZ[1], "highpass", fs=RATE_HZ, output="sos")
    at = round(np.linalg.norm(seen) / C_M_S * RATE_HZ)
    for sign in (1.0, -1.0):
        facing = np.zeros(3)
        facing[axis] = sign
        faced, all_around = (
            sosfiltfilt(high_pass, made(absorptions, facing=way, microphones_m=MICROPHONES_M[:1])[0])[at - 8 : at + 9]
            for way in (facing, None)
        )
        cosine = sign * leaving[axis] / np.linalg.norm(leaving)
        found = float(faced @ all_around / (all_around @ all_around))
        assert found == pytest.approx(1.0 - TALKER[-1] + TALKER[-1] * cosine, abs=0.05)


@given(shares=st.lists(st.floats(0.5, 2.0), min_size=6, max_size=6), rt60_s=st.floats(0.4, 2.0))
def test_the_mean_absorption_is_that_of_the_reverberation_time(shares: list[float], rt60_s: float) -> None:
    found = wall_absorption(rt60_s, ROOM_M, np.reshape(shares, (3, 2)), (0.5, 1.0, 1.2))
    assert found.shape == (3, 2, 3)
    assert ((found > 0.0) & (found <= MOST_ABSORPTION)).all()
    x, y, z = ROOM_M
    areas = np.repeat([y * z, x * z, x * y], 2).reshape(3, 2)
    if found.max() < MOST_ABSORPTION:
        means = (found * areas[..., None]).sum(axis=(0, 1)) / areas.sum()
        np.testing.assert_allclose(means, absorption(rt60_s, ROOM_M) * np.array([0.5, 1.0, 1.2]))


def test_two_bands_are_refused() -> None:
    with pytest.raises(ValueError, match="expected absorption in 1 or 3 bands, got 2"):
        made(np.full((3, 2, 2), 0.5))
