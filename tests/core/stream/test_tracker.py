"""Tracks: one for each source, as fast as it walks, as sure as its estimates, and over when it is silent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike

from livessl.core.stream.tracker import ACCELERATION_M_S2, GATE_M, MIN_STD_M, SILENCE_S, Tracker
from livessl.core.types import Estimate, FloatArray, Track, TrackState

START_NS = 1_700_000_000 * 10**9
STEP_S = 0.1
STD_M = 0.1
WALK_M_S = np.array([0.8, -0.5, 0.0])


def at_ns(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)


def estimate(time_s: float, position_m: ArrayLike, std_m: float = STD_M, confidence: float = 1.0) -> Estimate:
    return Estimate(at_ns(time_s), np.array(position_m, dtype=np.float64), std_m**2 * np.eye(3), confidence, ("north",))


def follow(tracker: Tracker, paths: Sequence[FloatArray], std_m: float = STD_M) -> list[list[Track]]:
    """Steps of `STEP_S`: at each, one estimate of every path (n, 3)."""
    steps = []
    for k in range(len(paths[0])):
        time_s = k * STEP_S
        steps.append(tracker.step(at_ns(time_s), [estimate(time_s, path[k], std_m) for path in paths]))
    return steps


def walk(start_m: ArrayLike, steps: int = 60, seed: int = 1, velocity_m_s: FloatArray = WALK_M_S) -> FloatArray:
    time_s = STEP_S * np.arange(steps)[:, None]
    scatter = STD_M * np.random.default_rng(seed).standard_normal((steps, 3))
    return np.asarray(np.asarray(start_m) + time_s * velocity_m_s + scatter)


def test_walking_source_is_one_track() -> None:
    steps = follow(Tracker(), [walk([1.0, 5.0, 1.5])])
    assert all(len(step) == 1 for step in steps)
    assert {step[0].id for step in steps} == {1}
    assert [step[0].state for step in steps] == [TrackState.NEW] + [TrackState.UPDATE] * 59
    assert [step[0].time_ns for step in steps] == [at_ns(k * STEP_S) for k in range(60)]


def test_velocity_points_in_the_direction_of_the_walk() -> None:
    for velocity_m_s in (WALK_M_S, -WALK_M_S):
        (track,) = follow(Tracker(), [walk([3.0, 5.0, 1.5], velocity_m_s=velocity_m_s)])[-1]
        # Of the steady state: with sd 0.11 m (0.1 and the least 0.05 m) each 0.1 s and 1 m/s^2 of acceleration the
        # filter remembers sqrt(0.11 / 1) = 0.3 s; its velocity scatters by 0.2 m/s. Three of them:
        np.testing.assert_allclose(track.velocity_m_s, velocity_m_s, atol=0.6)
        assert track.velocity_m_s @ velocity_m_s > 0.5 * velocity_m_s @ velocity_m_s
        assert np.linalg.norm(track.position_m - ([3.0, 5.0, 1.5] + 5.9 * velocity_m_s)) < 3 * STD_M


def test_velocity_is_exact_without_scatter() -> None:
    path = np.array([1.0, 5.0, 1.5]) + STEP_S * np.arange(200)[:, None] * WALK_M_S
    (track,) = follow(Tracker(), [path])[-1]
    np.testing.assert_allclose(track.velocity_m_s, WALK_M_S, atol=1e-3)  # metres a second, not a step
    np.testing.assert_allclose(track.position_m, path[-1], atol=1e-3)


def test_covariance_shrinks_below_one_estimates() -> None:
    rest = np.zeros(3)
    variances = [float(np.trace(s[0].covariance_m2)) for s in follow(Tracker(), [walk([1, 1, 1], velocity_m_s=rest)])]
    assert variances[0] == pytest.approx(3 * (STD_M**2 + MIN_STD_M**2))
    assert variances[5] < variances[1] < variances[0]
    assert variances[-1] == pytest.approx(variances[-2], rel=1e-3)
    # steady state of a constant-velocity filter: about sqrt(2) (T / 0.3 s) = 0.4 of one estimate's variance
    assert 0.2 < variances[-1] / variances[0] < 0.6
    np.testing.assert_array_less(0, np.linalg.eigvalsh(follow(Tracker(), [walk([1, 1, 1])])[-1][0].covariance_m2))


def test_two_sources_are_two_tracks() -> None:
    paths = [walk([1.0, 5.0, 1.5], seed=1), walk([6.0, 5.0, 1.5], seed=2)]
    steps = follow(Tracker(), paths)
    assert [[track.id for track in step] for step in steps] == [[1, 2]] * 60
    for k, track in enumerate(steps[-1]):
        assert np.linalg.norm(track.position_m - paths[k][-1]) < 4 * STD_M
    # in turn, as the windows of a live server bring them, it is the same
    tracker = Tracker()
    told = [tracker.step(at_ns(k * STEP_S), [estimate(k * STEP_S, paths[k % 2][k])]) for k in range(60)]
    assert told[1] == []  # beside one that is followed the other is told of from its second estimate on
    assert [tracks[0].id for tracks in told[2:]] == [1, 2] * 29


def test_jump_beyond_the_gate_is_another_source() -> None:
    for far_m, known in ((0.9 * GATE_M, True), (1.5 * GATE_M, False)):
        tracker = Tracker()
        follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
        first = tracker.step(at_ns(3.0), [estimate(3.0, [1.0 + far_m, 1.0, 1.0])])
        (track,) = first if known else tracker.step(at_ns(3.1), [estimate(3.1, [1.0 + far_m, 1.0, 1.0])])
        assert bool(first) == known  # a single estimate beside a followed source is told of nobody
        assert (track.id == 1) == known
        assert track.state is (TrackState.UPDATE if known else TrackState.NEW)


def test_uncertain_estimate_may_be_further_away() -> None:
    tracker = Tracker()
    follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
    (track,) = tracker.step(at_ns(3.0), [estimate(3.0, [3.0, 1.0, 1.0], std_m=1.0)])
    assert track.id == 1
    # and it moves the track little: its weight is the track's variance of some 0.1^2 against its own 1
    assert abs(track.position_m[0] - 1.0) < 0.1


def test_estimate_moves_a_track_little_along_its_uncertain_axis() -> None:
    tracker = Tracker()
    follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
    covariance = np.diag([4.0, 0.0025, 0.0025])
    found = Estimate(at_ns(3.0), np.array([1.6, 1.1, 1.0]), covariance, 1.0, ("north",))
    (track,) = tracker.step(at_ns(3.0), [found])
    x, y, _ = track.position_m - 1.0
    assert abs(x) < 0.02
    assert 0.02 < y < 0.1


def test_track_ends_after_silence() -> None:
    tracker = Tracker()
    last = follow(tracker, [walk([1.0, 5.0, 1.5])])[-1][0]
    silent_from_s = 59 * STEP_S
    assert tracker.step(at_ns(silent_from_s + SILENCE_S)) == []
    (ended,) = tracker.step(at_ns(silent_from_s + SILENCE_S + 0.01))
    assert (ended.id, ended.state, ended.time_ns) == (1, TrackState.END, last.time_ns)
    np.testing.assert_array_equal(ended.position_m, last.position_m)
    assert tracker.step(at_ns(100.0)) == []
    (again,) = tracker.step(at_ns(100.0), [estimate(100.0, last.position_m)])
    assert (again.id, again.state) == (2, TrackState.NEW)


def test_covariance_grows_in_a_pause() -> None:
    tracker = Tracker()
    before = follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])[-1][0]
    pause_s = 2.0
    (after,) = tracker.step(at_ns(2.9 + pause_s), [estimate(2.9 + pause_s, [1.5, 1.0, 1.0])])
    # in 2 s the acceleration alone may carry it by t^2 / 2 = 2 m: the new estimate outweighs the memory
    assert ACCELERATION_M_S2 * pause_s**2 / 2 == 2.0
    assert after.position_m[0] == pytest.approx(1.5, abs=0.02)
    assert np.trace(after.covariance_m2) > np.trace(before.covariance_m2)


def test_estimates_out_of_order_do_no_harm() -> None:
    tracker = Tracker()
    follow(tracker, [walk([1.0, 5.0, 1.5])])
    (track,) = tracker.step(at_ns(5.9), [estimate(5.5, [1.0 + 0.8 * 5.5, 5.0 - 0.5 * 5.5, 1.5])])
    assert track.id == 1
    assert track.time_ns == at_ns(5.9)
    assert np.linalg.eigvalsh(track.covariance_m2).min() > 0


def test_fixed_axis_is_no_singularity() -> None:
    tracker = Tracker()
    flat = np.diag([0.01, 0.01, 0.0])
    for k in range(10):
        (track,) = tracker.step(at_ns(k * STEP_S), [Estimate(at_ns(k * STEP_S), np.ones(3), flat, 0.5, ("north",))])
    assert track.position_m == pytest.approx([1.0, 1.0, 1.0])


def test_two_estimates_of_one_moment_are_never_one_track() -> None:
    tracker = Tracker()
    follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
    for time_s, ids in ((3.0, [1]), (3.1, [2, 1]), (3.2, [2, 1])):
        both = [estimate(time_s, [1.4, 1.0, 1.0]), estimate(time_s, [1.05, 1.0, 1.0])]
        assert [track.id for track in tracker.step(at_ns(time_s), both)] == ids


def test_sources_that_cross_keep_their_tracks() -> None:
    """At a right angle, 0.2 m apart at the nearest, two scatters of an estimate: mostly each goes on as it went.

    By a coin's toss a run in two would swap; 16 of 20 or more happen so in 0.6 % of all series.
    """
    kept = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        paths = [
            walk([1.0, 3.0, 1.5], seed=2 * seed, velocity_m_s=np.array([1.0, 0.0, 0.0])),
            walk([4.0, 0.2, 1.5], seed=2 * seed + 1, velocity_m_s=np.array([0.0, 1.0, 0.0])),
        ]
        tracker = Tracker()
        for k in range(60):
            order = rng.permutation(2) if k else [0, 1]
            told = tracker.step(at_ns(k * STEP_S), [estimate(k * STEP_S, paths[path][k]) for path in order])
            ids = {int(path): track.id for path, track in zip(order, told, strict=True)}
        kept += ids == {0: 1, 1: 2}
    assert kept >= 16


def test_estimates_are_assigned_together_whatever_their_order() -> None:
    """One estimate lies between two tracks and is nearer to the first, which the other estimate can only be of."""
    tracker = Tracker()
    follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1)), np.tile([2.0, 1.0, 1.0], (30, 1))])
    told = tracker.step(at_ns(3.0), [estimate(3.0, [1.4, 1.0, 1.0]), estimate(3.0, [0.8, 1.0, 1.0])])
    assert [track.id for track in told] == [2, 1]


def test_single_stray_estimate_gives_no_track() -> None:
    tracker = Tracker()
    for k in range(60):
        time_s = k * STEP_S
        at_m = [5.0, 1.0, 1.0] if k in (20, 40) else [1.0, 1.0, 1.0]  # 2 s apart: twice a stray, and no source
        assert {track.id for track in tracker.step(at_ns(time_s), [estimate(time_s, at_m)])} <= {1}
    (ended,) = tracker.step(at_ns(20.0))
    assert ended.id == 1


def direction(time_s: float, position_m: ArrayLike) -> Estimate:
    """Good across the line of sight, here x, and anywhere along it."""
    return Estimate(at_ns(time_s), np.array(position_m), np.diag([4.0, 0.01, 0.01]), 0.9, ("north",))


@pytest.mark.parametrize("back_m", [0.6, 1.6])
def test_source_that_turns_round_in_a_pause_keeps_its_track(back_m: float) -> None:
    """The prediction has moved on by 0.7 m after 0.7 s; 0.6 m back it is 1.3 m off, and the source is found again."""
    tracker = Tracker()
    path = np.array([1.0, 5.0, 1.5]) + STEP_S * np.arange(30)[:, None] * np.array([1.0, 0.0, 0.0])
    follow(tracker, [path])
    turned_m = path[-1] - np.array([back_m, 0.0, 0.0])
    first = tracker.step(at_ns(3.6), [estimate(3.6, turned_m, std_m=0.02)])
    assert [track.id for track in first] == ([1] if back_m < GATE_M else [])
    (second,) = tracker.step(at_ns(3.7), [estimate(3.7, turned_m - [0.1, 0.0, 0.0], std_m=0.02)])
    assert second.id == (1 if back_m < GATE_M else 2)
    if back_m < GATE_M:
        assert np.linalg.norm(second.position_m - turned_m) < 0.2  # and not where it was going


def test_direction_does_not_confirm_a_stray_estimate() -> None:
    for after, ids in ((direction(3.1, [3.2, 1.1, 1.0]), {1}), (estimate(3.1, [3.2, 1.0, 1.0]), {1, 2})):
        tracker = Tracker()
        follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
        told = tracker.step(at_ns(3.0), [estimate(3.0, [3.0, 1.0, 1.0])]) + tracker.step(at_ns(3.1), [after])
        again = tracker.step(at_ns(3.2), [estimate(3.2, [1.0, 1.0, 1.0])])
        assert {track.id for track in told + again} == ids


def test_direction_alone_starts_a_track_where_there_is_none() -> None:
    tracker = Tracker()
    (first,) = tracker.step(at_ns(0.0), [direction(0.0, [3.0, 1.0, 1.0])])
    (second,) = tracker.step(at_ns(0.1), [direction(0.1, [3.5, 1.0, 1.0])])
    assert (first.id, second.id) == (1, 1)


def test_estimate_of_low_confidence_moves_the_track_less() -> None:
    moved_m = []
    for confidence in (0.8, 0.9, 1.0):
        tracker = Tracker()
        follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
        (track,) = tracker.step(at_ns(3.0), [estimate(3.0, [1.5, 1.0, 1.0], confidence=confidence)])
        moved_m.append(float(track.position_m[0]) - 1.0)
    assert 0.0 < moved_m[0] < 0.75 * moved_m[1] < 0.75 * 0.75 * moved_m[2]
    tracker = Tracker()  # where the confidence is no probability it says nothing of that
    follow(tracker, [np.tile([1.0, 1.0, 1.0], (30, 1))])
    (track,) = tracker.step(at_ns(3.0), [estimate(3.0, [1.5, 1.0, 1.0], confidence=0.2)], probable=False)
    assert float(track.position_m[0]) - 1.0 == pytest.approx(moved_m[2])


def test_source_that_turned_while_only_directions_came_keeps_its_track() -> None:
    """Then, too, it is the last place that counts, and not where it would be along the line of sight."""
    tracker = Tracker()
    path = np.array([1.0, 5.0, 1.5]) + STEP_S * np.arange(30)[:, None] * np.array([1.0, 0.0, 0.0])
    follow(tracker, [path])
    for k in range(30, 37):  # it has turned round, which along the line of sight nobody hears
        (track,) = tracker.step(at_ns(k * STEP_S), [direction(k * STEP_S, [4.5, 5.0, 1.5])])
        assert track.id == 1
    assert track.position_m[0] > 4.4
    (again,) = tracker.step(at_ns(3.7), [estimate(3.7, [3.1, 5.0, 1.5], std_m=0.02)])
    assert again.id == 1
    assert abs(again.position_m[0] - 3.1) < 0.1
