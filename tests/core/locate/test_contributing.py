"""An array contributes when it carries evidence; its own noise is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, ideal_gcc, tetra, true_lags_s
from livessl.core.geometry import Grid, posed, tetrahedron
from livessl.core.locate.contributing import FALSE_ALARMS, contributing, height, is_fixed, threshold
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import ArraySpec, Evidence, Float32Array, FloatArray

FRAME: Final = 800
QUIET: Final = 8
"""Frames before a sound."""
GRID: Final = Grid(((0.0, 6.0), (0.0, 7.0), (0.0, 3.0)), 0.1)
NORTH: Final = tetra("north", [3.1, 1.8, 1.4])
SOUTH: Final = tetra("south", [2.9, 5.3, 1.6], yaw_deg=71.0)
SOURCE_M: Final = np.array([1.6, 3.4, 1.1])

BOTH: Final = Onset([NORTH, SOUTH], GRID, C_M_S)


def line(count: int, spacing_m: float) -> FloatArray:
    return np.stack([spacing_m * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)


def circle(count: int, radius_m: float) -> FloatArray:
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(count)], axis=1)


SHAPES: Final = {
    "tetrahedron": tetrahedron(0.5),
    "small tetrahedron": tetrahedron(0.2),
    "square": circle(4, 0.032),
    "ring": circle(6, 0.05),
    "line": line(4, 0.1),
    "pair": line(2, 0.4),
}
BANDS_HZ: Final = (BAND_HZ, (400.0, 4000.0), (4000.0, 7500.0))


def noise(rng: np.random.Generator, microphones: int, frames: int, rms: float, slope: float = 0.0) -> Float32Array:
    """Noise that differs at every microphone; its power falls with frequency to the power of `slope`."""
    spectrum = np.fft.rfft(rng.standard_normal((microphones, frames * FRAME)))
    samples = np.fft.irfft(spectrum / (1.0 + np.arange(spectrum.shape[1])) ** (slope / 2.0), frames * FRAME)
    return np.asarray(rms * samples / samples.std(), dtype=np.float32)


def as_sound(estimator: Onset, spec: ArraySpec, samples: Float32Array, *, detected: bool) -> Sound:
    """The sound of an array that was quiet for `QUIET` frames."""
    front_end = estimator.onset_front_end(spec.name, RATE_HZ)
    onsets = [
        front_end.push(samples[:, at : at + FRAME], quiet=at < QUIET * FRAME)
        for at in range(0, samples.shape[1], FRAME)
    ]
    return Sound((samples[:, QUIET * FRAME :],), RATE_HZ, onsets, detected=detected)


def received(spec: ArraySpec, rng: np.random.Generator, frames: int, level: float, rms: float) -> Float32Array:
    """A burst from `SOURCE_M` after `QUIET` frames, in noise."""
    count = (QUIET + frames) * FRAME
    sound = np.zeros(count)
    sound[QUIET * FRAME :] = level * burst(frames * FRAME, seed=int(rng.integers(1 << 30)))
    return heard(spec, SOURCE_M, sound) + noise(rng, len(spec.microphones_m), QUIET + frames, rms)


def located(north: Float32Array, south: Float32Array, *, south_detected: bool) -> Localization:
    return BOTH.locate(
        {
            "north": as_sound(BOTH, NORTH, north, detected=True),
            "south": as_sound(BOTH, SOUTH, south, detected=south_detected),
        }
    )


@pytest.mark.parametrize("band_hz", BANDS_HZ, ids=str)
@pytest.mark.parametrize("shape", SHAPES)
def test_noise_alone_seldom_stands_out(shape: str, band_hz: tuple[float, float]) -> None:
    """Of 60 sounds 0.06 are expected to, if the threshold holds its rate; three are as likely as 1 in 30 000."""
    rng = np.random.default_rng(len(shape) + round(band_hz[0]))
    spec = ArraySpec("one", posed(SHAPES[shape], [2.9, 3.2, 1.4], 17.0, 4.0, -3.0), band_hz)
    estimator = Onset([spec], Grid(GRID.bounds_m, 0.2), C_M_S)
    estimator.prepare("one", RATE_HZ)
    stood_out = 0
    for _ in range(60):
        samples = noise(rng, len(spec.microphones_m), QUIET + int(rng.integers(2, 12)), 1e-3, rng.uniform(0.0, 1.5))
        (evidence,) = estimator.evidence({"one": as_sound(estimator, spec, samples, detected=False)})
        power = estimator.power_maps([evidence]).fused.max()
        stood_out += height(evidence, float(power)) > threshold(spec, C_M_S)
    assert stood_out <= 60 * FALSE_ALARMS + 2


def test_an_array_that_receives_only_its_own_noise_changes_nothing() -> None:
    """Of 40 sounds 0.04 are expected in which noise passes for evidence."""
    rng = np.random.default_rng(11)
    passed = 0
    for _ in range(40):
        frames, rms = int(rng.integers(2, 12)), 10.0 ** rng.uniform(-6.0, -2.0)
        north = received(NORTH, rng, frames, 10.0 ** rng.uniform(-2.0, 0.0), 1e-4)
        found = located(north, noise(rng, 4, QUIET + frames, rms, rng.uniform(0.0, 1.5)), south_detected=False)
        if not found.unneeded:
            passed += 1
            continue
        alone = BOTH.locate({"north": as_sound(BOTH, NORTH, north, detected=True)})
        assert set(found.unneeded) == {"south"}
        assert [part.spec.name for part in found.evidence] == ["north"]
        np.testing.assert_array_equal(found.position_m, alone.position_m)
        assert found.confidence == alone.confidence
    assert passed <= 1


EAST: Final = tetra("east", [5.2, 3.6, 1.9], yaw_deg=-40.0)
THREE: Final = Onset([NORTH, SOUTH, EAST], GRID, C_M_S)
AROUND_M: Final = [np.array([3.0 + 2.4 * np.cos(k), 3.5 + 2.8 * np.sin(k), 1.0 + 0.1 * k]) for k in range(8)]
PAIRS: Final = [
    ArraySpec(f"p{k}", posed(SHAPES["pair"], at_m, 50.0 * k, 20.0 * k, 0.0), BAND_HZ) for k, at_m in enumerate(AROUND_M)
]


def test_noise_beside_two_arrays_that_fix_the_place_seldom_contributes_and_moves_little() -> None:
    """Of 40 sounds 2 are expected in which it does; eight are as likely as 1 in 1000."""
    rng = np.random.default_rng(21)
    passed = 0
    for _ in range(40):
        frames = int(rng.integers(2, 12))
        sounds = {
            spec.name: as_sound(THREE, spec, received(spec, rng, frames, 0.5, 1e-3), detected=True)
            for spec in (NORTH, SOUTH)
        }
        two = THREE.locate(sounds)
        empty = noise(rng, 4, QUIET + frames, 1e-3, rng.uniform(0.0, 1.5))
        three = THREE.locate({**sounds, "east": as_sound(THREE, EAST, empty, detected=False)})
        passed += "east" not in three.unneeded
        assert np.linalg.norm(three.position_m - two.position_m) < 0.02
    assert passed <= 8


def of_pairs(rng: np.random.Generator, heights: FloatArray, place_m: FloatArray) -> tuple[Evidence, ...]:
    """Evidence of pairs of microphones for a place, so many standard deviations above the noise of each."""
    evidence = []
    for spec, above in zip(PAIRS, heights, strict=True):
        gcc = ideal_gcc(spec, true_lags_s(spec.microphones_m, place_m))
        values = 0.1 * (above * gcc.values + rng.standard_normal(gcc.values.shape))
        evidence.append(
            Evidence(spec, replace(gcc, values=values.astype(np.float32)), noise_rms=0.1, is_presumed=False)
        )
    return tuple(evidence)


def nowhere(_: Evidence) -> float:
    """Own peak of an array that does not stand out."""
    return 0.0


@settings(max_examples=25)
@given(seed=st.integers(0, 1 << 30), above=st.floats(4.0, 4.3))
def test_pairs_that_do_not_stand_out_contribute_where_the_others_fix_the_place(seed: int, above: float) -> None:
    """As in a reverberant room: each is below its threshold, and all are high at one place."""
    evidence = of_pairs(np.random.default_rng(seed), np.full(8, above), SOURCE_M)
    functional = SRPFunctional(evidence, C_M_S)
    there = contributing(evidence, functional.pair_terms(SOURCE_M), nowhere, C_M_S)
    elsewhere = contributing(evidence, functional.pair_terms(np.array([5.1, 0.7, 2.2])), nowhere, C_M_S)
    assert len(there) >= 6
    assert len(elsewhere) <= 3


@pytest.mark.parametrize(("microphones", "fixed"), [((2, 2), False), ((2, 2, 2), True), ((4,), False), ((4, 2), True)])
def test_the_others_must_determine_three_coordinates(microphones: tuple[int, ...], fixed: bool) -> None:
    """Two pairs leave a curve, and one array a line, on which the noise of a further array fits somewhere."""
    shapes = {2: SHAPES["pair"], 4: SHAPES["tetrahedron"]}
    specs = [ArraySpec(str(n), shapes[count], BAND_HZ) for n, count in enumerate((*microphones, 4))]
    heights = [20.0] * len(microphones) + [2.0]
    assert is_fixed(specs, heights, len(microphones)) is fixed
    assert not is_fixed(specs, [3.0] * len(microphones) + [2.0], len(microphones))


def test_an_array_of_zeros_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    zeros = np.zeros((4, (QUIET + 6) * FRAME), dtype=np.float32)
    for south_detected in (False, True):
        found = located(received(NORTH, rng, 6, 0.5, 1e-4), zeros, south_detected=south_detected)
        assert set(found.unneeded) == {"south"}


def test_a_crackle_that_differs_at_every_microphone_hardly_ever_contributes() -> None:
    """A few windows hold most of a crackle, so that its correlations scatter more than those of steady noise."""
    rng = np.random.default_rng(12)
    since_s = np.arange(-QUIET * FRAME, 8 * FRAME) / RATE_HZ
    contributed = 0
    for _ in range(30):
        fading = np.exp(-np.maximum(since_s, 0.0) / rng.uniform(0.05, 0.3))
        envelope = np.where(since_s < 0.0, 1.0, 1.0 + rng.uniform(10.0, 100.0) * fading)
        crackle = np.asarray(noise(rng, 4, QUIET + 8, 1e-4) * envelope, dtype=np.float32)
        found = located(received(NORTH, rng, 8, 0.5, 1e-4), crackle, south_detected=True)
        assert "north" not in found.unneeded
        contributed += "south" not in found.unneeded
    assert contributed <= 4


@settings(max_examples=20)
@given(seed=st.integers(0, 1 << 30), snr_db=st.floats(0.0, 30.0))
def test_a_faint_sound_contributes_whether_or_not_it_was_detected(seed: int, snr_db: float) -> None:
    rng = np.random.default_rng([seed, 3])
    north = received(NORTH, rng, 8, 1.0, 1e-4)
    south = received(SOUTH, rng, 8, 1.0, 0.1 * 10.0 ** (-snr_db / 20.0))
    for south_detected in (False, True):
        found = located(north, south, south_detected=south_detected)
        assert not found.unneeded
        assert np.linalg.norm(found.position_m - SOURCE_M) < 0.3


def test_no_array_contributes_where_all_receive_noise() -> None:
    rng = np.random.default_rng(4)
    quiet = [noise(rng, 4, QUIET + 6, 1e-3) for _ in range(2)]
    sounds = {
        spec.name: as_sound(BOTH, spec, samples, detected=False)
        for spec, samples in zip((NORTH, SOUTH), quiet, strict=True)
    }
    found = BOTH.locate(sounds)
    assert set(found.unneeded) == {"north", "south"}
    assert found.refused == "no direction stands out in the sound"


@given(
    scale=st.floats(1.1, 4.0), count=st.integers(3, 8), radius_m=st.floats(0.02, 0.3), high_hz=st.floats(2000.0, 7000.0)
)
def test_the_threshold_grows_with_aperture_and_band(scale: float, count: int, radius_m: float, high_hz: float) -> None:
    spec = ArraySpec("one", circle(count, radius_m), (100.0, high_hz))
    for on_line in (False, True):
        least = threshold(spec, C_M_S, on_line=on_line)
        assert threshold(replace(spec, microphones_m=scale * spec.microphones_m), C_M_S, on_line=on_line) >= least
        assert threshold(replace(spec, band_hz=(100.0, scale * high_hz)), C_M_S, on_line=on_line) >= least
    assert threshold(spec, C_M_S, on_line=True) < threshold(spec, C_M_S)
