"""Zones of the site file: boxes and polygons, their faults, the file of drawn zones, and the floor plan's picture."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline

from livessl.errors import ConfigError
from livessl.site.floor_plan import PNG, SVG, read_floor_plan
from livessl.site.polygon import contains, polygon_faults, signed_area_m2
from livessl.site.zone_models import Zone
from livessl.site.zones_file import read_zones, write_zones
from small_site import Changes, site_of

TRIANGLE = [[0.5, 0.5], [2.0, 0.5], [1.0, 2.5]]
point = st.tuples(st.integers(-4, 4), st.integers(-4, 4))


def faults_of(changes: Changes, directory: Path | None = None) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        site_of(changes, directory)
    return [str(fault) for fault in caught.value.faults]


@settings(max_examples=200)
@given(st.lists(point, min_size=3, max_size=6, unique=True), st.integers(0, 5), st.booleans())
def test_a_polygon_is_accepted_if_and_only_if_no_two_edges_meet(
    points: list[tuple[int, int]], shift: int, backwards: bool
) -> None:
    """Edges are sampled in the exact arithmetic of whole numbers: an independent way to find that two have a point."""
    shift %= len(points)
    turned = (points[shift:] + points[:shift])[:: -1 if backwards else 1]
    accepted = polygon_faults(points) == []
    assert (polygon_faults(turned) == []) is accepted
    count = len(points)
    edges = [(points[i], points[(i + 1) % count]) for i in range(count)]
    meet = any(_meet(edges[i], edges[k], adjacent=abs(i - k) in (1, count - 1)) for i in range(count) for k in range(i))
    assert accepted is not (meet or signed_area_m2(points) == 0.0)


def _meet(one: Any, other: Any, *, adjacent: bool) -> bool:
    """Whether two segments between whole numbers have a point in common, the common corner of neighbours apart."""
    (a, b), (c, d) = (np.array(each) for each in (one, other))
    u, v, w = b - a, d - c, c - a
    cross = int(u[0] * v[1] - u[1] * v[0])
    if cross != 0:
        s, t = int(w[0] * v[1] - w[1] * v[0]), int(w[0] * u[1] - w[1] * u[0])
        if cross < 0:
            cross, s, t = -cross, -s, -t
        return 0 <= s <= cross and 0 <= t <= cross and not adjacent
    if int(w[0] * u[1] - w[1] * u[0]) != 0:
        return False
    axis = int(abs(u[1]) > abs(u[0]))
    (low, high), (first, last) = sorted((a[axis], b[axis])), sorted((c[axis], d[axis]))
    overlap = min(high, last) - max(low, first)
    return bool(overlap > 0 if adjacent else overlap >= 0)


@settings(max_examples=100)
@given(st.lists(point, min_size=3, max_size=7, unique=True), st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
def test_a_polygon_holds_the_points_that_matplotlib_finds_inside(
    points: list[tuple[int, int]], place: tuple[float, float]
) -> None:
    assume(polygon_faults(points) == [])
    outline = Outline(np.array([*points, points[0]], dtype=float))
    near = [outline.contains_point((place[0] + dx, place[1] + dy)) for dx in (-1e-6, 1e-6) for dy in (-1e-6, 1e-6)]
    assume(len(set(near)) == 1)  # not at an edge
    assert contains(points, *place) is bool(near[0])
    assert all(contains(points, *corner) for corner in points)


@pytest.mark.parametrize(
    ("zone", "expected"),
    [
        (
            {"polygon_m": TRIANGLE[:2]},
            "polygon_m: expected a polygon with at least 3 points, got 2; correct the points",
        ),
        (
            {"polygon_m": [[0, 0], [2, 2], [2, 0], [0, 2]]},
            "polygon_m: expected a polygon with no edges that cross, 1-2 crosses 3-4; correct the points, in order",
        ),
        (
            {"polygon_m": [[0, 0], [1, 0], [0, 0], [1, 1], [1, 0]]},
            "with each point once, points 1 and 3 are both [0, 0]; each point once, points 2 and 5 are both [1, 0]",
        ),
        ({"polygon_m": [[0, 0], [1, 1], [2, 2]]}, "an area, all points lie on one line"),
        ({"polygon_m": TRIANGLE, "z_m": [2, 1]}, "z_m: expected [low, high] with low < high, got [2, 1]; swap them"),
        ({"polygon_m": TRIANGLE, "bounds_m": [[0, 1]] * 3}, "expected either bounds_m (a box) or polygon_m"),
        ({}, "expected either bounds_m (a box) or polygon_m (corners on the floor plan), got neither"),
        ({"bounds_m": [[0, 1]] * 3, "z_m": [0, 1]}, "z_m belongs to polygon_m"),
        (
            {"polygon_m": [[9, 9], [11, 9], [9, 11]]},
            "polygon_m: expected a box that reaches into the room, on x from 0",
        ),
        ({"polygon_m": TRIANGLE, "exclude": True, "loiter_s": 3}, "remove loiter_s or exclude"),
        ({"polygon_m": TRIANGLE, "loiters": 3}, "unknown key 'loiters'; did you mean 'loiter_s'?"),
    ],
)
def test_faulty_zone_is_one_clear_message_with_its_line(zone: dict[str, Any], expected: str) -> None:
    [fault] = faults_of({"zones.hall": zone})[:1]
    assert expected in fault
    assert ": zones.hall" in fault


def test_a_closed_ring_is_a_polygon() -> None:
    assert Zone.model_validate({"polygon_m": [*TRIANGLE, TRIANGLE[0]]}).outline_m == tuple(map(tuple, TRIANGLE))


def test_a_polygon_has_a_range_of_heights() -> None:
    zone = Zone.model_validate({"polygon_m": TRIANGLE, "z_m": [0.5, 2]})
    assert [zone.contains([1.0, 1.0, z]) for z in (0.4, 0.5, 2.0, 2.1)] == [False, True, True, False]
    assert not zone.contains([0.5, 1.0, 1.0])
    assert zone.box_m(3.0) == ((0.5, 2.0), (0.5, 2.5), (0.5, 2.0))
    assert Zone.model_validate({"polygon_m": TRIANGLE}).box_m(3.0)[2] == (0.0, 3.0)


def test_drawn_zones_survive_their_file_and_the_site_has_them(tmp_path: Path) -> None:
    zones = {
        "desk": Zone.model_validate({"polygon_m": TRIANGLE, "z_m": [0, 1.5], "loiter_s": 20}),
        "fan": Zone.model_validate({"polygon_m": TRIANGLE, "exclude": True}),
    }
    write_zones(tmp_path / "zones.yaml", zones)
    assert read_zones(tmp_path / "zones.yaml") == zones
    site = site_of({"zones_file": "zones.yaml"}, tmp_path)
    assert list(site.all_zones) == ["door", "desk", "fan"]
    assert site.zones_of([1.0, 1.0, 1.0]) == ["door", "desk", "fan"]
    assert site_of({"zones_file": "none.yaml"}, tmp_path).drawn_zones == {}


def test_faults_of_the_file_of_drawn_zones_are_reported_with_its_lines(tmp_path: Path) -> None:
    text = "desk:\n  polygon_m: [[0, 0], [1, 1]]\nfan lamp:\n  polygon_m: [[0, 0], [1, 0], [1, 1]]\n"
    (tmp_path / "zones.yaml").write_text(text, encoding="utf-8")
    [fault] = faults_of({"zones_file": "zones.yaml"}, tmp_path)
    assert "zones_file: " in fault
    assert "zones.yaml:2: desk.polygon_m: expected a polygon with at least 3 points, got 2" in fault
    write_zones(tmp_path / "zones.yaml", {"door": Zone.model_validate({"polygon_m": TRIANGLE})})
    [fault] = faults_of({"zones_file": "zones.yaml"}, tmp_path)
    assert "zones.door: zones.yaml has a drawn zone of the same name; rename one of them" in fault


def test_rules_name_zones_that_can_alert(tmp_path: Path) -> None:
    write_zones(tmp_path / "zones.yaml", {"desk": Zone.model_validate({"polygon_m": TRIANGLE})})
    zones = {"fan": {"polygon_m": TRIANGLE, "exclude": True}}
    rules = {
        "a": {"events": {"zones": ["desk"]}},
        "b": {"events": {"zones": ["fan"]}},
        "c": {"tracks": {"zones": ["desk"], "changes": ["loiter"]}},
        "d": {"tracks": {"zones": ["dusk"]}},
    }
    faults = faults_of({"zones_file": "zones.yaml", "zones": zones, "alerts": {"rules": rules}}, tmp_path)
    found = "\n".join(faults)
    assert "alerts.rules.b.events.zones: zone 'fan' is excluded, and nothing there alerts" in found
    assert "alerts.rules.c.tracks.zones: zone 'desk' does not say how long loitering is; add loiter_s to it" in found
    assert "alerts.rules.d.tracks.zones: expected one of the zones fan, desk, got 'dusk'" in found
    [fault] = faults_of({"alerts": {"rules": {"a": {"tracks": {}}}}})
    assert "alerts.rules.a.tracks.zones: missing; add it" in fault


def test_example_of_the_page_about_zones_is_valid(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "zones.md").read_text(encoding="utf-8")
    [example] = re.findall(r"^```yaml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "plan.svg").write_text('<svg width="200" height="250"/>', encoding="utf-8")
    site = site_of(yaml.safe_load(example) | {"alerts.outbox": "alerts.sqlite", "server.events_db": "e"}, tmp_path)
    assert [rule.kind for rule in site.alerts.rules.values()] == ["tracks", "tracks"]
    assert site.zones_of([2.0, 2.0, 1.0]) == ["desk"]


def png(width: int, height: int) -> bytes:
    """The head of a PNG."""
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height) + b"\x08\x06\x00\x00\x00"


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("plan.png", png(200, 100), PNG),
        ("plan.svg", b'<?xml version="1.0"?>\n<svg xmlns="x" width="200" height="100px"><path/></svg>', SVG),
        ("plan.svg", b"<svg viewBox='5 5 200 100' xmlns='x'></svg>", SVG),
        ("plan.svg", b'<svg width="100%" height="100%" viewBox="0,0,200,100"></svg>', SVG),
    ],
)
def test_picture_of_the_floor_plan_has_its_place_in_the_room(tmp_path: Path, name: str, data: bytes, kind: str) -> None:
    (tmp_path / name).write_bytes(data)
    plan = {"image": name, "m_per_pixel": 0.02, "origin_m": [-0.5, 1.0]}
    picture = read_floor_plan(site_of({"floor_plan": plan}, tmp_path))
    assert picture is not None
    assert picture.media_type == kind
    assert np.array(picture.bounds_m) == pytest.approx(np.array([[-0.5, 3.5], [1.0, 3.0]]))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (None, "plan.png cannot be read: No such file or directory; correct the name"),
        (b"GIF89a", "expected a PNG, or an SVG with width and height or a viewBox"),
        (png(0, 3), "expected a PNG"),
        (b'<svg width="100%"></svg>', "expected a PNG, or an SVG with width"),
    ],
)
def test_picture_that_cannot_be_used_is_a_fault(tmp_path: Path, data: bytes | None, expected: str) -> None:
    if data is not None:
        (tmp_path / "plan.png").write_bytes(data)
    [fault] = faults_of({"floor_plan": {"image": "plan.png", "m_per_pixel": 0.02}}, tmp_path)
    assert "floor_plan.image: " in fault
    assert expected in fault
