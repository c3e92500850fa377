"""IPv6 for nodes and for HTTP, over real sockets: loopback, every address, and link-local with its interface."""

from __future__ import annotations

import errno
import json
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from browser import faultless_page, running_browser, visit
from conftest import require
from livessl import wire
from livessl.capture.link import Link
from livessl.capture.node import capture_recordings
from livessl.cli.main import main
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.server.app import Server
from livessl.server.receiver import BindError, address_cure
from livessl.site import keys
from livessl.site.tokens import add_token
from small_site import (
    HANG_S,
    RATE_HZ,
    Changes,
    running_server,
    scene,
    scene_recordings,
    site_of,
    wait_until,
    write_site,
)

CLOCK = SystemClock()
INTERFACES = Path("/proc/net/if_inet6")


@pytest.fixture(autouse=True, scope="module")
def _ipv6() -> None:
    with socket.socket() if not socket.has_ipv6 else socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            require(False, "this machine has no IPv6")


def on(host: str) -> Changes:
    """Both sockets of the server on an IPv6 address."""
    return {"server.bind": f"tcp://[{host}]:*", "server.http.host": host}


def link_local() -> str:
    """A link-local address of this machine, with its interface."""
    for line in INTERFACES.read_text().splitlines() if INTERFACES.exists() else ():
        digits, _, _, scope, _, interface = line.split()
        if scope == "20":
            address = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits))
            return f"{address}%{interface}"
    pytest.skip("no interface of this machine has a link-local IPv6 address")


def port_of(address: str) -> int:
    return int(address.rpartition(":")[2])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A site's folder with tokens and keys, the keys of two nodes enrolled; `stranger` has keys only."""
    keys.make_server_keys(tmp_path / "keys")
    for name in ("lab-pc", "replay"):
        keys.enrol(tmp_path / "keys", name, keys.make_node_keys(tmp_path / "keys", name))
    keys.make_node_keys(tmp_path / "keys", "stranger")
    return tmp_path


@contextmanager
def open_server(folder: Path, host: str) -> Iterator[tuple[Server, dict[str, str]]]:
    """A protected server on an address that other machines reach, and the headers of an admin."""
    token = add_token(folder / "tokens.yaml", "desk", "admin")
    changes = on(host) | {"keys": "keys", "server.http.tokens": "tokens.yaml"}
    with running_server(site_of(changes, folder)) as server:
        yield server, {"Authorization": f"Bearer {token}"}


def capture_scene(server: Server, endpoint: str, changes: Changes, folder: Path | None = None) -> None:
    """Send the scene as a live node does, and wait for both events."""
    published = server.parts.event_log.published
    site = site_of({"nodes.lab-pc.server": endpoint, **changes}, folder)
    start_ns = CLOCK.now_ns() // FRAME_NS * FRAME_NS - round(scene().duration_s * 1e9)
    capture_recordings(site, "lab-pc", scene_recordings(start_ns), CLOCK, "run-1", lambda: False)
    wait_until(lambda: server.parts.event_log.published == published + 2, "both events")


@contextmanager
def linked(endpoint: str, folder: Path, name: str) -> Iterator[Link]:
    """A node's connection, with its keys."""
    held = keys.node_keys(site_of({"keys": "keys"}, folder), name)
    link = Link(endpoint, wire.Hello(name, "run-1", {"north": float(RATE_HZ)}), CLOCK, held)
    yield link
    link.close(bye=True)


def serve_until(link: Link, condition: Callable[[], object], what: str) -> None:
    """Serve a link until the condition holds."""

    def turn() -> object:
        link.service()
        return condition()

    wait_until(turn, what)


def is_connected(link: Link) -> bool:
    return link.connected


def has_refused(server: Server, before: int) -> bool:
    return server.parts.refusals.count("nodes") > before


def test_loopback_serves_nodes_requests_and_websockets() -> None:
    with running_server(site_of(on("::1"))) as server:
        assert server.endpoint.startswith("tcp://[::1]:")
        assert server.url.startswith("http://[::1]:")
        capture_scene(server, server.endpoint, {})
        assert len(httpx.get(f"{server.url}/api/v1/events").json()["events"]) == 2
        with connect(f"ws{server.url.removeprefix('http')}/api/v1/live", origin=Origin(server.url)) as live:
            assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"http://127.0.0.1:{port_of(server.url)}/api/v1/health")


def test_host_may_stand_in_brackets() -> None:
    with running_server(site_of(on("::1") | {"server.http.host": "[::1]"})) as server:
        assert server.url.startswith("http://[::1]:")
        assert httpx.get(f"{server.url}/api/v1/health").status_code == 200


def test_names_and_pages_are_checked_like_those_of_ipv4() -> None:
    with running_server(site_of(on("::1"))) as server:
        port = port_of(server.url)
        for host in (f"[::1]:{port}", "[::1]", "localhost"):
            assert httpx.get(f"{server.url}/api/v1/site", headers={"Host": host}).status_code == 200, host
        for host in ("evil.example", f"[::2]:{port}", "[::1", "::1", "[::1]x"):
            assert httpx.get(f"{server.url}/api/v1/site", headers={"Host": host}).status_code == 400, host
        address = f"ws://[::1]:{port}/api/v1/live"
        for origin in (f"http://[::1]:{port + 1}", "http://[::2]", "http://localhost"):
            with (
                connect(address, origin=Origin(origin)) as live,
                pytest.raises(ConnectionClosed, match="trusted_hosts"),
            ):
                live.recv(timeout=HANG_S)


def test_every_address_means_ipv4_as_well(folder: Path) -> None:
    """Nodes have keys and clients have tokens. The list of refusals shows plain IPv4 addresses."""
    with open_server(folder, "::") as (server, admin):
        assert server.endpoint.startswith("tcp://[::]:")
        assert server.url.startswith("http://[::]:")
        for host in ("127.0.0.1", "[::1]"):
            endpoint = f"tcp://{host}:{port_of(server.endpoint)}"
            with linked(endpoint, folder, "lab-pc") as link:
                serve_until(link, partial(is_connected, link), "the connection")
            url = f"http://{host}:{port_of(server.url)}"
            assert httpx.get(f"{url}/api/v1/site").status_code == 401
            assert httpx.get(f"{url}/api/v1/site", headers=admin).status_code == 200
            with connect(f"ws{url.removeprefix('http')}/api/v1/live", additional_headers=admin) as live:
                assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws{url.removeprefix('http')}/api/v1/live")
            refused = server.parts.refusals.count("nodes")
            with linked(endpoint, folder, "stranger") as link:
                serve_until(link, partial(has_refused, server, refused), "the refusal")
        listed = httpx.get(f"http://[::1]:{port_of(server.url)}/api/v1/access", headers=admin).json()["refused"]
        assert {(one["door"], one["who"]) for one in listed} == {
            (door, who) for door in ("nodes", "http") for who in ("127.0.0.1", "::1")
        }


def test_link_local_address_with_its_interface(folder: Path) -> None:
    host = link_local()
    with open_server(folder, host) as (server, admin):
        assert server.endpoint.startswith(f"tcp://[{host}]:")
        assert server.url.startswith(f"http://[{host.replace('%', '%25')}]:")
        capture_scene(server, server.endpoint, {"keys": "keys"}, folder)
        with socket.create_connection((host, port_of(server.url)), timeout=HANG_S) as connection:
            head = f"GET /api/v1/site HTTP/1.1\r\nHost: [::1]\r\nAuthorization: {admin['Authorization']}\r\n\r\n"
            connection.sendall(head.encode())
            assert connection.recv(15) == b"HTTP/1.1 200 OK"


def test_session_is_replayed_to_a_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "session"
    made = f"--rt60 0 --count 2 --rate {RATE_HZ} --seed 5".split()
    assert main(["simulate", "--site", str(write_site(tmp_path)), "--out", str(session), *made]) == 0
    with running_server(site_of(on("::1"))) as server:
        assert main(["replay", str(session), "--server", server.endpoint, "--speed", "max"]) == 0
        server.wait_idle()
        assert server.parts.event_log.published == 2
    with pytest.raises(SystemExit):
        main(["replay", str(session), "--server", "tcp://::1:5570"])
    expected = "expected an IPv6 address in brackets, such as tcp://[::1]:5570, got 'tcp://::1:5570'"
    assert expected in capsys.readouterr().err


@pytest.mark.browser
def test_dashboard_works() -> None:
    with running_server(site_of(on("::1"))) as server, running_browser() as browser, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("array-north")).to_be_visible()


def test_machine_without_ipv6_is_named() -> None:
    assert address_cure(errno.EAFNOSUPPORT) == "this machine has no IPv6; write an IPv4 address of it"


def test_address_that_is_taken_is_named_as_in_the_site_file(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(on("::1"))) as server:
        http_port, node_port = port_of(server.url), port_of(server.endpoint)
        with pytest.raises(BindError, match=rf"^server.http: cannot listen on \[::1\]:{http_port}: Address already in"):
            Server(site_of({"server.http": {"host": "::1", "port": http_port}}), CLOCK)
        with pytest.raises(BindError, match=rf"^server.bind: cannot listen on tcp://\[::1\]:{node_port}: Address alr"):
            Server(site_of({"server.bind": f"tcp://[::1]:{node_port}"}), CLOCK)
    with pytest.raises(BindError, match=r"cannot listen on \[2001:db8::1\]:0: .*; write an address of this machine"):
        Server(site_of({"server.http": {"host": "2001:db8::1", "port": 0, "tokens": "tokens.yaml"}}, tmp_path), CLOCK)
