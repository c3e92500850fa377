"""livessl events: lines and objects of a running server's messages, filters, limits, and wrong use."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from cli.command_runs import Run, interrupted
from livessl.client.retry import Patience
from livessl.server.app import Server
from messages import START_NS, event_message
from publishing_lives import free_port
from small_site import running_server, site_of

SINCE = "2025-12-31T00:00:00Z"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        for k in range(3):
            zones = ["door"] if k == 1 else []
            server.parts.store.add(event_message(id=f"old-{k}", zones=zones), START_NS + k)
        yield server


def test_events_are_printed_in_order_of_time(run: Run, server: Server) -> None:
    done = run("events", "--url", server.url, "--since", SINCE, "--limit", "3", "--json")
    assert done.code == 0
    assert [event["id"] for event in done.objects] == ["old-0", "old-1", "old-2"]
    assert done.objects[0] == json.loads(done.out.splitlines()[0])
    assert done.objects[0].items() >= {"position_m": [2.0, 2.0, 1.0], "time_utc": "2026-01-01T00:00:00.000000Z"}.items()


def test_filters_are_sent_to_the_server(run: Run, server: Server) -> None:
    done = run("events", "--url", server.url, "--since", SINCE, "--limit", "1", "--zone", "door")
    assert done.code == 0
    [line] = done.out.splitlines()
    assert line.startswith("2026-01-01T00:00:00.000000Z")
    assert "( 2.00,  2.00,  1.00)" in line
    assert "located" in line


def test_other_kinds_have_lines_of_their_own(run: Run, server: Server) -> None:
    done = run("events", "--url", server.url, "--kinds", "arrays", "--limit", "1")
    [line] = done.out.splitlines()
    assert line.endswith("arrays  north starting, south starting")


def test_ctrl_c_ends_it_in_order(run: Run, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.cli.events._print", interrupted)
    assert run("events", "--url", server.url, "--kinds", "arrays").code == 0


def test_wrong_use_is_explained(run: Run, server: Server, tmp_path: Path) -> None:
    for arguments, code, text in (
        (["--kinds", "event,sound"], 2, "expected some of event, update, track, arrays, alert, zone, zones, poses"),
        (["--since", "yesterday"], 2, "expected RFC 3339 with an offset"),
        (["--token-file", str(tmp_path / "none")], 2, "--token-file: cannot read"),
        (["--url", "site.example"], 2, "url: expected an address such as http://127.0.0.1:8000, got 'site.example'"),
        (
            ["--url", "http://site.example:80x"],
            2,
            "url: expected an address such as http://127.0.0.1:8000, got 'http://s",
        ),
        (["--url", server.url.replace("http", "https")], 1, "does not speak TLS"),
        (["--url", server.url, "--zone", "hall"], 1, "zone: no zone 'hall'; zones are door"),
    ):
        done = run("events", *arguments)
        assert (done.code, text in done.err) == (code, True), done.err
        assert done.out == ""


def test_server_that_is_away_is_waited_for(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    waits: list[float] = []
    usual = Patience.next_wait_s

    def hurried(patience: Patience, error: Exception) -> float:
        waits.append(usual(patience, error))
        if len(waits) == 3:
            raise KeyboardInterrupt
        return 0.0

    monkeypatch.setattr(Patience, "next_wait_s", hurried)
    with caplog.at_level(logging.WARNING):
        assert run("events", "--url", f"http://127.0.0.1:{free_port()}").code == 0
    assert len(waits) == 3
    assert caplog.text.count("trying again") == 1
