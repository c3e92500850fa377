"""Recorded sessions replay with the same samples at the same times, and with their gaps."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, Self

import numpy as np
import pytest
import soundfile
from numpy.testing import assert_allclose, assert_array_equal

from livessl.capture.record import record_device
from livessl.clock import UnpacedClock
from livessl.core.types import Block, Float32Array
from livessl.errors import DeviceError
from livessl.recordings.assign import AssignedRecording, assign_files, assign_sessions, make_pipelines
from livessl.recordings.recorder import Recorder, record_playback
from livessl.recordings.recording import FileRecording, MemoryRecording
from livessl.recordings.session import read_session
from small_site import RATE_HZ, Changes, hiss, site_of, write_wav

START_NS = 1_767_225_600_000_000_000
SITE = site_of()
BOTH = {"north": [1, 2, 3, 4], "south": [8, 7, 6, 5]}


def never() -> bool:
    return False


def sixteen_bits(samples: Float32Array) -> Float32Array:
    return (np.round(samples * 2**15) / 2**15).astype(np.float32)


def read(path: Path) -> Float32Array:
    samples, rate_hz = soundfile.read(path, dtype="float32", always_2d=True)
    assert rate_hz == RATE_HZ
    return np.ascontiguousarray(samples.T)


def block(samples: Float32Array, first: int, stop: int, jitter_ns: int = 0, *, overflow: bool = False) -> Block:
    stamp_ns = START_NS + round(first / RATE_HZ * 1e9) + jitter_ns
    return Block(first, samples[:, first:stop].copy(), stamp_ns, overflow)


@pytest.mark.parametrize(("kind", "subtype"), [("flac", "PCM_24"), ("wav", "FLOAT")])
def test_wav_recording_becomes_a_session_without_loss(
    tmp_path: Path, kind: Literal["flac", "wav"], subtype: str
) -> None:
    heard = {name: sixteen_bits(hiss(1.01, seed=k)) for k, name in enumerate(BOTH)}
    wavs = {name: write_wav(tmp_path / f"{name}.wav", heard[name], subtype="PCM_16") for name in BOTH}
    out = tmp_path / "out"
    parts = assign_files(SITE, wavs, start_ns=START_NS)
    assert record_playback(out, SITE, parts, UnpacedClock(START_NS), never, kind)
    session = read_session(out)
    assert {piece.array: piece.start_ns for piece in session.pieces} == dict.fromkeys(BOTH, START_NS)
    for piece in session.pieces:
        assert soundfile.info(session.path(piece)).subtype == subtype
        assert_array_equal(read(session.path(piece)), heard[piece.array])
    replayed = assign_sessions(session.site(), [session])
    assert {part.array: (part.start_ns, part.channels) for part in replayed} == dict.fromkeys(
        BOTH, (START_NS, (1, 2, 3, 4))
    )


def test_recording_stops_on_request(tmp_path: Path) -> None:
    part = AssignedRecording("north", MemoryRecording("hiss", float(RATE_HZ), hiss(5.0)), START_NS, (1, 2, 3, 4))
    clock = UnpacedClock(START_NS)
    assert record_playback(tmp_path, SITE, [part], clock, lambda: clock.now_ns() >= START_NS + 500_000_000)
    [piece] = read_session(tmp_path).pieces
    assert read(tmp_path / piece.file).shape == (4, RATE_HZ // 2)


def test_channels_are_recorded_in_microphone_order(tmp_path: Path) -> None:
    samples = sixteen_bits(hiss(0.2, 8))
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        recorder.push(block(samples, 0, samples.shape[1]))
    session = read_session(tmp_path)
    for piece in session.pieces:
        assert_array_equal(read(session.path(piece)), samples[np.array(BOTH[piece.array]) - 1])


def test_start_time_is_fitted_to_all_stamps(tmp_path: Path) -> None:
    """Stamps are up to 20 ms late; the fit over 20 s is late by their mean, to a few ms."""
    samples = hiss(20.0, 8)
    rng = np.random.default_rng(3)
    step = RATE_HZ // 50
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        for first in range(0, samples.shape[1], step):
            recorder.push(block(samples, first, first + step, jitter_ns=int(rng.uniform(0, 20e6))))
    for piece in read_session(tmp_path).pieces:
        # mean 10 ms; the fit's error at its end is 2 sigma / sqrt(n) = 2 * 5.8 ms / sqrt(1000) = 0.4 ms
        assert_allclose((piece.start_ns - START_NS) / 1e6, 10.0, rtol=0, atol=4 * 0.4)


def test_gap_begins_a_new_file(tmp_path: Path) -> None:
    samples = sixteen_bits(hiss(3.0, 8))
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        recorder.push(block(samples, 0, 8000))
        recorder.push(block(samples, 8000, 8000))  # an empty block is not a gap
        recorder.push(block(samples, 8000, 16000))
        assert recorder.recorded
        recorder.push(block(samples, 24000, 32000))  # samples are missing before it
        recorder.push(block(samples, 32000, 40000, overflow=True))  # an unknown number is missing here
    session = read_session(tmp_path)
    north = [piece for piece in session.pieces if piece.array == "north"]
    assert [piece.file for piece in north] == ["north-000.flac", "north-001.flac", "north-002.flac"]
    for piece, first, stop in zip(north, (0, 24000, 32000), (16000, 32000, 40000), strict=True):
        assert piece.start_ns == START_NS + round(first / RATE_HZ * 1e9)
        assert_array_equal(read(session.path(piece)), samples[:4, first:stop])
    [part] = [part for part in assign_sessions(SITE, [session]) if part.array == "north"]
    blocks = list(part.recording.blocks(part.start_ns))
    starts = [b.first_index for b, before in zip(blocks[1:], blocks, strict=False) if follows_a_gap(b, before)]
    assert starts == [24000]


def follows_a_gap(one: Block, before: Block) -> bool:
    return one.first_index - before.first_index != int(before.samples.shape[1])


def test_complete_files_survive_a_crash(tmp_path: Path) -> None:
    samples = hiss(2.0, 8)
    recorder = Recorder(tmp_path, SITE, BOTH, float(RATE_HZ))
    recorder.push(block(samples, 0, 8000))
    names = ["north-000.flac", "south-000.flac", "north-001.flac", "south-001.flac"]
    assert starts(tmp_path) == dict.fromkeys(names[:2], 0)
    recorder.push(block(samples, 8000, 9000, jitter_ns=20_000_000))
    assert starts(tmp_path) == dict.fromkeys(names[:2], 0)
    recorder.push(block(samples, 10000, 12000))
    second = round(10000 / RATE_HZ * 1e9)
    written = starts(tmp_path)  # the recorder still runs
    assert list(written) == names
    assert written[names[0]] == written[names[1]] > 0  # a complete segment has a start fitted to all stamps
    assert written[names[2]] == written[names[3]] == second
    assert FileRecording(tmp_path / names[0]).duration_s == 9000 / RATE_HZ
    recorder.__exit__(None, None, None)
    assert len(assign_sessions(SITE, [read_session(tmp_path)])) == 2


def starts(directory: Path) -> dict[str, int]:
    return {piece.file: piece.start_ns - START_NS for piece in read_session(directory).pieces}


def test_nothing_recorded_leaves_no_session(tmp_path: Path) -> None:
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        recorder.push(Block(0, np.zeros((8, 0), dtype=np.float32), START_NS))
    assert not recorder.recorded
    assert list(tmp_path.iterdir()) == []


class Ailing:
    """A device that stops for a while and reports it."""

    name = "UMC1820"
    sample_rate_hz = float(RATE_HZ)
    channels = 8
    problem: str | None = None
    lost_blocks = 0
    through_sound_server = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Block]:
        samples = hiss(1.0, 8)
        for first, self.problem in ((0, None), (1600, "unplugged"), (1600, "unplugged"), (3200, None)):
            yield block(samples, first, first if self.problem else first + 1600)


def test_device_problem_is_logged_when_it_changes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        record_device(Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)), Ailing(), never)
    assert caplog.messages == ["unplugged", "device 'UMC1820' delivers sound again"]


def test_wav_has_no_limit_of_4_gib(tmp_path: Path) -> None:
    """The test checks only the container format, because a file of 4 GiB takes too long to write."""
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ), "wav") as recorder:
        recorder.push(block(hiss(0.5, 8), 0, 8000))
    assert soundfile.info(tmp_path / "north-000.wav").format == "RF64"


def test_more_than_eight_microphones_are_wav(tmp_path: Path) -> None:
    positions = [[1 + 0.1 * k, 1.0, 1.0] for k in range(9)]
    changes: Changes = {"arrays.north": {"microphones_m": positions}, "nodes": {}}
    samples = hiss(0.5, 13)
    channels = {"north": list(range(1, 10)), "south": [10, 11, 12, 13]}
    with Recorder(tmp_path, site_of(changes), channels, float(RATE_HZ), "flac") as recorder:
        recorder.push(block(samples, 0, 8000))
    files = {piece.array: piece.file for piece in read_session(tmp_path).pieces}
    assert files == {"north": "north-000.wav", "south": "south-000.flac"}
    assert_array_equal(read(tmp_path / "north-000.wav"), samples[:9])


def test_24_bits_hold_the_samples_of_a_converter(tmp_path: Path) -> None:
    samples = hiss(0.5, 8, level=1e-4)
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        recorder.push(block(samples, 0, 8000))
    assert_allclose(read(tmp_path / "north-000.flac"), samples[:4], rtol=0, atol=2**-23)
    assert FileRecording(tmp_path / "north-000.flac").channels == 4


def test_every_file_that_does_not_fit_is_reported(tmp_path: Path) -> None:
    wavs = {
        "north": write_wav(tmp_path / "few.wav", hiss(0.1, 3)),
        "south": tmp_path / "missing.wav",
        "west": write_wav(tmp_path / "good.wav", hiss(0.1)),
    }
    with pytest.raises(DeviceError) as caught:
        assign_files(SITE, wavs)
    few, missing, west = str(caught.value).splitlines()
    assert "few.wav: expected 4 channels" in few
    assert "missing.wav: expected a WAV or FLAC file, cannot read it: no such file" in missing
    assert "west=" in west
    assert "no such array; arrays are north, south" in west


def test_files_begin_together_except_for_their_offset(tmp_path: Path) -> None:
    site = site_of({"arrays.south.wav_offset_s": -0.25})
    files = {name: write_wav(tmp_path / f"{name}.wav", hiss(0.1)) for name in BOTH}
    parts = assign_files(site, files, start_ns=START_NS)
    assert [part.start_ns - START_NS for part in parts] == [0, -250_000_000]


def test_unfinished_files_of_a_joint_array_end_together(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A recorder that is killed has written more of one file than of another."""
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ)) as recorder:
        recorder.push(block(sixteen_bits(hiss(3.0, 8)), 0, 48_000))
    path = tmp_path / "south-000.flac"
    path.write_bytes(path.read_bytes()[:-30_000])
    apart = assign_sessions(SITE, [read_session(tmp_path)])
    north_s, south_s = (part.recording.duration_s for part in apart)
    assert north_s == 3.0
    assert north_s - 1 < south_s < north_s
    assert [message.partition(": ")[2] for message in caplog.messages] == [
        f"the file is shorter than its header says; {south_s:.2f} s of sound were found and read"
    ]
    caplog.clear()
    site = site_of({"joint": {"both": ["north", "south"]}})
    [pipeline], [_] = make_pipelines(site, assign_sessions(site, [read_session(tmp_path)]))
    assert pipeline.arrays == ["both"]
    assert caplog.messages[1:] == [
        f"{tmp_path / 'north-000.flac'}: its last {north_s - south_s:.3f} s are not used, because {path} ends before"
    ]


def test_file_that_was_only_begun_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    samples = hiss(1.0, 8)
    with Recorder(tmp_path, SITE, BOTH, float(RATE_HZ), "wav") as recorder:
        recorder.push(block(samples, 0, 8000))
        recorder.push(block(samples, 9000, 16000))
    begun = [tmp_path / "north-001.wav", tmp_path / "south-001.wav"]
    for path in begun:
        path.write_bytes(path.read_bytes()[: path.stat().st_size - 7000 * 4 * 4])
    parts = assign_sessions(SITE, [read_session(tmp_path)])
    assert [part.recording.duration_s for part in parts] == [0.5, 0.5]
    assert caplog.messages == [f"{path}: it holds no sound and is left out" for path in begun]
    for path in (tmp_path / "north-000.wav", begun[0]):
        path.write_bytes(begun[0].read_bytes())
    with pytest.raises(DeviceError) as caught:
        assign_sessions(SITE, [read_session(tmp_path)])
    assert [line.partition(": ")[2] for line in str(caught.value).splitlines()] == [
        "expected sound, got a file of zero length; record it again"
    ] * 2


def test_wide_file_of_two_arrays_is_noted_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_wav(tmp_path / "wide.wav", hiss(1.0, 8))
    path.write_bytes(path.read_bytes()[:-4000])
    parts = assign_files(SITE, {"north": path, "south": path})
    assert [part.channels for part in parts] == [(1, 2, 3, 4), (5, 6, 7, 8)]
    assert len(caplog.messages) == 1
    assert "the file is shorter than its header says; " in caplog.text
