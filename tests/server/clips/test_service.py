"""What becomes of an event's sound: which events have clips, what is missing in them, and what is given up."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alert_desk import START, refused
from clip_desk import head
from clip_events import desk_of, event, heard, refused_one
from livessl.core.stream.load_policy import LEVELS
from livessl.core.types import FRAME_NS, Frame, Status
from livessl.errors import ConfigError
from livessl.schema.clips import MissingReason
from livessl.server.clips import service
from livessl.server.clips.missing import MissingClips
from livessl.server.clips.record import write_clip
from livessl.server.clips.service import SETTLE_NS
from small_site import RATE_HZ, Changes

DAY_NS = 86_400_000_000_000
CLIPS: dict[str, Any] = {"folder": "clips", "pre_s": 1.0, "post_s": 0.5}


def test_clip_has_the_whole_span_that_was_sent_and_says_how_much_that_is(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard(range(-60, 30)), *heard(range(-8, 16), "south")], None)
    desk.finish(event())
    assert desk.clips.is_waiting("small-0")
    desk.work()
    files = desk.files(event())
    north, south = files["array-north.flac"], files["array-south.flac"]
    assert (north["pre_roll_s"], north["post_roll_s"]) == (1.0, 0.5)  # what the site asks for
    assert (south["pre_roll_s"], south["post_roll_s"]) == (0.4, 0.3)  # what there was
    assert north["gaps_s"] == south["gaps_s"] == []
    assert (desk.clips.counts.written, desk.clips.counts.incomplete) == (1, 0)
    assert not desk.clips.is_waiting("small-0")


def test_frames_that_are_missing_are_listed_and_counted(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard([*range(-8, 3), *range(6, 16)]), *heard(range(-8, 16), "south")], None)
    desk.finish(event())
    desk.work()
    assert desk.files(event())["array-north.flac"]["gaps_s"] == [[0.55, 0.7]]
    assert (desk.clips.counts.written, desk.clips.counts.incomplete) == (1, 1)


def test_gap_before_the_event_makes_no_clip_incomplete(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take([*heard([*range(-18, -12), *range(-8, 16)]), *heard(range(-8, 16), "south")], None)
    desk.finish(event())
    desk.work()
    assert len(desk.files(event())["array-north.flac"]["gaps_s"]) == 1
    assert desk.clips.counts.incomplete == 0


def test_array_whose_clock_is_known_to_be_ahead_is_cut_at_the_time_of_the_sound(tmp_path: Path) -> None:
    desk, ahead_ns = desk_of(tmp_path, pre_s=0.2, post_s=0.0), 110_000_000
    for n in range(4):
        desk.offsets.learn(START * FRAME_NS + n, {"north": 0.0, "south": ahead_ns / 1e9})
    rest_s = desk.offsets.rest_s("south") + 0.05 * desk.offsets.frames_ahead("south")
    rest_s -= desk.offsets.rest_s("north") + 0.05 * desk.offsets.frames_ahead("north")
    assert rest_s == pytest.approx(0.11, abs=1e-3)
    desk.clips.take([*heard(range(-20, 30)), *heard(range(-20, 30), "south", ahead_ns)], None)
    desk.finish(event())
    desk.work()
    north, south = (desk.files(event())[f"array-{name}.flac"] for name in ("north", "south"))
    assert abs(north["pre_roll_s"] - south["pre_roll_s"]) < 0.051  # a frame more or less
    assert 0.15 < south["pre_roll_s"] <= 0.2


def test_direction_only_event_has_a_signal_that_is_beamed_in_its_direction(tmp_path: Path) -> None:
    desk, found = desk_of(tmp_path), event(status=Status.DIRECTION_ONLY)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(found)
    desk.work()
    assert set(desk.files(found)) == {"array-north.flac", "enhanced.flac"}


def test_refused_event_that_no_array_has_sound_of_gets_no_clip_and_says_why(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.finish(refused(0))
    assert (desk.clips.waiting, desk.clips.counts.without_sound) == (0, 1)
    assert desk.clips.why_missing("small-0", "refused") is MissingReason.WITHOUT_SOUND


def test_site_file_says_which_events_have_clips(tmp_path: Path) -> None:
    desk = desk_of(tmp_path, of=["located"])
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(refused_one(), event(1, status=Status.DIRECTION_ONLY))
    assert desk.clips.waiting == 0
    assert desk.clips.why_missing("small-0", "refused") is MissingReason.STATUS
    assert desk.clips.why_missing("small-2", "located") is None
    desk.finish(event(2))
    assert desk.clips.waiting == 1


@pytest.mark.parametrize(
    ("of", "said"), [([], "at least 1 item"), (["heard"], "'located', 'direction-only' or 'refused'")]
)
def test_wrong_statuses_are_a_fault(tmp_path: Path, of: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        desk_of(tmp_path, of=of)


def test_reasons_outlive_a_restart_and_end_with_the_retention_of_events(tmp_path: Path) -> None:
    changes: Changes = {"store": {"retention_days": 1}}
    desk = desk_of(tmp_path, changes)
    desk.finish(refused(0))
    desk.work()
    [path] = (tmp_path / "clips").iterdir()
    with path.open("ab") as file:
        file.write(b'{"event_id": "small-1", "star')  # the power failed
    again = desk_of(tmp_path, changes)
    missing = MissingClips(tmp_path / "clips")
    missing.load()
    assert missing.why("small-0") is MissingReason.WITHOUT_SOUND
    assert missing.why("small-1") is None
    again.clock.ns += DAY_NS + 3_600_000_000_000
    missing.expire(again.clock.ns - DAY_NS)
    assert missing.why("small-0") is None
    assert [each.read_bytes() for each in (tmp_path / "clips").iterdir()] == [b""]


def test_replay_gives_neither_frames_nor_events(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.switches.is_replay = True
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(event())
    assert desk.clips.waiting == 0
    desk.switches.is_replay = False
    desk.finish(event())
    desk.work()
    assert desk.clips.counts.without_sound == 1


def test_server_that_gives_up_arrays_cuts_no_clips_and_counts_them(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.switches.relief = LEVELS[1]  # updates are given up, and clips are still cut
    desk.finish(event(1))
    desk.work()
    assert (desk.clips.counts.shed, desk.clips.counts.written) == (0, 1)
    desk.switches.relief = next(relief for relief in LEVELS if relief.arrays is not None)
    desk.finish(event())
    desk.work()
    assert (desk.clips.counts.shed, desk.clips.counts.written, desk.clips.waiting) == (1, 1, 0)


def test_clip_is_not_cut_before_its_last_frames_can_have_come(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take(heard(range(-8, 12)), None)
    desk.clock.ns = event().end_ns
    desk.finish(event())
    desk.clock.ns += SETTLE_NS + 490_000_000
    assert not desk.clips.work()
    desk.clips.take(heard(range(12, 16)), None)
    desk.clock.ns += 10_000_000
    assert desk.clips.work()
    assert desk.files(event())["array-north.flac"]["post_roll_s"] == 0.3


def test_frames_are_released_once_their_results_are_final(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    desk.clips.take(heard(range(20)), None)
    desk.clips.take([], START + 100)
    desk.finish(event())
    desk.clips.take(heard([3000]), START + 3000)  # long after the clip should have been cut
    desk.work()
    assert desk.clips.counts.without_sound == 1


def test_frames_of_the_longest_event_are_kept_until_its_clip_is_cut(tmp_path: Path) -> None:
    desk = desk_of(tmp_path, {"fusion.max_event_s": 60})
    desk.clips.take(heard(range(-8, 16)), None)
    desk.clips.take([], START + 1200)  # one minute of an event is final at once
    desk.finish(event())
    desk.work()
    assert desk.clips.counts.written == 1


def test_clips_that_were_deleted_and_not_erased_are_erased_with_the_next_old_ones(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    left = tmp_path / "clips" / ".partial-going-small-1"
    left.mkdir()
    (left / "a.flac").write_bytes(b"sound")
    desk.work()
    assert not left.exists()


def test_clip_that_fails_for_whatever_reason_is_counted_and_the_next_one_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path)

    def fail(*_: Any) -> Any:
        raise np.linalg.LinAlgError("Singular matrix")

    desk.clips.take(heard(range(-8, 16)), None)
    with monkeypatch.context() as patch:
        patch.setattr(service, "write_clip", fail)
        desk.finish(event())
        desk.work()
    assert (desk.clips.counts.failed, desk.clips.waiting) == (1, 0)
    [problem] = desk.clips.problems
    assert "the clip of 'small-0' was not made: LinAlgError: Singular matrix; report" in problem
    desk.finish(event())
    desk.work()
    assert (desk.clips.counts.written, desk.clips.problems) == (1, [])


def test_disk_that_hangs_delays_nobody_and_what_does_not_fit_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk, reached, release = desk_of(tmp_path), threading.Event(), threading.Event()

    def slow(*arguments: Any) -> Any:
        reached.set()
        assert release.wait(60)
        return write_clip(*arguments)

    monkeypatch.setattr(service, "write_clip", slow)
    monkeypatch.setattr(service, "MAX_WAITING", 3)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(event())
    worker = threading.Thread(target=desk.work)
    worker.start()
    assert reached.wait(60)
    desk.finish(*(event(number) for number in range(11, 16)))  # returns at once: the disk still hangs
    assert (desk.clips.waiting, desk.clips.counts.shed) == (3, 3)
    release.set()
    worker.join(60)
    assert not worker.is_alive()
    desk.work()
    assert (desk.clips.counts.written, desk.clips.counts.without_sound) == (1, 2)


@pytest.mark.parametrize(
    ("changes", "clips", "days"),
    [({}, {"max_age_days": 2}, 2), ({"store": {"retention_days": 1}}, {"max_age_days": None}, 1)],
)
def test_clips_are_deleted_at_their_age_or_with_their_event(
    tmp_path: Path, changes: Changes, clips: dict[str, Any], days: int
) -> None:
    desk = desk_of(tmp_path, changes, **clips)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(event())
    desk.work()
    desk.clock.ns += days * DAY_NS - 3_600_000_000_000
    desk.work()
    assert desk.clips.folder.figures.count == 1
    desk.clock.ns += 3_600_000_000_000
    desk.work()
    assert (desk.clips.folder.figures.count, desk.clips.counts.deleted) == (0, 1)


def test_clips_kept_for_ever_that_leave_no_room_are_a_problem(tmp_path: Path) -> None:
    desk = desk_of(tmp_path, max_bytes=1_000_000)
    for number in range(2):
        desk.clips.take(heard(range(-8 + 20 * number, 16 + 20 * number)), None)
        desk.finish(event(number))
        desk.work()
        desk.clips.folder.keep(f"small-{number}", True)
    assert desk.clips.problems == []
    desk.clips.folder.put("small-0", lambda _: head(0, {"a.flac": 1_200_000}))
    [problem] = desk.clips.problems
    assert problem.startswith(
        "server.clips.max_bytes: clips that are kept for ever, or may be as they are unreadable, take 1."
    )
    assert problem.endswith(" MB of 1.0 MB, so that new ones are deleted; keep fewer, or raise it")
    desk.clips.folder.keep("small-0", False)
    assert desk.clips.problems == []


def test_enhanced_signal_can_be_left_out(tmp_path: Path) -> None:
    desk = desk_of(tmp_path, enhanced=False)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.finish(event())
    desk.work()
    assert set(desk.files(event())) == {"array-north.flac"}


def test_array_of_more_than_eight_microphones_is_stored_as_wav(tmp_path: Path) -> None:
    circle = {"geometry": {"circle": {"radius_m": 0.2, "count": 9}}, "position_m": [1.9, 1.3, 1.4]}
    desk = desk_of(tmp_path, {"arrays.north": circle, "nodes": {}})
    wide = [
        Frame("north", 1, f.frame_index, f.time_ns, RATE_HZ, np.tile(f.samples, (3, 1))[:9], 0.01, f.active)
        for f in heard(range(-8, 16))
    ]
    desk.clips.take(wide, None)
    desk.finish(event())
    desk.work()
    assert desk.files(event())["array-north.wav"]["channels"] == 9
