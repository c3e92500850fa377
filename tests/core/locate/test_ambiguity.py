"""Planes and lines of microphones: what cannot be told apart is reported as such, and what can be is located."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.geometry import Grid, circle, line, posed
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.mirror import flatness, look_alikes
from livessl.core.stream.verdict import judged
from livessl.core.types import ArraySpec, FloatArray, Status

ROOM = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
TOLERANCE_M = 0.15
"""Elevations hardly change the delays of a flat array where they are low: heights are off by up to a decimetre."""


def flat(
    name: str, centre_m: Sequence[float], radius_m: float = 0.1, turns_deg: Sequence[float] = (0, 0, 0)
) -> ArraySpec:
    return ArraySpec(name, posed(circle(radius_m, 4), centre_m, *turns_deg), BAND_HZ)


def straight(name: str, centre_m: Sequence[float], yaw_deg: float = 0.0) -> ArraySpec:
    return ArraySpec(name, posed(line(0.1, 4), centre_m, yaw_deg), BAND_HZ)


def located(arrays: Sequence[ArraySpec], source_m: Sequence[float] | FloatArray, grid: Grid = ROOM) -> Localization:
    """The answer of the default method to a burst at 40 dB above the microphones' noise."""
    estimator = Onset(arrays, grid, C_M_S)
    noise = np.random.default_rng(0)
    sounds = {}
    for spec in arrays:
        samples = heard(spec, source_m, burst(8000, highest=0.7))
        samples = samples + (0.01 * samples.std() * noise.standard_normal(samples.shape)).astype(np.float32)
        sounds[spec.name] = Sound((samples,), RATE_HZ)
    return estimator.locate(sounds)


def status(found: Localization, arrays: Sequence[ArraySpec]) -> Status:
    return judged(found, arrays)[0]


def off_m(found: Localization, place_m: Sequence[float] | FloatArray) -> float:
    return float(np.linalg.norm(found.position_m - place_m))


def nearest_candidate(found: Localization, place_m: Sequence[float] | FloatArray) -> tuple[float, float]:
    """Distance of the nearest candidate, in metres, and its probability."""
    return min((float(np.linalg.norm(each.position_m - place_m)), each.probability) for each in found.candidates)


@settings(max_examples=12, deadline=None)
@given(
    height_m=st.floats(0.9, 1.7),
    yaws_deg=st.tuples(st.floats(0.0, 90.0), st.floats(0.0, 90.0)),
    radius_m=st.floats(0.08, 0.2),
    above_m=st.floats(-0.8, 0.8),
    x_m=st.floats(0.5, 3.7),
    y_m=st.floats(2.0, 3.2),
)
def test_coplanar_arrays_report_a_place_and_its_mirror_image(
    height_m: float, yaws_deg: tuple[float, float], radius_m: float, above_m: float, x_m: float, y_m: float
) -> None:
    assume(abs(above_m) > 0.45)
    arrays = [
        flat("north", [2.1, 4.4, height_m], radius_m, (yaws_deg[0], 0, 0)),
        flat("south", [2.0, 0.8, height_m], radius_m, (yaws_deg[1], 0, 0)),
    ]
    source_m, image_m = (np.array([x_m, y_m, height_m + sign * above_m]) for sign in (1.0, -1.0))
    found = located(arrays, source_m)
    answer, why = judged(found, arrays)
    assert answer is Status.DIRECTION_ONLY
    assert why is not None
    assert f"the plane z = {height_m:.2f} m" in why
    assert found.confidence < 0.8
    for place_m in (source_m, image_m):
        distance_m, probability = nearest_candidate(found, place_m)
        assert distance_m < 2 * TOLERANCE_M
        assert probability == pytest.approx(0.5, abs=0.1)


@settings(max_examples=8, deadline=None)
@given(turns_deg=st.tuples(*(st.floats(-180.0, 180.0) for _ in range(3))), side=st.sampled_from([-1.0, 1.0]))
def test_a_tilted_plane_has_its_own_mirror_image(turns_deg: tuple[float, float, float], side: float) -> None:
    middle_m = np.array([2.1, 2.5, 1.35])
    shape_m = np.concatenate([circle(0.1, 5) + np.array([0.9, 0.0, 0.0]), circle(0.1, 5) - np.array([0.9, 0.2, 0.0])])
    microphones_m = posed(shape_m, middle_m, *turns_deg)
    arrays = [ArraySpec("one", microphones_m[:5], BAND_HZ), ArraySpec("other", microphones_m[5:], BAND_HZ)]
    normal = np.cross(microphones_m[1] - microphones_m[0], microphones_m[2] - microphones_m[0])
    normal /= np.linalg.norm(normal)
    source_m, image_m = middle_m + side * 0.9 * normal, middle_m - side * 0.9 * normal
    found = located(arrays, source_m)
    assert status(found, arrays) is Status.DIRECTION_ONLY
    assert max(nearest_candidate(found, place_m)[0] for place_m in (source_m, image_m)) < TOLERANCE_M


@pytest.mark.parametrize("z_m", [0.3, 2.2])
def test_bounds_that_end_at_the_plane_tell_the_sides_apart(z_m: float) -> None:
    arrays = [flat("north", [2.1, 4.4, 1.3]), flat("south", [2.0, 0.8, 1.3])]
    half = Grid((*ROOM.bounds_m[:2], (0.0, 1.3) if z_m < 1.3 else (1.3, 2.7)), 0.1)
    found = located(arrays, [1.4, 2.3, z_m], half)
    assert status(found, arrays) is Status.LOCATED
    assert off_m(found, [1.4, 2.3, z_m]) < TOLERANCE_M
    assert not found.candidates


@pytest.mark.parametrize(
    "third",
    [tetra("third", [3.9, 2.6, 1.2]), flat("third", [3.9, 2.6, 1.3], 0.1, (0.0, 60.0, 0.0))],
    ids=["tetrahedron", "tilted"],
)
def test_another_array_tells_the_sides_apart(third: ArraySpec) -> None:
    arrays = [flat("north", [2.1, 4.4, 1.3]), flat("south", [2.0, 0.8, 1.3]), third]
    for z_m in (0.3, 2.2):
        found = located(arrays, [1.4, 2.3, z_m])
        assert status(found, arrays) is Status.LOCATED
        assert off_m(found, [1.4, 2.3, z_m]) < TOLERANCE_M


def test_flat_arrays_in_different_planes_locate_together() -> None:
    arrays = [flat("table", [2.1, 4.4, 0.7]), flat("wall", [0.1, 1.3, 1.5], 0.1, (0.0, 90.0, 0.0))]
    for source_m in ([1.4, 2.3, 0.2], [2.9, 1.6, 1.9]):
        found = located(arrays, source_m)
        assert status(found, arrays) is Status.LOCATED
        assert off_m(found, source_m) < TOLERANCE_M


def test_parallel_planes_a_few_centimetres_apart_are_one_plane() -> None:
    arrays = [flat("north", [2.1, 4.4, 1.30], 0.05), flat("south", [2.0, 0.8, 1.33], 0.05)]
    found = located(arrays, [1.4, 2.6, 2.3])
    assert status(found, arrays) is Status.DIRECTION_ONLY
    assert nearest_candidate(found, [1.4, 2.6, 2.3])[0] < 0.3
    assert nearest_candidate(found, [1.4, 2.6, 0.33])[0] < 0.3


def test_arrays_on_one_line_report_a_circle() -> None:
    arrays = [straight("west", [1.2, 2.5, 1.3]), straight("east", [3.0, 2.5, 1.3])]
    found = located(arrays, [2.2, 3.7, 1.3])
    answer, why = judged(found, arrays)
    assert answer is Status.DIRECTION_ONLY
    assert why is not None
    assert "one line along x" in why
    assert 2 < len(found.candidates) <= 8
    assert sum(each.probability for each in found.candidates) == pytest.approx(1.0)
    for each in found.candidates:
        assert np.linalg.norm((each.position_m - [2.2, 2.5, 1.3])[1:]) == pytest.approx(1.2, abs=TOLERANCE_M)


@settings(max_examples=4, deadline=None)
@given(
    yaw_deg=st.floats(0.0, 180.0),
    middle_m=st.tuples(st.floats(1.9, 2.3), st.floats(2.3, 2.8), st.floats(1.2, 1.5)),
    spacing_m=st.floats(0.06, 0.12),
    along_m=st.floats(-0.4, 0.4),
    radius_m=st.floats(0.7, 1.1),
    around_deg=st.floats(0.0, 360.0),
)
def test_lines_in_any_direction_report_a_circle_around_them(
    yaw_deg: float,
    middle_m: tuple[float, float, float],
    spacing_m: float,
    along_m: float,
    radius_m: float,
    around_deg: float,
) -> None:
    turn, around = np.deg2rad(yaw_deg), np.deg2rad(around_deg)
    axis = np.array([np.cos(turn), np.sin(turn), 0.0])
    across = np.array([-np.sin(turn), np.cos(turn), 0.0])
    arrays = [
        ArraySpec(name, posed(line(spacing_m, 4), middle_m + off_m * axis, yaw_deg), BAND_HZ)
        for name, off_m in (("west", -0.9), ("east", 0.9))
    ]
    outwards = np.cos(around) * across + np.sin(around) * np.array([0.0, 0.0, 1.0])
    found = located(arrays, middle_m + along_m * axis + radius_m * outwards)
    answer, why = judged(found, arrays)
    assert answer is Status.DIRECTION_ONLY
    assert why is not None
    assert "all microphones lie on one line" in why
    assert len(found.candidates) > 2
    for each in found.candidates:
        from_middle_m = each.position_m - middle_m
        assert from_middle_m @ axis == pytest.approx(along_m, abs=TOLERANCE_M)
        assert np.linalg.norm(np.cross(from_middle_m, axis)) == pytest.approx(radius_m, abs=TOLERANCE_M)


def test_a_search_in_a_plane_leaves_front_and_back_of_a_line() -> None:
    plane = Grid((*ROOM.bounds_m[:2], (1.3, 1.3)), 0.1)
    arrays = [straight("west", [1.2, 2.5, 1.3]), straight("east", [3.0, 2.5, 1.3])]
    found = located(arrays, [2.2, 3.7, 1.3], plane)
    assert status(found, arrays) is Status.DIRECTION_ONLY
    assert len(found.candidates) == 2
    for y_m in (3.7, 1.3):
        assert nearest_candidate(found, [2.2, y_m, 1.3])[0] < TOLERANCE_M
    front = Grid(((0.0, 4.2), (2.5, 5.1), (1.3, 1.3)), 0.1)
    assert off_m(located(arrays, [2.2, 3.7, 1.3], front), [2.2, 3.7, 1.3]) < TOLERANCE_M


def test_coordinates_that_hang_on_the_wavefronts_curvature_are_uncertain() -> None:
    """Two lines at right angles measure two cones; where along their intersection the sound was, they do not."""
    arrays = [straight("south", [2.1, 0.2, 1.3]), straight("west", [0.2, 2.5, 1.3], 90.0)]
    found = located(arrays, [3.6, 4.4, 1.9])
    assert status(found, arrays) is not Status.LOCATED
    error_m = found.position_m - [3.6, 4.4, 1.9]
    assert (
        error_m @ np.linalg.solve(found.covariance_m2, error_m) < 16.3
        or nearest_candidate(found, [3.6, 4.4, 1.9])[0] < 0.5
    )


def test_a_mirror_image_within_the_accuracy_widens_the_covariance() -> None:
    arrays = [flat("north", [2.1, 4.4, 1.3], 0.25), flat("south", [2.0, 0.8, 1.3], 0.25)]
    found = located(arrays, [1.4, 2.3, 1.42])
    assert status(found, arrays) is Status.LOCATED
    error_m = found.position_m - [1.4, 2.3, 1.42]
    assert np.linalg.norm(error_m) < 0.5
    assert error_m @ np.linalg.solve(found.covariance_m2, error_m) < 11.3  # 99 % of the chi-squared distribution of 3


def test_a_tetrahedron_has_no_look_alikes() -> None:
    arrays = [tetra("north", [2.7, 4.2, 1.3]), tetra("south", [2.3, 1.1, 1.5])]
    assert flatness(arrays, C_M_S) is None
    assert len(look_alikes(np.array([1.0, 2.0, 1.0]), arrays, ROOM, C_M_S)) == 0
    assert located(arrays, [1.1, 3.3, 1.5]).candidates == ()


def test_microphones_count_as_coplanar_within_a_share_of_the_wavelength() -> None:
    bent_m = circle(0.1, 4) + np.array([[0.0, 0.0, 0.03], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    high, low = ArraySpec("high", bent_m, (100.0, 6000.0)), ArraySpec("low", bent_m, (100.0, 1000.0))
    assert flatness([high], C_M_S) is None
    assert flatness([low], C_M_S) is not None
