"""TLS from certificate files: requests and WebSockets are encrypted, and the server does not start on wrong files."""

from __future__ import annotations

import json
import shutil
import socket
import ssl
import subprocess
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect

from conftest import require
from livessl import client
from livessl.clock import SystemClock
from livessl.errors import ConfigError
from livessl.server import http
from livessl.server.app import Server
from small_site import HANG_S, running_server, site_of, wait_until

FILES = {"server.http.certificate": "site.crt", "server.http.private_key": "site.key"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate for this machine, its key, another key, and the key behind a passphrase."""
    require(shutil.which("openssl") is not None, "openssl is not installed (Debian: apt install openssl)")
    directory = tmp_path_factory.mktemp("tls")
    new = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=livessl"]
    names = ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", "site.key", "-out", "site.crt"]
    locked = ["rsa", "-aes256", "-passout", "pass:secret", "-in", "site.key", "-out", "locked.key"]
    for arguments in ([*new, *names], ["genrsa", "-out", "other.key", "2048"], locked):
        subprocess.run(["openssl", *arguments], cwd=directory, check=True, capture_output=True)
    return directory


def test_everything_is_encrypted(folder: Path) -> None:
    trusted = ssl.create_default_context(cafile=folder / "site.crt")
    with running_server(site_of(FILES, folder)) as server:
        assert server.url.startswith("https://127.0.0.1:")
        health = httpx.get(f"{server.url}/api/v1/health", verify=trusted)
        assert health.json()["secured"]["tls"] is True
        with connect(f"wss{server.url.removeprefix('https')}/api/v1/live", ssl=trusted, open_timeout=HANG_S) as live:
            assert json.loads(live.recv(timeout=HANG_S))["kind"] == "hello"
        with pytest.raises(httpx.HTTPError):
            httpx.get(server.url.replace("https", "http") + "/api/v1/health")
        with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
            httpx.get(f"{server.url}/api/v1/health", verify=ssl.create_default_context())


def test_client_trusts_the_named_authority_and_no_unknown_one(folder: Path) -> None:
    with running_server(site_of(FILES, folder)) as server:
        with client.connect(server.url, ca_file=folder / "site.crt") as live:
            assert next(iter(live)).kind == "hello"
            assert live.site().site == "small"
        with client.connect(server.url) as live:
            with pytest.raises(client.RefusedError, match=r"is not trusted: .*; name the certificate of its"):
                next(iter(live))
            with pytest.raises(client.RefusedError, match="certificate is not trusted"):
                live.site()


def test_connections_that_never_begin_tls_are_limited(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "MAX_CONNECTIONS", 3)
    trusted = ssl.create_default_context(cafile=folder / "site.crt")
    with running_server(site_of(FILES, folder)) as server, ExitStack() as stack:
        address = ("127.0.0.1", int(server.url.rpartition(":")[2]))
        for _ in range(3):
            stack.enter_context(socket.create_connection(address, timeout=HANG_S))
        wait_until(lambda: is_turned_away(address), "the limit")
        stack.close()
        wait_until(lambda: is_answered(f"{server.url}/api/v1/health", trusted), "room")


def is_turned_away(address: tuple[str, int]) -> bool:
    """Return whether the server closes a new connection before TLS."""
    with socket.create_connection(address, timeout=0.3) as client:
        try:
            return client.recv(1) == b""
        except TimeoutError:
            return False
        except ConnectionResetError:
            return True


def is_answered(url: str, trusted: ssl.SSLContext) -> bool:
    try:
        return httpx.get(url, verify=trusted).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_ciphers_are_authenticated_and_forward_secret(folder: Path, version: ssl.TLSVersion) -> None:
    trusted = ssl.create_default_context(cafile=folder / "site.crt")
    trusted.minimum_version = trusted.maximum_version = version
    with running_server(site_of(FILES, folder)) as server:
        port = int(server.url.rpartition(":")[2])
        for offered in ("DEFAULT", "AES128-GCM-SHA256:ECDHE-RSA-AES128-SHA256"):
            trusted.set_ciphers(offered)
            with socket.create_connection(("127.0.0.1", port), timeout=HANG_S) as plain:
                if version is ssl.TLSVersion.TLSv1_2 and offered != "DEFAULT":  # not forward secret, or without AEAD
                    with pytest.raises(ssl.SSLError):
                        trusted.wrap_socket(plain, server_hostname="127.0.0.1")
                    continue
                with trusted.wrap_socket(plain, server_hostname="127.0.0.1") as secured:
                    chosen = secured.cipher()
                    assert chosen is not None
                    assert "GCM" in chosen[0] or "CHACHA20" in chosen[0]


@pytest.mark.parametrize(
    ("certificate", "key", "fault"),
    [
        ("site.crt", "other.key", "KEY_VALUES_MISMATCH"),
        ("site.crt", "locked.key", "name a PEM certificate and its key without a passphrase"),
        ("missing.crt", "site.key", "No such file or directory"),
        ("site.key", "site.key", "name a PEM certificate"),
    ],
)
def test_server_does_not_start_on_files_that_do_not_match(folder: Path, certificate: str, key: str, fault: str) -> None:
    changes = {"server.http.certificate": certificate, "server.http.private_key": key}
    with pytest.raises(ConfigError, match=fault) as caught:
        Server(site_of(changes, folder), SystemClock())
    assert str(caught.value).startswith("server.http.certificate: cannot use ")


@pytest.mark.parametrize("given", ["certificate", "private_key"])
def test_one_file_without_the_other_is_a_fault(given: str) -> None:
    with pytest.raises(ConfigError, match=f"expected certificate and private_key, got {given} alone; add the other"):
        site_of({f"server.http.{given}": "site.pem"})
