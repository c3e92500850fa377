"""Holds every message and every answer of the servers and hubs that tests run against the models of the API.

A plugin of pytest: it watches each application that a `Server` or a `HubServer` makes. What breaks the contract makes
the test that ran at that moment fail.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Final

import orjson
import pytest
from fastapi import FastAPI
from pydantic import TypeAdapter, ValidationError
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.types import Message as Sent

from livessl.federation.app import create_hub_app
from livessl.federation.archive import Archive
from livessl.federation.config import Hub
from livessl.federation.intake import Intake
from livessl.schema.answers import Error, HTTPValidationError
from livessl.schema.messages import Message
from livessl.server.api.app import create_app
from livessl.server.api.auth import Access
from livessl.server.api.live import LIVE
from livessl.server.fanout import Fanout
from livessl.server.parts import Parts
from livessl.server.refusals import Refusals

UNMODELLED: Final = ("/api/v1/openapi.json", "/api/v1/asyncapi.json")
"""JSON whose form others define."""


class Contract:
    """Counts of checked messages and answers, and the faults found in them."""

    def __init__(self) -> None:
        self.faults: list[str] = []
        self.messages = 0
        self.answers = 0
        self.paths: dict[str, dict[str, Any]] = {}

    def take(self) -> list[str]:
        """The faults since the last call."""
        faults, self.faults = self.faults, []
        return faults

    @contextmanager
    def broken(self) -> Iterator[list[str]]:
        """Collect the faults of a context in a list instead of failing the test."""
        before, faults = self.take(), []  # type: tuple[list[str], list[str]]
        self.faults = faults
        try:
            yield faults
        finally:
            self.faults = before

    def check(self, model: Any, text: str | bytes, what: str) -> None:
        """Note a fault unless a JSON text is an instance of a model in strict mode, without further fields."""
        try:
            _adapter(model).validate_json(text, strict=True, extra="forbid")
        except ValidationError as error:
            self.faults.append(f"{what}: {error}\n{text[:500]!r}")

    def check_message(self, text: str | bytes) -> None:
        """Check a message of the live WebSocket."""
        self.messages += 1
        self.check(Message, text, "message")

    def check_answer(self, kind: str, scope: Scope, status: int, headers: dict[bytes, bytes], body: bytes) -> None:
        """Check a REST answer of a kind of application against what its route and the OpenAPI description declare."""
        path, route = scope["path"].removeprefix(scope["root_path"]), scope.get("route")
        if not path.startswith("/api/") or path in UNMODELLED:
            return
        self.answers += 1
        what = f"{scope['method']} {path} -> {status}"
        form = headers.get(b"content-type", b"").decode()
        model = HTTPValidationError if status == 422 else Error
        if route is not None and status != 405:
            method = scope["method"].replace("HEAD", "GET").lower()
            operation = self.paths[kind][route.path][method]
            described = operation["responses"]
            if status == 422:
                self.faults += [f"{what}: {fault}" for fault in misplaced(operation, orjson.loads(body or b"{}"))]
            if str(status) not in described or form not in described[str(status)].get("content", [""]):
                self.faults.append(f"{what}: status {status} with content {form!r} is not described")
            model = route.response_model if status == 200 else route.responses.get(status, {}).get("model", model)
        if form == "application/json" and body:
            self.check(model, body, what)

    def watch(self, fanout: Fanout) -> None:
        """Check all that a fan-out publishes, with or without subscribers."""
        publish = fanout.publish

        def checked(message: dict[str, Any], *rest: Any) -> None:
            publish(message, *rest)
            self.check_message(orjson.dumps({"v": 1, "seq": fanout.last_seq, **message}))

        vars(fanout)["publish"] = checked


CONTRACT: Final = Contract()


def misplaced(operation: dict[str, Any], refusal: dict[str, Any]) -> list[str]:
    """Faults of a 422 whose `loc` names nothing of the request: no parameter, or a body that there is not."""
    known = {(each["in"], each["name"]) for each in operation.get("parameters", [])}
    places = [tuple(fault["loc"]) for fault in refusal.get("detail", []) if fault["type"] != "extra_forbidden"]
    if "requestBody" in operation:
        places = [place for place in places if place[0] != "body"]
    return [f"{place} is nothing of the request" for place in places if place[:2] not in known]


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    return TypeAdapter(model)


class Checked:
    """ASGI middleware that checks what leaves the application."""

    def __init__(self, app: ASGIApp, kind: str) -> None:
        self._app = app
        self._kind = kind

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        started: dict[str, Any] = {}
        body = bytearray()

        async def checked(message: Sent) -> None:
            if message["type"] == "websocket.send" and scope["path"] == LIVE:
                CONTRACT.check_message(message["text"])
            elif message["type"] == "http.response.start":
                started.update(message)
            elif message["type"] == "http.response.body":
                body.extend(message.get("body", b""))
                if not message.get("more_body"):
                    CONTRACT.check_answer(self._kind, scope, started["status"], dict(started["headers"]), bytes(body))
            await send(message)

        try:
            await self._app(scope, receive, checked)
        except Exception as error:
            CONTRACT.faults.append(f"{scope['type']} {scope['path']}: {error!r}")
            raise


def pytest_configure(config: pytest.Config) -> None:
    """Watch every application that a server makes from now on."""
    monkey = pytest.MonkeyPatch()
    config.add_cleanup(monkey.undo)

    def check_answers(kind: str, application: FastAPI, access: Access) -> FastAPI:
        application.add_middleware(Checked, kind=kind)
        if access.wanted or kind not in CONTRACT.paths:  # with tokens, more statuses are described
            CONTRACT.paths[kind] = application.openapi()["paths"]
        return application

    def watched(parts: Parts, access: Access) -> FastAPI:
        CONTRACT.watch(parts.fanout)
        return check_answers("server", create_app(parts, access), access)

    def watched_hub(hub: Hub, archive: Archive, intake: Intake, access: Access, refusals: Refusals) -> FastAPI:
        return check_answers("hub", create_hub_app(hub, archive, intake, access, refusals), access)

    monkey.setattr("livessl.server.app.create_app", watched)
    monkey.setattr("livessl.federation.app.create_hub_app", watched_hub)


@pytest.fixture(autouse=True)
def _contract_of_the_api() -> Iterator[None]:
    """The test fails if a message or an answer breaks the contract meanwhile."""
    yield
    faults = CONTRACT.take()
    if faults:
        pytest.fail("\n".join(faults))


@pytest.fixture
def contract() -> Contract:
    """The check that runs beside all tests."""
    return CONTRACT
