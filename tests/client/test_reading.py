"""Answers of a server as models: events of older releases, of newer ones, and what is no answer of livessl."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.client.questions import health_of
from livessl.client.reading import ForeignAnswerError, NewerServerError, read_answer
from livessl.schema.answers import EventLog, EventPage, OneEvent
from messages import event_message

LATER: dict[str, Any] = {"membership": [], "excluded": False, "excluded_by": [], "source": 1, "candidates": []}
"""Fields that releases 0.1 and 0.2 did not store, with the values that a client gives them."""

LATER_PARTS: dict[str, Any] = {"agrees": None, "off_deg": None, "asked": False}
"""The same of a contribution; release 0.2 stored them."""

PART: dict[str, Any] = {
    "array": "north", "active_s": 0.4, "level_dbfs": -30.0, "azimuth_deg": 1.0, "elevation_deg": 2.0, "distance_m": 2.0,
}  # fmt: skip


@given(lacks=st.sets(st.sampled_from(sorted(LATER))), lacks_part=st.sets(st.sampled_from(sorted(LATER_PARTS))))
def test_stored_events_of_older_releases_are_read(lacks: set[str], lacks_part: set[str]) -> None:
    part = {**PART, **{key: value for key, value in LATER_PARTS.items() if key not in lacks_part}}
    event = {key: value for key, value in event_message(contributions=[part]).items() if key not in lacks}
    log = {"v": 1, "position": "0-1", "more": False, "unsaved": 0, "complete": True, "events": [event]}
    page = {"v": 1, "events": [event], "next_cursor": None, "previous_cursor": None}
    for found in (
        *read_answer(EventLog, json.dumps(log), "event-log").events,
        *read_answer(EventPage, json.dumps(page), "events").events,
        read_answer(OneEvent, json.dumps({"v": 1, **event}), "events/small-1"),
    ):
        read = found.model_dump()
        assert {key: read[key] for key in lacks} == {key: LATER[key] for key in lacks}
        assert {key: read["contributions"][0][key] for key in LATER_PARTS} == LATER_PARTS


def test_answer_that_cannot_be_read_is_an_error_of_the_run() -> None:
    with pytest.raises(
        NewerServerError, match=r"^events/a: cannot read the answer: status: .*; update the older of the two"
    ):
        read_answer(OneEvent, json.dumps({"v": 1, **event_message(status="guessed")}), "events/a")
    with pytest.raises(ForeignAnswerError, match=r"^events/a: expected an answer in JSON.*check that the address"):
        read_answer(OneEvent, b"<!doctype html><title>Welcome</title>", "events/a")
    with pytest.raises(ForeignAnswerError, match=r"^health: expected an answer in JSON"):
        health_of(b"<html>")
