"""The API under random requests: every answer is as the OpenAPI description says, and none is a 500.

A small part of `schemathesis run`; docs/security.md has the whole command.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.specs.openapi.checks import positive_data_acceptance, response_schema_conformance

from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.site.tokens import add_token
from small_site import running_server, scene_recordings, site_of

UNTOLD = ("/api/v1/event-log", "/api/v1/events", "/api/v1/history/journal", "/api/v1/map", "/api/v1/zones/{name}")
TOO_STRICT = {path: [positive_data_acceptance] for path in UNTOLD} | {
    "/api/v1/stream": [positive_data_acceptance, response_schema_conformance]
}
"""Checks left out by path: the first does not know which cursors exist, that a volume has no picture, or that edges of
a polygon must not cross; the second compares each event of a stream with the schema of its whole text."""


@pytest.fixture(scope="module")
def token(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    directory = tmp_path_factory.mktemp("site")
    return add_token(directory / "tokens.yaml", "fuzz", "admin"), directory


@pytest.fixture(scope="module")
def headers(token: tuple[str, Path]) -> dict[str, str]:
    return {"Authorization": f"Bearer {token[0]}"}


@pytest.fixture(scope="module")
def api(token: tuple[str, Path], headers: dict[str, str]) -> Iterator[Any]:
    """The OpenAPI description of a server that has located something."""
    with running_server(site_of({"server.http.tokens": "tokens.yaml"}, token[1])) as server:
        send_session(
            site_of(), server.endpoint, scene_recordings(0), UnpacedClock(), SystemClock(), "run", lambda: False
        )
        server.wait_idle()
        yield schemathesis.openapi.from_url(f"{server.url}/api/v1/openapi.json", headers=headers)
        assert server.parts.failure is None


def test_answers_are_as_described(api: Any, headers: dict[str, str]) -> None:
    operations = [found.ok() for found in api.get_all_operations()]
    assert len(operations) == sum(len(methods) for methods in api.raw_schema["paths"].values()) > 30
    for operation in operations:

        @settings(max_examples=5, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
        @given(case=operation.as_strategy())
        def answers_as_described(case: Any) -> None:
            case.call_and_validate(headers=headers, excluded_checks=TOO_STRICT.get(case.operation.path, []))

        answers_as_described()


def test_binary_body_is_refused_as_described(api: Any, headers: dict[str, str]) -> None:
    path = "/api/v1/arrays/{name}/enabled"
    answer = httpx.put(
        api.location.replace("/api/v1/openapi.json", path.format(name="north")),
        headers={**headers, "Content-Type": "application/json"},
        content=b"\x11\xff",
    )
    assert answer.status_code == 400
    assert "400" in api.raw_schema["paths"][path]["put"]["responses"]
