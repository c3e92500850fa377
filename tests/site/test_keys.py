"""Keys and tokens on disk: they are made once, readable only by their owner, and never shown by an error."""

from __future__ import annotations

import hashlib
import json
import re
import stat
from pathlib import Path
from typing import Any

import pytest
import yaml

from livessl.cli.main import main
from livessl.errors import ConfigError
from livessl.site import keys, tokens
from livessl.site.checks import unprotected_addresses
from livessl.site.load import load_site
from livessl.site.tokens import Client, Role
from small_site import Changes, site_of, write_site

KEYED: Changes = {"keys": "keys", "server.http.tokens": "tokens.yaml"}


@pytest.fixture
def site(tmp_path: Path) -> Path:
    return write_site(tmp_path, KEYED)


def keyed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return the output of a `keys` command."""
    assert main(["keys", *map(str, arguments)]) == 0
    return capsys.readouterr().out.strip()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return the error of a `keys` command that is wrong use."""
    assert main(["keys", *map(str, arguments)]) == 2
    return capsys.readouterr().err


def test_token_is_stored_as_a_hash_in_a_private_file(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    token = keyed(capsys, "token", "--site", site, "--name", "wall")
    path = site.parent / "tokens.yaml"
    assert re.fullmatch(r"livessl_[A-Za-z0-9_-]{43}", token)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    text = path.read_text(encoding="utf-8")
    assert token not in text
    [entry] = yaml.safe_load(text)["tokens"]
    assert entry == {"name": "wall", "role": "viewer", "sha256": hashlib.sha256(token.encode()).hexdigest()}


def test_tokens_identify_their_clients_and_others_identify_none(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = {role: keyed(capsys, "token", "--site", site, "--name", f"a-{role}", "--role", str(role)) for role in Role}
    known = tokens.read_tokens(site.parent / "tokens.yaml")
    for role, token in made.items():
        assert known.client(token) == Client(f"a-{role}", role)
        assert known.client(token[:-1]) is None
        assert known.client(token + "=") is None
    for stranger in ("", "livessl_", "\udcff", "x" * 10_000):
        assert known.client(stranger) is None
    assert len(set(made.values())) == 3


def test_every_known_hash_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a comparison reveals neither which token matched nor how much of it."""
    compared: list[bytes] = []

    def compare(known: bytes, presented: bytes) -> bool:
        compared.append(known)
        return known == presented

    monkeypatch.setattr("hmac.compare_digest", compare)
    held = {hashlib.sha256(name.encode()).digest(): Client(name, Role.VIEWER) for name in "abc"}
    assert tokens.Tokens(held).client("a") == Client("a", Role.VIEWER)
    assert compared == list(held)


def test_revoked_token_has_no_client(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = site.parent / "tokens.yaml"
    first, second = (keyed(capsys, "token", "--site", site, "--name", name) for name in ("wall", "desk"))
    keyed(capsys, "revoke", "--site", site, "--token", "wall")
    assert tokens.read_tokens(path).client(first) is None
    assert tokens.read_tokens(path).client(second) is not None
    assert "no token named 'wall'; tokens are desk" in refused(capsys, "revoke", "--site", site, "--token", "wall")
    keyed(capsys, "revoke", "--site", site, "--token", "desk")
    with pytest.raises(
        ConfigError, match="make a token with `livessl keys token`"
    ):  # the last token was revoked, but the server stays closed
        tokens.read_tokens(path)


def test_name_of_a_token_is_unique(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keyed(capsys, "token", "--site", site, "--name", "wall")
    said = refused(capsys, "token", "--site", site, "--name", "wall", "--role", "admin")
    assert "a token named 'wall' exists already" in said
    assert "expected a name of 1 to 64 letters" in refused(capsys, "token", "--site", site, "--name", "a b")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o666])
def test_secrets_that_others_can_read_are_refused(site: Path, mode: int, capsys: pytest.CaptureFixture[str]) -> None:
    keyed(capsys, "token", "--site", site, "--name", "wall")
    keyed(capsys, "server", "--site", site)
    loaded = load_site(site)
    for path, read in (
        (site.parent / "tokens.yaml", lambda: tokens.read_tokens(site.parent / "tokens.yaml")),
        (site.parent / "keys" / "server.secret", lambda: keys.server_keys(loaded)),
    ):
        read()
        path.chmod(mode)
        with pytest.raises(
            ConfigError, match=rf"expected a file that only its owner can use, got mode {mode:o}; chmod 600 it"
        ):
            read()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tokens: [{name: a, role: viewer, sha256: SECRET}]", "tokens.0.sha256: String should match"),
        ("tokens: [{name: a, role: SECRET, sha256: SECRET}]", "tokens.0.role: Input should be 'viewer'"),
        ("tokens: [{name: a, role: viewer, token: SECRET}]", "tokens.0.token: Extra inputs are not permitted"),
        ("tokens: []", "tokens: Tuple should have at least 1 item"),
        ("SECRET: [", "not valid YAML; make it with `livessl keys token`"),
        ("SECRET", "make it with|valid dictionary"),
    ],
)
def test_error_in_a_tokens_file_names_the_place_but_not_the_value(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "tokens.yaml"
    path.touch(mode=0o600)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said) as caught:
        tokens.read_tokens(path)
    assert "SECRET" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_node_is_enrolled_with_the_printed_keys(site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = tmp_path / "node"
    there.mkdir()
    node_site = write_site(there, KEYED)
    server = keyed(capsys, "server", "--site", site)
    node = keyed(capsys, "node", "lab-pc", "--site", node_site, "--server", server)
    keyed(capsys, "enrol", "lab-pc", node, "--site", site)
    at_server, at_node = keys.server_keys(load_site(site)), keys.node_keys(load_site(node_site), "lab-pc")
    assert at_server is not None
    assert at_node is not None
    assert at_server.nodes == {"lab-pc": at_node.own.public}
    assert at_node.server == at_server.own.public
    assert at_node.own.public.hex() == node
    assert at_node.own.secret not in (at_node.own.public, at_server.own.secret)
    for path in (site.parent / "keys" / "server.secret", there / "keys" / "lab-pc.secret"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not list((site.parent / "keys").glob("lab-pc*"))  # the node's secret was never on the server


def test_a_further_server_has_a_key_of_its_own(tmp_path: Path) -> None:
    """A file beside the site file; without it, the key of the node's own server is used."""
    site = site_of({"keys": "keys"}, tmp_path)
    own, further = (keys.make_server_keys(tmp_path / folder) for folder in ("west", "east"))
    keys.make_node_keys(tmp_path / "keys", "lab-pc", own)
    (tmp_path / "east.public").write_text(f"{further.hex()}\n", encoding="utf-8")
    held = [keys.node_keys(site, "lab-pc", file) for file in (None, "east.public")]
    assert [None if each is None else each.server for each in held] == [own, further]
    with pytest.raises(ConfigError, match=r"north\.public: the server's public key cannot be read"):
        keys.node_keys(site, "lab-pc", "north.public")


def test_secrets_are_in_no_repr(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keyed(capsys, "server", "--site", site)
    held = keys.server_keys(load_site(site))
    assert held is not None
    assert repr(held.own.public) in repr(held)
    assert repr(held.own.secret) not in repr(held)


def test_no_pair_is_ever_overwritten(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = keyed(capsys, "server", "--site", site)
    assert "server.secret: exists already and would be lost" in refused(capsys, "server", "--site", site)
    keyed(capsys, "node", "lab-pc", "--site", site)
    assert "lab-pc.secret: exists already" in refused(capsys, "node", "lab-pc", "--site", site, "--server", key)


def test_dismissed_node_is_not_enrolled(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, key in (("a", "0" * 64), ("b", "1" * 64), ("a", "2" * 64)):
        keyed(capsys, "enrol", name, key, "--site", site)
    assert keys.enrolled(site.parent / "keys") == {"a": b"\x22" * 32, "b": b"\x11" * 32}
    keyed(capsys, "revoke", "--node", "a", "--site", site)
    assert keys.enrolled(site.parent / "keys") == {"b": b"\x11" * 32}
    assert "no node 'a' is enrolled; nodes are b" in refused(capsys, "revoke", "--node", "a", "--site", site)


def test_list_shows_clients_but_no_secret(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    token = keyed(capsys, "token", "--site", site, "--name", "wall", "--role", "operator")
    key = keyed(capsys, "enrol", "lab-pc", "ab" * 32, "--site", site) or "ab" * 32
    told = json.loads(keyed(capsys, "list", "--site", site, "--json"))
    assert told == {"nodes": {"lab-pc": key}, "clients": [{"name": "wall", "role": "operator"}]}
    lines = keyed(capsys, "list", "--site", site)
    assert re.search(rf"node +lab-pc +{key}\nclient +wall +operator", lines)
    assert token not in lines


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["server"], "keys: expected the folder that holds the keys, got none; add keys: keys to the site file"),
        (["token", "--name", "a"], "expected the file that holds the tokens, got none; add tokens: tokens.yaml"),
    ],
)
def test_commands_on_a_site_without_keys_name_the_key_to_add(
    tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(capsys, *arguments, "--site", write_site(tmp_path))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "server.secret").unlink(), "make it with `livessl keys server`"),
        (lambda folder: (folder / "server.secret").write_text("TOPSECRET"), "expected a secret key of 64"),
        (lambda folder: (folder / "nodes.yaml").write_text("lab-pc: nonsense"), "expected NAME: PUBLIC KEY a line"),
        (lambda folder: (folder / "nodes.yaml").write_text("- a"), "expected NAME: PUBLIC KEY a line"),
    ],
)
def test_unusable_server_keys_are_refused(
    site: Path, spoil: Any, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    keyed(capsys, "server", "--site", site)
    spoil(site.parent / "keys")
    with pytest.raises(ConfigError, match=said) as caught:
        keys.server_keys(load_site(site))
    assert "TOPSECRET" not in str(caught.value)


def test_missing_public_key_of_the_server_names_its_source(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "node", "lab-pc", "--site", site)
    assert "server.public: the server's public key cannot be read: No such file or directory; `livessl keys" in said
    with pytest.raises(ConfigError, match="make it with `livessl keys node lab-pc`"):
        keys.node_keys(load_site(site), "lab-pc")


def test_site_without_keys_needs_none() -> None:
    assert keys.server_keys(site_of()) is None
    assert keys.node_keys(site_of(), "lab-pc") is None


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "192.168.1.7", "::", "[::]", "fe80::1%eth0", "::ffff:0.0.0.0", "", "lab-pc.local", "127.0.0.1.example"],
)
def test_api_open_to_the_network_needs_tokens(host: str) -> None:
    [fault] = unprotected_addresses(site_of({"server.http.host": host}))
    assert fault.where == "server.http.host"
    assert "make a token with `livessl keys token`" in fault.what
    assert unprotected_addresses(site_of({"server.http.host": host, "server.http.tokens": "tokens.yaml"})) == []


@pytest.mark.parametrize("bind", ["tcp://*:5570", "tcp://0.0.0.0:5570", "tcp://[::]:5570", "tcp://eth0:5570"])
def test_socket_open_to_the_network_needs_keys(bind: str) -> None:
    [fault] = unprotected_addresses(site_of({"server.bind": bind}))
    assert fault.where == "server.bind"
    assert "`livessl keys server`" in fault.what
    assert unprotected_addresses(site_of({"server.bind": bind, "keys": "keys"})) == []


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "localhost", "::1", "::ffff:127.0.0.1"])
def test_loopback_addresses_need_no_protection(host: str) -> None:
    endpoint = f"tcp://{f'[{host}]' if ':' in host else host}:5570"
    assert unprotected_addresses(site_of({"server.http.host": host, "server.bind": endpoint})) == []
    assert unprotected_addresses(site_of({"server.bind": "ipc:///run/livessl"})) == []


@pytest.mark.parametrize("command", ["serve", "check"])
def test_unprotected_server_does_not_start_and_reports_all_faults(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_site(tmp_path, {"server.http.host": "0.0.0.0", "server.bind": "tcp://*:5570"})
    assert main([command, *(["--site"] if command == "serve" else []), str(path)]) == 2
    said = capsys.readouterr().err
    assert "server.http.host: '0.0.0.0' can be reached from other machines" in said
    assert "server.bind: 'tcp://*:5570' can be reached from other machines" in said


def test_trusted_hosts_without_tokens_are_warned_about() -> None:
    changes: Changes = {"server.http.trusted_hosts": ["site.example"]}
    [warning] = site_of(changes).warnings
    assert warning.startswith("server.http.trusted_hosts: everyone who reaches the proxy may do everything; set")
    assert site_of(changes | {"server.http.tokens": "tokens.yaml"}).warnings == ()


def test_unencrypted_tokens_are_warned_about() -> None:
    public = {"server.http.host": "0.0.0.0", "server.http.tokens": "tokens.yaml"}
    [warning] = site_of(public).warnings
    assert warning.startswith("server.http: tokens and positions travel unencrypted; set certificate and private_key")
    files = {"server.http.certificate": "site.crt", "server.http.private_key": "site.key"}
    assert site_of(public | files).warnings == ()
    assert site_of({"server.http.tokens": "tokens.yaml"}).warnings == ()
