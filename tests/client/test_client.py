"""The clients against a running server: typed messages, questions, refusals, tokens and TLS."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from livessl import client
from livessl.cli import events
from livessl.client import Client, Event, RefusedError, UnreachableError, UpdateMessage, aconnect, connect, resumption
from livessl.client.options import Options, Wanted
from livessl.errors import UseError
from livessl.server.api import queries
from livessl.server.app import Server
from livessl.site.tokens import add_token, revoke_token
from messages import START_NS, event_message, update_message
from publishing_lives import free_port
from small_site import HANG_S, running_server, site_of, wait_until

FORBIDDEN = ("fastapi", "numba", "numpy", "scipy", "sqlalchemy", "uvicorn", "yaml", "zmq", "livessl.server")
"""What a program that only follows a server must not load."""

IMPORT_S = 0.3
"""Longest time, in seconds of the processor, of `import livessl.client`."""


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        for k in range(3):
            zones = ["door"] if k == 1 else []
            server.parts.store.add(event_message(id=f"old-{k}", zones=zones), START_NS + k)
        yield server


def publish(server: Server, *messages: dict[str, Any]) -> None:
    assert server.loop is not None
    for message in messages:
        server.loop.call_soon_threadsafe(server.parts.fanout.publish, message)


def clients(server: Server, count: int) -> None:
    wait_until(lambda: server.parts.fanout.clients == count, f"{count} clients")


def publish_to_one(server: Server, *messages: dict[str, Any]) -> None:
    clients(server, 1)
    publish(server, *messages)


@pytest.mark.processes
def test_import_is_quick_and_loads_nothing_of_the_server() -> None:
    program = f"""
import sys, time
begin = time.process_time()
import livessl.client
took_s = time.process_time() - begin
from livessl.client import aconnect, connect, Event
print(took_s)
print([name for name in {FORBIDDEN!r} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=HANG_S)
    took_s, loaded = done.stdout.splitlines()
    assert float(took_s) < IMPORT_S
    assert loaded == "[]"


def test_every_public_name_is_there() -> None:
    assert all(getattr(client, name) is not None for name in client.__all__)
    assert set(client.__all__) <= set(dir(client))
    with pytest.raises(AttributeError, match="no attribute 'konnect'"):
        client.konnect  # noqa: B018


def test_clients_know_all_kinds_of_the_server() -> None:
    assert set(events.KINDS) == queries.KINDS
    assert queries.KINDS | {"hello", "gap"} == resumption._KINDS


def test_live_messages_are_typed(server: Server) -> None:
    with connect(server.url, kinds=["event", "update"]) as live:
        messages = iter(live)
        Thread(target=publish_to_one, args=(server, update_message(), event_message(id="a"))).start()
        update, event = next(messages), next(messages)
    assert isinstance(update, UpdateMessage)
    assert isinstance(event, Event)
    assert event.position_m == [2.0, 2.0, 1.0]
    assert event.time_utc == datetime(2026, 1, 1, tzinfo=UTC)


def test_asynchronous_client_delivers_the_same(server: Server) -> None:
    async def follow() -> list[str]:
        async with aconnect(server.url, kinds=["event"], since="2025-12-31T00:00:00Z", zone="door") as live:
            found = []
            async for message in live:
                assert isinstance(message, Event)
                found.append(message.id)
                if len(found) == 1:
                    publish(server, event_message(id="outside"), event_message(id="b", zones=["door"]))
                else:
                    break
            answers = [await live.site(), await live.arrays(), await live.tracks(), await live.health()]
            assert [event.id async for event in live.events(zone="door")] == ["old-1"]
            assert (await live.event("old-2")).id == "old-2"
            assert {type(answer).__name__ for answer in answers} == {"Site", "Arrays", "Tracks", "Health"}
            return found

    assert asyncio.run(follow()) == ["old-1", "b"]


def test_questions_have_typed_answers(server: Server) -> None:
    with connect(server.url) as asked:
        assert asked.site().site == "small"
        assert [array.name for array in asked.arrays().arrays] == ["north", "south"]
        assert asked.tracks().tracks == []
        assert asked.health().status == "starting"
        assert [event.id for event in asked.events()] == ["old-2", "old-1", "old-0"]
        assert [event.id for event in asked.events(since=datetime(2027, 1, 1, tzinfo=UTC))] == []
        assert asked.event("old-0").confidence == 0.5
        with pytest.raises(RefusedError, match="no event 'none'"):
            asked.event("none")


def test_pages_are_followed(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.client.questions.PAGE", 1)
    with connect(server.url) as asked:
        assert [event.id for event in asked.events()] == ["old-2", "old-1", "old-0"]


def test_close_ends_the_iteration_of_another_thread(server: Server) -> None:
    live = connect(server.url, kinds=["alert"])
    follower = Thread(target=lambda: list(live))
    follower.start()
    clients(server, 1)
    live.close()
    follower.join(timeout=HANG_S)
    assert not follower.is_alive()


def test_iteration_goes_on_where_it_ended(server: Server) -> None:
    with connect(server.url, kinds=["event"]) as live:
        first = iter(live)
        Thread(target=publish_to_one, args=(server, event_message(id="c-0"))).start()
        assert next(first).id == "c-0"  # type: ignore[union-attr]
        first.close()  # type: ignore[attr-defined]
        clients(server, 0)
        publish(server, event_message(id="c-1"))
        assert next(iter(live)).id == "c-1"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (Options(kinds=["events"]), "kinds: expected some of"),
        (Options(zone="hall"), "zone: no zone 'hall'; zones are door"),
        (Options(min_confidence=7.0), "min_confidence: expected a number from 0 to 1, got '7.0'"),
    ],
)
def test_wrong_filter_is_an_error_and_no_reason_to_try_again(server: Server, options: Options, reason: str) -> None:
    with connect(server.url, **options) as live, pytest.raises(RefusedError) as caught:
        next(iter(live))
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("url", "given", "reason"),
    [
        ("127.0.0.1:8000", {}, "url: expected an address such as http://127.0.0.1:8000, got '127.0.0.1:8000'"),
        ("http://site.example", {"ca_file": "site.crt"}, "ca_file: expected an address that begins with https://"),
        ("https://site.example", {"ca_file": "missing.crt"}, "ca_file: cannot read certificates from missing.crt"),
        ("http://site.example", {"kinds": "event"}, "kinds: expected several texts such as ['event'], got one text"),
        ("http://site.example", {"since": datetime(2026, 1, 1)}, "since: expected a time with an offset"),  # noqa: DTZ001
        ("http://site.example", {"token": "a\r\nb"}, "token: expected the text that `livessl keys token` printed"),
    ],
)
def test_unusable_argument_is_refused_at_once(url: str, given: dict[str, Any], reason: str) -> None:
    with pytest.raises(UseError) as caught:
        connect(url, **given)
    assert str(caught.value).startswith(reason)


def test_client_without_a_server_gives_up_when_it_was_told_to() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    with connect(url, give_up_s=0.0) as live:
        with pytest.raises(UnreachableError, match="no answer from a server"):
            next(iter(live))
        with pytest.raises(UnreachableError, match="no answer from a server"):
            live.site()


def test_token_is_sent_and_its_revocation_ends_the_client(tmp_path: Path) -> None:
    path = tmp_path / "tokens.yaml"
    token = add_token(path, "program", "viewer")
    add_token(path, "other", "viewer")
    with running_server(site_of({"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        with connect(server.url) as stranger:
            with pytest.raises(RefusedError, match="answered 403 to the WebSocket; give a token"):
                next(iter(stranger))
            with pytest.raises(RefusedError, match="answered 401"):
                stranger.site()
            assert type(stranger.health()).__name__ == "HealthStatus"
        with connect(server.url, token) as live:
            assert live.site().site == "small"
            messages = iter(live)
            assert next(messages).kind == "hello"
            revoke_token(path, "program")
            with pytest.raises(RefusedError, match="the token is no longer valid"):
                for _ in messages:
                    pass


def test_all_options_reach_the_server() -> None:
    given = Options(kinds=["update", "event"], zone="door", min_confidence=0.5, track=7, max_rate_hz=2.0)
    wanted = Wanted.of(given)
    assert wanted.query == {
        "kinds": "event,update", "zone": "door", "min_confidence": "0.5", "track": "7", "max_rate_hz": "2.0",
    }  # fmt: skip
    assert wanted.filters == {"zone": "door", "min_confidence": "0.5"}
    assert isinstance(connect("http://site.example", **given), Client)
