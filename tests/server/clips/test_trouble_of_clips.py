"""Errors of clips appear in the reasons of health, each until the same operation succeeds."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alert_desk import refused
from clip_desk import ClipDesk
from clip_events import desk_of, event, heard
from livessl.server.clips import service
from livessl.server.clips.speech import PROGRAM
from livessl.simulation.sounds import voice
from small_site import RATE_HZ


def test_file_of_reasons_that_can_be_written_again_is_no_problem_any_more(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    path = tmp_path / "clips" / "missing.jsonl"
    path.mkdir()
    desk.finish(refused(0))
    desk.work()
    assert [problem for problem in desk.clips.problems if problem.startswith("missing.jsonl in server.clips.folder: ")]
    path.rmdir()
    desk.clock.ns += service.EXPIRE_NS
    desk.work()
    assert desk.clips.problems == []
    assert path.read_text().count("small-0") == 1


def test_detector_that_works_again_is_no_problem_although_it_detects_speech(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path, {"privacy": "no-speech"})
    detector = desk.clips._speech
    monkeypatch.setattr(detector, "_program", (sys.executable, "-c", "raise SystemExit(1)"))
    put(desk)
    desk.finish(event())
    desk.work()
    [problem] = desk.clips.problems
    assert problem.startswith("server.clips, privacy: no-speech: the clip of 'small-0' was not stored")
    monkeypatch.setattr(detector, "_program", PROGRAM)
    desk.finish(replace(event(), id="small-1"))
    desk.work()
    assert (desk.clips.counts.with_speech, desk.clips.problems) == (1, [])
    desk.clips.stop()


def test_clip_that_is_stored_does_not_hide_that_old_ones_are_not_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path)

    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(desk.clips.folder, "expire", refuse)
    monkeypatch.setattr(service, "EXPIRE_NS", 10**18)
    desk.clips.take(heard(range(-8, 16)), None)
    desk.clips.work()
    desk.finish(event())
    desk.clock.ns += 10_000_000_000
    assert desk.clips.work()
    assert desk.clips.counts.written == 1
    assert desk.clips.problems == ["server.clips.folder: old clips were not deleted: Permission denied; correct that"]


def put(desk: ClipDesk) -> None:
    """Let a desk have frames in which there is a voice."""
    spoken = np.resize(voice(np.random.default_rng(1), RATE_HZ), (24, RATE_HZ // 20))
    frames = heard(range(-8, 16))
    desk.clips.take([replace(f, samples=np.tile(s, (4, 1))) for f, s in zip(frames, spoken, strict=True)], None)
