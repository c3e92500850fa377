"""Clips of refused events: what they have, and that they come last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from alert_desk import START, refused
from clip_events import desk_of, event, heard, refused_one
from livessl.core.stream.load_policy import LEVELS
from livessl.core.types import FRAME_NS, Status
from livessl.schema.clips import MissingReason
from livessl.server.clips import service


def test_refused_event_has_the_arrays_recordings_and_says_why_there_is_no_enhanced_one(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard(range(-8, 16)), *heard(range(-8, 16), "south")], None)
    desk.finish(refused_one())
    desk.work()
    assert set(desk.files(refused_one())) == {"array-north.flac", "array-south.flac"}
    clip = desk.clips.folder.read("small-0")
    assert clip is not None
    assert clip.content["position_m"] is None
    assert "neither a place nor a direction" in clip.content["no_enhanced"]
    assert desk.clips.counts.written == 1


@pytest.mark.parametrize("requested", [True, False])
def test_refused_event_has_the_frames_that_were_requested_for_it_and_no_others(tmp_path: Path, requested: bool) -> None:
    desk, found = desk_of(tmp_path), replace(refused(0), heard_by=("north",))
    south = [replace(frame, requested=requested) for frame in heard(range(-8, 16), "south")]
    desk.clips.take([*heard(range(-8, 16)), *south], None)
    desk.finish(found)
    desk.work()
    assert set(desk.files(found)) == {"array-north.flac", *(["array-south.flac"] if requested else [])}


def test_refused_events_leave_half_of_the_queue_to_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "MAX_WAITING", 4)
    desk = desk_of(tmp_path)
    desk.finish(*(refused_one(number) for number in range(5)))
    assert (desk.clips.waiting, desk.clips.counts.shed) == (2, 3)
    desk.finish(event(6), event(7))
    assert (desk.clips.waiting, desk.clips.counts.shed) == (4, 3)


def test_located_event_gets_its_clip_before_refused_ones_that_came_earlier(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard(range(-8, 16)), *heard(range(-8, 16), "south")], None)
    located, direction = event(8), event(9, status=Status.DIRECTION_ONLY)
    located, direction = (
        replace(each, start_ns=event().start_ns, end_ns=event().end_ns) for each in (located, direction)
    )
    desk.finish(refused_one(), replace(refused_one(), id="small-1"), located, direction)
    desk.clock.ns += 10_000_000_000
    assert desk.clips.work()
    assert desk.clips.work()
    assert desk.clips.folder.ids() == ["small-8", "small-9"]
    desk.work()
    assert desk.clips.folder.ids() == ["small-0", "small-1", "small-8", "small-9"]


def test_refused_event_whose_frames_are_gone_when_its_turn_comes_is_shed(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard(range(-8, 16)), *heard(range(-8, 16), "south")], None)
    desk.finish(refused_one())
    spare_frames = desk.clips._spare_ns // FRAME_NS
    desk.clips.take([], START + 5 + spare_frames)  # the first frames of the event are released
    desk.work()
    assert (desk.clips.counts.shed, desk.clips.counts.written, desk.clips.waiting) == (1, 0, 0)
    assert desk.clips.why_missing("small-0", "refused") is MissingReason.SHED


def test_overloaded_server_makes_no_clips_of_refused_events(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.switches.relief = LEVELS[1]
    desk.finish(refused_one(), event(1))
    assert (desk.clips.waiting, desk.clips.counts.shed) == (1, 1)
    assert desk.clips.why_missing("small-0", "refused") is MissingReason.SHED


def test_clips_of_refused_events_make_room_before_older_ones_with_a_place(tmp_path: Path) -> None:
    desk = desk_of(tmp_path, max_bytes=1_000_000, enhanced=False)
    for found in (event(0), refused_one(1), event(2)):
        n = 20 * int(found.id[-1])
        desk.clips.take([*heard(range(n - 8, n + 16))], None)
        desk.finish(found)
        desk.work()
    folder = desk.clips.folder
    sizes = {name: clip.nbytes for name in folder.ids() if (clip := folder.read(name)) is not None}
    assert folder.expire(None, sum(sizes.values()) - 1) == 1
    assert folder.ids() == ["small-0", "small-2"]
