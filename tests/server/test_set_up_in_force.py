"""The set-up in force: other poses without a restart, the calibration file, and what is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from livessl.clock import SystemClock
from livessl.errors import ConfigError
from livessl.server.set_up_in_force import CalibrationFileError, Commit, OutOfDateError, SetUpChangedError, SetUpInForce
from livessl.site.build.calibrated import typed_arrays
from livessl.site.effective import effective_settings
from livessl.site.load import load_site
from livessl.site.models import CalibratedArray, Site
from small_site import Changes, site_of, write_site

SHIFT_M = np.array([0.1, -0.2, 0.05])


class Desk:
    """A set-up with everything that follows it and that it publishes."""

    def __init__(self, directory: Path, changes: Changes | None = None) -> None:
        self.site = load_site(write_site(directory, changes))
        self.followed: list[Site] = []
        self.published: list[dict[str, Any]] = []
        self.set_up = SetUpInForce(self.site, SystemClock(), self.published.append)
        self.set_up.follow(lambda site: partial(self.followed.append, site))

    def moved(self, name: str = "south") -> dict[str, CalibratedArray]:
        """What is stored of an array that somebody moved from where the site file has it."""
        return typed_arrays(self.site, {name: self.site.array(name).microphones_m + SHIFT_M})


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def test_accepted_poses_are_in_force_stored_and_there_after_a_restart(desk: Desk, tmp_path: Path) -> None:
    assert desk.set_up.accept(desk.moved(), "typed") == ["south"]
    (followed,) = desk.followed
    assert followed is desk.set_up.site
    after_m = desk.site.array("south").microphones_m + SHIFT_M
    assert desk.set_up.site.array("south").microphones_m == pytest.approx(after_m, abs=1e-4)
    assert np.array_equal(desk.set_up.site.array("north").microphones_m, desk.site.array("north").microphones_m)
    (message,) = desk.published
    assert (message["kind"], message["changed"]) == ("poses", ["south"])
    assert message["arrays"]["south"]["position_m"] == pytest.approx(after_m.mean(axis=0), abs=1e-3)
    again = load_site(tmp_path / "site.yaml")
    assert again.calibration == "calibration/small.yaml"
    assert np.array_equal(again.array("south").microphones_m, desk.set_up.site.array("south").microphones_m)
    described = desk.set_up.describe()
    assert (described["arrays"], described["method"], described["can_undo"]) == (["south"], "typed", True)


def test_each_change_can_be_undone_once_and_the_first_one_too(desk: Desk, tmp_path: Path) -> None:
    with pytest.raises(LookupError, match="no calibration before"):
        desk.set_up.undo()
    desk.set_up.accept(desk.moved("north"), "typed")
    desk.set_up.accept(desk.moved("south"), "typed")
    assert desk.set_up.undo() == ["south"]
    assert not desk.set_up.describe()["can_undo"]
    assert load_site(tmp_path / "site.yaml").array("north").microphones_m == pytest.approx(
        desk.site.array("north").microphones_m + SHIFT_M, abs=1e-4
    )
    desk.set_up.accept(desk.moved("south"), "typed")

    (tmp_path / "first").mkdir()
    first = Desk(tmp_path / "first")
    first.set_up.accept(first.moved(), "typed")
    assert first.set_up.undo() == ["south"]
    assert first.set_up.describe()["arrays"] == []
    assert np.array_equal(
        load_site(tmp_path / "first" / "site.yaml").array("south").microphones_m,
        first.site.array("south").microphones_m,
    )


def test_a_named_file_that_is_still_to_be_written_is_made_by_the_first_change(tmp_path: Path) -> None:
    desk = Desk(tmp_path, {"calibration": str(tmp_path / "state" / "poses.yaml")})
    (said,) = desk.site.warnings
    assert "poses.yaml yet, so the poses of the site file are in force" in said
    assert {setting.place[0] for setting in effective_settings(tmp_path / "site.yaml")} >= {"arrays", "calibration"}
    assert desk.set_up.accept(desk.moved(), "typed") == ["south"]
    again = load_site(tmp_path / "site.yaml")
    assert again.warnings == ()
    assert np.array_equal(again.array("south").microphones_m, desk.set_up.site.array("south").microphones_m)


def test_a_file_that_another_program_wrote_is_taken_over(desk: Desk, tmp_path: Path) -> None:
    written = tmp_path / "calibration" / "small.yaml"
    written.parent.mkdir()
    entry = desk.moved()["south"].model_dump(exclude_defaults=True)
    written.write_text(yaml.safe_dump({"arrays": {"south": {**entry, "position_std_m": 0.03}}}))
    assert desk.set_up.reload() == ["south"]
    assert desk.set_up.site.array("south").uncertainty.position_m == 0.03
    assert desk.set_up.reload() == []
    written.write_text("arrays: {south: {microphones_m: [[0, 0, 0], [1, 1, 1]]}}")
    with pytest.raises(ConfigError, match="expected 4 microphones in the calibration file, got 2"):
        desk.set_up.reload()
    written.write_text("arrays: [")
    with pytest.raises(ConfigError, match="cannot be read"):
        desk.set_up.reload()
    assert "cannot be read" in desk.set_up.describe()["problem"]
    assert len(desk.followed) == 1


def test_arrays_outside_the_room_are_refused_and_nothing_changes(desk: Desk, tmp_path: Path) -> None:
    outside = typed_arrays(desk.site, {"south": desk.site.array("south").microphones_m + 5.0})
    with pytest.raises(ConfigError, match="south"):
        desk.set_up.accept(outside, "typed")
    assert not (tmp_path / "calibration").exists()
    assert desk.set_up.site is desk.site


def test_a_file_that_cannot_be_written_changes_nothing(desk: Desk, tmp_path: Path) -> None:
    (tmp_path / "calibration").write_text("no folder")
    with pytest.raises(CalibrationFileError, match="cannot be written"):
        desk.set_up.accept(desk.moved(), "typed")
    assert desk.set_up.site is desk.site


@pytest.mark.parametrize("when", ["prepares", "commits"])
def test_a_follower_that_fails_leaves_poses_and_file_as_they_were(desk: Desk, tmp_path: Path, when: str) -> None:
    desk.set_up.accept(desk.moved("north"), "typed")
    before = desk.set_up.site
    files = {path.name: path.read_bytes() for path in (tmp_path / "calibration").iterdir()}

    def fails(_: Site) -> Commit:
        def commit() -> None:
            raise MemoryError

        if when == "prepares":
            raise MemoryError
        return commit

    desk.set_up.follow(fails)
    with pytest.raises(MemoryError):
        desk.set_up.accept(desk.moved(), "typed")
    assert desk.set_up.site is before
    assert len(desk.published) == 1
    assert {path.name: path.read_bytes() for path in (tmp_path / "calibration").iterdir()} == files
    if when == "prepares":
        assert desk.followed == [before], "no follower has taken over what another one cannot"


def test_poses_that_were_proposed_for_others_are_refused(desk: Desk) -> None:
    desk.set_up.accept(desk.moved(), "typed", proposed_for=desk.site)
    with pytest.raises(OutOfDateError, match="other poses have come into force"):
        desk.set_up.accept(desk.moved("north"), "typed", proposed_for=desk.site)
    assert np.array_equal(desk.set_up.site.array("north").microphones_m, desk.site.array("north").microphones_m)


def test_nothing_is_written_where_nothing_changes(desk: Desk, tmp_path: Path) -> None:
    as_it_is = typed_arrays(desk.site, {"south": desk.site.array("south").microphones_m})
    rounded = Desk(tmp_path, {"arrays.south": {"microphones_m": as_it_is["south"].microphones_m}})
    assert rounded.set_up.accept(as_it_is, "typed") == []
    assert not (tmp_path / "calibration").exists()
    assert rounded.set_up.accept(rounded.moved(), "typed") == ["south"]
    files = {path.name: path.read_bytes() for path in (tmp_path / "calibration").iterdir()}
    assert rounded.set_up.accept(rounded.moved(), "typed") == []
    assert {path.name: path.read_bytes() for path in (tmp_path / "calibration").iterdir()} == files
    assert rounded.set_up.undo() == ["south"]


def test_other_names_of_files_are_taken_over_although_no_pose_changes(desk: Desk) -> None:
    named = desk.site.model_copy(update={"calibration": "measured.yaml"})
    assert desk.set_up.take_over(named) == []
    assert desk.set_up.site.calibration == "measured.yaml"
    assert desk.published == []


def test_poses_that_fit_only_another_room_need_a_restart(desk: Desk) -> None:
    size_m = desk.site.room.size_m
    changes = {"room.size_m": [size_m[0] + 5.0, *size_m[1:]], "arrays.north.position_m": [size_m[0] + 2.0, 1.3, 1.4]}
    with pytest.raises(SetUpChangedError, match=r"arrays\.north.*room"):
        desk.set_up.take_over(site_of(changes))
    assert desk.set_up.site is desk.site


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"arrays.west": {"microphones_m": [[1, 1, 1], [1.2, 1, 1]]}}, "expected the arrays north, south"),
        (
            {
                "arrays.south": {"microphones_m": [[1, 1, 1], [1.2, 1, 1]]},
                "nodes.lab-pc.arrays": {"north": [1, 2, 3, 4], "south": [5, 6]},
            },
            "expected 4 microphones, got 2",
        ),
        ({"band_hz": [200, 3000]}, "its band"),
    ],
)
def test_a_site_that_differs_in_more_than_poses_needs_a_restart(desk: Desk, changes: Changes, words: str) -> None:
    with pytest.raises(SetUpChangedError, match=words):
        desk.set_up.take_over(site_of(changes))
    assert desk.followed == []


def test_a_site_that_was_loaded_anew_brings_its_poses_and_speed_of_sound(desk: Desk) -> None:
    assert desk.set_up.take_over(desk.site) == []
    assert desk.set_up.take_over(site_of({"temperature_c": 30.0, "site": "other"})) == []
    assert desk.set_up.site.c_m_s == site_of({"temperature_c": 30.0}).c_m_s
    assert desk.set_up.site.site == "small"  # what is no pose is left out
    assert desk.set_up.take_over(site_of({"arrays.north.position_m": [1.5, 1.3, 1.4]})) == ["north"]
