"""Recordings read like devices: their samples, their time stamps, and files that are refused."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import soundfile
from numpy.testing import assert_allclose, assert_array_equal

from livessl.clock import UnpacedClock
from livessl.core.types import Block, Float32Array
from livessl.errors import DeviceError
from livessl.recordings.recording import (
    FileRecording,
    LoopedRecording,
    MemoryRecording,
    Recording,
    SplicedRecording,
    TimedRecording,
    merged_blocks,
    paced_blocks,
)
from small_site import RATE_HZ, hiss, write_wav

START_NS = 1_767_225_600_000_000_000
NS = 1_000_000_000


def joined(blocks: Iterable[Block]) -> Float32Array:
    return np.concatenate([block.samples for block in blocks], axis=1)


def recording(seconds: float = 1.0, rate_hz: float = RATE_HZ, channels: int = 4, seed: int = 0) -> MemoryRecording:
    samples = hiss(seconds * rate_hz / RATE_HZ, channels, seed)
    return MemoryRecording("hiss", float(rate_hz), samples)


@pytest.mark.parametrize("rate_hz", [1, 24, 26])
def test_samples_at_a_few_hertz_are_read_in_blocks(rate_hz: int) -> None:
    samples = hiss(0.01)
    assert_array_equal(joined(MemoryRecording("slow", float(rate_hz), samples).blocks(START_NS)), samples)


@pytest.mark.parametrize("rate_hz", [1, 99, 1_000_001, 2**31 - 1])
def test_file_with_an_absurd_rate_is_refused(tmp_path: Path, rate_hz: int) -> None:
    path = write_wav(tmp_path / "odd.wav", hiss(0.01), rate_hz)
    with pytest.raises(DeviceError, match=r"expected a sampling rate from 100 to 1,000,000 Hz, got .*; export it"):
        FileRecording(path)


@pytest.mark.parametrize("rate_hz", [100, 1_000_000])
def test_file_with_the_lowest_or_highest_rate_is_read(tmp_path: Path, rate_hz: int) -> None:
    samples = hiss(0.01)
    path = write_wav(tmp_path / "odd.wav", samples, rate_hz)
    assert_array_equal(joined(FileRecording(path).blocks(START_NS)), samples)


@pytest.mark.parametrize(
    ("ending", "subtype", "rounding"),
    [
        ("wav", "PCM_U8", 2**-7),
        ("wav", "PCM_16", 2**-15),
        ("wav", "PCM_24", 2**-23),
        ("wav", "PCM_32", 2**-23),  # float32 has 24 bits
        ("wav", "FLOAT", 0.0),
        ("wav", "DOUBLE", 0.0),
        ("flac", "PCM_16", 2**-15),
        ("flac", "PCM_24", 2**-23),
    ],
)
def test_every_sample_format_is_read(tmp_path: Path, ending: str, subtype: str, rounding: float) -> None:
    samples = hiss(0.33, channels=5)
    path = write_wav(tmp_path / f"sound.{ending}", samples, subtype=subtype)
    read = FileRecording(path)
    assert (read.name, read.sample_rate_hz, read.channels) == (str(path), RATE_HZ, 5)
    assert read.duration_s == pytest.approx(0.33)
    got = joined(read.blocks(0))
    assert got.dtype == np.float32
    assert_allclose(got, samples, rtol=0, atol=rounding)
    assert not np.array_equal(got[0], got[1])


def refusal(path: Path) -> str:
    with pytest.raises(DeviceError) as caught:
        FileRecording(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: expected ")
    assert "\n" not in said
    return said


def test_missing_file_is_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "missing.wav").endswith("expected a WAV or FLAC file, cannot read it: no such file")


def test_file_without_sound_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.wav"
    for content in (b"", b"dear diary", b"RIFF", bytes(1000)):
        path.write_bytes(content)
        assert "expected a WAV or FLAC file, cannot read it" in refusal(path)
    assert "expected a WAV or FLAC file, cannot read it" in refusal(tmp_path)


def test_file_of_zero_length_is_refused(tmp_path: Path) -> None:
    path = write_wav(tmp_path / "empty.wav", np.zeros((4, 0), dtype=np.float32))
    assert "got a file of zero length; record it again" in refusal(path)


@pytest.mark.parametrize("subtype", ["FLOAT", "DOUBLE"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_refused(tmp_path: Path, subtype: str, bad: float) -> None:
    samples = hiss(20.0)
    samples[2, 300_000] = bad  # beyond the first samples that are scanned
    said = refusal(write_wav(tmp_path / "broken.wav", samples, subtype=subtype))
    assert "got NaN or infinity at sample 300000 of channel 3; export it again" in said


def test_samples_beyond_the_range_of_a_converter_are_refused(tmp_path: Path) -> None:
    samples = hiss(20.0)
    samples[2, 300_000] = -1e6  # the largest that is accepted
    FileRecording(write_wav(tmp_path / "loud.wav", samples))
    samples[2, 300_000] = -1.001e6
    said = refusal(write_wav(tmp_path / "broken.wav", samples))
    assert "samples around 1 at full scale, got -1.001e+06 at sample 300000 of channel 3; export it again" in said


@pytest.mark.parametrize("subtype", ["PCM_16", "FLOAT"])
def test_all_zero_file_is_refused(tmp_path: Path, subtype: str) -> None:
    samples = np.zeros((4, 300_001), dtype=np.float32)
    assert "got all-zero samples; was the right input recorded?" in refusal(
        write_wav(tmp_path / "silence.wav", samples, subtype=subtype)
    )
    samples[3, -1] = 0.5  # one click, at the very end, is sound
    FileRecording(write_wav(tmp_path / "click.wav", samples, subtype=subtype))


def test_file_removed_after_the_check_is_reported(tmp_path: Path) -> None:
    path = write_wav(tmp_path / "sound.wav", hiss())
    read = FileRecording(path)
    path.unlink()
    with pytest.raises(DeviceError, match="no such file"):
        next(read.blocks(0))


@pytest.mark.parametrize("rate_hz", [16000, 22050, 44100, 48000, 96000])
def test_stamps_are_ideal_and_indices_contiguous(tmp_path: Path, rate_hz: int) -> None:
    source = recording(1.01, rate_hz)
    read: list[Recording] = [source, FileRecording(write_wav(tmp_path / "s.wav", source.samples, rate_hz))]
    for one in read:
        blocks = list(one.blocks(START_NS))
        index = 0
        for block in blocks:
            assert block.first_index == index
            # an ideal stamp is exact to the rounding of a nanosecond, however long the recording
            assert abs(block.stamp_ns - START_NS - index / rate_hz * 1e9) <= 1
            assert not block.overflow
            index += block.samples.shape[1]
        assert {block.samples.shape[1] for block in blocks[:-1]} == {round(0.02 * rate_hz)}
        assert_array_equal(joined(blocks), source.samples)


def test_merged_blocks_come_in_order_of_completion() -> None:
    early, late, short = recording(0.5), recording(0.3, 22050, seed=1), recording(0.05, seed=2)
    recordings = [
        TimedRecording(late, START_NS + 133_000_000),
        TimedRecording(early, START_NS),
        TimedRecording(short, START_NS + 900_000_000),
    ]
    entries = list(merged_blocks(recordings))
    ends = [end_ns for end_ns, _, _ in entries]
    assert ends == sorted(ends)
    for index, item in enumerate(recordings):
        mine = [(end_ns, block) for end_ns, of, block in entries if of == index]
        assert_array_equal(joined(block for _, block in mine), joined_of(item))
        assert mine[0][1].stamp_ns == item.start_ns
        for end_ns, block in mine:
            assert abs(end_ns - block.stamp_ns - block.samples.shape[1] / item.recording.sample_rate_hz * 1e9) <= 1
    assert [index for _, index, _ in entries] != sorted(index for _, index, _ in entries)  # the recordings interleave


def joined_of(item: TimedRecording) -> Float32Array:
    return joined(item.recording.blocks(item.start_ns))


def test_no_block_is_played_before_it_is_complete() -> None:
    clock = UnpacedClock(START_NS)
    recordings = [TimedRecording(recording(0.2), START_NS), TimedRecording(recording(0.2, 44100), START_NS + 7)]
    seen = [(clock.now_ns(), end_ns) for end_ns, _, _ in paced_blocks(recordings, clock)]
    assert seen == [(end_ns, end_ns) for _, end_ns in seen]
    assert len(seen) == 20


class Sleeper(UnpacedClock):
    """A clock whose single sleeps last at most 70 ms."""

    def sleep_until_ns(self, time_ns: int) -> bool:
        return super().sleep_until_ns(min(time_ns, self.now_ns() + 70_000_000)) and self.now_ns() >= time_ns


def test_empty_blocks_come_while_no_block_is_due() -> None:
    """Empty blocks come before the beginning and in a gap, so that a caller can do other work."""
    spliced = SplicedRecording(
        (TimedRecording(recording(0.04), START_NS), TimedRecording(recording(0.04), START_NS + NS))
    )
    clock = Sleeper(START_NS - NS)
    last_ns, heard = START_NS - NS, []
    for now_ns, _, block in paced_blocks([TimedRecording(spliced, START_NS)], clock):
        assert now_ns - last_ns <= 70_000_000
        last_ns = now_ns
        heard.append(block.samples.shape[1])
    assert [n for n in heard if n] == [320] * 4
    assert heard.count(0) == 14 + 13  # a second and 20 ms; then a second less 20 ms


def test_looped_recording_has_no_gaps() -> None:
    once = recording(0.05)  # not a whole number of blocks
    looped = LoopedRecording(once)
    assert (looped.name, looped.channels, looped.sample_rate_hz) == ("hiss", 4, RATE_HZ)
    assert looped.duration_s == float("inf")
    blocks = list(islice(looped.blocks(START_NS), 12))
    assert_array_equal(joined(blocks), np.tile(once.samples, 4))
    index = 0
    for block in blocks:
        assert block.first_index == index
        assert abs(block.stamp_ns - START_NS - index / RATE_HZ * 1e9) <= 1
        index += block.samples.shape[1]


def test_spliced_recording_keeps_the_gap() -> None:
    first, second = recording(0.1, seed=1), recording(0.1, seed=2)
    gap_ns = 2 * NS + 31_250  # 2 s and half a sample
    spliced = SplicedRecording((TimedRecording(first, START_NS), TimedRecording(second, START_NS + gap_ns)))
    assert spliced.duration_s == pytest.approx(2.1, abs=1e-4)
    assert (spliced.name, spliced.channels, spliced.sample_rate_hz) == ("hiss", 4, RATE_HZ)
    for shift_ns in (0, 500 * NS):  # at the time of recording, or at any other
        blocks = list(spliced.blocks(START_NS + shift_ns))
        before, after = blocks[:5], blocks[5:]
        assert_array_equal(joined(before), first.samples)
        assert_array_equal(joined(after), second.samples)
        assert before[0].stamp_ns == START_NS + shift_ns
        assert after[0].stamp_ns == START_NS + shift_ns + gap_ns
        assert after[0].first_index == round(gap_ns * RATE_HZ / 1e9) > before[-1].first_index + 320


def test_block_of_a_wrong_shape_is_refused() -> None:
    for samples in (np.zeros(4, dtype=np.float32), np.zeros((4, 5))):
        with pytest.raises(ValueError, match=re.escape("(channels, n) float32")):
            Block(0, samples, 0)  # type: ignore[arg-type]


def test_soundfile_writes_the_formats_of_these_tests(tmp_path: Path) -> None:
    path = write_wav(tmp_path / "s.wav", hiss(0.1), subtype="PCM_24")
    assert soundfile.info(path).subtype == "PCM_24"
