"""Messages of native libraries: each is logged once, and counted."""

from __future__ import annotations

import logging
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.capture.native_output import LONGEST, MOST_MESSAGES, SUMMARY_NS, NativeOutput


@pytest.fixture(autouse=True)
def _all_messages(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)


def test_repeated_message_is_logged_once_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    output = NativeOutput()
    for step in range(1000):
        output.feed(f"ALSA lib pcm.c:{step}: unknown PCM at 0x{step:x}\n".encode(), step)
    assert caplog.messages == ["sound library: ALSA lib pcm.c:0: unknown PCM at 0x0"]
    output.feed(b"something else\n", SUMMARY_NS)
    assert caplog.messages[1:] == [
        "sound library: something else",
        "sound library, 999 times more: ALSA lib pcm.c:#: unknown PCM at #",
    ]
    output.summarize()
    assert len(caplog.messages) == 3


def test_number_of_distinct_messages_is_limited(caplog: pytest.LogCaptureFixture) -> None:
    output = NativeOutput()
    names = ["".join(chr(97 + int(digit)) for digit in f"{k:03d}") for k in range(MOST_MESSAGES + 25)]
    output.feed("\n".join(names).encode() + b"\n", 0)
    assert len(caplog.messages) == MOST_MESSAGES
    output.summarize()
    assert caplog.messages[MOST_MESSAGES:] == ["sound library, 25 times more: other messages"]


@given(st.lists(st.integers(0, 60), max_size=6))
def test_lines_do_not_depend_on_how_they_were_cut(cuts: list[int]) -> None:
    text = b"one\ntwo two\n\nthree \xff three\nfour\n"
    places = [0, *sorted(min(cut, len(text)) for cut in cuts), len(text)]
    output = NativeOutput()
    for begin, end in pairwise(places):
        output.feed(text[begin:end], 0)
    assert output.lines == 4


def test_endless_line_takes_no_memory(caplog: pytest.LogCaptureFixture) -> None:
    output = NativeOutput()
    for _ in range(100):
        output.feed(b"x" * 65536, 0)
    output.feed(b"\n", 0)
    assert caplog.messages == [f"sound library: {'x' * LONGEST}"]
    assert output.lines == 1
