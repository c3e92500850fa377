"""OSPA and the measures of tracks, on made-up truths and estimates."""

from __future__ import annotations

import numpy as np
import pytest

from livessl.core.types import FloatArray
from livessl.lab.evaluate.tracking import assigned, ospa_m, score

NONE_M = np.zeros((0, 3))
ONE_M = np.array([[1.0, 2.0, 1.5]])
TWO_M = np.array([[1.0, 2.0, 1.5], [4.0, 2.0, 1.5]])
TIMES_S = np.arange(0.0, 2.0, 0.05)
WALK_M = np.column_stack([1.0 + TIMES_S, np.full_like(TIMES_S, 3.0), np.full_like(TIMES_S, 1.5)])


def shifted(places_m: FloatArray, along_x_m: float) -> FloatArray:
    return np.asarray(places_m + np.array([along_x_m, 0.0, 0.0]))


def test_ospa_counts_errors_up_to_the_cut_off_and_unmatched_elements_as_the_cut_off() -> None:
    assert ospa_m(NONE_M, NONE_M) == 0.0
    assert ospa_m(TWO_M, TWO_M[::-1]) == 0.0  # the order does not matter
    assert ospa_m(TWO_M, shifted(TWO_M, 0.2)) == pytest.approx(0.2)
    assert ospa_m(ONE_M, shifted(ONE_M, 7.0)) == 1.0
    assert ospa_m(TWO_M, shifted(ONE_M, 0.2)) == pytest.approx((0.2 + 1.0) / 2.0)
    assert ospa_m(ONE_M, shifted(TWO_M, 0.2)) == pytest.approx((0.2 + 1.0) / 2.0)
    assert ospa_m(ONE_M, NONE_M) == ospa_m(NONE_M, ONE_M) == 1.0


def test_each_estimate_is_assigned_to_one_source_at_most() -> None:
    np.testing.assert_allclose(assigned(TWO_M, shifted(ONE_M, 0.2)), [0.2, np.inf])
    between_m = np.array([[1.6, 2.0, 1.5], [0.5, 2.0, 1.5]])  # the first is nearer to both; the sum decides
    np.testing.assert_allclose(assigned(TWO_M, between_m), [0.5, 2.4], atol=1e-12)


def test_a_track_that_stays_with_the_talker_is_perfect() -> None:
    found = score(TIMES_S, WALK_M, {4: (TIMES_S, shifted(WALK_M, 0.3))})
    assert found.rmse_m == pytest.approx(0.3)
    assert (found.detected, found.ids, found.swaps, found.breaks, found.false_per_s, found.latency_s) == (
        1,
        1,
        0,
        0,
        0,
        0,
    )
    assert found.ospa_m == pytest.approx(0.3)


def test_states_are_interpolated_but_not_over_long_gaps() -> None:
    sparse = slice(0, None, 8)  # 0.4 s apart
    known = score(TIMES_S, WALK_M, {1: (TIMES_S[sparse], WALK_M[sparse])})
    assert known.rmse_m == pytest.approx(0.0, abs=1e-9)
    silent = slice(0, None, 12)  # 0.6 s apart
    torn = score(TIMES_S, WALK_M, {1: (TIMES_S[silent], WALK_M[silent])})
    assert torn.detected == pytest.approx(4 / 40)  # at its states alone
    assert torn.breaks == 3


def test_a_late_takeover_and_a_false_track_are_counted() -> None:
    tracks = {
        1: (TIMES_S[10:20], WALK_M[10:20]),
        2: (TIMES_S[20:], WALK_M[20:]),
        3: (TIMES_S[20:], shifted(WALK_M[20:], 3.0)),
    }
    found = score(TIMES_S, WALK_M, tracks)
    assert found.latency_s == pytest.approx(0.5)
    assert (found.ids, found.swaps, found.breaks) == (2, 1, 0)
    assert found.detected == pytest.approx(30 / 40)
    assert found.false_per_s == pytest.approx(20 / 40)
    assert found.ospa_m == pytest.approx((10 * 1.0 + 10 * 0.0 + 20 * 0.5) / 40)


def test_without_tracks_nothing_is_detected() -> None:
    found = score(TIMES_S, WALK_M, {})
    assert (found.detected, found.ids, found.ospa_m) == (0.0, 0, 1.0)
    assert np.isnan(found.rmse_m)
    assert np.isnan(found.latency_s)
