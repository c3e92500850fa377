"""`livessl keys`: the output of its actions, for people and as JSON."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from cli.command_runs import Run
from livessl.cli.keys import ROLES
from livessl.site.tokens import Role, read_tokens
from small_site import write_site


@pytest.fixture
def site(tmp_path: Path) -> Path:
    return write_site(tmp_path, {"keys": "keys", "server.http.tokens": "tokens.yaml"})


def test_token_is_printed_with_a_note_that_a_running_server_accepts_it(
    run: Run, site: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    token = run("keys", "token", "--site", site, "--name", "wall").out.strip()
    assert token
    assert [client.name for client in read_tokens(site.parent / "tokens.yaml").clients] == ["wall"]
    assert "a running server accepts it within a second" in caplog.text
    assert token not in caplog.text


def test_results_are_printed_as_json_on_request(run: Run, site: Path) -> None:
    [server] = run("keys", "server", "--site", site, "--json").objects
    options = ["--site", site, "--server", server["public_key"], "--json"]
    [node] = run("keys", "node", "lab-pc", *options).objects
    [client] = run("keys", "token", "--site", site, "--name", "wall", "--role", "operator", "--json").objects
    assert (node["name"], len(bytes.fromhex(node["public_key"]))) == ("lab-pc", 32)
    assert node["public_key"] != server["public_key"]
    assert (client["name"], client["role"]) == ("wall", "operator")
    assert client["token"]
    run("keys", "enrol", "lab-pc", node["public_key"], "--site", site)
    [listed] = run("keys", "list", "--site", site, "--json").objects
    assert json.dumps(listed) == json.dumps(
        {"nodes": {"lab-pc": node["public_key"]}, "clients": [{"name": "wall", "role": "operator"}]}
    )


def test_roles_of_the_command_are_those_of_the_tokens() -> None:
    assert tuple(map(str, Role)) == ROLES
