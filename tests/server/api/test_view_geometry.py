"""The numbers behind the views of the room, against numpy: projection, ellipsoids, cameras and places for labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import Any, Final

import numpy as np
import pytest
from playwright.sync_api import expect

from browser import faultless_page, running_browser, visit
from livessl.core.types import FloatArray
from room_views import directions, leaves, overlap
from small_site import HANG_S, running_server, site_of

pytestmark = [pytest.mark.browser]

SIZE_M: Final = [4.0, 5.0, 3.0]
LOOKS: Final = [(-90.0, 90.0), (0.0, 0.0), (-90.0, 0.0), (-62.0, 24.0), (131.0, 57.0), (-180.0, 3.0)]
CHI2_95_OF_3: Final = 7.8147
"""95 % quantile of the chi-square distribution with three degrees of freedom."""

Script = Callable[..., Any]


@pytest.fixture(scope="module")
def script() -> Iterator[Script]:
    """Function that evaluates JavaScript with a module of the page as `m` and a value as `given`."""
    with running_server(site_of()) as server, running_browser() as browser, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)

        def evaluate(module: str, code: str, given: Any = None) -> Any:
            return page.evaluate(
                f"async (given) => {{ const m = await import('./static/{module}'); return {code}; }}", given
            )

        yield evaluate


def covariance_m2(seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(3, 3)) * [0.3, 0.1, 0.02]
    return np.asarray(root @ root.T)


@pytest.mark.parametrize("look", LOOKS)
def test_points_are_projected_along_the_direction_of_the_viewer(script: Script, look: tuple[float, float]) -> None:
    points = np.random.default_rng(1).uniform(-1, 6, (20, 3))
    code = """(([look, points]) => {
      const projection = new m.Projection(...look).placed(50, points[0], [300, 200]);
      return points.map((point) => [...projection.at(point), projection.depth(point)]);
    })(given)"""
    found = np.array(script("projection.js", code, [look, points.tolist()]))
    right, up, toward = directions(*look)
    away = points - points[0]
    assert found[:, 0] == pytest.approx(300 + 50 * away @ right)
    assert found[:, 1] == pytest.approx(200 - 50 * away @ up)
    assert found[:, 2] == pytest.approx(points @ toward)


def test_fixed_views_have_axes_to_the_right_and_up_and_turned_ones_have_none(script: Script) -> None:
    code = "Object.values(m.FIXED).map((look) => new m.Projection(...look).axes)"
    assert script("projection.js", code) == [[0, 1], [1, 2], [0, 2]]
    assert script("projection.js", "new m.Projection(180, 0).axes") is None


@pytest.mark.parametrize("look", LOOKS)
def test_faces_are_behind_every_point_of_the_room(script: Script, look: tuple[float, float]) -> None:
    """The middle of each face is farther from the viewer than the room's middle; a fixed view has one face."""
    code = """new m.Projection(...given[0]).faces(given[1]).map((face) => [
      face.view, ...m.onFace(face, given[1][face.along[0]] / 2, given[1][face.along[1]] / 2)])"""
    faces = script("projection.js", code, [look, SIZE_M])
    toward = directions(*look)[2]
    seen = {"side": 0, "front": 1, "floor": 2}
    assert {view for view, *_ in faces} == {view for view, axis in seen.items() if abs(toward[axis]) > 0.02}
    for _, *middle in faces:
        assert np.array(middle) @ toward < np.array(SIZE_M) / 2 @ toward


@pytest.mark.parametrize("look", LOOKS)
def test_covariance_is_seen_as_its_projection(script: Script, look: tuple[float, float]) -> None:
    full = covariance_m2(2)
    found = script("projection.js", "new m.Projection(...given[0]).shadow(given[1])", [look, full.tolist()])
    across = directions(*look)[:2]
    assert np.array(found) == pytest.approx(across @ full @ across.T, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_half_axes_span_the_ellipsoid_of_95_percent(script: Script, seed: int) -> None:
    """The sum of their squares is the covariance, enlarged; they are at right angles to each other."""
    full = covariance_m2(seed)
    axes = np.array(script("geometry.js", "m.ellipsoid95(given, 100)", full.tolist()))
    assert axes.T @ axes == pytest.approx(CHI2_95_OF_3 * full, rel=1e-3, abs=1e-9)
    for a, b in combinations(axes, 2):
        assert a @ b == pytest.approx(0, abs=1e-9)
    assert sorted(np.sum(axes**2, axis=1)) == pytest.approx(CHI2_95_OF_3 * np.linalg.eigvalsh(full), rel=1e-3)


def test_half_axes_are_limited_and_a_missing_covariance_has_none(script: Script) -> None:
    axes = script("geometry.js", "m.ellipsoid95([[1e6, 0, 0], [0, 1, 0], [0, 0, 0]], 7)")
    assert sorted(np.linalg.norm(axes, axis=1)) == pytest.approx([0, np.sqrt(CHI2_95_OF_3), 7], rel=1e-3)
    assert script("geometry.js", "m.ellipsoid95(null, 7)") is None
    assert script("geometry.js", "m.ellipsoid95([[NaN, 0, 0], [0, 1, 0], [0, 0, 1]], 7)") is None


def test_camera_goes_round_stays_above_the_floor_and_keeps_to_the_room(script: Script) -> None:
    code = """((size) => {
      const from = m.start(size);
      return [
        m.turned(from, 360, 0), m.turned(from, -130, 200), m.turned(from, 0, -200),
        m.zoomed(from, 1e9, size), m.zoomed(from, 1e-9, size), m.moved(from, 1e3, 1e3, size),
      ];
    })(given)"""
    round_once, above, below, near, far, away = script("camera.js", code, SIZE_M)
    start = script("camera.js", "m.start(given)", SIZE_M)
    assert start["target"] == [2.0, 2.5, 1.5]
    assert round_once == start
    assert above["azimuthDeg"] == pytest.approx(168)
    assert (above["elevationDeg"], below["elevationDeg"]) == (90, 0)
    assert (near["zoom"], far["zoom"]) == (24, 0.6)
    assert all(0 <= c <= size for c, size in zip(away["target"], SIZE_M, strict=True))


def test_camera_takes_the_shorter_way_round(script: Script) -> None:
    code = (
        """m.between({ ...m.start(given), azimuthDeg: 170 }, { ...m.start(given), azimuthDeg: -170, zoom: 4 }, 0.5)"""
    )
    halfway = script("camera.js", code, SIZE_M)
    assert abs(halfway["azimuthDeg"]) == pytest.approx(180)
    assert halfway["zoom"] == pytest.approx(2)


@pytest.mark.parametrize("count", [3, 30, 200])
def test_labels_never_overlap_and_never_leave_their_bounds(script: Script, count: int) -> None:
    """There is no room for 200 labels: some get no place, and the others still do not overlap."""
    rng = np.random.default_rng(count)
    labels = [
        {"anchor": rng.uniform(0, [600, 300]).tolist(), "gap": 12, "width": float(width), "height": 15}
        for width in rng.uniform(20, 90, count)
    ]
    bounds = {"left": 0, "top": 0, "width": 600, "height": 300}
    taken = [{"left": 100, "top": 100, "width": 80, "height": 40}]
    found = script("labels.js", "m.placed(given[0], given[1], { taken: given[2] })", [labels, bounds, taken])
    boxes = [box for box in found if box is not None]
    assert len(found) == count
    assert len(boxes) == count or count == 200
    for a, b in combinations([*boxes, *taken], 2):
        assert not overlap(a, b)
    assert not any(leaves(box, 600, 300) for box in boxes)


def test_label_keeps_off_what_is_drawn_as_long_as_there_is_room(script: Script) -> None:
    label = {"anchor": [100, 100], "gap": 10, "width": 40, "height": 15}
    below = {"left": 60, "top": 105, "width": 80, "height": 40}
    bounds = {"left": 0, "top": 0, "width": 200, "height": 200}
    code = "m.placed([given[0]], given[1], { avoid: given[2] })[0]"
    beside = script("labels.js", code, [label, bounds, [below]])
    assert beside["top"] + beside["height"] == 90  # above
    everywhere = {"left": 0, "top": 0, "width": 200, "height": 200}
    assert script("labels.js", code, [label, bounds, [everywhere]])["top"] == 110  # below, as without it


def test_far_label_is_led_to(script: Script) -> None:
    label = {"anchor": [100, 100], "gap": 10, "width": 40, "height": 15, "far": True}
    bounds = {"left": 0, "top": 0, "width": 200, "height": 200}
    found = script("labels.js", "m.placed([given[0]], given[1])[0]", [label, bounds])
    assert found["away"] is True
    assert found["top"] > 110


def test_points_that_coincide_form_sets(script: Script) -> None:
    points = [[0, 0], [100, 0], [5, 0], [10, 0], [100, 30]]
    assert script("labels.js", "m.together(given, 6)", points) == [[0, 2, 3], [1], [4]]
