"""Listening live to a microphone: the samples that it sent, for operators, and only where the site permits it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from livessl.errors import ConfigError
from livessl.server.app import Server
from livessl.server.clips.listeners import FULL_SCALE, HEADER, MOST_LISTENERS, MOST_QUEUED, Listeners
from livessl.site.tokens import add_token
from scene_server import capture_scene
from small_site import HANG_S, RATE_HZ, frame, heard, mark, running_server, site_of, wait_until

LISTEN = {"server.listen": True}
PER_FRAME = RATE_HZ // 20


def listen(server: Server, query: str = "?array=north&channel=2", token: str | None = None) -> Any:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    url = f"ws{server.url.removeprefix('http')}/api/v1/listen{query}"
    return connect(url, open_timeout=HANG_S, additional_headers=headers)


def test_listener_gets_what_the_microphone_received() -> None:
    truth = np.round(np.clip(heard("north")[1], -1, 1) * np.float32(FULL_SCALE)).astype(np.int16)
    with running_server(site_of(LISTEN)) as server:
        with listen(server) as socket:
            wait_until(lambda: server.parts.listeners.count == 1, "the listener")
            capture_scene(server)
            messages = [socket.recv(timeout=HANG_S) for _ in range(16)]
        wait_until(lambda: server.parts.listeners.count == 0, "the end of the listener")
    heads = [HEADER.unpack_from(message) for message in messages]
    assert {(rate_hz, left_out) for _, rate_hz, left_out in heads} == {(float(RATE_HZ), 0)}
    pieces = [np.frombuffer(message, "<i2", offset=HEADER.size) for message in messages]
    assert {len(piece) for piece in pieces} == {PER_FRAME}
    first_ns = heads[0][0]
    starts = [round((time_ns - first_ns) * RATE_HZ / 1e9) for time_ns, _, _ in heads]
    places = [at for at in range(len(truth) - PER_FRAME + 1) if np.array_equal(truth[at : at + 8], pieces[0][:8])]
    assert len(places) == 1
    for start, piece in zip(starts, pieces, strict=True):
        np.testing.assert_array_equal(piece, truth[places[0] + start : places[0] + start + PER_FRAME])


@pytest.mark.parametrize(
    ("changes", "query", "said"),
    [
        ({}, "?array=north", "listen: the site file does not permit it; set server.listen: true"),
        (LISTEN, "?array=nroth", "array: no array 'nroth'; there are north, south"),
        (LISTEN, "?array=north&channel=5", "channel: expected a number from 1 to 4, got '5'"),
        (LISTEN, "?array=north&channel=-1", "channel: expected a number from 1 to 4, got '-1'"),
        (LISTEN, "?array=north&chanel=1", "unknown parameter 'chanel'; did you mean 'channel'?"),
    ],
)
def test_wrong_request_is_closed_with_the_reason(changes: dict[str, Any], query: str, said: str) -> None:
    with (
        running_server(site_of(changes)) as server,
        listen(server, query) as socket,
        pytest.raises(ConnectionClosed) as caught,
    ):
        socket.recv(timeout=HANG_S)
    assert caught.value.rcvd is not None
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, said)


def test_viewer_may_not_listen(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of({**LISTEN, "server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        with pytest.raises(InvalidStatus) as caught:
            listen(server, token=token).__enter__()
        assert caught.value.response.status_code == 403


def test_positions_only_refuses_listening() -> None:
    with pytest.raises(ConfigError, match=r"server\.listen: with privacy: positions-only listening is not allowed"):
        site_of({**LISTEN, "privacy": "positions-only"})


@given(count=st.integers(1, 3 * MOST_QUEUED))
def test_client_that_does_not_read_loses_the_oldest_and_is_told_how_many(count: int) -> None:
    async def run() -> list[tuple[int, int]]:
        listeners = Listeners()
        with listeners.listening("north", 1) as listener:
            listeners.take([frame(n, n) for n in range(count)], None)
            listeners.take([frame(n, n, "south") for n in range(5)], None)
            listeners.take([mark(1, 1), frame(1, 1).without_samples()], None)
            await asyncio.sleep(0)
            found = [HEADER.unpack_from(await listener.next()) for _ in range(min(count, MOST_QUEUED))]
        return [(round(time_ns / 5e7), left_out) for time_ns, _, left_out in found]

    found = asyncio.run(run())
    lost = max(0, count - MOST_QUEUED)
    assert found == [(n, lost if n == lost else 0) for n in range(lost, count)]


def test_number_of_listeners_is_limited() -> None:
    async def run() -> None:
        listeners = Listeners()
        contexts = [listeners.listening("north", 1) for _ in range(MOST_LISTENERS)]
        for context in contexts:
            context.__enter__()
        with pytest.raises(ValueError, match="8 clients listen already"), listeners.listening("north", 1):
            pass
        contexts[0].__exit__(None, None, None)
        with listeners.listening("north", 1):
            assert listeners.count == MOST_LISTENERS

    asyncio.run(run())
