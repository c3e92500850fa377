"""Sound files whose header disagrees with the file are read as far as they are complete."""

from __future__ import annotations

import io
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from livessl.core.types import Float32Array
from livessl.errors import DeviceError
from livessl.recordings.recording import FileRecording
from livessl.recordings.session import read_session
from livessl.recordings.sound_file import SoundWriter
from small_site import write_site

FLAC_BLOCK = 4608
"""Largest number of samples in a frame of the FLAC encoders in use."""

UNFINISHED = "its header was never finished"
CUT = "the file is shorter than its header says"
CONTAINERS = [
    ("WAV", "PCM_16", 2),
    ("WAV", "PCM_24", 3),
    ("WAV", "FLOAT", 4),
    ("WAVEX", "PCM_32", 4),
    ("RF64", "FLOAT", 4),
    ("FLAC", "PCM_16", 2),
    ("FLAC", "PCM_24", 3),
]


def noise(frames: int, channels: int, seed: int) -> Float32Array:
    """Noise (n, channels) that 16 bits hold exactly."""
    rng = np.random.default_rng(seed)
    return (rng.integers(-8000, 8000, (frames, channels)) / 2**15).astype(np.float32)


def encoded(samples: Float32Array, rate_hz: int, container: str, subtype: str) -> bytes:
    buffer = io.BytesIO()
    soundfile.write(buffer, samples, rate_hz, format=container, subtype=subtype)
    return buffer.getvalue()


def read(path: Path) -> tuple[Float32Array, str | None]:
    recording = FileRecording(path)
    samples = np.concatenate([block.samples for block in recording.blocks(0)], axis=1).T
    assert recording.duration_s == len(samples) / recording.sample_rate_hz
    return samples, recording.note


@st.composite
def sounds(draw: st.DrawFn) -> tuple[Float32Array, int, tuple[str, str, int]]:
    channels = draw(st.integers(1, 8))
    rate_hz = draw(st.sampled_from([8000, 16000, 22050, 44100, 48000, 96000]))
    samples = noise(draw(st.integers(1, 30_000)), channels, draw(st.integers(0, 99)))
    return samples, rate_hz, draw(st.sampled_from(CONTAINERS))


@settings(deadline=None, max_examples=25)
@given(sound=sounds(), where=st.floats(0, 1))
@example(sound=(noise(1, 1, 0), 8000, ("WAV", "PCM_24", 3)), where=47 / 48)  # an odd number of bytes is padded
@example(sound=(noise(1, 1, 0), 8000, ("WAV", "PCM_24", 3)), where=1.0)
def test_file_cut_at_any_byte_is_read_up_to_there_or_refused(
    tmp_path_factory: pytest.TempPathFactory, sound: Any, where: float
) -> None:
    samples, rate_hz, (container, subtype, width) = sound
    whole = encoded(samples, rate_hz, container, subtype)
    size = round(where * len(whole))
    path = tmp_path_factory.mktemp("cut") / "cut.wav"
    path.write_bytes(whole[:size])
    per_sample = width * samples.shape[1]
    start = whole.find(b"\xff\xf8") if container == "FLAC" else whole.find(b"data") + 8
    left = size - start  # bytes of sound and of its padding, negative within the header
    if container == "FLAC":
        sound_bytes = len(whole) - start
        possible = left / sound_bytes * len(samples)
        least = possible - 2 * FLAC_BLOCK  # frames of noise are nearly equally long
    else:
        possible = least = min(left // per_sample, len(samples))
    refusal = ""
    try:
        got, note = read(path)
    except DeviceError as error:
        refusal = str(error)
    if refusal:
        assert refusal.startswith(f"{path}: expected ")
        assert "\n" not in refusal
        assert least <= 0
        return
    assert_array_equal(got, samples[: len(got)])
    assert least <= len(got) <= possible + FLAC_BLOCK * (container == "FLAC")
    assert (note is None) == (len(got) == len(samples))
    assert note is None or f"{path}: {CUT}; {len(got) / rate_hz:.2f} s of sound were found and read" == note


@settings(deadline=None, max_examples=25)
@given(
    sound=sounds(),
    riff=st.sampled_from([0, 36, 4096, 0xFFFFFFF8]),
    extra=st.integers(0, 7),
    announced=st.floats(0, 0.9),
)
def test_header_that_was_never_finished_hides_nothing(
    tmp_path_factory: pytest.TempPathFactory, sound: Any, riff: int, extra: int, announced: float
) -> None:
    """The header says zero, or the length at its last update; an incomplete sample may follow."""
    samples, rate_hz, (container, subtype, width) = sound
    raw = bytearray(encoded(samples, rate_hz, container, subtype))
    said = int(announced * len(samples)) * width * samples.shape[1]
    if container == "FLAC":
        said = int(announced * len(samples))
        packed = int.from_bytes(raw[18:26], "big") >> 36 << 36 | said
        raw[18:26], raw[26:42] = packed.to_bytes(8, "big"), bytes(16)
    else:
        start = raw.find(b"data") + 8
        end = start + len(samples) * width * samples.shape[1]
        total = start + said - 8 if said else riff
        if container == "RF64":
            raw[20:36] = struct.pack("<QQ", total, said)
        else:
            raw[start - 4 : start], raw[4:8] = struct.pack("<I", said), struct.pack("<I", total)
        raw = raw[:end] + b"\x99" * min(extra, width * samples.shape[1] - 1)
    path = tmp_path_factory.mktemp("unfinished") / "unfinished.wav"
    path.write_bytes(raw)
    got, note = read(path)
    assert_array_equal(got, samples)
    fault = "its header does not say how long it is" if container == "FLAC" and said == 0 else UNFINISHED
    assert note == f"{path}: {fault}; {len(samples) / rate_hz:.2f} s of sound were found and read"


@settings(deadline=None, max_examples=25)
@given(sound=sounds(), title=st.text("abc ", min_size=0, max_size=9))
def test_good_file_gets_no_note(tmp_path_factory: pytest.TempPathFactory, sound: Any, title: str) -> None:
    """Chunks behind the sound are no sound, whether or not the length of the whole counts them."""
    samples, rate_hz, (container, subtype, _) = sound
    raw = bytearray(encoded(samples, rate_hz, container, subtype))
    if container == "FLAC":
        raw += (b"TAG" + title.encode()).ljust(128, b"\0") if title else b""
    else:
        text = title.encode() + bytes(len(title) % 2)
        raw += bytes(len(raw) % 2) + b"LIST" + struct.pack("<I", len(title)) + text
        if title and container != "RF64":
            raw[4:8] = struct.pack("<I", len(raw) - 8)
    path = tmp_path_factory.mktemp("good") / "good.wav"
    path.write_bytes(raw)
    got, note = read(path)
    assert note is None
    assert_array_equal(got, samples)


@pytest.mark.parametrize("size", [0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFF000])
def test_file_that_came_through_a_pipe_is_read_without_a_note(tmp_path: Path, size: int) -> None:
    samples = noise(5000, 2, 1)
    raw = bytearray(encoded(samples, 16000, "WAV", "PCM_16"))
    raw[4:8] = raw[40:44] = struct.pack("<I", size)
    path = tmp_path / "pipe.wav"
    path.write_bytes(raw)
    got, note = read(path)
    assert note is None
    assert_array_equal(got, samples)


def test_empty_file_with_a_title_holds_no_sound(tmp_path: Path) -> None:
    raw = bytearray(encoded(noise(0, 2, 1), 16000, "WAV", "PCM_16")) + b"LIST\x04\0\0\0abcd"
    for total in (len(raw) - 8, 36):
        raw[4:8] = struct.pack("<I", total)
        path = tmp_path / "empty.wav"
        path.write_bytes(raw)
        with pytest.raises(DeviceError, match="got a file of zero length; record it again"):
            FileRecording(path)


@pytest.mark.parametrize("container", ["FLAC", "WAV"])
def test_damage_in_the_middle_is_one_sentence(tmp_path: Path, container: str) -> None:
    raw = bytearray(encoded(noise(60_000, 4, 1), 16000, container, "PCM_16"))
    raw[len(raw) // 2 : len(raw) // 2 + 40_000] = bytes(40_000)
    path = tmp_path / "damaged"
    path.write_bytes(raw)
    if container == "WAV":  # nothing in it shows the damage
        assert len(read(path)[0]) == 60_000
        return
    with pytest.raises(DeviceError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: expected 3.75 s of sound, cannot read it beyond 1.")
    assert str(caught.value).endswith("; the file is damaged, copy or record it again")


@pytest.mark.parametrize("kind", ["flac", "wav"])
def test_finished_file_is_as_libsndfile_writes_it(tmp_path: Path, kind: Any) -> None:
    samples = noise(50_000, 3, 4)
    writer = SoundWriter(tmp_path / "ours", 16000, 3, kind)
    for first in range(0, len(samples), 777):
        writer.write(samples[first : first + 777].T)
    writer.close()
    container, subtype = {"flac": ("FLAC", "PCM_24"), "wav": ("RF64", "FLOAT")}[kind]
    with soundfile.SoundFile(tmp_path / "theirs", "w", 16000, 3, subtype, format=container) as file:
        for first in range(0, len(samples), 777):
            file.write(samples[first : first + 777])
    assert (tmp_path / "ours").read_bytes() == (tmp_path / "theirs").read_bytes()
    assert FileRecording(tmp_path / "ours").note is None


KILLED = """
import os, sys
import numpy as np
from pathlib import Path
from livessl.core.types import Block
from livessl.recordings.recorder import Recorder
from livessl.site.load import load_site
directory, kind, rate, seconds = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
samples = np.load(directory / "samples.npy")
channels = {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]}
recorder = Recorder(directory / "session", load_site(directory / "site.yaml"), channels, float(rate), kind)
step = rate // 50
for first in range(0, round(seconds * rate), step):
    recorder.push(Block(first, samples[:, first : first + step].copy(), 10**18 + round(first / rate * 1e9)))
os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize(
    ("kind", "rate_hz", "seconds"), [("flac", 48000, 3.3), ("wav", 44100, 2.7), ("flac", 16000, 4.9)]
)
def test_killed_recorder_loses_less_than_a_second(tmp_path: Path, kind: str, rate_hz: int, seconds: float) -> None:
    """The session can be read by livessl; other programs that trust the header lose two seconds at most."""
    write_site(tmp_path, {"nodes.lab-pc.device.sample_rate_hz": rate_hz})
    samples = np.ascontiguousarray(noise(round(seconds * rate_hz) + rate_hz, 8, 3).T)
    np.save(tmp_path / "samples.npy", samples)
    command = [sys.executable, "-c", KILLED, str(tmp_path), kind, str(rate_hz), str(seconds)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    session = read_session(tmp_path / "session")
    assert [piece.array for piece in session.pieces] == ["north", "south"]
    for number, piece in enumerate(session.pieces):
        path = session.path(piece)
        got, note = read(path)
        assert seconds - 1 <= len(got) / rate_hz <= seconds + 0.02
        assert_array_equal(got, samples[4 * number : 4 * number + 4, : len(got)].T)
        assert note is not None
        assert note.startswith(f"{path}: {UNFINISHED}; ")
        assert seconds - 2 <= soundfile.info(path).duration <= seconds + 0.02
