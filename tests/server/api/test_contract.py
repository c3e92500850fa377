"""The check of every message and answer against the models: it passes over real ones, and it can fail."""

from __future__ import annotations

import json

import httpx
import pytest
from fastapi import Response
from websockets.sync.client import connect

from api_contract import Contract
from livessl.server.api import live, queries, routes
from livessl.server.fanout import Fanout
from small_site import HANG_S, running_server, site_of


def test_all_messages_and_answers_are_checked(contract: Contract) -> None:
    messages, answers = contract.messages, contract.answers
    with running_server(site_of()) as server:
        with connect(f"ws{server.url.removeprefix('http')}/api/v1/live", open_timeout=HANG_S) as socket:
            for _ in range(3):
                socket.recv(timeout=HANG_S)
        assert httpx.get(f"{server.url}/api/v1/arrays").status_code == 200
        assert httpx.get(f"{server.url}/api/v1/events/none").status_code == 404
    assert contract.messages - messages >= 5  # three as sent, two of them as published
    assert contract.answers - answers == 2


def test_a_field_that_the_model_lacks_is_found(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    described = routes.describe_site
    monkeypatch.setattr(routes, "describe_site", lambda *parts: {**described(*parts), "colour": "red"})
    with contract.broken() as faults, running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/site").json()["colour"] == "red"
    [fault] = faults
    assert "GET /api/v1/site -> 200" in fault
    assert "colour" in fault


def test_a_wrong_value_in_a_message_is_found(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "API_VERSION", 2)
    with contract.broken() as faults, running_server(site_of()) as server:
        socket = connect(f"ws{server.url.removeprefix('http')}/api/v1/live", open_timeout=HANG_S)
        with socket:
            assert json.loads(socket.recv(timeout=HANG_S))["v"] == 2
    assert any("hello.v" in fault for fault in faults)


@pytest.mark.parametrize(
    ("change", "fault"),
    [({"kind": "rumour"}, "rumour"), ({"mode": "dead"}, "mode"), ({"now_utc": "noon"}, "now_utc"), ({"x": 1}, "x")],
)
def test_a_wrong_message_is_found_without_subscribers(
    contract: Contract, change: dict[str, object], fault: str
) -> None:
    right: dict[str, object] = {
        "kind": "arrays",
        "now_utc": "2026-01-31T12:00:00Z",
        "mode": "live",
        "arrays": [],
        "overload": None,
    }
    with contract.broken() as faults:
        fanout = Fanout()
        contract.watch(fanout)
        fanout.publish(right)
        assert faults == []
        fanout.publish({**right, **change})
        [found] = faults
    assert fault in found


def test_an_exception_in_a_route_is_found(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "describe_site", lambda *_: 1 / 0)
    with contract.broken() as faults, running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/site").status_code == 500
    [fault] = faults
    assert "ZeroDivisionError" in fault


def test_a_status_that_is_not_described_is_found(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "describe_site", lambda *_: {"v": 1})
    monkeypatch.setattr(routes, "as_json", lambda found: Response("{}", 418, media_type="application/json"))
    with contract.broken() as faults, running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/site").status_code == 418
    assert "GET /api/v1/site -> 418: status 418 with content 'application/json' is not described" in faults


def test_a_refusal_that_names_nothing_of_the_request_is_found(
    contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(routes, "unprocessable", lambda _, what: queries.unprocessable("colour", what))
    with contract.broken() as faults, running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/map?view=volume").status_code == 422
    assert faults == ["GET /api/v1/map -> 422: ('query', 'colour') is nothing of the request"]
