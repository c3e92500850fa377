"""Pages of other origins: nothing is permitted by default, and what the site file permits is reading and framing."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from livessl.errors import ConfigError
from livessl.site.tokens import add_token
from scene_server import live
from small_site import HANG_S, Changes, running_server, site_of

PAGE = "https://intranet.example"
ALLOWED: Changes = {"server.http.allowed_origins": [PAGE], "server.http.frame_ancestors": [PAGE]}
ASKS = {"Origin": PAGE, "Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization"}


def test_nothing_is_permitted_by_default() -> None:
    with running_server(site_of()) as server:
        answer = httpx.get(f"{server.url}/api/v1/site", headers={"Origin": PAGE})
        assert "access-control-allow-origin" not in answer.headers
        assert answer.headers["content-security-policy"].endswith("frame-ancestors 'self'")
        assert "access-control-allow-origin" not in httpx.options(f"{server.url}/api/v1/site", headers=ASKS).headers
        with live(server, origin=PAGE) as socket, pytest.raises(ConnectionClosed):
            socket.recv(timeout=HANG_S)


def test_permitted_page_may_read_with_a_token_and_change_nothing(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "page", "operator")
    changes = {**ALLOWED, "server.http.tokens": "tokens.yaml"}
    with running_server(site_of(changes, tmp_path)) as server:
        url, header = f"{server.url}/api/v1/events", "access-control-allow-origin"
        asked = httpx.options(url, headers=ASKS)
        assert (asked.status_code, asked.headers[header]) == (200, PAGE)
        assert "Authorization" in asked.headers["access-control-allow-headers"]
        answer = httpx.get(url, headers={"Origin": PAGE, "Authorization": f"Bearer {token}"})
        assert (answer.status_code, answer.headers[header]) == (200, PAGE)
        assert "ETag" in answer.headers["access-control-expose-headers"]
        refused = httpx.get(url, headers={"Origin": PAGE})
        assert (refused.status_code, refused.headers[header]) == (401, PAGE)  # so that the page can say why
        assert httpx.options(url, headers={**ASKS, "Access-Control-Request-Method": "PUT"}).status_code == 400
        assert header not in httpx.options(url, headers={**ASKS, "Origin": "https://evil.example"}).headers
        policy = answer.headers["content-security-policy"]
        assert policy.endswith(f"frame-ancestors 'self' {PAGE}")


def test_permitted_page_may_open_the_websocket() -> None:
    with running_server(site_of(ALLOWED)) as server:
        with live(server, origin=PAGE) as socket:
            assert "hello" in socket.recv(timeout=HANG_S)
        for page in (f"{PAGE}:444", "http://intranet.example", "https://x.intranet.example"):
            with live(server, origin=page) as socket, pytest.raises(ConnectionClosed):
                socket.recv(timeout=HANG_S)


@pytest.mark.parametrize("name", ["allowed_origins", "frame_ancestors"])
@pytest.mark.parametrize(
    "origin", ["*", "intranet.example", "https://a.example/path", "https://a.example; script-src *"]
)
def test_anything_but_an_origin_is_refused(name: str, origin: str) -> None:
    with pytest.raises(ConfigError, match=rf"server\.http\.{name}.*expected the origin of a page without a path"):
        site_of({f"server.http.{name}": [origin]})
