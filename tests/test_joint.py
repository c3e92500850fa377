"""Joint arrays: several arrays of one device are processed as one array of all their microphones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from livessl import offline
from livessl.capture.links import UndeliveredError
from livessl.capture.node import send_session
from livessl.cli.main import main
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import Block, Event, Float32Array, Frame, Mark
from livessl.errors import DeviceError
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.recording import MemoryRecording, SplicedRecording, TimedRecording
from livessl.recordings.session import read_session
from livessl.site.build.pipeline import make_pipeline
from livessl.site.models import Site
from small_site import (
    RATE_HZ,
    Changes,
    heard,
    hiss,
    running_server,
    scene,
    scene_recordings,
    site_of,
    wait_until,
    write_site,
    write_wav,
)

JOINT: Changes = {"joint.both": ["north", "south"]}
NODELESS: Changes = {**JOINT, "nodes": {}}
START_NS = 1_767_225_600_000_000_000

NEAR_M = 0.5 * 343.0 / RATE_HZ
"""Path of sound, in metres, in half a sample: the error of delays rounded to samples. Ours are finer, without
reverberation."""


def events_of(site: Site, parts: Sequence[AssignedRecording]) -> list[Event]:
    return [o for o in offline.run(site, parts, UnpacedClock(START_NS)) if isinstance(o, Event)]


def eight() -> Float32Array:
    return np.concatenate([heard("north"), heard("south")])


def whole(array: str = "both") -> AssignedRecording:
    """The scene as one recording of eight channels."""
    return AssignedRecording(array, MemoryRecording("eight", float(RATE_HZ), eight()), START_NS, tuple(range(1, 9)))


def site_of_eight() -> Site:
    """The small site with one array of eight microphones instead of two of four."""
    microphones = np.vstack([spec.microphones_m for spec in site_of().specs])
    changes: Changes = {"arrays": {"both": {"microphones_m": microphones.tolist()}}}
    return site_of({**changes, "nodes.lab-pc.arrays": {"both": list(range(1, 9))}})


def distances_m(events: Sequence[Event]) -> list[float]:
    found = []
    for event, source in zip(events, scene().sources, strict=True):
        assert event.estimate is not None
        found.append(float(np.linalg.norm(event.estimate.position_m - source.position_m)))
    return found


def facts(events: Sequence[Event]) -> list[tuple[Any, ...]]:
    """Return all fields of an event as exact values; covariance, rounded, and confidence are those of the sound."""
    told: list[tuple[Any, ...]] = []
    for event in events:
        assert event.estimate is not None
        estimate = event.estimate
        # the frames of joint arrays may be off each by itself, those of one array only together
        covariance_m2 = np.round(estimate.sound_covariance_m2, 12) + 0.0
        bits = (estimate.position_m.tobytes(), covariance_m2.tobytes(), estimate.sound_confidence)
        told.append((*bits, replace(event, estimate=None)))
    return told


def test_joint_arrays_give_exactly_the_events_of_one_array() -> None:
    joint = events_of(site_of(JOINT), scene_recordings(START_NS))
    assert [event.heard_by for event in joint] == [("both",), ("both",)]
    assert max(distances_m(joint)) < NEAR_M
    assert facts(joint) == facts(events_of(site_of_eight(), [whole()]))
    summed = events_of(site_of(), scene_recordings(START_NS))
    assert [event.heard_by for event in summed] == [("north", "south")] * 2
    assert [fact[0] for fact in facts(summed)] != [fact[0] for fact in facts(joint)]


def test_an_offset_of_a_millisecond_moves_the_events_of_joint_arrays_only() -> None:
    """Joint arrays therefore need one clock; arrays whose maps are summed do not."""
    north, south = scene_recordings(START_NS)
    shifted = np.roll(heard("south"), RATE_HZ // 1000, axis=1)
    late = replace(south, recording=MemoryRecording("south", float(RATE_HZ), shifted), start_ns=START_NS)
    assert max(distances_m(events_of(site_of(), [north, late]))) < NEAR_M
    assert min(distances_m(events_of(site_of(JOINT), [north, late]))) > 10 * NEAR_M


def test_array_outside_the_joint_one_stays_separate() -> None:
    third: Changes = {"arrays.west": {"geometry": {"tetrahedron": {"edge_m": 0.2}}, "position_m": [0.5, 2.6, 1.1]}}
    site = site_of({**JOINT, **third})
    assert [(spec.name, len(spec.microphones_m)) for spec in site.processed] == [("west", 4), ("both", 8)]
    assert [spec.name for spec in site.specs] == ["north", "south", "west"]


def test_pipeline_detects_activity_of_joint_arrays_together() -> None:
    """Activity on one of them activates all eight channels."""
    samples = hiss(2.0, 8, level=1e-4)
    samples[4:, RATE_HZ : RATE_HZ + 3200] += hiss(0.2, 4, seed=1, level=0.2)  # at the southern ones only
    pipeline = make_pipeline(site_of(JOINT), {"south": [8, 7, 6, 5], "north": [1, 2, 3, 4]}, float(RATE_HZ))
    assert pipeline.arrays == ["both"]
    made = pipeline.push(Block(0, samples, START_NS)) + pipeline.flush()
    assert {message.array for message in made} == {"both"}
    frames = [message for message in made if isinstance(message, Frame)]
    assert len([frame for frame in frames if frame.active]) == 4
    for frame in frames:
        first = round((frame.time_ns - START_NS) / 1e9 * RATE_HZ)
        there = samples[[0, 1, 2, 3, 7, 6, 5, 4], first : first + frame.samples.shape[1]]
        np.testing.assert_array_equal(frame.samples, there)
    [levels] = {len(message.channel_power) for message in made if isinstance(message, Mark)}
    assert levels == 8


def refusal(site: Site, parts: Sequence[AssignedRecording]) -> str:
    with pytest.raises(DeviceError) as caught:
        make_pipelines(site, parts)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_recordings_with_different_starts_are_refused() -> None:
    north, south = scene_recordings(START_NS)
    later = replace(south, start_ns=START_NS + 62_500)  # a sample
    assert refusal(site_of(JOINT), [north, later]) == (
        "array 'both': joint processing expects recordings of one start, length and sampling rate, got north (0 s, "
        "5.3 s, 16000 Hz), south (6.25e-05 s, 5.3 s, 16000 Hz); record them through one device, or remove joint.both"
    ).replace("5.3", f"{north.recording.duration_s:g}")


def test_recordings_of_different_lengths_are_refused() -> None:
    north, south = scene_recordings(START_NS)
    short = MemoryRecording("south", float(RATE_HZ), heard("south")[:, :-1])
    said = refusal(site_of(JOINT), [north, replace(south, recording=short, start_ns=START_NS)])
    assert "expects recordings of one start, length and sampling rate" in said


def test_missing_recording_of_a_member_is_refused() -> None:
    said = refusal(site_of(JOINT), scene_recordings(START_NS)[:1])
    assert said == (
        "array 'both': joint processing expects a recording of each of north, south, got none of 'south'; add it, or "
        "remove joint.both"
    )


def test_recording_of_the_joint_array_and_of_a_member_is_refused() -> None:
    said = refusal(site_of(JOINT), [whole(), scene_recordings(START_NS)[0]])
    assert said == "array 'both': expected a recording of it or of 'north', got both; leave one out"


def test_files_without_a_node_are_not_taken_for_one_device() -> None:
    said = refusal(site_of(NODELESS), scene_recordings(START_NS))
    assert said == (
        "array 'both': joint processing expects arrays sampled by one clock, got 'north' by north, 'south' by south; "
        "record them through one device, or let their maps be summed instead"
    )


def test_one_recording_of_all_members_needs_no_node() -> None:
    joint = facts(events_of(site_of(JOINT), scene_recordings(START_NS)))
    assert facts(events_of(site_of(NODELESS), [whole()])) == joint
    parts = [
        replace(whole(name), channels=numbers) for name, numbers in (("north", (1, 2, 3, 4)), ("south", (5, 6, 7, 8)))
    ]
    assert facts(events_of(site_of(NODELESS), parts)) == joint
    parts = [replace(parts[0], channels=(1, 2, 4, 3)), parts[1]]
    assert facts(events_of(site_of(NODELESS), parts)) != joint


def test_gap_in_one_recording_only_is_refused() -> None:
    def spliced(array: str, *cuts: tuple[float, float]) -> AssignedRecording:
        samples = heard(array)
        stretches = [
            TimedRecording(
                MemoryRecording(array, float(RATE_HZ), samples[:, round(first * RATE_HZ) : round(stop * RATE_HZ)]),
                START_NS + round(first * 1e9),
            )
            for first, stop in cuts
        ]
        return AssignedRecording(array, SplicedRecording(tuple(stretches)), START_NS, (1, 2, 3, 4))

    site, end_s = site_of(JOINT), heard("north").shape[1] / RATE_HZ
    torn = ((0.0, 0.3), (0.5, end_s))
    assert len(events_of(site, [spliced("north", *torn), spliced("south", *torn)])) == 2
    with pytest.raises(DeviceError, match=r"north \+ south: expected recordings whose samples match .* 0\.300 s after"):
        events_of(site, [spliced("north", *torn), spliced("south", (0.0, end_s))])


# the commands


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """WAV files of the scene: of each array, and of both."""
    for name in ("north", "south"):
        write_wav(tmp_path / f"{name}.wav", heard(name))
    write_wav(tmp_path / "eight.wav", eight())
    return tmp_path


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> list[dict[str, Any]]:
    """Events that a command prints."""
    assert main([str(argument) for argument in (*arguments, "--json")]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def wavs(files: Path) -> list[str]:
    return ["--wav", f"north={files / 'north.wav'}", "--wav", f"south={files / 'south.wav'}"]


OPTION = ("--joint", "both=north,south")


def test_locate_joins_by_the_site_file_or_an_option(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = write_site(files, JOINT)
    joint = told(capsys, "locate", "--site", site, *wavs(files))
    assert [event["arrays"] for event in joint] == [["both"], ["both"]]
    assert [event["status"] for event in joint] == ["located", "located"]
    for event, source in zip(joint, scene().sources, strict=True):
        assert np.linalg.norm(np.array(event["position_m"]) - source.position_m) < NEAR_M
    assert told(capsys, "locate", "--site", site, "--wav", f"both={files / 'eight.wav'}") == joint
    site = write_site(files)
    assert told(capsys, "locate", "--site", site, *wavs(files), *OPTION) == joint
    apart = told(capsys, "locate", "--site", site, *wavs(files))
    assert [event["arrays"] for event in apart] == [["north", "south"]] * 2


def test_sessions_hold_the_arrays_and_replay_joint_or_apart(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = write_site(files, JOINT)
    session, joint = files / "session", told(capsys, "locate", "--site", site, *wavs(files))
    arguments = ["record", "--site", site, "--node", "lab-pc", "--out", session, "--format", "wav", *wavs(files)]
    assert main([str(argument) for argument in arguments]) == 0
    assert [piece.array for piece in read_session(session).pieces] == ["north", "south"]
    assert read_session(session).site().joint == {"both": ("north", "south")}
    capsys.readouterr()
    # only the 50 ms grid of frames may differ, because the recordings may begin elsewhere on it
    replayed = told(capsys, "replay", session, "--once", "--speed", "max")
    assert [event["arrays"] for event in replayed] == [["both"], ["both"]]
    for one, other in zip(replayed, joint, strict=True):
        assert np.linalg.norm(np.subtract(one["position_m"], other["position_m"])) < NEAR_M
    site = write_site(files)
    apart = told(capsys, "replay", session, "--site", site, "--once", "--speed", "max")
    assert [event["arrays"] for event in apart] == [["north", "south"]] * 2
    again = told(capsys, "replay", session, "--site", site, "--once", "--speed", "max", *OPTION)
    assert [event["position_m"] for event in again] == [event["position_m"] for event in replayed]


def test_simulation_writes_the_members_not_the_joint_array(files: Path) -> None:
    arguments = [
        "simulate",
        "--site",
        write_site(files, JOINT),
        "--out",
        files / "scene",
        "--count",
        "1",
        "--rt60",
        "0",
    ]
    assert main([str(argument) for argument in arguments]) == 0
    assert [piece.array for piece in read_session(files / "scene").pieces] == ["north", "south"]


def test_check_counts_joint_microphones(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(write_site(files, JOINT))]) == 0
    assert "arrays both (8 microphones)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("both=north,west", r"site.yaml: joint.both.west: expected one of the arrays north, south, got 'west'"),
        ("north=north,south", r"site.yaml: joint.north: expected a name that no array has"),
    ],
)
def test_wrong_option_is_refused(files: Path, capsys: pytest.CaptureFixture[str], option: str, said: str) -> None:
    site = write_site(files)
    assert main(["locate", "--site", str(site), *wavs(files), "--joint", option]) == 2
    [complaint] = capsys.readouterr().err.splitlines()
    assert said in complaint


def test_server_accepts_a_joint_node_and_refuses_a_separate_one(files: Path) -> None:
    clock = SystemClock()
    with running_server(site_of(JOINT)) as server:
        endpoint = server.endpoint
        arguments = (endpoint, scene_recordings(START_NS), UnpacedClock(START_NS), clock)
        with pytest.raises(UndeliveredError, match="array 'north' is joined in 'both' at the server; give node and"):
            send_session(site_of(), *arguments, "run-1", lambda: False)
        send_session(site_of(JOINT), *arguments, "run-2", lambda: False)
        server.wait_idle()
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        read = {name: httpx.get(f"{server.url}/api/v1/{name}").json() for name in ("events", "site", "arrays")}
        image = httpx.get(f"{server.url}/api/v1/map", params={"array": "both"})
        unknown = httpx.get(f"{server.url}/api/v1/map", params={"array": "north"})
    for event, expected in zip(
        read["events"]["events"][::-1], events_of(site_of(JOINT), scene_recordings(START_NS)), strict=True
    ):
        assert expected.estimate is not None
        assert event["position_m"] == [round(float(x), 4) for x in expected.estimate.position_m]
        assert event["arrays"] == ["both"]
    assert read["site"]["joint"] == {"both": ["north", "south"]}
    assert len(read["site"]["arrays"]["both"]["microphones_m"]) == 8
    [array] = read["arrays"]["arrays"]
    assert (array["name"], array["node"], len(array["channel_levels_dbfs"])) == ("both", "lab-pc", 8)
    assert image.status_code == 200
    assert unknown.status_code == 404
    assert "there are fused, both" in unknown.text
