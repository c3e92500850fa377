"""The inputs that a session was recorded from, and a site file that gives them in another order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.errors import DeviceError
from livessl.recordings.assign import assign_sessions
from livessl.recordings.session import SITE_FILE, piece, read_session, write_session
from small_site import RATE_HZ, site_of, write_wav

NORTH = "nodes.lab-pc.arrays.north"
RECORDED = [4, 2, 3, 1]
INPUTS = st.permutations(RECORDED)


def session_of(directory: Path, inputs: list[int], channels: int = 4) -> Path:
    directory.mkdir(exist_ok=True)
    write_wav(directory / "north.wav", np.full((channels, RATE_HZ // 10), 0.1, dtype=np.float32))
    write_session(directory, site_of({NORTH: inputs}), [piece("north", "north.wav", 0)])
    return directory


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return session_of(tmp_path_factory.mktemp("session"), RECORDED)


@settings(max_examples=10)
@given(inputs=INPUTS)
def test_channels_are_taken_in_the_order_of_the_site_file(directory: Path, inputs: list[int]) -> None:
    session = read_session(directory)
    assert session.inputs()["north"] == RECORDED
    [part] = assign_sessions(site_of({NORTH: inputs}), [session])
    assert [RECORDED[channel - 1] for channel in part.channels] == inputs


def test_other_inputs_are_noted_and_change_nothing(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    [part] = assign_sessions(site_of({NORTH: [11, 12, 13, 14]}), [read_session(directory)])
    assert part.channels == (1, 2, 3, 4)
    assert "was recorded from the inputs 4, 2, 3, 1, and the site file gives 11, 12, 13, 14" in caplog.text


def test_a_recording_of_all_inputs_keeps_the_channels_of_the_site_file(tmp_path: Path) -> None:
    session = read_session(session_of(tmp_path, RECORDED, channels=8))
    [part] = assign_sessions(site_of({NORTH: [4, 3, 2, 1]}), [session])
    assert part.channels == (4, 3, 2, 1)


def test_sessions_of_two_wirings_are_refused(tmp_path: Path, directory: Path) -> None:
    other = session_of(tmp_path, [1, 2, 3, 4])
    with pytest.raises(DeviceError, match="give sessions of different wirings one by one"):
        assign_sessions(site_of({NORTH: [2, 1, 3, 4]}), [read_session(directory), read_session(other)])


@pytest.mark.parametrize("text", [None, "nodes: {}\n"], ids=["other inputs", "no inputs"])
def test_the_order_of_one_session_is_not_that_of_another(tmp_path: Path, directory: Path, text: str | None) -> None:
    other = session_of(tmp_path, [11, 12, 13, 14])
    if text is not None:
        (other / SITE_FILE).write_text(text, encoding="utf-8")
    sessions = [read_session(directory), read_session(other)]
    for given_in in (sessions, sessions[::-1]):
        with pytest.raises(DeviceError, match="give sessions of different wirings one by one"):
            assign_sessions(site_of({NORTH: [1, 2, 3, 4]}), given_in)


def of_number(text: str) -> str:
    return f"nodes: {{pc: {{arrays: {{north: [1, {text}]}}}}}}"


@pytest.mark.parametrize(
    "text",
    ["", "[", "[" * 2000, "nodes: 3", "nodes: {pc: {arrays: [1]}}", "nodes: {pc: {arrays: {a: x}}}", "2026-99-99",
     *map(of_number, [".inf", "-.inf", ".nan", "x", "null", "[2]", "2026-11-30", "2026-99-99", "9" * 5000])],
)  # fmt: skip
def test_a_damaged_site_file_names_no_inputs(tmp_path: Path, text: str) -> None:
    session = read_session(session_of(tmp_path, RECORDED))
    (tmp_path / SITE_FILE).write_text(text, encoding="utf-8")
    assert session.inputs() == {}
