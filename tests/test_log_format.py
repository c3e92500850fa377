"""Log lines as JSON: one object a line, whatever the message holds."""

from __future__ import annotations

import io
import json
import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.clock import utc_ns
from livessl.log_format import VARIABLE, JsonFormatter, LogForm, log_form

pytest_plugins: list[str] = []


def written(level: int, message: str, *arguments: object, failed: bool = False) -> str:
    """Return what a logger with the formatter writes."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter("serve"))
    logger = logging.Logger("livessl.server.app")  # of its own, so that nothing else is written
    logger.addHandler(handler)
    logger.log(level, message, *arguments, exc_info=failed)
    return stream.getvalue()


@given(st.text(), st.sampled_from(["debug", "info", "warning", "error", "critical"]))
def test_every_record_is_one_line_with_its_message_level_and_time(message: str, level: str) -> None:
    line = written(getattr(logging, level.upper()), "%s", message)
    assert line.endswith("\n")
    assert len(line.splitlines()) == 1
    found = json.loads(line)
    assert (found["message"], found["level"]) == (message, level)
    assert (found["logger"], found["command"]) == ("livessl.server.app", "serve")
    assert utc_ns(found["time_utc"]) % 1000 == 0
    assert "exception" not in found


def test_exception_has_its_type_and_traceback_on_the_same_line() -> None:
    try:
        raise LookupError("gone")
    except LookupError:
        line = written(logging.ERROR, "the thread has failed", failed=True)
    found = json.loads(line)
    assert len(line.splitlines()) == 1
    assert found["exception"] == "LookupError"
    assert "LookupError: gone" in found["traceback"]


@pytest.mark.parametrize(("value", "form"), [("", "text"), ("text", "text"), ("json", "json")])
def test_environment_chooses_the_form(value: str, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, value)
    assert log_form() is LogForm(form)
