"""Requests of every client: HEAD, parameters that do not exist, times in lower case, and what the description says."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from livessl.server.app import Server
from small_site import HANG_S, running_server, site_of

API = "/api/v1"
PATHS = ["/site", "/arrays", "/tracks", "/events", "/map", "/health", "/access"]


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url) as client:
        yield client


@pytest.fixture(scope="module")
def described(server: Server) -> dict[str, Any]:
    found: dict[str, Any] = httpx.get(f"{server.url}{API}/openapi.json").json()
    return found


@pytest.mark.parametrize(
    "path",
    [
        *(f"{API}{path}" for path in PATHS),
        f"{API}/openapi.json",
        f"{API}/asyncapi.json",
        f"{API}/events/none",
        "/",
        "/docs",
        "/metrics",
        "/static/app.js",
    ],
)
def test_head_answers_as_get_without_the_body(client: httpx.Client, path: str) -> None:
    get, head = client.get(path), client.head(path)
    assert head.status_code == get.status_code
    assert head.content == b""
    changing = {"date", "content-length"} if path in (f"{API}/health", f"{API}/arrays", "/metrics") else {"date"}
    assert {name: value for name, value in head.headers.items() if name not in changing} == {
        name: value for name, value in get.headers.items() if name not in changing
    }


def test_every_described_get_route_answers_head(client: httpx.Client, described: dict[str, Any]) -> None:
    """Also those that are added later; parts of paths are names that do not exist."""
    routes = sorted(path for path, methods in described["paths"].items() if "get" in methods)
    assert len(routes) > 20
    for path in (re.sub(r"{\w+}", "1", route) for route in routes):
        with client.stream("GET", path) as answer:  # a stream has no end
            status = answer.status_code
        head = client.head(path)
        assert (head.status_code, head.content) == (status, b""), path


def test_connection_lives_on_after_head(client: httpx.Client) -> None:
    """A body that was sent by mistake would be read as the start of the next answer."""
    for _ in range(3):
        assert client.head(f"{API}/site").status_code == 200
        assert client.get(f"{API}/site").json()["site"] == "small"


@pytest.mark.parametrize(
    ("path", "cure"),
    [
        ("/events?zones=door", "unknown parameter 'zones'; did you mean 'zone'?"),
        ("/events?min-confidence=0.5", "unknown parameter 'min-confidence'; did you mean 'min_confidence'?"),
        ("/map?views=floor", "unknown parameter 'views'; did you mean 'view'?"),
        ("/map?q=1", "unknown parameter 'q'; expected one of array, view, format"),
        ("/site?full=1", "unknown parameter 'full'; this request takes no parameters"),
        ("/events/none?limit=3", "unknown parameter 'limit'; this request takes no parameters"),
    ],
)
def test_unknown_parameter_is_refused(client: httpx.Client, path: str, cure: str) -> None:
    response = client.get(f"{API}{path}")
    assert response.status_code == 422
    name, value = path.partition("?")[2].split("=")
    assert response.json()["detail"] == [
        {"type": "extra_forbidden", "loc": ["query", name], "msg": cure, "input": value}
    ]


@pytest.mark.parametrize(
    "value", ["NaN", "-Infinity", "1e999", '"\\ud800"', "[" * 900 + "]" * 900, '{"\\udfff": NaN}', "null"]
)
def test_value_that_json_cannot_hold_is_refused_like_any_other(client: httpx.Client, value: str) -> None:
    json_type = {"Content-Type": "application/json"}
    for body in (f'{{"enabled": {value}}}', f'{{"enabled": true, "more": {value}}}', value):
        answer = client.put(f"{API}/arrays/north/enabled", content=body, headers=json_type)
        assert answer.status_code == 422
        assert all(set(fault) >= {"loc", "msg", "type"} for fault in answer.json()["detail"])


@pytest.mark.parametrize("content_type", [None, "application/octet-stream", "text/plain"])
def test_bytes_that_are_no_text_are_refused_like_any_other(client: httpx.Client, content_type: str | None) -> None:
    headers = {} if content_type is None else {"Content-Type": content_type}
    answer = client.put(f"{API}/arrays/north/enabled", content=b"\xff{\xfe", headers=headers)
    assert answer.status_code == 422
    assert answer.json()["detail"]


def test_every_unknown_parameter_is_named(client: httpx.Client) -> None:
    faults = client.get(f"{API}/events?zones=a&limit=3&size=4").json()["detail"]
    assert [fault["loc"][1] for fault in faults] == ["zones", "size"]


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("/live?kind=event", "unknown parameter 'kind'; did you mean 'kinds'?"),
        ("/map?view=floor", "unknown parameter 'view'; did you mean 'views'?"),
        (
            "/live?q=1",
            "unknown parameter 'q'; expected one of kinds, min_confidence, zone, track, max_rate_hz, since_seq",
        ),
        (f"/live?{'é' * 100}=1", f"unknown parameter '{'é' * 50}"),
    ],
)
def test_unknown_parameter_of_a_websocket_closes_it(server: Server, path: str, reason: str) -> None:
    with (
        connect(f"ws{server.url.removeprefix('http')}{API}{path}", open_timeout=HANG_S) as socket,
        pytest.raises(ConnectionClosed) as caught,
    ):
        socket.recv(timeout=HANG_S)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1008
    assert caught.value.rcvd.reason.startswith(reason)


@pytest.mark.parametrize("time", ["2024-01-01t00:00:00z", "2024-01-01T00:00:00z", "2024-01-01t00:00:00.5+01:00"])
def test_times_in_lower_case_are_understood(client: httpx.Client, time: str) -> None:
    assert client.get(f"{API}/events", params={"since": time, "until": time}).status_code == 200


def test_every_route_understands_times_in_lower_case(client: httpx.Client, described: dict[str, Any]) -> None:
    timed = [
        (path, parameter["name"])
        for path, methods in described["paths"].items()
        for parameter in methods.get("get", {}).get("parameters", ())
        if "date-time" in str(parameter["schema"]) and "{" not in path
    ]
    assert len(timed) >= 4
    for path, name in timed:
        upper, lower = (
            client.get(path, params={name: time}) for time in ("2024-01-01T00:00:00Z", "2024-01-01t00:00:00z")
        )
        assert lower.status_code == upper.status_code != 422, (path, name)


def test_answers_are_described_by_models(described: dict[str, Any]) -> None:
    for path, methods in described["paths"].items():
        for operation in methods.values():
            for status, answer in operation["responses"].items():
                for form, content in answer.get("content", {}).items():
                    schema = content["schema"]
                    if form == "application/json":
                        assert "$ref" in schema or all("$ref" in option for option in schema["anyOf"]), (path, status)
                    else:
                        assert schema["type"] == "string"


def test_map_is_described_with_its_forms_and_headers(client: httpx.Client, described: dict[str, Any]) -> None:
    answer = described["paths"][f"{API}/map"]["get"]["responses"]["200"]
    assert set(answer["content"]) == {"image/png", "application/octet-stream"}
    assert set(answer["headers"]) == {
        f"X-Map-{name}" for name in ("Shape", "Bounds-M", "Time-Utc", "Age-S", "Min", "Max")
    }


def test_times_enums_and_ranges_are_described(described: dict[str, Any]) -> None:
    schemas = described["components"]["schemas"]
    event = schemas["Event"]["properties"]
    assert {"type": "string", "format": "date-time"}.items() <= event["time_utc"]["anyOf"][0].items()
    assert (event["confidence"]["minimum"], event["confidence"]["maximum"]) == (0, 1)
    assert schemas["Status"]["enum"] == ["located", "direction-only", "refused"]
    assert schemas["TrackState"]["enum"] == ["new", "update", "end"]
    assert schemas["ClockState"]["enum"] == ["settling", "locked", "stepped"]
    assert schemas["Mode"]["enum"] == ["live", "replay"]
    assert schemas["RoleName"]["enum"] == ["viewer", "operator", "admin"]
    parameters = {one["name"]: one["schema"] for one in described["paths"][f"{API}/events"]["get"]["parameters"]}
    assert {"type": "string", "format": "date-time"} in parameters["since"]["anyOf"]


def test_every_field_is_described(described: dict[str, Any]) -> None:
    schemas = described["components"]["schemas"]
    for name, schema in schemas.items():
        assert schema.get("description"), name
        for field, found in schema.get("properties", {}).items():
            reference = found.get("$ref", found.get("items", {}).get("$ref"))
            assert found.get("description") or reference or field in ("kind", "detail"), f"{name}.{field}"


def test_server_ends_without_a_traceback_though_a_client_does_not_read(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with running_server(site_of()) as server:
            address = httpx.URL(server.url)
            client.connect((address.host, address.port))
            client.sendall(f"GET {API}/openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n".encode() * 20)
            assert client.recv(12) == b"HTTP/1.1 200"
    assert "Traceback" not in capfd.readouterr().err
