"""The layout that `livessl check` draws and measures."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cli.command_runs import Run
from livessl.lab.layout.measures import layout_of, nearest_wall
from livessl.lab.layout.terminal import COLUMNS, ROWS, as_text, floor_plan
from livessl.lab.plan.design import make_plan
from small_site import site_of, write_site


def test_check_prints_distances_speed_of_sound_and_expected_error(run: Run, tmp_path: Path) -> None:
    done = run("check", write_site(tmp_path, {"temperature_c": 20}))
    assert done.code == 0
    assert "(1.90, 1.30, 1.40)" in done.out
    apart_m = float(np.linalg.norm(np.array([0.3, 2.5, 0.1])))
    assert f"{apart_m:.2f} m to south" in done.out
    assert "speed of sound: 343.2 m/s, in air of 20 degrees Celsius" in done.out
    assert re.search(r"expected error at 1.5 m height with RT60 0.7 s: median \d+\.\d\d m, 95 % \d+\.\d\d m", done.out)


def test_expected_error_is_that_of_the_plan(run: Run, tmp_path: Path) -> None:
    plan = make_plan(site_of(), 0.4)
    [checked] = run("check", write_site(tmp_path), "--rt60", "0.4", "--json").objects
    expected = checked["layout"]["expected_error"]
    assert expected["median_m"] == pytest.approx(plan.fused.percentile_m(50), rel=1e-12)
    assert expected["height_m"] == plan.height_m
    [distance] = checked["layout"]["distances_m"]
    assert distance["distance_m"] == pytest.approx(float(np.linalg.norm([0.3, 2.5, 0.1])), abs=1e-5)


def test_room_that_cannot_have_the_reverberation_time_is_said_and_valid(run: Run, tmp_path: Path) -> None:
    done = run("check", write_site(tmp_path), "--rt60", "0.01")
    assert done.code == 0
    assert "expected error: not predicted, " in done.out


@settings(max_examples=15, deadline=None)
@given(
    place_m=st.tuples(st.floats(0.2, 3.8), st.floats(0.2, 4.8), st.floats(0.25, 2.7)),
    axis=st.integers(0, 2),
)
def test_nearest_wall_is_the_smallest_gap_of_any_microphone(place_m: tuple[float, float, float], axis: int) -> None:
    spec = site_of({"arrays.north.position_m": list(place_m)}).array("north")
    size = np.array([4.0, 5.0, 3.0])
    gaps = np.concatenate([spec.microphones_m.ravel(), (size - spec.microphones_m).ravel()])
    assert nearest_wall(spec, site_of()).distance_m == pytest.approx(gaps.min())


@settings(max_examples=15, deadline=None)
@given(place_m=st.tuples(st.floats(0.3, 3.7), st.floats(0.3, 4.7)))
def test_array_is_drawn_where_it_is(place_m: tuple[float, float]) -> None:
    site = site_of({"arrays.north.position_m": [*place_m, 1.2], "zones": {}})
    rows = floor_plan(site)
    inner = [row.partition("│")[2].rpartition("│")[0] for row in rows if "│" in row]
    assert len(inner) <= ROWS
    assert all(len(row) == len(inner[0]) <= COLUMNS for row in inner)
    [(row, column)] = [(y, line.index("A")) for y, line in enumerate(reversed(inner)) if "A" in line]
    cell = np.array([4.0 / len(inner[0]), 5.0 / len(inner)])
    drawn = (np.array([column, row]) + 0.5) * cell
    assert (np.abs(drawn - place_m) <= 0.5 * cell + 1e-9).all()


def test_floor_plan_keeps_the_proportions_of_the_room() -> None:
    """Characters are about twice as high as they are wide."""
    inner = [row for row in floor_plan(site_of()) if "│" in row]
    width = inner[0].count(" ") - 2
    assert width / (2.0 * len(inner)) == pytest.approx(4.0 / 5.0, rel=0.1)


def test_site_of_many_arrays_is_drawn(tmp_path: Path) -> None:
    shape = {"tetrahedron": {"edge_m": 0.1}}
    arrays = {
        f"a{x}{y}": {"geometry": shape, "position_m": [0.3 + 0.38 * x, 0.3 + 0.75 * y, 1.0]}
        for x in range(10)
        for y in range(6)
    }
    site = site_of({"arrays": arrays, "nodes": {}, "zones": {}})
    text = as_text(layout_of(site, 0.4), 0.4)
    for name in arrays:
        assert f" {name} " in text
    assert "distances:" not in text


def test_figure_is_written(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "layout.png"
    assert run("check", write_site(tmp_path), "--png", picture).code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
