"""The last log lines of a server: what is kept of long ones, and lines that cannot be formatted."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.server.recent_log import MAX_LINE, RecentLog


@pytest.fixture
def recent() -> Iterator[RecentLog]:
    recent = RecentLog()
    with recent.attached():
        yield recent


def record(message: str, *arguments: object) -> logging.LogRecord:
    return logging.LogRecord("livessl.test", logging.ERROR, __file__, 1, message, arguments, None)


@given(st.integers(1, 3 * MAX_LINE))
def test_a_message_is_kept_whole_or_with_its_beginning_and_its_end(length: int) -> None:
    recent, text = RecentLog(), "".join(chr(0x4E00 + index) for index in range(length))
    recent.handle(record("%s", text))
    (line,) = recent.lines()
    if length <= MAX_LINE:
        assert line.message == text
        return
    assert len(line.message) <= MAX_LINE
    assert (line.message[0], line.message[-1]) == (text[0], text[-1])
    begin, said, end = line.message.split("\n")
    assert said == f"… {length - len(begin) - len(end)} characters are left out …"
    assert text.startswith(begin)
    assert text.endswith(end)


def test_the_error_at_the_end_of_a_long_traceback_is_kept(recent: RecentLog) -> None:
    try:
        raise ValueError(f"{MAX_LINE * '.'} what is wrong")
    except ValueError:
        logging.getLogger("livessl.test").exception("the thread has failed")
    (line,) = recent.lines()
    assert line.message.startswith("the thread has failed")
    assert line.message.endswith(". what is wrong")


def test_a_message_that_cannot_be_formatted_ends_nothing(
    recent: RecentLog, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", True)
    recent.handle(record("%d sounds", "three"))
    assert "Logging error" in capsys.readouterr().err
    assert recent.lines() == []
