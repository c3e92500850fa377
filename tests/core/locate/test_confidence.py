"""Confidence, refusal and covariance of a position, on synthetic evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, ideal_gcc, tetra, true_lags_s
from livessl.core.geometry import Grid, line, posed
from livessl.core.locate import refine
from livessl.core.locate.confidence import (
    AGREED,
    CLEAR_PEAK_TO_RMS,
    LEAST_CONFIDENCE,
    ConfidenceFeatures,
    Judgement,
    crossing_deg,
    judge,
)
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import ArraySpec, Evidence

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
SOURCE_M = np.array([1.13, 3.31, 1.47])


def evidence_of(spec: ArraySpec, height: float, noise: float = 0.1) -> Evidence:
    gcc = ideal_gcc(spec, true_lags_s(spec.microphones_m, SOURCE_M), RATE_HZ)
    scatter = np.random.default_rng(len(spec.name)).standard_normal(gcc.values.shape)
    values = (height * gcc.values + noise * scatter).astype(np.float32)
    return Evidence(spec, replace(gcc, values=values))


def judged(*evidence: Evidence, rival_share: float = 0.3) -> Judgement:
    functional = SRPFunctional(evidence, C_M_S)
    power = float(functional.value(SOURCE_M[None])[0])
    return judge(functional, evidence, SOURCE_M, power, rival_share * power, GRID)


@given(margin=st.floats(0.0, 0.3), ratio=st.floats(0.0, 9.0), more=st.floats(0.01, 0.1))
def test_confidence_grows_with_margin_and_peak_to_rms_ratio(margin: float, ratio: float, more: float) -> None:
    confidence = ConfidenceFeatures(margin, ratio).confidence
    assert 0.0 < confidence < 1.0
    assert ConfidenceFeatures(margin + more, ratio).confidence > confidence
    assert ConfidenceFeatures(margin, ratio + more).confidence > confidence


def test_clear_evidence_is_accepted_and_noise_is_refused() -> None:
    clear = judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 1.0))
    assert clear.refused is None
    assert clear.features.confidence > 0.95
    drowned = judged(evidence_of(NORTH, 0.02), evidence_of(SOUTH, 0.02), rival_share=0.95)
    assert drowned.features.confidence < LEAST_CONFIDENCE
    assert drowned.refused is not None
    assert f"{drowned.features.confidence:.2f}" in drowned.refused


def test_an_array_with_only_noise_hardly_lowers_the_peak_to_rms_ratio() -> None:
    alone = judged(evidence_of(NORTH, 1.0)).features
    both = judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 0.0)).features
    assert both.peak_to_rms == pytest.approx(alone.peak_to_rms, abs=1.0)  # noise reaches at most its own RMS
    assert judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 1.0)).features.peak_to_rms > alone.peak_to_rms + 2.0


def test_crossing_lines_of_sight_determine_the_distance_whatever_the_margin() -> None:
    assert (
        ConfidenceFeatures(0.01, 5.0, crossing_deg=45.0, second_array=2.5).confidence
        > ConfidenceFeatures(0.01, 5.0, crossing_deg=5.0, second_array=2.5).confidence + 0.2
    )
    east = tetra("east", [2.0, 0.0, 1.0])
    west = tetra("west", [0.0, 2.0, 1.0])
    assert crossing_deg([east], np.array([2.0, 3.0, 1.0])) == 0.0
    assert crossing_deg([east, west], np.array([2.0, 2.0, 1.0])) == pytest.approx(90.0, abs=3.0)
    beyond = east.centre_m + 3.0 * (west.centre_m - east.centre_m)
    assert crossing_deg([east, west], beyond) == pytest.approx(0.0, abs=1e-3)


@given(weak=st.floats(0.0, 1.9), more=st.floats(0.05, 0.5))
def test_a_second_array_with_a_weak_peak_hardly_determines_the_distance(weak: float, more: float) -> None:
    first = ConfidenceFeatures(0.05, 6.0, crossing_deg=60.0, second_array=weak)
    assert replace(first, second_array=weak + more).confidence > first.confidence
    clear = replace(first, second_array=CLEAR_PEAK_TO_RMS)
    assert replace(clear, second_array=CLEAR_PEAK_TO_RMS + more).confidence == clear.confidence


@given(disagreement=st.floats(0.0, AGREED), more=st.floats(0.05, 1.0))
def test_confidence_falls_once_arrays_disagree(disagreement: float, more: float) -> None:
    agreed = ConfidenceFeatures(0.3, 6.0, crossing_deg=60.0, second_array=3.0)
    assert replace(agreed, disagreement=disagreement).confidence == agreed.confidence
    assert replace(agreed, disagreement=AGREED + more).confidence < agreed.confidence
    assert replace(agreed, disagreement=AGREED + 1.0).confidence < LEAST_CONFIDENCE


@given(spread_m=st.floats(0.01, 0.2), more=st.floats(0.05, 1.0))
def test_confidence_of_lines_falls_with_the_spread_of_a_position(spread_m: float, more: float) -> None:
    near = ConfidenceFeatures(0.5, 8.0, spread_m=spread_m, of_lines=True)
    assert replace(near, spread_m=spread_m + more).confidence < near.confidence
    assert replace(near, spread_m=0.2).confidence < LEAST_CONFIDENCE
    assert replace(near, spread_m=0.005).confidence > 0.95
    assert replace(near, of_lines=False).confidence > 0.95


def test_lines_of_microphones_have_no_lines_of_sight() -> None:
    """Three lines give as many angles as there are coordinates: a clear peak is anywhere where three cones meet."""
    places = ([2.1, 0.2, 1.4], [0.2, 2.7, 1.2], [4.0, 2.9, 1.7])
    turned = ((0.0, 0.0), (90.0, 0.0), (0.0, 90.0))
    lines = [
        ArraySpec(f"line {k}", posed(line(0.1, 4), place_m, *angles), BAND_HZ)
        for k, (place_m, angles) in enumerate(zip(places, turned, strict=True))
    ]
    features = judged(*(evidence_of(spec, 1.0) for spec in lines)).features
    assert features.of_lines
    assert features.crossing_deg == 0.0
    mixed = judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 1.0), evidence_of(lines[0], 1.0)).features
    assert not mixed.of_lines
    assert mixed.crossing_deg > 20.0
    assert replace(features, of_lines=False).confidence >= features.confidence


def test_one_array_with_a_clear_peak_is_not_sure() -> None:
    both = judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 1.0)).features
    one = judged(evidence_of(NORTH, 1.0), evidence_of(SOUTH, 0.0)).features
    assert both.is_sure
    assert one.second_array < 2.0 < both.second_array
    assert not one.is_sure
    assert not judged(evidence_of(NORTH, 1.0)).features.is_sure


def test_pairs_that_disagree_widen_the_covariance() -> None:
    """Delays off by 10 us, 3 mm of sound: far below a lobe, so that the heights hardly change."""
    evidence = [evidence_of(NORTH, 1.0, 0.0), evidence_of(SOUTH, 1.0, 0.0)]
    off_s = 1e-5 * np.random.default_rng(0).standard_normal((2, 6))
    torn = [
        Evidence(spec, ideal_gcc(spec, true_lags_s(spec.microphones_m, SOURCE_M) + off, RATE_HZ))
        for spec, off in zip((NORTH, SOUTH), off_s, strict=True)
    ]
    agreed, disagreed = (judged(*each).covariance_m2 for each in (evidence, torn))
    deviations_m = np.sqrt(np.linalg.eigvalsh(agreed))
    assert deviations_m[0] > 0.005  # what remains with the clearest evidence,
    assert deviations_m[-1] < 0.015  # and half a millimetre in an array of 0.3 m
    assert np.trace(disagreed) > 1.2 * np.trace(agreed)  # although the placement is most of both


def test_the_covariance_of_one_array_does_not_shrink_when_its_pairs_agree() -> None:
    """Three delays determine three coordinates: that the pairs agree says nothing."""
    alone = judged(evidence_of(NORTH, 1.0, 0.0)).covariance_m2
    assert np.linalg.eigvalsh(alone)[-1] > 0.05**2


def test_silence_is_refused_without_a_warning() -> None:
    silent = [replace(h, gcc=replace(h.gcc, values=np.zeros_like(h.gcc.values))) for h in (evidence_of(NORTH, 1.0),)]
    nothing = judged(*silent)
    assert nothing.refused is not None
    assert nothing.features == ConfidenceFeatures(0.0, 0.0, spread_m=nothing.features.spread_m)
    assert nothing.features.spread_m == pytest.approx(float(np.max(GRID.upper_m - GRID.lower_m)), rel=0.9)
    assert np.isfinite(nothing.covariance_m2).all()


def test_neighbourhood_reaches_a_metre_and_stays_inside_the_grid() -> None:
    box = refine.neighbourhood(SOURCE_M, GRID)
    for axis, (first, last) in enumerate(box):
        points = GRID.axis_m(axis)
        assert abs(points[first] - SOURCE_M[axis]) <= 1.0
        assert abs(points[last] - SOURCE_M[axis]) <= 1.0
        assert first == 0 or abs(points[first - 1] - SOURCE_M[axis]) > 1.0
        assert last == len(points) - 1 or abs(points[last + 1] - SOURCE_M[axis]) > 1.0
