"""What a valid site file stands for: microphones, search volume, zones, and warnings about grids."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from livessl.core.types import FloatArray
from livessl.site.build.grid import search_grid
from site_faults import ARRAY, JOINT, NODE
from small_site import Changes, site_of

SQUARE_M = [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]


def microphones(changes: Changes, directory: Path | None = None) -> FloatArray:
    return (
        site_of({"arrays.south": ..., f"{NODE}.arrays.south": ..., **changes}, directory).array("north").microphones_m
    )


def posed_square(directory: Path, **turn: float) -> FloatArray:
    """Return the microphones' positions relative to the array's origin."""
    (directory / "square.yaml").write_text(yaml.safe_dump({"microphones_m": SQUARE_M}), encoding="utf-8")
    array = {"geometry": "square.yaml", "position_m": [2.0, 2.0, 1.0], "orientation_deg": turn}
    return microphones({ARRAY: array}, directory) - [2.0, 2.0, 1.0]


def test_poses_turn_the_right_way(tmp_path: Path) -> None:
    x, y, z = np.eye(3) * 0.1
    cases: list[tuple[dict[str, float], FloatArray, FloatArray, FloatArray]] = [
        ({}, x, y, z),
        ({"yaw": 90}, y, -x, z),  # counter-clockwise seen from above
        ({"pitch": 90}, -z, y, x),  # lowers the +x end
        ({"roll": 90}, x, z, -y),  # raises the +y end
        ({"yaw": 90, "pitch": 90}, -z, -x, y),  # first pitch, then yaw
        ({"pitch": 90, "roll": 90}, -z, x, -y),  # first roll, then pitch
    ]
    for turn, first, third, fourth in cases:
        turned = posed_square(tmp_path, **turn)
        assert_allclose(turned, np.stack([first, -first, third, fourth]), rtol=0, atol=1e-12, err_msg=str(turn))


def test_absolute_microphones_are_the_posed_ones() -> None:
    pose: Changes = {f"{ARRAY}.orientation_deg": {"yaw": 25, "pitch": -10, "roll": 5}}
    posed_m = microphones(pose)
    absolute_m = microphones({ARRAY: {"microphones_m": posed_m.tolist()}})
    assert_allclose(absolute_m, posed_m, rtol=0, atol=0)
    assert np.abs(microphones({}) - posed_m).max() > 0.01


def test_shapes_have_their_channels_in_order() -> None:
    def shape(**shape: Any) -> FloatArray:
        count = next(iter(shape.values())).get("count", 4)
        array = {"geometry": shape, "position_m": [2.0, 2.0, 1.0]}
        channels = list(range(1, count + 1))
        return microphones({ARRAY: array, f"{NODE}.arrays.north": channels}) - [2.0, 2.0, 1.0]

    tetrahedron = shape(tetrahedron={"edge_m": 0.5})
    distances = np.linalg.norm(tetrahedron[:, None] - tetrahedron[None], axis=2)
    assert_allclose(distances[~np.eye(4, dtype=bool)], 0.5)
    assert tetrahedron[0, 2] > 0.3
    assert_allclose(tetrahedron[1], np.array([0.5 / np.sqrt(3), 0, tetrahedron[2, 2]]), atol=1e-12)
    circle = shape(circle={"radius_m": 0.1, "count": 4})
    assert_allclose(circle, np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]]), atol=1e-12)
    clockwise = shape(circle={"radius_m": 0.1, "count": 4, "clockwise": True})
    assert_allclose(clockwise, circle[[0, 3, 2, 1]], atol=1e-12)
    line = shape(line={"spacing_m": 0.1, "count": 3})
    assert_allclose(line, np.array([[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]]), atol=1e-12)


def test_speed_of_sound_is_given_or_follows_from_the_temperature() -> None:
    assert site_of().c_m_s == 343.0
    assert site_of({"speed_of_sound_m_s": 340.0}).c_m_s == 340.0
    # 331.3 sqrt(1 + 20 / 273.15) = 343.2
    assert site_of({"temperature_c": 20.0}).c_m_s == pytest.approx(343.2, abs=0.05)
    assert site_of({"temperature_c": 0}).c_m_s == pytest.approx(331.3)


def test_search_volume_is_the_room_or_the_bounds() -> None:
    assert search_grid(site_of()).shape == (16, 20, 12)
    box = search_grid(site_of({"grid.bounds_m": [[1, 2], [0, 5], [0, 3]]}))
    assert box.shape == (4, 20, 12)
    plane = search_grid(site_of({"grid.bounds_m": [[0, 4], [0, 5], [1.2, 1.2]]}))
    assert plane.shape == (16, 20, 1)
    assert plane.free_axes == (0, 1)
    assert plane.points_m()[:, 2] == pytest.approx(1.2)


def test_array_may_have_a_band_of_its_own() -> None:
    site = site_of({f"{ARRAY}.band_hz": [200, 3000]})
    assert site.array("north").band_hz == (200.0, 3000.0)
    assert site.array("south").band_hz == (100.0, 6000.0)


def test_zones_hold_positions_inside_and_on_their_surface() -> None:
    site = site_of({"zones.all": {"bounds_m": [[0, 4], [0, 5], [0, 3]]}})
    assert site.zones_of([0.5, 0.5, 1.0]) == ["door", "all"]
    assert site.zones_of([1.0, 1.0, 2.5]) == ["door", "all"]
    assert site.zones_of([1.01, 1.0, 2.5]) == ["all"]
    assert site.zones_of([-0.1, 1.0, 2.5]) == []
    assert site.zones_of(None) == []


CEILING = [[x, y, 2.9] for x, y in [(0.1, 0.1), (5, 0.1), (9.9, 0.1), (9.9, 4), (9.9, 7.9), (0.1, 7.9)]]
HALL: Changes = {
    "room.size_m": [10.0, 8.0, 3.0],
    "grid.spacing_m": 0.1,
    "arrays": {"ceiling": {"microphones_m": CEILING}},
    "nodes": {},
    "zones": {},
}
"""Six microphones around a whole ceiling as one array: a spacing of 0.1 m is many periods of 6 kHz."""


def test_array_too_wide_for_the_grid_is_warned_about() -> None:
    [said] = site_of(HALL).warnings
    found = re.fullmatch(
        r"grid.spacing_m: array 'ceiling' is 12.5 m wide: up to 6000 Hz needs a spacing of about (\S+) m, got 0.1; "
        "positions may be wrong: lower the array's band_hz, or make arrays smaller",
        said,
    )
    assert found is not None
    # 1 / (2 f |grad tau|) over a cell's half diagonal; |grad tau| = 2 sin(angle / 2) / c, and most pairs are seen
    # under more than 60 and less than 180 degrees: from c / (sqrt(3) f) = 0.033 to half of that, 0.016 m
    assert 0.016 < float(found[1]) < 0.033
    assert "warnings" not in site_of(HALL).model_dump()


def test_suggested_band_removes_the_warning() -> None:
    assert site_of({**HALL, "arrays": {"ceiling": {"microphones_m": CEILING, "band_hz": [100, 1500]}}}).warnings == ()
    assert site_of({**HALL, "arrays": {"ceiling": {"microphones_m": CEILING, "band_hz": [4000, 16000]}}}).warnings == ()


def test_joint_array_too_wide_for_the_grid_is_warned_about() -> None:
    [said] = site_of({JOINT: ["north", "south"]}).warnings
    assert re.search("array 'both' is 2.8 m wide: .*; positions may be wrong: .* or take joint.both away", said)


def test_usual_arrays_cause_no_warning() -> None:
    half_a_metre = {"geometry": {"tetrahedron": {"edge_m": 0.5}}}
    assert site_of({"grid.spacing_m": 0.1, f"{ARRAY}.geometry": half_a_metre["geometry"]}).warnings == ()
    assert site_of().warnings == ()


def test_array_may_be_on_a_node_or_on_none() -> None:
    site = site_of({f"{NODE}.arrays.south": ...})
    assert site.node_of("north") == "lab-pc"
    assert site.node_of("south") is None


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://*:5570",
        "tcp://127.0.0.1:*",
        "tcp://[::1]:1",
        "tcp://[::]:*",
        "tcp://[fe80::1%eth0]:1",
        "ipc:///run/livessl",
    ],
)
def test_valid_endpoints_are_accepted(endpoint: str) -> None:
    assert site_of({"server.bind": endpoint}).server.bind == endpoint


def test_array_of_sixteen_channels_is_accepted() -> None:
    positions = [[1 + 0.1 * k, 1.0, 1.0] for k in range(16)]
    changes: Changes = {ARRAY: {"microphones_m": positions}, f"{NODE}.arrays.north": list(range(9, 25))}
    assert site_of(changes).array("north").microphones_m.shape == (16, 3)
