"""The AsyncAPI description of the WebSockets: its form, and that it holds all that can be asked for and sent."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from livessl.server.api.queries import KINDS
from livessl.server.app import Server
from livessl.server.maps import HEADER
from livessl.site.tokens import add_token
from small_site import running_server, site_of

PATH = "/api/v1/asyncapi.json"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


@pytest.fixture(scope="module")
def described(server: Server) -> dict[str, Any]:
    found: dict[str, Any] = httpx.get(f"{server.url}{PATH}").json()
    return found


def follow(document: dict[str, Any], reference: str) -> Any:
    found: Any = document
    for key in reference.removeprefix("#/").split("/"):
        found = found[key]
    return found


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if isinstance(value.get("$ref"), str):
            yield value["$ref"]
        for part in value.values():
            yield from references(part)
    elif isinstance(value, list):
        for part in value:
            yield from references(part)


def test_every_reference_leads_somewhere(described: dict[str, Any]) -> None:
    found = set(references(described))
    assert len(found) > 20
    for reference in found:
        follow(described, reference)


def test_server_is_the_one_that_was_asked(server: Server, described: dict[str, Any]) -> None:
    assert described["asyncapi"] == "3.0.0"
    [here] = described["servers"].values()
    assert (here["protocol"], here["host"]) == ("ws", server.url.removeprefix("http://"))
    assert "security" not in here


def test_unknown_query_parameter_is_refused(server: Server) -> None:
    answer = httpx.get(f"{server.url}{PATH}?form=yaml")
    assert answer.status_code == 422
    assert answer.json()["detail"][0]["loc"] == ["query", "form"]


def test_every_kind_of_message_is_described(described: dict[str, Any]) -> None:
    live = described["channels"]["live"]
    assert live["address"] == "/api/v1/live"
    messages = [follow(described, message["$ref"]) for message in live["messages"].values()]
    kinds = {message["name"]: follow(described, message["payload"]["$ref"]) for message in messages}
    assert set(kinds) == KINDS | {"hello", "gap"}
    for kind, schema in kinds.items():
        assert schema["properties"]["kind"]["const"] == kind
        assert {"kind", "v"} <= set(schema["required"])
        assert ("seq" in schema["required"]) == (kind != "gap")


def test_operations_send_all_messages_of_their_channel(described: dict[str, Any]) -> None:
    for operation in described["operations"].values():
        assert operation["action"] == "send"
        channel = follow(described, operation["channel"]["$ref"])
        assert [follow(described, message["$ref"]) for message in operation["messages"]] == list(
            channel["messages"].values()
        )


def test_queries_are_described(described: dict[str, Any]) -> None:
    def query(channel: str) -> dict[str, Any]:
        found: dict[str, Any] = described["channels"][channel]["bindings"]["ws"]["query"]["properties"]
        return found

    assert list(query("live")) == ["kinds", "min_confidence", "zone", "track", "max_rate_hz", "since_seq"]
    assert list(query("map")) == ["array", "views"]
    assert (query("live")["min_confidence"]["minimum"], query("live")["min_confidence"]["maximum"]) == (0, 1)


def test_picture_is_described_as_it_is_packed(described: dict[str, Any]) -> None:
    picture = described["components"]["messages"]["Picture"]
    assert picture["contentType"] == "application/octet-stream"
    text = re.sub(r"\s+", " ", picture["description"])
    assert f"a header of {HEADER.size} bytes" in text
    fields = re.findall(r"(\d?) ?(bytes|u?int\d+|float32)\b", text.partition("The header holds:")[2])
    codes = {"bytes": "s", "uint8": "B", "uint16": "H", "int64": "q", "float32": "f"}
    packed = "".join(code * (1 if code == "s" else int(n or 1)) for n, form in fields for code in codes[form])
    assert packed == "sBBHqfffffffHH"
    assert HEADER.format == "<4sBBHq7f2H"


def test_token_is_described(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of({"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        assert httpx.get(f"{server.url}{PATH}").status_code == 401
        described = httpx.get(f"{server.url}{PATH}", headers={"Authorization": f"Bearer {token}"}).json()
    [security] = described["servers"]["site"]["security"]
    scheme = follow(described, security["$ref"])
    assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")
    assert "livessl.token.TOKEN" in scheme["description"]
