"""Times in what leaves the product: every exit writes them as the server does, at whole seconds and between them."""

from __future__ import annotations

import csv
import io
import json
import pkgutil
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from importlib import import_module
from typing import Any, get_args

import httpx
import pytest
from pydantic import AwareDatetime, BaseModel, PlainSerializer, TypeAdapter

import livessl.client
import livessl.federation
import livessl.schema
import livessl.server.api
from cli.command_runs import Run
from livessl.client import connect
from livessl.client.options import rfc3339
from livessl.schema.values import UtcTime
from livessl.server.app import Server
from messages import START_NS, event_message
from small_site import running_server, site_of

TIMES = {
    "whole": "2026-01-01T00:00:00.000000Z",
    "tenths": "2026-01-01T00:00:01.500000Z",
    "microseconds": "2026-01-01T00:00:02.000001Z",
}
"""Texts of times, by the id of the event that began then."""

SINCE = "2025-12-31T00:00:00Z"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        for number, (name, text) in enumerate(TIMES.items()):
            server.parts.store.add(event_message(id=name, time_utc=text), START_NS + number)
        yield server


def times(events: list[Any]) -> dict[str, str]:
    return {event["id"]: event["time_utc"] for event in events}


def test_every_route_writes_times_in_the_same_way(server: Server) -> None:
    def text(path: str) -> str:
        return httpx.get(f"{server.url}/api/v1/{path}").text

    assert times(json.loads(text("events"))["events"]) == TIMES
    assert times([json.loads(text(f"events/{name}")) for name in TIMES]) == TIMES
    assert times([json.loads(line) for line in text("events.jsonl").splitlines()]) == TIMES
    assert times(list(csv.DictReader(io.StringIO(text("events.csv"), newline="")))) == TIMES


def test_command_writes_times_as_the_server_does(run: Run, server: Server) -> None:
    command = ["events", "--url", server.url, "--since", SINCE, "--limit", str(len(TIMES))]
    assert times(run(*command, "--json").objects) == TIMES
    assert [line.split()[0] for line in run(*command).out.splitlines()] == list(TIMES.values())


def test_client_writes_times_as_the_server_does(server: Server) -> None:
    with connect(server.url, kinds=["event"], since=SINCE) as live:
        messages = [message for _, message in zip(TIMES, live, strict=False)]
        listed = list(live.events(since=SINCE))
    for found in (messages, listed):
        assert times([json.loads(event.model_dump_json()) for event in found]) == TIMES
        assert times([event.model_dump(mode="json") for event in found]) == TIMES
        assert all(isinstance(event.model_dump()["time_utc"], datetime) for event in found)


@pytest.mark.parametrize("offset_h", [0, 1, -8])
@pytest.mark.parametrize("text", TIMES.values())
def test_offset_and_fraction_do_not_change_the_form(text: str, offset_h: int) -> None:
    instant = datetime.fromisoformat(text).astimezone(timezone(timedelta(hours=offset_h)))
    adapter = TypeAdapter(UtcTime)
    assert json.loads(adapter.dump_json(adapter.validate_python(instant))) == text
    assert rfc3339(instant, "since") == text
    assert adapter.validate_json(json.dumps(text)) == instant


def test_no_model_has_times_of_another_type() -> None:
    """Only `UtcTime` says how a time is written."""
    for package in (livessl.schema, livessl.server.api, livessl.federation, livessl.client):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            import_module(module.name)
    found = {
        f"{model.__name__}.{name}": (*field.metadata, *parts_of(field.annotation))
        for model in subclasses(BaseModel)
        if model.__module__.startswith("livessl.")
        for name, field in model.model_fields.items()
        if {datetime, AwareDatetime} & set(parts_of(field.annotation))
    }
    wrong = [name for name, parts in found.items() if not any(isinstance(each, PlainSerializer) for each in parts)]
    assert wrong == []
    assert len(found) > 20


def subclasses(model: type[BaseModel]) -> list[type[BaseModel]]:
    found: list[type[BaseModel]] = []
    for below in model.__subclasses__():
        found += [below, *subclasses(below)]
    return found


def parts_of(annotation: Any) -> list[Any]:
    """An annotation, and all that it is made of."""
    inner = [part for each in get_args(annotation) for part in parts_of(each)]
    return [annotation, *getattr(annotation, "__metadata__", ()), *inner]
