"""Evidence that bears clocks that are apart inside an array."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, burst, heard, ideal_gcc, peak_lags_s, tetra, true_lags_s
from livessl.core.geometry import Grid
from livessl.core.locate import onset
from livessl.core.locate.estimator import Sound
from livessl.core.locate.onset import Onset
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.tolerant import tolerant
from livessl.core.types import ArraySpec, Evidence, FloatArray, Uncertainty

GRID: Final = Grid(((0.0, 6.0), (0.0, 5.0), (0.0, 3.0)), 0.1)
CORNERS_M: Final = ((0.5, 0.5, 0.7), (5.2, 0.6, 0.9), (5.1, 4.3, 0.8), (0.6, 4.4, 1.0))


def frame(name: str, corner_m: tuple[float, float, float], *, clock_s: float = 1e-4) -> ArraySpec:
    """Two pairs of microphones, a metre long each: the second pair has a recorder of its own."""
    towards = np.sign(np.array([3.0, 2.5, 0.0]) - corner_m)
    ends = np.array([[0.1, 0, 0], [1.0, 0, 0], [0, 0.1, 0], [0, 0, 0.9]]) * (towards + np.array([0.0, 0.0, 1.0]))
    return ArraySpec(name, np.array(corner_m) + ends, (100.0, 6000.0), Uncertainty(clock_s=clock_s))


FRAMES: Final = [frame(f"f{k}", corner_m) for k, corner_m in enumerate(CORNERS_M)]


def evidence_of(spec: ArraySpec, source_m: FloatArray, apart_s: float, echo_m: FloatArray, share: float) -> Evidence:
    """A source whose second pair is sampled `apart_s` later, and a lower echo that fits all pairs."""
    late_s = np.array([0.0, apart_s, apart_s, apart_s, apart_s, 0.0])  # pairs 01, 02, 03, 12, 13, 23
    gcc = ideal_gcc(spec, true_lags_s(spec.microphones_m, source_m) + late_s)
    echo = ideal_gcc(spec, true_lags_s(spec.microphones_m, echo_m))
    return Evidence(spec, replace(gcc, values=(gcc.values + share * echo.values).astype(np.float32)), noise_rms=0.1)


def highest_m(evidence: list[Evidence]) -> FloatArray:
    search = PeakSearch([part.spec for part in evidence], GRID, C_M_S)
    for part in evidence:
        search.prepare(part.spec.name, part.gcc.lags_s)
    (peak,) = search.among(evidence)(1)
    return GRID.point_m(peak.point)


def test_sources_are_found_although_an_echo_fits_the_pairs_better() -> None:
    """The sharp evidence has some of them at the echo; clocks that are apart move the others."""
    rng = np.random.default_rng(1)
    sharp_m, wide_m = [], []
    for _ in range(10):
        source_m, echo_m = rng.uniform([1.0, 1.0, 0.3], [2.6, 4.0, 2.7]), rng.uniform([3.6, 1.0, 0.3], [5.0, 4.0, 2.7])
        apart_s = rng.choice([-1.0, 1.0], 4) * rng.uniform(0.7e-4, 0.9e-4, 4)
        parts = [evidence_of(spec, source_m, late, echo_m, 0.5) for spec, late in zip(FRAMES, apart_s, strict=True)]
        sharp_m.append(np.linalg.norm(highest_m(parts) - source_m))
        wide_m.append(np.linalg.norm(highest_m([tolerant(part) for part in parts]) - source_m))
    assert np.median(sharp_m) > 0.7
    assert max(sharp_m) > 3.0
    assert np.median(wide_m) < 0.4
    assert max(wide_m) < 1.0


def test_nothing_changes_where_one_converter_samples_all_channels() -> None:
    spec = frame("one", CORNERS_M[0], clock_s=0.0)
    part = evidence_of(spec, np.array([2.0, 2.0, 1.0]), 0.0, np.array([4.0, 3.0, 1.0]), 0.5)
    assert tolerant(part) is part
    high = replace(part, spec=replace(spec, uncertainty=Uncertainty(clock_s=1e-4), band_hz=(4000.0, 7500.0)))
    assert tolerant(high) is high


def test_peaks_stay_where_they_are_and_get_wider() -> None:
    part = evidence_of(FRAMES[0], np.array([2.0, 2.0, 1.0]), 0.0, np.array([4.0, 3.0, 1.0]), 0.0)
    wide = tolerant(part)
    np.testing.assert_allclose(peak_lags_s(wide.gcc), peak_lags_s(part.gcc), atol=1e-6)
    known = tolerant(replace(part, background=part.gcc.values)).background
    np.testing.assert_array_equal(known, wide.gcc.values)
    assert (wide.gcc.values.max(axis=1) < 0.7 * part.gcc.values.max(axis=1)).all()


def test_noise_keeps_its_standard_deviation_in_the_new_unit() -> None:
    spec = FRAMES[0]
    part = evidence_of(spec, np.array([2.0, 2.0, 1.0]), 0.0, np.array([4.0, 3.0, 1.0]), 0.0)
    axis_s = part.gcc.lags_s
    rng = np.random.default_rng(4)
    frequencies_hz = np.linspace(*spec.band_hz, 300)
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, 300, 1))
    noise = np.cos(2.0 * np.pi * frequencies_hz[:, None] * axis_s + phases).sum(axis=1)
    noise *= 0.1 / noise.std()
    wide = tolerant(replace(part, gcc=replace(part.gcc, values=noise.astype(np.float32))))
    middle = wide.gcc.values[:, len(axis_s) // 4 : -len(axis_s) // 4]
    assert wide.noise_rms == pytest.approx(middle.std(), rel=0.15)


@pytest.mark.parametrize(("height", "second_looks"), [(0.3, True), (3.0, True), (3.0, False)])
def test_the_more_certain_of_two_places_is_told_if_there_is_time(
    height: float, second_looks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two tetrahedra receive a sound; their tolerant evidence is of another place, weak or strong."""
    averaged: list[str] = []
    arrays = [tetra("north", [1.0, 2.5, 1.4]), tetra("south", [5.0, 2.4, 1.6], yaw_deg=71.0)]
    here_m, there_m = np.array([2.6, 3.6, 1.1]), np.array([3.4, 1.1, 2.0])
    estimator = Onset(arrays, GRID, C_M_S)
    rng = np.random.default_rng(2)

    def elsewhere(part: Evidence) -> Evidence:
        averaged.append(part.spec.name)
        gcc = ideal_gcc(part.spec, true_lags_s(part.spec.microphones_m, there_m))
        rows = [np.interp(part.gcc.lags_s, gcc.lags_s, row) for row in gcc.values]
        values = height * np.array(rows) + rng.normal(0.0, 0.3, part.gcc.values.shape)
        return replace(part, gcc=replace(part.gcc, values=values.astype(np.float32)))

    monkeypatch.setattr(onset, "tolerant", elsewhere)
    sounds = {}
    for spec in arrays:
        samples = heard(spec, here_m, burst(4000)) + rng.normal(0.0, 0.01, (4, 4000)).astype(np.float32)
        sounds[spec.name] = Sound((samples,), RATE_HZ, second_looks=second_looks)
    found = estimator.locate(sounds)
    assert found.features is not None
    assert found.features.whole is second_looks  # onsets alone are not sure
    off_m = np.linalg.norm(found.position_m - (there_m if height > 1.0 and second_looks else here_m))
    assert off_m < (0.1 if second_looks else 0.2)  # onset windows cut the burst at its edges
    assert bool(averaged) is second_looks
