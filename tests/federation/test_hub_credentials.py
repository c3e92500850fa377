"""The files in deploy/hub: TLS, an account for each site, and a leaf node beside a site's server."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from conftest import require
from hub_desk import SiteDesk, hub_site, ids_at, make_hub, running_hub, running_site, sounds
from livessl.errors import ConfigError
from livessl.federation.config import load_hub
from livessl.lab.processes import free_port
from livessl.server.forwarding.stream import Place, message_id, parse_message_id, parse_subject, subject
from nats_servers import NATS_SERVER, NatsServer, running_servers
from small_site import site_of, wait_until

DEPLOY: Final = Path(__file__).parents[2] / "deploy" / "hub"
USERS: Final = {"hub": "change-me-hub", "lab": "change-me-lab"}


def deployed(name: str, changes: dict[str, str]) -> str:
    """A file of deploy/hub without its own ports, with these texts replaced."""
    text = re.sub(r"^(server_name: .*\n)listen: .*\n", r"\1", (DEPLOY / name).read_text(encoding="utf-8"), flags=re.M)
    text = re.sub(r"^cluster \{.*?^\}\n", "", text, flags=re.M | re.S)  # one of three servers alone has no majority
    for before, after in changes.items():
        text = text.replace(before, after)
    return text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate for this machine, and the files of passwords."""
    require(shutil.which("openssl") is not None, "openssl is not installed (Debian: apt install openssl)")
    directory = tmp_path_factory.mktemp("nats")
    new = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=livessl"]
    names = ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", "server.key", "-out", "server.pem"]
    subprocess.run([*new, *names], cwd=directory, check=True, capture_output=True)
    shutil.copy(directory / "server.pem", directory / "ca.pem")
    shutil.copy(DEPLOY / "accounts.conf", directory / "accounts.conf")
    for user, password in USERS.items():
        path = directory / f"{user}.password"
        path.write_text(password, encoding="utf-8")
        path.chmod(0o600)
    return directory


@pytest.fixture(scope="module")
def servers(folder: Path) -> Iterator[tuple[NatsServer, NatsServer]]:
    """A server of the hub, and a leaf node of the site `lab`."""
    require(NATS_SERVER is not None, "NATS is not installed (Debian: apt install nats-server)")
    leaves = f"127.0.0.1:{free_port()}"
    changes = {"/etc/nats": str(folder), "0.0.0.0:7422": leaves, "/var/lib/nats": str(folder / "kept"), "50GB": "1GB"}
    hub = NatsServer(folder, "nats-1", whole=deployed("nats.conf", changes))
    urls = {
        "/etc/nats": str(folder),
        "nats-1.example:7422": leaves,
        ", tls://lab:change-me-lab@nats-2.example:7422": "",
    }
    leaf = NatsServer(folder, "lab-leaf", whole=deployed("nats-leaf.conf", urls))
    with running_servers([hub, leaf]):
        yield hub, leaf


def secured(user: str) -> dict[str, str]:
    return {"user": user, "password": f"{user}.password", "ca": "ca.pem"}


def test_sites_reach_the_hub_by_tls_and_by_a_leaf_node_under_their_own_name_only(
    folder: Path, servers: tuple[NatsServer, NatsServer]
) -> None:
    server, leaf = servers
    url = f"tls://127.0.0.1:{server.port}"
    nats = {"servers": [url], **secured("hub")}
    changes = {f"server.hub.{name}": value for name, value in secured("lab").items()}
    stream = {"max_bytes": 100_000_000}
    with running_hub(make_hub("hub.sqlite", [url], folder, nats=nats, stream=stream)) as hub:
        with running_site(hub_site(folder, "lab", [url], changes)) as desk:
            desk.finish(*sounds("lab", 0, 3))
            wait_until(lambda: len(ids_at(hub.url, "lab")) == 3, "events by TLS")
        with running_site(hub_site(folder, "lab", [leaf.url])) as desk:
            desk.finish(*sounds("lab", 3, 3))
            wait_until(lambda: len(ids_at(hub.url, "lab")) == 6, "events by the leaf node")
        with running_site(hub_site(folder, "yard", [url], changes)) as desk:
            desk.finish(*sounds("yard", 0, 1))

            def is_refused() -> bool:
                return desk.link.problem is not None and "no stream" in desk.link.problem

            wait_until(is_refused, "a refusal")
            assert desk.outbox.unsent(10)
        assert ids_at(hub.url, "lab") == [f"lab-{number}" for number in range(6)]
        assert ids_at(hub.url, "yard") == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"server.hub.servers": ["nats://nats.example:4222"]}, r"without TLS, others could read .*; use tls://"),
        ({"server.hub.servers": ["nats://a:b@127.0.0.1"]}, "got a URL with a user; set user, and password"),
        ({"server.hub.servers": ["http://127.0.0.1"]}, "expected tls://HOST:PORT"),
        ({"server.hub.servers": []}, "server.hub.servers"),
        ({"server.hub.user": "lab"}, "expected user and password, got user alone; add the other one"),
        ({"server.events_db": None}, "expected server.events_db as well"),
        ({"server.hub.location_deg": [91, 0]}, "location_deg"),
    ],
)
def test_a_link_that_cannot_work_is_a_fault_of_the_site_file(changes: dict[str, object], message: str) -> None:
    link = {"server.hub.servers": ["nats://127.0.0.1:4222"], "server.events_db": "events.sqlite"}
    with pytest.raises(ConfigError, match=message):
        site_of({**link, **changes})


def test_files_that_the_link_needs_are_checked_at_the_start(tmp_path: Path) -> None:
    secrets = {"server.hub.user": "lab", "server.hub.password": "lab.password"}
    with pytest.raises(ConfigError, match=r"lab\.password: cannot be read: .*; write the password into it"):
        SiteDesk(hub_site(tmp_path, "lab", ["nats://127.0.0.1:4222"], secrets))
    with pytest.raises(ConfigError, match=r"server\.hub\.ca: cannot read certificates from .*; name a PEM file"):
        SiteDesk(hub_site(tmp_path, "lab", ["tls://127.0.0.1:4222"], {"server.hub.ca": "ca.pem"}))


def test_the_shipped_file_of_a_hub_is_valid(tmp_path: Path) -> None:
    hub = load_hub(DEPLOY / "hub.yaml")
    assert hub.settings.stream.replicas == 3
    wrong = tmp_path / "hub.yaml"
    wrong.write_text("nats: {server: [x]}\ndatabase: mysql://x\nhttp: {host: 0.0.0.0}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_hub(wrong)
    text = str(caught.value)
    assert "hub.yaml:1: nats.server: unknown key 'server'; did you mean 'servers'?" in text
    assert "hub.yaml:2: database: expected the name of a file, or postgresql://" in text
    wrong.write_text("nats: {servers: ['tls://x']}\ndatabase: h.sqlite\nhttp: {host: 0.0.0.0}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"hub.yaml:3: http.host: .* can be reached from other machines"):
        load_hub(wrong)


@pytest.mark.parametrize("site", ["lab", "lab.1", "a-b_c.d"])
def test_names_in_nats_can_be_read_back(site: str) -> None:
    assert len(subject(site, "event").split(".")) == 3
    assert parse_subject(subject(site, "event")) == (site, "event")
    place = Place("0123456789abcdef", 42)
    assert parse_message_id(message_id(place)) == place
    assert parse_message_id("events") is parse_message_id(None) is parse_message_id("a-b") is None
