"""The gate in front of the HTTP application: every route and WebSocket with every role, and limits of requests."""

from __future__ import annotations

import json
import logging
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from livessl.clock import SystemClock
from livessl.errors import ConfigError
from livessl.server.api.auth import MAX_BODY_BYTES, RELOAD_S, needed_role
from livessl.server.api.stream import STREAM
from livessl.server.app import Server
from livessl.server.http import MAX_HEAD_BYTES
from livessl.site.tokens import Role, add_token, revoke_token
from small_site import HANG_S, running_server, site_of, wait_until, write_site

TOKENED = {"server.http.tokens": "tokens.yaml"}
ROLES: list[Role | None] = [None, *Role]


class Secured:
    """A server with tokens, and one token of each role."""

    def __init__(self, server: Server, tokens: dict[Role, str]) -> None:
        self.server = server
        self.tokens = tokens

    def ask(self, path: str, role: Role | None, method: str = "GET", **more: Any) -> httpx.Response:
        return httpx.request(method, f"{self.server.url}{path}", headers=self.headers(role), **more)

    def headers(self, role: Role | None) -> dict[str, str]:
        return {} if role is None else {"Authorization": f"Bearer {self.tokens[role]}"}

    def live(self, path: str = "live", **more: Any) -> Any:
        return connect(f"ws{self.server.url.removeprefix('http')}/api/v1/{path}", open_timeout=HANG_S, **more)

    def routes(self) -> set[str]:
        """Every path of the OpenAPI description, with examples in place of its parameters."""
        described = self.ask("/api/v1/openapi.json", Role.VIEWER).json()
        return {path.format(event_id="small-0", name="north", number=1, key="k") for path in described["paths"]}


def listen(live: ClientConnection) -> None:
    """Receive messages until the server closes the WebSocket."""
    while True:
        live.recv(timeout=HANG_S)


def raw(url: str, data: bytes, until: bytes | None = None) -> bytes:
    """Send bytes; return the answer up to a text in it or to the end of the connection."""
    with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), timeout=HANG_S) as connection:
        answer = b""
        try:
            connection.sendall(data)
            while not (until and until in answer) and (part := connection.recv(65536)):
                answer += part
        except ConnectionError:  # the server closed the connection before it had read everything
            pass
        return answer


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    directory = tmp_path_factory.mktemp("site")
    tokens = {role: add_token(directory / "tokens.yaml", str(role), str(role)) for role in Role}  # type: ignore[arg-type]
    with running_server(site_of(TOKENED, directory)) as server:
        yield Secured(server, tokens)


PUBLIC = {"/", "/static/app.js", "/static/index.html", "/api/v1/health"}
FOR_ADMINS = {"/api/v1/access", "/api/v1/log"}
FOR_OPERATORS = {f"/api/v1/events/small-0/clips/{name}" for name in ("best", "keep", "north")}


@pytest.mark.parametrize("role", ROLES)
def test_every_route_is_for_its_roles(secured: Secured, role: Role | None) -> None:
    for path in secured.routes() | PUBLIC | {"/api/v1/openapi.json", "/api/v1/nothing", "/static"}:
        method = "HEAD" if path == STREAM else "GET"  # the body of a stream never ends
        status = secured.ask(path, role, method).status_code
        if path in PUBLIC:
            assert status == 200, path
        elif role is None:
            assert status == 401, path
        elif (path in FOR_ADMINS and role < Role.ADMIN) or (path in FOR_OPERATORS and role < Role.OPERATOR):
            assert status == 403, path
        else:
            assert status in (200, 204, 307, 404, 405, 422), path


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE", "TRACE", "INVENTED"])
def test_other_methods_need_an_operator(secured: Secured, role: Role | None, method: str) -> None:
    """The role is checked first: only operators learn that the method does not exist."""
    expected = {None: 401, Role.VIEWER: 403, Role.OPERATOR: 405, Role.ADMIN: 405}[role]
    assert secured.ask("/api/v1/site", role, method).status_code == expected
    assert secured.ask("/api/v1/health", role, method).status_code == expected


@pytest.mark.parametrize("role", ROLES)
def test_disabling_an_array_needs_an_operator(secured: Secured, role: Role | None) -> None:
    expected = {None: 401, Role.VIEWER: 403, Role.OPERATOR: 200, Role.ADMIN: 200}[role]
    for enabled in (False, True):
        answer = secured.ask("/api/v1/arrays/north/enabled", role, "PUT", json={"enabled": enabled})
        assert answer.status_code == expected
        arrays = secured.ask("/api/v1/arrays", Role.VIEWER).json()["arrays"]
        assert arrays[0]["enabled"] is (enabled or expected != 200)


def test_new_and_revoked_tokens_take_effect_without_a_restart(tmp_path: Path) -> None:
    """A WebSocket that was opened with a revoked token is closed with a reason; the others stay open."""
    path = tmp_path / "tokens.yaml"
    tokens = {Role.VIEWER: add_token(path, "wall", "viewer"), Role.ADMIN: add_token(path, "boss", "admin")}
    with running_server(site_of(TOKENED, tmp_path)) as server:
        secured = Secured(server, tokens)
        with (
            secured.live(additional_headers=secured.headers(Role.VIEWER)) as wall,
            secured.live(additional_headers=secured.headers(Role.ADMIN)) as boss,
        ):
            tokens[Role.OPERATOR] = add_token(path, "desk", "operator")
            wait_until(lambda: secured.ask("/api/v1/site", Role.OPERATOR).status_code == 200, "the new token")
            revoke_token(path, "wall")
            with pytest.raises(ConnectionClosed) as caught:
                listen(wall)
            assert caught.value.rcvd is not None
            assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, "the token is no longer valid")
            assert secured.ask("/api/v1/site", Role.VIEWER).status_code == 401
            path.chmod(0o644)  # a file that others can read is refused: the tokens of before stay valid
            path.touch()
            time.sleep(2 * RELOAD_S)
            assert secured.ask("/api/v1/site", Role.OPERATOR).status_code == 200
            path.unlink()
            wait_until(lambda: secured.ask("/api/v1/site", Role.ADMIN).status_code == 401, "the end of all tokens")
            with pytest.raises(ConnectionClosed):
                listen(boss)


def test_paths_without_a_route_are_guarded() -> None:
    assert needed_role("GET", "/api/v9/anything") is Role.VIEWER
    assert needed_role("DELETE", "/api/v9/anything") is Role.OPERATOR
    assert needed_role("GET", "/staticky") is Role.VIEWER
    assert needed_role("POST", "/static/app.js") is Role.OPERATOR
    assert needed_role("POST", "/api/v1/access") is Role.ADMIN
    assert needed_role("GET", "/api/v1/access\n") is Role.ADMIN  # the router ignores a last newline, too
    assert needed_role("GET", "/api/v1/listen\n") is Role.OPERATOR
    assert needed_role("GET", "/api/v1/events/a/clips/b\n.flac") is Role.OPERATOR


@pytest.mark.parametrize("path", ["access", "access%0A"])
def test_newline_in_a_path_opens_nothing(secured: Secured, path: str) -> None:
    assert secured.ask(f"/api/v1/{path}", Role.OPERATOR).status_code == 403


@pytest.mark.parametrize("role", list(Role))
def test_live_with_a_token(secured: Secured, role: Role) -> None:
    """Programs send the token in a header; browsers offer it among the protocols."""
    with secured.live(additional_headers=secured.headers(role)) as live:
        assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
        assert live.subprotocol is None
    offered = [Subprotocol("livessl"), Subprotocol(f"livessl.token.{secured.tokens[role]}")]
    with secured.live(subprotocols=offered) as live:
        assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
        assert live.subprotocol == "livessl"  # and never the one with the token


@pytest.mark.parametrize("role", list(Role))
def test_map_with_a_token(secured: Secured, role: Role) -> None:
    with secured.live("map", additional_headers=secured.headers(role)) as watching:
        assert watching.ping().wait(timeout=HANG_S)  # the connection is open and stays open


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"additional_headers": {"Authorization": "Bearer livessl_wrong"}},
        {"additional_headers": {"Authorization": "Basic bGl2ZXNzbA=="}},
        {"subprotocols": [Subprotocol("livessl")]},
        {"subprotocols": [Subprotocol("livessl"), Subprotocol("livessl.token.wrong")]},
    ],
)
@pytest.mark.parametrize("path", ["live", "map", "nothing"])
def test_socket_without_a_token_is_not_opened(secured: Secured, path: str, more: dict[str, Any]) -> None:
    with pytest.raises(InvalidStatus) as caught:
        secured.live(path, **more)
    assert caught.value.response.status_code == 403


@pytest.mark.parametrize(
    "header",
    [
        "",
        "Bearer",
        "bearer livessl_wrong",
        "Basic TOKEN",
        "TOKEN",
        "Bearer TOKENx",
        "Bearer \xff",
        "Bearer a b",
    ],
)
def test_wrong_credentials_are_no_credentials(secured: Secured, header: str) -> None:
    value = header.replace("TOKEN", secured.tokens[Role.VIEWER]).encode("latin-1")
    response = httpx.get(f"{secured.server.url}/api/v1/site", headers={b"Authorization": value})
    assert response.status_code == 401
    assert response.headers["WWW-Authenticate"] == 'Bearer realm="livessl"'
    assert response.json() == {"detail": "expected a valid token; send it as Authorization: Bearer TOKEN"}
    assert response.headers["X-Content-Type-Options"] == "nosniff"


def test_token_in_the_query_is_not_accepted(secured: Secured) -> None:
    """Addresses are kept in histories and logs."""
    assert secured.ask(f"/api/v1/site?token={secured.tokens[Role.ADMIN]}", None).status_code == 401


def test_case_of_the_scheme_does_not_matter(secured: Secured) -> None:
    for scheme in ("Bearer", "bearer", "BEARER"):
        headers = {"Authorization": f"{scheme} {secured.tokens[Role.VIEWER]}"}
        assert httpx.get(f"{secured.server.url}/api/v1/site", headers=headers).status_code == 200


def test_health_without_a_token_holds_the_status_only(secured: Secured) -> None:
    assert secured.ask("/api/v1/health", None).json() == {"v": 1, "status": "starting"}
    assert secured.ask("/api/v1/health", Role.VIEWER).json()["arrays"] == {"north": "starting", "south": "starting"}


def test_health_reports_what_is_secured(secured: Secured) -> None:
    assert secured.ask("/api/v1/health", Role.VIEWER).json()["secured"] == {
        "nodes": False,
        "tokens": True,
        "tls": False,
    }


def test_openapi_describes_the_token(secured: Secured) -> None:
    described = secured.ask("/api/v1/openapi.json", Role.VIEWER).json()
    assert described["security"] == [{"token": []}]
    assert described["components"]["securitySchemes"] == {"token": {"type": "http", "scheme": "bearer"}}
    for path, methods in described["paths"].items():
        for described in methods.values():
            assert {"401", "403"} <= set(described["responses"]), path


def test_admins_see_clients_and_refusals(secured: Secured) -> None:
    secured.ask("/api/v1/site", None)
    seen = secured.ask("/api/v1/access", Role.ADMIN).json()
    assert seen["clients"] == [{"name": str(role), "role": str(role)} for role in Role]
    assert seen["nodes"] == []
    [refused] = [r for r in seen["refused"] if r["reason"].startswith("expected a valid token")]
    assert (refused["door"], refused["who"]) == ("http", "127.0.0.1")
    assert refused["count"] >= 1


def refused_count(secured: Secured, reason: str) -> float:
    text = secured.ask("/metrics", Role.VIEWER).text
    found = [line for line in text.splitlines() if line.startswith("livessl_refused_total{") and reason in line]
    return sum(float(line.rpartition(" ")[2]) for line in found)


def test_refusals_are_counted_and_logged_once(secured: Secured, caplog: pytest.LogCaptureFixture) -> None:
    before = refused_count(secured, "role admin, got one of the role operator")
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            secured.ask("/api/v1/access", Role.OPERATOR)
    assert refused_count(secured, "role admin, got one of the role operator") == before + 5
    assert secured.ask("/api/v1/health", Role.VIEWER).json()["refused"]["http"] >= 5
    assert len([r for r in caplog.records if "got one of the role operator" in r.getMessage()]) <= 1


@pytest.mark.parametrize("length", [MAX_BODY_BYTES + 1, 10**12, 10**19])
def test_body_that_is_too_long_is_not_read(secured: Secured, length: int) -> None:
    token = secured.tokens[Role.OPERATOR]
    head = f"POST /api/v1/site HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\nContent-Length: {length}\r\n\r\n"
    assert raw(secured.server.url, head.encode() + b"x", until=b"\r\n").startswith(b"HTTP/1.1 413")


def test_body_of_unknown_length_is_not_read(secured: Secured) -> None:
    assert secured.ask("/api/v1/site", Role.OPERATOR, "POST", content=iter([b"x", b"y"])).status_code == 411


def test_body_within_the_limit_reaches_the_routes(secured: Secured) -> None:
    assert secured.ask("/api/v1/site", Role.OPERATOR, "POST", content=bytes(MAX_BODY_BYTES)).status_code == 405


def test_head_that_is_too_long_is_not_read(secured: Secured) -> None:
    for head in (b"GET /" + b"x" * 8 * MAX_HEAD_BYTES, b"GET / HTTP/1.1\r\nX-A: " + b"x" * 8 * MAX_HEAD_BYTES):
        answer = raw(secured.server.url, head)
        assert not answer or answer.startswith(b"HTTP/1.1 400")
    assert secured.ask("/api/v1/health", None).status_code == 200


@pytest.mark.processes
def test_token_is_in_no_log(tmp_path: Path) -> None:
    """The most verbose log holds no token, whether it was right or wrong and wherever the request had it."""
    tokens = {role: add_token(tmp_path / "tokens.yaml", str(role), str(role)) for role in Role}  # type: ignore[arg-type]
    site = write_site(tmp_path, TOKENED)
    command = [sys.executable, "-m", "livessl", "--verbose", "serve", "--site", str(site)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = [process.stderr.readline()]
        while "dashboard on" not in lines[-1]:
            assert lines[-1], lines
            lines.append(process.stderr.readline())
        url = lines[-1].rpartition(" ")[2].strip()
        try:
            for token in tokens.values():
                for header in (f"Bearer {token}", f"Basic {token}", f"Bearer {token}x"):
                    httpx.get(f"{url}/api/v1/access", headers={"Authorization": header})
                httpx.get(f"{url}/api/v1/site?token={token}")
                offered = [Subprotocol("livessl"), Subprotocol(f"livessl.token.{token}")]
                with connect(f"ws{url.removeprefix('http')}/api/v1/live", subprotocols=offered) as live:
                    live.recv(timeout=HANG_S)
                raw(url, f"GET / HTTP/1.1\r\nAuthorization: Bearer {token}\r\nbroken\r\n\r\n".encode())
        finally:
            process.terminate()
            lines.append(process.stderr.read())
    log = "".join(lines)
    assert "was refused" in log
    for role, token in tokens.items():
        assert token.removeprefix("livessl_") not in log, role


def test_server_does_not_start_without_its_file_of_tokens(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"tokens\.yaml: cannot be read: No such file"):
        Server(site_of(TOKENED, tmp_path), SystemClock())


def test_server_with_tokens_behind_a_proxy_answers_to_any_host_name(secured: Secured) -> None:
    """DNS rebinding gains nothing there: a foreign page does not know a token."""
    headers = {**secured.headers(Role.VIEWER), "Host": "livessl.example.org"}
    assert httpx.get(f"{secured.server.url}/api/v1/site", headers=headers).status_code == 200


def test_without_tokens_every_local_client_is_an_admin() -> None:
    with running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/access").json()["clients"] == []
        assert httpx.post(f"{server.url}/api/v1/site").status_code == 405
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert health["secured"] == {"nodes": False, "tokens": False, "tls": False}
        assert health["refused"] == {"nodes": 0, "http": 0}
