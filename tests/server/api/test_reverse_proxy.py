"""Behind a reverse proxy: at the root of a name and under a path, with a real nginx and in a browser."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from browser import faultless_page, running_browser, visit
from livessl.server.app import Server
from livessl.site.tokens import add_token
from nginx import example, running_nginx
from small_site import HANG_S, Changes, running_server, site_of

HOST = "Host $http_host"
PUBLIC = "http://site.example"
TRUSTED: Changes = {"server.http.trusted_hosts": ["site.example", "*.lab.example"]}
UNDER_PATH: Changes = {"server.http.root_path": "/livessl"}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@contextmanager
def proxied(
    folder: Path, changes: Changes | None = None, location: str = "/", *, host: str = HOST
) -> Iterator[tuple[Server, str]]:
    """A server behind the documented nginx; `host` replaces its header."""
    with running_server(site_of(changes, folder)) as server:
        block = example(location).replace("http://127.0.0.1:8000", server.url).replace(HOST, host)
        with running_nginx(folder, block) as url:
            yield server, url + location.rstrip("/")


def first_message(url: str, origin: str, **headers: str) -> str:
    """Kind of the first message that a page gets, or the reason why its WebSocket is closed."""
    address = f"ws{url.removeprefix('http')}/api/v1/live"
    with connect(address, origin=Origin(origin), additional_headers=headers, open_timeout=HANG_S) as live:
        try:
            return str(json.loads(live.recv(timeout=HANG_S))["kind"])
        except ConnectionClosed as error:
            closed = error.rcvd
    assert closed is not None
    assert closed.code == 1008
    return closed.reason


@pytest.mark.browser
@pytest.mark.parametrize(("location", "changes"), [("/", {}), ("/livessl/", UNDER_PATH)])
def test_documented_nginx_serves_the_dashboard(
    browser: Browser, tmp_path: Path, location: str, changes: Changes
) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    changes = changes | {"server.http.tokens": "tokens.yaml"}
    with proxied(tmp_path, changes, location) as (_, url), faultless_page(browser) as page:
        opened: list[str] = []
        page.on("websocket", lambda socket: opened.append(socket.url.partition("?")[0]))
        visit(page, f"{url}/")
        page.get_by_role("textbox", name="Access token").fill(token)
        with page.expect_websocket(lambda socket: "/api/v1/map" in socket.url):  # opened after the greeting
            page.keyboard.press("Enter")
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("array-north")).to_be_visible()
        expect(page.get_by_test_id("banner")).to_be_hidden()
        assert set(opened) == {f"ws{url.removeprefix('http')}/api/v1/{name}" for name in ("live", "map")}
        visit(page, f"{url}/docs")
        expect(page.locator("#operations-estimates-get_events_api_v1_events_get")).to_be_visible(timeout=1000 * HANG_S)
        page.locator("#operations-estimates-get_tracks_api_v1_tracks_get .opblock-summary-control").click()
        page.get_by_role("button", name="Try it out").click()
        page.get_by_role("button", name="Execute").click()
        expect(page.locator(".live-responses-table tbody .response-col_status").first).to_contain_text("200")


@pytest.mark.parametrize("keeps_path", [False, True])
def test_path_may_be_removed_by_the_proxy_or_not(tmp_path: Path, keeps_path: bool) -> None:
    with running_server(site_of(UNDER_PATH, tmp_path)) as server:
        passed = f"{server.url}{'' if keeps_path else '/'}"
        block = example("/livessl/").replace("http://127.0.0.1:8000/", passed).replace(HOST, "Host 127.0.0.1")
        with running_nginx(tmp_path, block) as root, httpx.Client(base_url=f"{root}/livessl") as client:
            for path in ("/", "/static/app.js", "/api/v1/site", "/metrics", "/docs", "/docs/start.js"):
                assert client.get(path).status_code == 200, path
            assert client.get("/api/v1/nothing").status_code == 404
            redirected = httpx.get(f"{root}/livessl", headers={"Host": "site.example"})
            assert redirected.headers["Location"].endswith("/livessl/")
            described = client.get("/api/v1/openapi.json").json()
            assert [one["url"] for one in described["servers"]] == ["/livessl"]
            [channels] = client.get("/api/v1/asyncapi.json").json()["servers"].values()
            assert channels["pathname"] == "/livessl"
            assert first_message(f"{root}/livessl", "http://127.0.0.1") == "hello"


def test_server_itself_answers_with_and_without_its_path() -> None:
    with running_server(site_of(UNDER_PATH)) as server:
        for path in ("/", "/livessl/", "/static/app.js", "/livessl/static/app.js", "/livessl/api/v1/site"):
            assert httpx.get(f"{server.url}{path}").status_code == 200, path
        redirect = httpx.get(f"{server.url}/livessl")
        assert (redirect.status_code, redirect.headers["Location"]) == (308, "/livessl/")
        assert httpx.get(f"{server.url}/livesslx/").status_code == 404


@pytest.mark.parametrize("path", ["/api/v1/site", "/livessl/api/v1/site", "/livessl/livessl/api/v1/site", "/livessl"])
def test_no_path_gets_past_the_tokens(tmp_path: Path, path: str) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(UNDER_PATH | {"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        assert httpx.get(f"{server.url}{path}").status_code in (308, 401)
        for allowed in ("/livessl/", "/livessl/api/v1/health", "/livessl/static/app.js"):
            assert httpx.get(f"{server.url}{allowed}").status_code == 200, allowed
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws{server.url.removeprefix('http')}/livessl/api/v1/live")


@pytest.mark.parametrize("tokens", [False, True])
def test_nginx_that_replaces_the_host_needs_a_trusted_name(
    tmp_path: Path, tokens: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """The host that nginx sends by default is the address of its upstream."""
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    changes: Changes = {"server.http.tokens": "tokens.yaml"} if tokens else {}
    bearer = {"Authorization": f"Bearer {token}"}
    with proxied(tmp_path, changes, host="Host $proxy_host") as (server, url):
        assert httpx.get(f"{url}/api/v1/site", headers=bearer).status_code == 200
        reason = first_message(url, PUBLIC, **bearer)
        cures = "add it to server.http.trusted_hosts (proxy) or allowed_origins"
        assert reason == f"origin: site.example is not this server; {cures}"
        longest = first_message(url, f"http://{'x' * 200}.example", **bearer)
        assert (longest.endswith(cures), len(longest.encode())) == (True, 123)
        assert server.parts.refusals.counts()["http", "a page of another server"] == 2
    with proxied(tmp_path, changes | TRUSTED, host="Host $proxy_host") as (server, url):
        for origin in (PUBLIC, "https://site.example:8443", "https://Desk.Lab.example"):
            assert first_message(url, origin, **bearer) == "hello", origin
        for origin in ("http://evil.example", "https://site.example.evil.example", "https://lab.example", "null"):
            assert first_message(url, origin, **bearer).startswith("origin: "), origin
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


def test_nginx_that_keeps_the_host_needs_a_trusted_name_or_tokens(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def ask(url: str) -> httpx.Response:
        return httpx.get(f"{url}/api/v1/site", headers={"Host": "site.example"})

    with proxied(tmp_path, host="Host site.example") as (server, url):
        answer = ask(url)
        assert answer.status_code == 400
        assert answer.text == (
            "host: expected a name of this server, got 'site.example'; add it to server.http.trusted_hosts"
        )
        with pytest.raises(InvalidStatus) as refused:
            first_message(url, PUBLIC)
        assert refused.value.response.status_code == 400
        assert refused.value.response.body == answer.content
        assert server.parts.refusals.counts() == {("http", "a host name that is not the server's own"): 2}
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []
    with proxied(tmp_path, TRUSTED, host="Host site.example") as (_, url):
        assert ask(url).status_code == 200
        assert first_message(url, PUBLIC) == "hello"
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with proxied(tmp_path, {"server.http.tokens": "tokens.yaml"}, host="Host site.example") as (_, url):
        assert first_message(url, PUBLIC, Authorization=f"Bearer {token}") == "hello"


def test_listed_names_limit_a_server_with_tokens_as_well(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(TRUSTED | {"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:

        def status(host: str) -> int:
            return httpx.get(f"{server.url}/api/v1/health", headers={"Host": host}).status_code

        for host in ("site.example", "SITE.example:8443", "a.b.lab.example", "127.0.0.1", "[::1]:1"):
            assert status(host) == 200, host
        for host in ("evil.example", "lab.example", "xlab.example", "site.example.evil.example", "[::2]", "a:b"):
            assert status(host) == 400, host


def test_page_of_the_default_port_may_connect() -> None:
    """Some proxies pass on the host with the port that browsers leave out."""
    with running_server(site_of({"server.http.trusted_hosts": ["other.example"]})) as server:
        port = server.url.rpartition(":")[2]
        for origin, host, kind in (
            ("https://localhost", "localhost:443", "hello"),
            ("http://localhost", "localhost:80", "hello"),
            ("https://localhost", "localhost:80", "origin"),
            (f"http://localhost:{port}", f"localhost:{port}", "hello"),
            (f"http://localhost:{port}", "localhost", "origin"),
        ):
            answer = first_message(server.url, origin, **{"X-Forwarded-Host": host})
            assert answer.partition(":")[0] == kind, (origin, host)


FORWARDED = {"X-Forwarded-For": "198.51.100.7, 203.0.113.9", "X-Forwarded-Proto": "https"}


@pytest.mark.parametrize(
    ("proxies", "sent", "who"),
    [
        (["127.0.0.1"], FORWARDED, "203.0.113.9"),
        (["127.0.0.0/8", "203.0.113.0/24"], FORWARDED, "198.51.100.7"),
        (["127.0.0.1"], {"X-Forwarded-For": "[2001:db8::7]:4711"}, "2001:db8::7"),
        (["127.0.0.1"], {"X-Forwarded-For": "::ffff:203.0.113.9"}, "203.0.113.9"),
        (["127.0.0.1"], {"X-Forwarded-For": "203.0.113.9:4711"}, "203.0.113.9"),
        (["127.0.0.1"], {"X-Forwarded-For": "a name\tand more"}, "127.0.0.1"),
        (["127.0.0.1"], {"X-Forwarded-For": ""}, "127.0.0.1"),
        (["10.0.0.0/8"], FORWARDED, "127.0.0.1"),
        ([], FORWARDED, "127.0.0.1"),
    ],
)
def test_refusals_name_the_client_if_the_proxy_is_known(
    tmp_path: Path, proxies: list[str], sent: dict[str, str], who: str
) -> None:
    token = add_token(tmp_path / "tokens.yaml", "desk", "admin")
    changes = {"server.http.tokens": "tokens.yaml", "server.http.forwarded_allow_ips": proxies}
    bearer = {"Authorization": f"Bearer {token}"}
    with running_server(site_of(changes, tmp_path)) as server, httpx.Client(base_url=server.url) as client:
        assert client.get("/api/v1/site", headers=sent).status_code == 401
        [refused] = client.get("/api/v1/access", headers=bearer).json()["refused"]
        assert refused["who"] == who
        [described] = client.get("/api/v1/asyncapi.json", headers=bearer | sent).json()["servers"].values()
        forwarded = "X-Forwarded-Proto" in sent and "127.0.0.1" in (proxies or [""])[0].replace("0.0/8", "0.1")
        assert described["protocol"] == ("wss" if forwarded else "ws")


def test_forwarded_host_opens_no_door(tmp_path: Path) -> None:
    """A page whose own name points to the server can set the header; it must not pass for the server's name."""
    with running_server(site_of({"server.http.forwarded_allow_ips": ["127.0.0.1"]})) as server:
        for host, forwarded in (("evil.example", "localhost"), ("localhost", "evil.example")):
            headers = {"Host": host, "X-Forwarded-Host": forwarded}
            answer = httpx.get(f"{server.url}/api/v1/site", headers=headers)
            assert (answer.status_code, "'evil.example'" in answer.text) == (400, True)
    with running_server(site_of({"server.http.forwarded_allow_ips": []})) as server:  # nobody's header counts
        reason = first_message(server.url, PUBLIC, **{"X-Forwarded-Host": "site.example"})
        assert reason.startswith("origin: ")


@pytest.mark.browser
def test_page_names_the_cause_when_its_origin_is_refused(browser: Browser, tmp_path: Path) -> None:
    with proxied(tmp_path, host="Host $proxy_host") as (_, url), faultless_page(browser) as page:
        visit(page, f"{url}/")
        banner = page.get_by_test_id("banner")
        expect(banner).to_contain_text(f"No connection: origin: {url.removeprefix('http://')}", timeout=1000 * HANG_S)
        expect(banner).to_contain_text("is not this server; add it to server.http.trusted_hosts")


@pytest.mark.browser
def test_page_names_the_cause_when_the_proxy_passes_no_websocket(browser: Browser, tmp_path: Path) -> None:
    with running_server(site_of()) as server, faultless_page(browser) as page:
        block = example("/").replace("http://127.0.0.1:8000", server.url).replace(HOST, "Host $proxy_host")
        block = "\n".join(line for line in block.splitlines() if "pgrade" not in line)
        with running_nginx(tmp_path, block) as url:
            visit(page, f"{url}/")
            expected = "No connection: requests are answered, but the WebSocket is not; a reverse proxy must pass on"
            expect(page.get_by_test_id("banner")).to_contain_text(expected, timeout=1000 * HANG_S)


@pytest.mark.browser
def test_page_names_the_cause_when_the_host_is_refused_later(browser: Browser, tmp_path: Path) -> None:
    """The proxy is changed while the page is open, so that the server no longer knows its name."""
    with faultless_page(browser) as page, running_server(site_of()) as server:
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        refusal = "host: expected a name of this server, got 'site.example'; add it to server.http.trusted_hosts"
        page.route("**/api/v1/site", lambda route: route.fulfill(status=400, content_type="text/plain", body=refusal))
        page.route_web_socket("**/api/v1/live*", lambda socket: socket.close())
        page.reload()
        expect(page.get_by_test_id("banner")).to_contain_text(f"No connection: {refusal}", timeout=1000 * HANG_S)
