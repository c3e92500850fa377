"""An event is located again from its clip: as it was located first, by other methods, and with other poses."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
import soundfile

from livessl.core.types import FRAME_NS, Event, FloatArray, Frame, Status
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.clips import relocate as relocation
from livessl.server.clips.reader import ClipReader
from livessl.server.clips.relocate import relocate
from livessl.server.clips.relocate_many import Task, relocate_many
from livessl.server.clips.service import Clips
from livessl.server.clips.stored_sound import (
    NoClipError,
    RelocationError,
    check_memory,
    stored_clip,
    stored_frames,
    stored_sound,
)
from livessl.simulation.scene import make_scene, render
from livessl.site.models import Site
from small_site import RATE_HZ, hiss, scene, site_of
from stored_clips import START_NS, Offsets, clipped, events, located, messages, sent


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("site")


@pytest.fixture(scope="module")
def clips(directory: Path) -> Clips:
    return clipped(directory, messages())


@pytest.fixture
def copied(clips: Clips, directory: Path, tmp_path: Path) -> Path:
    """A copy of the folder of clips."""
    assert clips.folder.figures.count
    return Path(shutil.copytree(directory / "clips", tmp_path / "clips"))


def place_m(event: Event) -> FloatArray:
    assert event.estimate is not None
    return event.estimate.position_m


def test_same_method_gives_the_same_answer(clips: Clips) -> None:
    for event in events():
        found = relocate(site_of(), clips.folder, event.id, "onset", "then")
        again = found.event
        assert (found.others, found.moved) == ((), ())
        for name in ("id", "start_ns", "end_ns", "status", "reason", "method", "heard_by", "source"):
            assert getattr(again, name) == getattr(event, name), name
        assert event.estimate is not None
        assert again.estimate is not None
        assert again.estimate.arrays == event.estimate.arrays
        # the recordings have 24 bits; the simulated microphones have those of a float
        np.testing.assert_allclose(place_m(again), place_m(event), atol=1e-3)
        np.testing.assert_allclose(again.estimate.covariance_m2, event.estimate.covariance_m2, rtol=0.02, atol=1e-6)
        assert again.estimate.confidence == pytest.approx(event.estimate.confidence, abs=1e-3)
        assert again.power == event.power


@pytest.mark.parametrize("method", ["srp-phat", "cepstral", "averaged"])
def test_another_method_answers_as_if_it_had_located_the_live_sound(clips: Clips, method: str) -> None:
    for event, source in zip(events(method), scene().sources, strict=True):
        again = relocate(site_of(), clips.folder, event.id, method, "then").event
        assert (again.method, again.status) == (method, event.status)
        np.testing.assert_allclose(place_m(again), place_m(event), atol=1e-3)
        assert float(np.linalg.norm(place_m(again) - source.position_m)) < 0.2


@pytest.mark.parametrize(("frames", "rest_s"), [(3, 0.0), (-7, 0.004)])
def test_clock_that_is_off_changes_nothing(tmp_path: Path, frames: int, rest_s: float) -> None:
    """The fusion has corrected it by whole frames; the recordings are by the joint clock."""
    ns = frames * 50_000_000 + round(1e9 * rest_s)
    taken = [
        replace(one, frame_index=one.frame_index + frames, time_ns=one.time_ns + ns)
        if isinstance(one, Frame) and one.array == "south"
        else one
        for one in messages()
    ]
    clips = clipped(tmp_path, taken, Offsets({"south": frames}, rest_s))
    for event in events():
        again = relocate(site_of(), clips.folder, event.id, "onset", "then").event
        assert (again.id, again.heard_by) == (event.id, event.heard_by)
        np.testing.assert_allclose(place_m(again), place_m(event), atol=1e-3)


def moved(shift_m: float) -> Site:
    return site_of({"arrays.south.position_m": [2.2 + shift_m, 3.8, 1.5], "temperature_c": 35.0})


@pytest.mark.parametrize("shift_m", [0.12, -0.16])
def test_poses_of_then_and_of_now(clips: Clips, shift_m: float) -> None:
    for event in events():
        then = relocate(moved(shift_m), clips.folder, event.id, "onset", "then")
        now = relocate(moved(shift_m), clips.folder, event.id, "onset", "now")
        assert then.moved == now.moved == ("south",)
        np.testing.assert_allclose(place_m(then.event), place_m(event), atol=1e-3)
        [fresh] = [other for other in located(moved(shift_m), messages()) if other.id == event.id]
        assert now.event.status is fresh.status
        np.testing.assert_allclose(place_m(now.event), place_m(fresh), atol=1e-3)
        assert float(np.linalg.norm(place_m(now.event) - place_m(event))) > 0.02


def test_part_of_a_longer_sound_is_located_by_itself(tmp_path: Path) -> None:
    """A clip begins before its event, and there with a part that was an event before."""
    site = site_of({"fusion.max_event_s": 0.5})
    long = make_scene(
        site.room.size_m,
        rt60_s=0.0,
        sounds=[("long", hiss(1.3, 1)[0])],
        count=1,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=2,
        lead_s=0.7,
    )
    samples = {spec.name: render(long, spec.microphones_m, seed=3) for spec in site.specs}
    taken = sent(
        [
            AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), heard), START_NS, (1, 2, 3, 4))
            for name, heard in samples.items()
        ]
    )
    parts = located(site, taken)
    assert [event.status for event in parts] == [Status.LOCATED] * 3
    clips = clipped(tmp_path, taken, found=parts)
    for part in parts:
        again = relocate(site, clips.folder, part.id, "onset", "then").event
        assert (again.start_ns, again.end_ns, again.heard_by) == (part.start_ns, part.end_ns, part.heard_by)
        np.testing.assert_allclose(place_m(again), place_m(part), atol=0.02)
        other = relocate(site, clips.folder, part.id, "srp-phat", "then").event
        assert (other.id, other.start_ns, other.end_ns) == (again.id, part.start_ns, part.end_ns)


def test_clip_that_does_not_fit_says_why(tmp_path: Path) -> None:
    clips = clipped(tmp_path, messages())
    first, second = (event.id for event in events())
    folder, site = clips.folder, site_of()
    with pytest.raises(NoClipError, match="event 'none' has no recordings; it cannot be located again without"):
        relocate(site, folder, "none", "onset", "then")
    without = site_of({"arrays.south": ..., "nodes.lab-pc.arrays.south": ...})
    with pytest.raises(RelocationError, match=r"array 'south': .* 4 channels, and the site file has no such array now"):
        relocate(without, folder, first, "onset", "now")
    three = {"microphones_m": [[2.0, 3.8, 1.5], [2.2, 3.8, 1.5], [2.2, 4.0, 1.6]]}
    fewer = site_of({"arrays.south": three, "nodes.lab-pc.arrays.south": [5, 6, 7]})
    with pytest.raises(RelocationError, match="has 4 channels, and the site file has 3 microphones now; locate the"):
        relocate(fewer, folder, first, "onset", "then")
    (tmp_path / "clips" / first / "array-south.flac").write_bytes(b"fLaC")
    with pytest.raises(RelocationError, match=r"array-south\.flac cannot be read: .*; restore the file"):
        relocate(site, folder, first, "onset", "then")
    (tmp_path / "clips" / first / "array-south.flac").unlink()
    with pytest.raises(NoClipError, match=r"its recording 'array-south\.flac' is gone"):
        relocate(site, folder, first, "onset", "then")
    path = tmp_path / "clips" / second / "clip.json"
    about = orjson.loads(path.read_bytes())
    quiet = {name: {**known, "frames": [[*row[:4], False, row[5]] for row in known["frames"]]} for name, known in
             about["arrays"].items()}  # fmt: skip
    path.write_bytes(orjson.dumps({**about, "arrays": quiet}))
    with pytest.raises(RelocationError, match="no active frame of it: frames are missing; see its gaps_s"):
        relocate(site, folder, second, "onset", "then")
    path.write_bytes(orjson.dumps({name: value for name, value in about.items() if name != "arrays"}))
    with pytest.raises(
        RelocationError, match=r"are of an earlier release, .*; locate them with `livessl locate --site SITE --wav"
    ):
        relocate(site, folder, second, "onset", "then")


INDEX = START_NS // FRAME_NS

DAMAGES: dict[str, tuple[str, Any, str]] = {
    "field of another release": ("arrays.north.uncertainty.humidity_percent", 3.0, "humidity_percent"),
    "no speed of sound": ("c_m_s", ..., "'c_m_s' is missing"),
    "speed of sound of zero": ("c_m_s", 0, "c_m_s: expected a number from 100 to 2000, got 0"),
    "speed of sound that makes correlations fill the memory": ("c_m_s", 1e-9, "c_m_s: expected a number from 100"),
    "microphones in another country": ("arrays.south.microphones_m", [[0, 0, 1], [1e9, 0, 1]], "expected positions"),
    "sampling rate of nothing": (
        "arrays.north.sample_rate_hz",
        1e12,
        r"expected a number from 100 to 1e\+06, got 1000000000000",
    ),
    "uncertainty in words": ("arrays.north.uncertainty.clock_s", "0.1", r"clock_s: expected a number from 0 to 100"),
    "uncertainty below zero": ("arrays.north.uncertainty.position_m", -1, r"position_m: expected a number from 0"),
    "no list of files": ("files", ..., "'files' is missing"),
    "files of another form": ("files", ["a.flac"], r"files\.0: input should be an object, got 'a\.flac'"),
    "no file of an array": ("files", [], "'north' is missing"),
    "short row": ("arrays.south.frames", [[1, 2, 3]], r"not enough values"),
    "begin before the recording": ("arrays.south.frames", [[1, -2, 3, 0.1, True, False]], "a start of 0 or more"),
    "frame beyond the recording": (
        "arrays.south.frames",
        [[INDEX, 10**9, 3, 0.1, True, False]],
        "expected 1000000003 samp",
    ),
    "frame of another year": ("arrays.south.frames", [[1, 0, 3, 0.1, True, False]], "within 3600 s of the event"),
    "flat positions": (
        "arrays.south.microphones_m",
        [[1.0, 2.0]] * 4,
        r"south\.microphones_m: expected positions \(K, 3\)",
    ),
    "positions without numbers": ("arrays.south.microphones_m", [[1.0, 2.0, None]] * 4, "expected positions"),
    "arrays of another form": ("arrays", ["north"], "has no attribute 'items'"),
    "no answer": ("answer", ..., "'answer' is missing"),
    "answer of another form": ("answer.position_m", [1.0], "not enough values"),
    "answer in words": ("answer.confidence", "0.9", "a confidence and a position as numbers"),
    "position in words": ("answer.position_m", ["1", "2", "3"], "a confidence and a position as numbers"),
}


def put(about: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with another value of a dotted key, or without it."""
    first, _, rest = key.partition(".")
    if rest:
        return {**about, first: put(about[first], rest, value)}
    return {name: each for name, each in {**about, first: value}.items() if each is not ...}


@pytest.mark.parametrize(("key", "value", "why"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_or_future_clip_is_refused_alone(copied: Path, key: str, value: Any, why: str) -> None:
    first, second = (event.id for event in events())
    path = copied / first / "clip.json"
    path.write_bytes(orjson.dumps(put(orjson.loads(path.read_bytes()), key, value)))
    with pytest.raises(RelocationError, match=f"{first}.*({why}).*; .*delete (it|them|the recordings)"):
        relocate(site_of(), ClipReader(copied), first, "onset", "then")
    task = Task(site_of(), copied, None, "then")
    damaged, whole = relocate_many(task, [first, second], 1)
    assert (damaged["again"], whole["error"], whole["again"]["status"]) == (None, None, "located")
    assert re.search(why, damaged["error"])


def test_sound_that_takes_too_much_memory_is_refused_before_it_is_read(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, event = ClipReader(copied), events()[0].id
    sound = stored_sound(stored_clip(folder, event))
    frames = [frame for array in sound.arrays for frame in stored_frames(sound, array)]
    nbytes = sum(frame.samples.nbytes for frame in frames)
    files = sound.clip.files
    whole = sum(4 * each["channels"] * round(each["sample_rate_hz"] * each["duration_s"]) for each in files)
    assert 0.5 * whole < nbytes <= whole
    check_memory(sound, whole)
    read: list[Any] = []
    monkeypatch.setattr(relocation, "stored_frames", lambda *wanted: read.append(wanted))
    with pytest.raises(
        RelocationError, match=r"expected at most \d+ MB of decoded samples, got \d+ MB; locate the event"
    ):
        relocate(site_of(), folder, event, "onset", "then", most_bytes=nbytes - 1)
    assert read == []


def test_recording_of_other_channels_is_refused(copied: Path) -> None:
    event = events()[0].id
    soundfile.write(copied / event / "array-south.flac", np.zeros((RATE_HZ, 3)), RATE_HZ)
    with pytest.raises(RelocationError, match=r"expected 4 channels, as clip\.json says, got 3; restore the file"):
        relocate(site_of(), ClipReader(copied), event, "onset", "then")
