"""A recorder that meets a limit at any byte keeps what it has, says how much that is, and leaves a session to read."""

from __future__ import annotations

import re
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.types import Block
from livessl.errors import UseError
from livessl.recordings.recorder import Recorder, RecordingError
from livessl.recordings.recording import FileRecording
from livessl.recordings.session import read_session
from livessl.recordings.sound_file import Format
from small_site import RATE_HZ, hiss, site_of

CHANNELS = {"north": [1, 2, 3, 4], "south": [5, 6]}
LENGTH_S = 2.5
SOUND = hiss(LENGTH_S, 6)
BLOCK_S = 0.05
FLAC_BLOCK_S = 4608 / RATE_HZ
"""Longest sound that the encoder holds back, in seconds."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes: for the recorder, a disk that is full."""
    before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))


def record(out: Path, kind: Format, size: int) -> str | None:
    """Record `SOUND` with this limit; return what the recorder says if it had to end."""
    step = round(BLOCK_S * RATE_HZ)
    try:
        with largest_file(size), Recorder(out, site_of(), CHANNELS, float(RATE_HZ), kind) as recorder:
            for first in range(0, SOUND.shape[1], step):
                stamp_ns = 10**18 + round(first / RATE_HZ * 1e9)
                recorder.push(Block(first, SOUND[:, first : first + step].copy(), stamp_ns))
    except RecordingError as error:
        return str(error)
    return None


@settings(max_examples=15, deadline=None)
@given(kind=st.sampled_from(["flac", "wav"]), share=st.floats(0.0, 1.1))
def test_what_was_recorded_before_the_limit_is_kept(
    tmp_path_factory: pytest.TempPathFactory, kind: Format, share: float
) -> None:
    out = tmp_path_factory.mktemp("limit") / "session"
    bytes_per_sample = {"flac": 3, "wav": 4}[kind]
    size = round(share * SOUND.shape[1] * 4 * bytes_per_sample)
    said = record(out, kind, size)
    if said is None:
        assert share > 0.9
        assert [piece.array for piece in read_session(out).pieces] == ["north", "south"]
        return
    assert said.startswith(f"{out}: a file has reached the largest size allowed")
    assert "\n" not in said
    found = re.search(r"the (\d+\.\d) s before are kept and can be replayed", said)
    if found is None:
        assert "nothing is kept" in said
        assert share < 0.2
        return
    kept_s = float(found[1])
    assert kept_s >= share * LENGTH_S - FLAC_BLOCK_S * (kind == "flac") - BLOCK_S - 0.1
    session = read_session(out)
    for piece in session.pieces:
        recording = FileRecording(session.path(piece))
        assert recording.note is None  # the header was mended, so that other programs read as much
        samples = np.concatenate([block.samples for block in recording.blocks(0)], axis=1)
        assert samples.shape[1] / RATE_HZ >= kept_s - 0.05
        expected = SOUND[np.array(CHANNELS[piece.array]) - 1, : samples.shape[1]]
        np.testing.assert_allclose(samples, expected, rtol=0, atol=2**-23)


def test_a_limit_at_the_first_byte_is_an_error_and_no_session(tmp_path: Path) -> None:
    said = record(tmp_path / "session", "flac", 0)
    assert said is not None
    assert "nothing is kept" in said
    with pytest.raises(UseError):
        read_session(tmp_path / "session")
