"""`livessl plan`: its text, its files, its warnings and its errors."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from livessl.cli.main import main
from livessl.lab.plan.design import make_plan
from livessl.lab.plan.prediction import Move
from livessl.lab.plan.warn import warnings
from livessl.lab.plan.words import addition_text, as_json, move_text
from small_site import Changes, site_of, write_site

ROOM: Changes = {"room.size_m": [8.0, 10.0, 4.0]}
CORNER: Changes = {**ROOM, "arrays.north.position_m": [1.2, 1.4, 1.5], "arrays.south.position_m": [2.3, 1.9, 1.6]}


def planned(directory: Path, changes: Changes | None = None, *more: str) -> list[str]:
    return ["plan", "--site", str(write_site(directory, changes)), *more]


def object_of(directory: Path, capsys: pytest.CaptureFixture[str], changes: Changes | None, *more: str) -> Any:
    assert main(planned(directory, changes, "--json", *more)) == 0
    return json.loads(capsys.readouterr().out)


def test_json_is_one_object_that_agrees_with_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = object_of(tmp_path, capsys, {**ROOM, "nodes.lab-pc.device.sample_rate_hz": 44100}, "--rt60", "0.8")
    assert plan["room"]["critical_distance_m"] == pytest.approx(1.28, abs=5e-3)
    assert [entry["from_broadside_deg"] for entry in plan["arrays"]["north"]["angle_error"]] == [0, 30, 60, 80]
    shown = plan["map"]
    error_m = np.array(shown["error_m"])
    assert error_m.shape == (len(shown["y_m"]), len(shown["x_m"]))
    assert np.median(error_m) == pytest.approx(plan["predicted_error"]["p50_m"], abs=1e-5)
    for array in plan["arrays"].values():
        assert np.array(array["map_error_m"]).shape == error_m.shape
        assert (np.array(array["map_error_m"]) >= error_m - 1e-5).all(), "two arrays are at least as good as one"
        assert len(array["pairs"]) == 6
        assert array["predicted_error"]["median_radial_m"] > 5 * array["predicted_error"]["median_tangential_m"]


def test_paper_at_half_a_metre(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes = {**ROOM, "arrays.north.geometry": {"tetrahedron": {"edge_m": 0.5}}}
    changes["nodes.lab-pc.device.sample_rate_hz"] = 44100
    plan = object_of(tmp_path, capsys, changes)
    errors = [entry["error_deg"] for entry in plan["arrays"]["north"]["angle_error"]]
    off = np.abs(np.array(errors) - [0.257, 0.298, 0.519, 1.61])
    assert (off <= [0.5e-3, 0.5e-3, 0.5e-3, 5e-3]).all()
    assert plan["arrays"]["north"]["diffuse_correlation"] == pytest.approx(0.013, abs=5e-4)


def test_map_has_x_as_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = object_of(tmp_path, capsys, CORNER)
    row, column = np.unravel_index(np.argmin(plan["arrays"]["south"]["map_error_m"]), np.shape(plan["map"]["error_m"]))
    best = [plan["map"]["x_m"][column], plan["map"]["y_m"][row]]
    assert np.linalg.norm(np.array(best) - [2.3, 1.9]) < 1.0
    assert np.linalg.norm(np.array(best) - [1.9, 2.3]) > 0.3 or best[0] > best[1], "columns are x"


def test_advice_keeps_its_promise_for_the_site_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = object_of(tmp_path, capsys, CORNER)
    assert 1 <= len(plan["advice"]) <= 3
    for advice in plan["advice"]:
        name = advice["array"]
        assert advice["kind"] == "move"
        assert advice["text"].startswith(f"move array {name!r} by ")
        assert advice["median_after_m"] < 0.95 * advice["median_before_m"]
        assert advice["median_before_m"] == pytest.approx(plan["predicted_error"]["p50_m"], rel=1e-9)
        moved = {
            **CORNER,
            f"arrays.{name}.position_m": list(np.add(CORNER[f"arrays.{name}.position_m"], advice["offset_m"])),
        }
        moved[f"arrays.{name}.position_m"] = [float(x) for x in moved[f"arrays.{name}.position_m"]]
        there = object_of(tmp_path, capsys, moved)
        assert there["predicted_error"]["p50_m"] == pytest.approx(advice["median_after_m"], rel=1e-9)
        np.testing.assert_allclose(there["arrays"][name]["centre_m"], advice["position_m"], rtol=0, atol=1e-6)


def test_a_site_with_one_array_gets_the_position_of_a_second(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one: Changes = {**ROOM, "arrays.south": ..., "nodes": ...}
    [added] = [advice for advice in object_of(tmp_path, capsys, one)["advice"] if advice["kind"] == "add"]
    assert added["text"].startswith("add an array like 'north', shifted by ")
    assert added["median_after_m"] < 0.5 * added["median_before_m"]
    position_m = [float(x) for x in np.add([1.9, 1.3, 1.4], added["offset_m"])]
    two = {**ROOM, "nodes": ..., "arrays.south.position_m": position_m}
    there = object_of(tmp_path, capsys, two)
    assert there["predicted_error"]["p50_m"] == pytest.approx(added["median_after_m"], rel=1e-9)
    assert [advice for advice in there["advice"] if advice["kind"] == "add"] == []


@pytest.mark.parametrize(
    ("offset_m", "text"),
    [
        ((1.2, 0.0), "move array 'south' by +1.2 m in x: median predicted error 0.31 → 0.18 m"),
        ((-0.5, 2.0), "move array 'south' by -0.5 m in x and +2.0 m in y: median predicted error 0.31 → 0.18 m"),
        ((0.0, -1.0), "move array 'south' by -1.0 m in y: median predicted error 0.31 → 0.18 m"),
    ],
)
def test_text_of_a_move(offset_m: tuple[float, float], text: str) -> None:
    assert move_text(Move("south", offset_m, 0.31, 0.18)) == text
    assert addition_text(Move("south", offset_m, 0.31, 0.18)).endswith(text.removeprefix("move array 'south' by"))


def test_text_is_readable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(planned(tmp_path, CORNER)) == 0
    said = capsys.readouterr().out
    for part in ("critical distance 1.39 m", "north", "south", "all ", "advice", "m in y", "predicted error"):
        assert part in said
    assert "nan" not in said


def test_out_writes_both_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "plan"
    plan = object_of(tmp_path, capsys, CORNER, "--out", str(out))
    assert json.loads((out / "plan.json").read_text(encoding="utf-8")) == plan
    assert (out / "plan.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_figure_of_one_array_and_of_five(tmp_path: Path) -> None:
    one: Changes = {"arrays.south": ..., "nodes": ...}
    assert main(planned(tmp_path, one, "--out", str(tmp_path / "one"))) == 0
    five = {
        f"arrays.a{k}": {"geometry": {"tetrahedron": {"edge_m": 0.2}}, "position_m": [1.0 + k, 2.0, 1.2]}
        for k in range(3)
    }
    assert main(planned(tmp_path, five, "--out", str(tmp_path / "five"))) == 0
    assert (tmp_path / "five" / "plan.png").stat().st_size > (tmp_path / "one" / "plan.png").stat().st_size


def test_without_matplotlib(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(planned(tmp_path, None, "--out", str(tmp_path / "plan"))) == 1
    assert "run `sh scripts/setup.sh figures`" in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()
    assert main(planned(tmp_path)) == 0, "text needs none"


def test_anechoic_has_the_floor_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dead = object_of(tmp_path, capsys, None, "--rt60", "0")
    live = object_of(tmp_path, capsys, None, "--rt60", "0.5")
    rough = object_of(tmp_path, capsys, None, "--rt60", "0", "--calibration", "0.004")
    assert dead["room"]["critical_distance_m"] is None
    assert dead["predicted_error"]["p50_m"] < live["predicted_error"]["p50_m"]
    # the floor is proportional; the search volume's own width bends it by less than a per cent where two arrays look
    assert rough["predicted_error"]["p50_m"] == pytest.approx(2 * dead["predicted_error"]["p50_m"], rel=0.01)
    assert main(planned(tmp_path, None, "--rt60", "0")) == 0
    assert "no reverberation" in capsys.readouterr().out


def test_a_plane_is_planned_at_its_height(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plane = {"grid.bounds_m": [[0.5, 3.5], [0.5, 4.5], [1.1, 1.1]]}
    plan = object_of(tmp_path, capsys, plane)
    assert plan["height_m"] == 1.1
    assert plan["map"]["x_m"][0] > 0.5
    assert object_of(tmp_path, capsys, None)["height_m"] == 1.5
    low = {"grid.bounds_m": [[0.5, 3.5], [0.5, 4.5], [0.2, 1.0]]}
    assert object_of(tmp_path, capsys, low)["height_m"] == pytest.approx(0.6)
    assert object_of(tmp_path, capsys, None, "--height", "0.7")["height_m"] == 0.7


@pytest.mark.parametrize(
    ("changes", "more", "said"),
    [
        ({}, ("--rt60", "0.01"), "reverberation time"),
        ({}, ("--height", "3.5"), "height: expected 0 to 3 m, where the site searches, got 3.5 m"),
        ({"grid.bounds_m": [[5, 6], [0, 5], [0, 3]]}, (), "grid.bounds_m: expected a box that reaches into the room"),
        ({"room.size_m": [4.0, 5.0]}, (), "room.size_m"),
    ],
)
def test_wrong_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: Changes, more: tuple[str, ...], said: str
) -> None:
    assert main(planned(tmp_path, changes, *more, "--out", str(tmp_path / "plan"))) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


@pytest.mark.parametrize("option", [("--rt60", "-1"), ("--calibration", "0"), ("--height", "tall")])
def test_wrong_numbers(tmp_path: Path, option: tuple[str, str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(planned(tmp_path, None, *option))
    assert caught.value.code == 2


def test_out_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan").write_text("", encoding="utf-8")
    assert main(planned(tmp_path, None, "--out", str(tmp_path / "plan"))) == 2
    assert "expected a folder, got a file" in capsys.readouterr().err


FLAT = {"geometry": {"circle": {"radius_m": 0.1, "count": 4}}, "position_m": [2.0, 2.5, 1.2]}
FINE = {"grid.spacing_m": 0.1}
WARNINGS: dict[str, tuple[Changes, float]] = {
    "hardly a distance; set up a second one": ({**FINE, "arrays.south": ..., "nodes": ...}, 0.5),
    "all arrays stand in one line": (
        {**FINE, "arrays.middle": {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [2.05, 2.5, 1.4]}},
        0.5,
    ),
    "all microphones lie in the plane z = 1.20 m: in ": (
        {**FINE, "arrays.north": FLAT, "arrays.south": ..., "nodes": ...},
        0.5,
    ),
    "m from the wall x = 0": ({**FINE, "arrays.north.position_m": [0.4, 1.3, 1.4]}, 0.5),
    "m from the wall y = 5 m": ({**FINE, "arrays.north.position_m": [2.0, 4.5, 1.4]}, 0.5),
    "m from the ceiling": ({**FINE, "arrays.north.position_m": [2.0, 2.0, 2.6]}, 0.5),
    "wider than the critical distance": ({**FINE, "arrays.north.geometry": {"tetrahedron": {"edge_m": 1.4}}}, 1.5),
    "less than half a wavelength": ({**FINE, "arrays.north.geometry": {"tetrahedron": {"edge_m": 0.02}}}, 0.5),
    "needs a sample rate of 13333 Hz": ({**FINE, "nodes.lab-pc.device.sample_rate_hz": 13000}, 0.5),
    "the plan treats the joint arrays (both) as separate ones": ({**FINE, "joint.both": ["north", "south"]}, 0.5),
    "a grid of 0.5 m is too coarse": ({"grid.spacing_m": 0.5}, 0.5),
}


@pytest.mark.parametrize("said", WARNINGS)
def test_warnings(said: str) -> None:
    changes, rt60_s = WARNINGS[said]
    assert any(said in warning for warning in warnings(make_plan(site_of(changes), rt60_s)))


def test_a_good_site_has_no_warning() -> None:
    assert warnings(make_plan(site_of(FINE), 0.5)) == []


def test_flat_arrays_under_the_ceiling_cause_no_warning() -> None:
    under = {**FLAT, "position_m": [2.0, 2.5, 2.4]}
    site = site_of(
        {**FINE, "arrays.north": under, "arrays.south": ..., "nodes": ..., "grid.bounds_m": [[0, 4], [0, 5], [0, 2.4]]}
    )
    assert not any("mirror image" in warning for warning in warnings(make_plan(site, 0.5)))


def test_sample_rate_without_a_node_is_reported_as_assumed() -> None:
    plan = as_json(make_plan(site_of({"nodes": ...}), 0.5))
    assert plan["arrays"]["north"]["sample_rate_hz"] == 44100
    assert plan["arrays"]["north"]["sample_rate_known"] is False
