"""The zones in force: who may change which, and what survives a restart."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from livessl.server.zones.book import ZoneBook, ZoneRefusedError, ZonesFileError
from livessl.server.zones.zone_map import ZoneMap, no_zone
from livessl.site import zones_file
from livessl.site.zone_models import Zone
from small_site import Changes, site_of

TRIANGLE = [[0.5, 0.5], [2.0, 0.5], [1.0, 2.5]]
DESK = Zone.model_validate({"polygon_m": TRIANGLE, "z_m": [0, 2]})


def book_of(directory: Path, changes: Changes | None = None) -> tuple[ZoneBook, list[dict[str, Any]]]:
    published: list[dict[str, Any]] = []
    return ZoneBook(site_of({"zones_file": "zones.yaml", **(changes or {})}, directory), published.append), published


def test_drawn_zone_is_in_force_at_once_published_and_there_after_a_restart(tmp_path: Path) -> None:
    book, published = book_of(tmp_path)
    assert book.current.holding([1.0, 1.0, 1.0]) == ["door"]
    book.put("desk", DESK)
    assert book.current.holding([1.0, 1.0, 1.0]) == ["door", "desk"]
    [message] = published
    assert (message["kind"], list(message["by_name"])) == ("zones", ["door", "desk"])
    assert [zone["owner"] for zone in message["by_name"].values()] == ["site-file", "drawn"]
    assert list(book_of(tmp_path)[0].current.zones) == ["door", "desk"]
    book.put("desk", DESK.model_copy(update={"exclude": True}))
    assert book_of(tmp_path)[0].current.zones["desk"].exclude
    book.delete("desk")
    assert [len(message["by_name"]) for message in published] == [2, 2, 1]
    assert list(book_of(tmp_path)[0].current.zones) == ["door"]


def test_zones_of_the_site_file_belong_to_it(tmp_path: Path) -> None:
    book, published = book_of(tmp_path)
    with pytest.raises(ZoneRefusedError, match="zone 'door' belongs to the site file; change it there"):
        book.put("door", DESK)
    with pytest.raises(ZoneRefusedError, match="belongs to the site file"):
        book.delete("door")
    with pytest.raises(LookupError, match="no zone 'hall'; zones are door"):
        book.delete("hall")
    assert published == []
    assert list(tmp_path.iterdir()) == []


def test_site_without_a_file_for_zones_has_a_cure(tmp_path: Path) -> None:
    book, _ = book_of(tmp_path, {"zones_file": None})
    with pytest.raises(ZoneRefusedError, match=r"names no file for drawn zones; add zones_file: zones\.yaml"):
        book.put("desk", DESK)


def test_zone_that_a_rule_needs_stays_and_is_not_excluded(tmp_path: Path) -> None:
    zones_file.write_zones(tmp_path / "zones.yaml", {"desk": DESK})
    book, _ = book_of(tmp_path, {"alerts": {"rules": {"a": {"tracks": {"zones": ["desk"]}}}}})
    with pytest.raises(ZoneRefusedError, match="zone 'desk': rule 'a' needs it"):
        book.delete("desk")
    with pytest.raises(ZoneRefusedError, match="rule 'a' alerts about it, and nothing alerts in an excluded zone"):
        book.put("desk", DESK.model_copy(update={"exclude": True}))
    book.put("desk", DESK.model_copy(update={"z_m": None}))


@pytest.mark.parametrize(
    ("name", "zone", "expected"),
    [("a b", DESK, "expected a name of"), ("far", {"polygon_m": [[9, 9], [10, 9], [9, 10]]}, "reaches into the room")],
)
def test_zone_that_a_site_file_could_not_have_is_refused(tmp_path: Path, name: str, zone: Any, expected: str) -> None:
    book, _ = book_of(tmp_path)
    with pytest.raises(ValueError, match=expected):
        book.put(name, Zone.model_validate(zone))


def test_zone_that_cannot_be_kept_is_not_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    book, published = book_of(tmp_path)
    book.put("desk", DESK)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "open", full)
    with pytest.raises(ZonesFileError, match=r"zones_file: .*zones\.yaml cannot be written: No space left on device"):
        book.put("fan", DESK)
    monkeypatch.undo()
    assert list(book.current.zones) == ["door", "desk"]
    assert len(published) == 1
    assert list(book_of(tmp_path)[0].current.zones) == ["door", "desk"]


class KilledError(BaseException):
    """Stands for SIGKILL: nothing handles it."""


STEPS = ("open the new file", "write it to the disk", "replace the old file", "open the folder", "write the name")


@pytest.mark.parametrize("step", range(len(STEPS) + 1))
def test_zones_are_the_old_or_the_new_ones_after_a_kill_at_any_step(
    step: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The change is answered only after the last step, and survives a kill from the third one on."""
    book, _ = book_of(tmp_path)
    book.put("desk", DESK)
    steps = iter(range(100))

    def killing(call: Any) -> Any:
        def called(*given: Any, **named: Any) -> Any:
            if next(steps) == step:
                raise KilledError
            return call(*given, **named)

        return called

    with monkeypatch.context() as patches:
        for owner, name in ((os, "open"), (os, "fsync"), (Path, "replace")):
            patches.setattr(owner, name, killing(getattr(owner, name)))
        try:
            book.put("fan", DESK)
            is_answered = True
        except KilledError:
            is_answered = False
    assert next(steps) == min(step + 1, len(STEPS)), "the steps are not those that the test knows"
    assert is_answered == (step == len(STEPS))
    after = [*book_of(tmp_path)[0].current.zones]
    assert after == (["door", "desk", "fan"] if step > STEPS.index("replace the old file") else ["door", "desk"])
    book_of(tmp_path)[0].put("shelf", DESK)  # what the kill left is no obstacle
    assert [*book_of(tmp_path)[0].current.zones] == [*after, "shelf"]


def test_number_of_drawn_zones_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.server.zones.book.MAX_DRAWN", 2)
    book, _ = book_of(tmp_path)
    for name in ("a", "b", "a"):
        book.put(name, DESK)
    with pytest.raises(ZoneRefusedError, match="at most 2 drawn zones; delete one first"):
        book.put("c", DESK)


def test_membership_says_how_probable_each_zone_is_and_what_excludes() -> None:
    zones = {
        "left": {"bounds_m": [[0, 2], [0, 5], [0, 3]]},
        "fan": {"polygon_m": [[2, 0], [4, 0], [4, 5], [2, 5]], "exclude": True},
    }
    shapes = ZoneMap(site_of({"zones": zones}))
    position, covariance = [1.9, 2.5, 1.5], [[0.04, 0, 0], [0, 0.04, 0], [0, 0, 0.04]]
    found = shapes.memberships(position, covariance)
    assert found["left"] == pytest.approx(0.6915, abs=1e-3)  # half a standard deviation from the edge
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-3)
    assert shapes.excluding(shapes.holding(position), found) == []
    assert shapes.excluding(["fan"], {}) == ["fan"]
    assert shapes.excluding([], {"fan": 0.5}) == ["fan"]


def test_unknown_zone_is_answered_with_the_names_of_all_zones() -> None:
    assert no_zone("hall", ["door", "desk"]) == "no zone 'hall'; zones are door, desk"
    assert no_zone("hall", []) == "no zone 'hall'; this site has no zones"
