"""Errors of every route of a server and a hub: one shape for each status, and 404 for what does not exist."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from hub_desk import make_hub, running_hub
from livessl.schema.answers import Error, HTTPValidationError
from small_site import running_server, site_of

NO_TEXT = b"\x11\xff"
NOBODY = "nats://127.0.0.1:1"

UNCHECKED = ("/metrics",)
"""Prometheus may be set up with parameters of its own."""

UNKNOWN: list[tuple[str, str, Any]] = [
    ("GET", "events/none", None),
    ("GET", "events/no%00ne", None),
    ("GET", "events/none/clips", None),
    ("GET", "events/none/clips/best", None),
    ("GET", "events/none/clips/enhanced.flac", None),
    ("PUT", "events/none/clips/keep", {"keep": True}),
    ("DELETE", "events/none/clips", None),
    ("POST", "events/none/relocate", {}),
    ("GET", "point?camera=door&event=none", None),
    ("GET", "point?camera=none&event=none", None),
    ("GET", "events?zone=none", None),
    ("GET", "events?array=none", None),
    ("GET", "events.csv?zone=none", None),
    ("GET", "history/heat-map?zone=none", None),
    ("GET", "event-log?zone=none", None),
    ("GET", "zone-changes?zone=none", None),
    ("DELETE", "zones/none", None),
    ("GET", "map?array=none", None),
    ("PUT", "arrays/none/enabled", {"enabled": False}),
    ("GET", "alerts?rule=none", None),
    ("GET", "alerts/none/picture.png", None),
    ("PUT", "alerts/rules/none/armed", {"armed": False}),
    ("GET", "alerts/rules/none/dry-run", None),
    ("POST", "alerts/dead-letters/1/resend", None),
    ("DELETE", "alerts/dead-letters/1", None),
    ("POST", "set-up/verify", {"claps": [{"number": 1, "place_m": [1.0, 1.0, 1.0]}]}),
    ("POST", "set-up/move", {"arrays": {"none": {"position_m": [1.0, 1.0, 1.0], "turn_deg": [0.0, 0.0, 0.0]}}}),
    ("POST", "set-up/refine", {"known": ["none"]}),
    ("POST", "set-up/accept", {"id": "none"}),
    ("GET", "none", None),
]


@pytest.fixture(scope="module")
def server_url() -> Iterator[str]:
    cameras = {"door": {"position_m": [0.1, 0.1, 2.5], "orientation_deg": {"yaw": 45}}}
    with running_server(site_of({"cameras": cameras})) as server:
        yield server.url


@pytest.fixture(scope="module")
def hub_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_hub(make_hub("hub.sqlite", [NOBODY], tmp_path_factory.mktemp("hub"))) as hub:
        yield hub.url


def bad_requests(method: str, address: str, operation: dict[str, Any]) -> Iterator[httpx.Request]:
    """Requests to an operation, each with one bad value: an unknown parameter, each known one, a body."""
    parameters = operation.get("parameters", [])
    names = {each["name"]: "1" for each in parameters if each["in"] == "path"}
    usual = address.format(**names)
    yield httpx.Request(method, usual, params={"no_such": "1"})
    for each in parameters:
        schema, name = each["schema"], each["name"]
        options = schema.get("anyOf", [schema])
        if not any("enum" in option or option.get("type") in ("number", "integer") for option in options):
            continue
        if each["in"] == "path":
            yield httpx.Request(method, address.format(**{**names, name: "bad"}))
        elif each["in"] == "query":
            yield httpx.Request(method, usual, params={name: "bad"})
        else:
            yield httpx.Request(method, usual, headers={name: "bad"})
    for content in (b'{"no_such": 1}', b"[]", b"{", NO_TEXT) if "requestBody" in operation else ():
        yield httpx.Request(method, usual, content=content, headers={"Content-Type": "application/json"})


@pytest.mark.parametrize("kind", ["server", "hub"])
def test_every_route_refuses_bad_values_in_the_same_shape(request: pytest.FixtureRequest, kind: str) -> None:
    """The contract that all tests watch adds that `loc` names something of the request."""
    url, asked = request.getfixturevalue(f"{kind}_url"), 0
    described: dict[str, Any] = httpx.get(f"{url}/api/v1/openapi.json").json()
    with httpx.Client() as client:
        for path, methods in described["paths"].items():
            for method, operation in methods.items() if path not in UNCHECKED else ():
                assert "422" in operation["responses"], path
                for bad in bad_requests(method, f"{url}{path}", operation):
                    answer = client.send(bad)
                    asked += 1
                    is_text = bad.content != NO_TEXT
                    assert answer.status_code == (422 if is_text else 400), (method, path, bad.content)
                    assert answer.headers["content-type"] == "application/json"
                    model = HTTPValidationError if is_text else Error
                    model.model_validate_json(answer.content, strict=True, extra="forbid")
    assert asked > len(described["paths"])


@pytest.mark.parametrize(("method", "path", "body"), UNKNOWN)
def test_what_does_not_exist_is_answered_with_404(server_url: str, method: str, path: str, body: Any) -> None:
    refused(httpx.request(method, f"{server_url}/api/v1/{path}", json=body))


@pytest.mark.parametrize(
    "path",
    [
        "sites/none/events/none",
        "sites/no%00ne/events/none",
        "sites/none",
        *(f"{name}?site=none" for name in ("arrays", "tracks", "alerts", "events")),
        "none",
    ],
)
def test_what_a_hub_does_not_know_is_answered_with_404(hub_url: str, path: str) -> None:
    refused(httpx.get(f"{hub_url}/api/v1/{path}"))


def refused(answer: httpx.Response) -> None:
    assert answer.status_code == 404, answer.text
    Error.model_validate_json(answer.content, strict=True, extra="forbid")


@pytest.mark.parametrize("path", ["arrays", "tracks", "alerts", "events"])
def test_hub_refuses_a_site_with_nul_that_postgresql_cannot_compare(hub_url: str, path: str) -> None:
    answer = httpx.get(f"{hub_url}/api/v1/{path}?site=%00")
    assert answer.status_code == 422
    assert answer.json()["detail"][0]["loc"] == ["query", "site"]
