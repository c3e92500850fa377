"""Parts of both ends of the stream: requests for messages, standstill, and connections that have to be secret."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import nats
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error
from nats.errors import TimeoutError as NatsTimeoutError
from nats.js.api import ConsumerInfo, SequenceInfo

from hub_desk import SiteDesk, hub_site, ids_at, make_hub, running_hub, running_site, sounds
from livessl.clock import SystemClock
from livessl.federation.archive import Archive
from livessl.federation.config import Hub
from livessl.federation.intake import BATCH, Intake, RefusedError
from livessl.federation.standstill import STANDSTILL_S, Standstill
from livessl.server.forwarding.outbox import Outgoing
from livessl.server.forwarding.stream import STREAM, connect_options, connected, ended, first_number, outbox_name
from livessl.site.hub_models import NatsConfig
from nats_servers import NatsServer, running_nats
from small_site import wait_until


@pytest.mark.parametrize("deaf", [0, 1, 3])
def test_tasks_end_although_they_lose_cancellations(deaf: int) -> None:
    async def goes_on() -> None:
        for _ in range(deaf):
            with suppress(asyncio.CancelledError):
                await asyncio.sleep(1000)
        await asyncio.sleep(1000)

    async def fails() -> None:
        raise LookupError

    async def work() -> None:
        tasks = [asyncio.create_task(each) for each in (goes_on(), asyncio.sleep(0), fails())]
        await asyncio.sleep(0)
        await ended(*tasks)
        assert all(task.done() for task in tasks)
        assert isinstance(tasks[-1].exception(), LookupError)

    asyncio.run(work())


class Waiting:
    """A subscription with these messages: numbers stand for messages of a stream, texts for statuses."""

    def __init__(self, *messages: int | str) -> None:
        self._messages = deque(messages)
        self.stalls = 0

    @property
    def pending_msgs(self) -> int:
        return len(self._messages)

    async def next_msg(self, timeout: float) -> Msg:
        if not self._messages:
            self.stalls += 1
            raise NatsTimeoutError
        what = self._messages.popleft()
        headers = {"Status": what, "Description": "told"} if isinstance(what, str) else None
        return Msg(_client=Client(), subject="s", data=str(what).encode(), headers=headers)


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[tuple[Hub, Archive]]:
    hub = make_hub("hub.sqlite", ["nats://127.0.0.1:1"], tmp_path)
    archive = Archive(hub.database, SystemClock())
    yield hub, archive
    archive.close()


@pytest.fixture
def intake(parts: tuple[Hub, Archive]) -> Any:
    return Intake(*parts, SystemClock())


def test_intake_ends_whole_although_its_connection_loses_cancellations(parts: tuple[Hub, Archive]) -> None:
    lost, left = 0, False

    class LosingIntake(Intake):
        async def _receive(self) -> None:
            nonlocal lost, left
            try:
                for _ in range(3):
                    with suppress(asyncio.CancelledError):
                        await asyncio.sleep(1000)
                    lost += 1
                await asyncio.sleep(1000)
            finally:
                left = True

    async def work() -> None:
        running = asyncio.create_task(LosingIntake(*parts, SystemClock()).run())
        await asyncio.sleep(0.01)
        await ended(running)
        assert (lost, left) == (3, True)

    asyncio.run(work())


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 40), most=st.integers(1, 40), status=st.sampled_from(["404", "408"]))
def test_a_request_ends_by_its_last_message_or_its_status_without_a_wait(
    intake: Any, count: int, most: int, status: str
) -> None:
    waiting = Waiting(*range(count), status)
    left, is_ended, got = most, False, 0
    while left and not is_ended:
        batch, is_ended = asyncio.run(intake._next_batch(waiting, left))
        got, left = got + len(batch), left - len(batch)
    assert (got, waiting.stalls) == (min(count, most), 0)
    assert is_ended == (count < most)


@pytest.mark.parametrize("status", ["503", "409"])
def test_a_refusal_is_no_end_of_a_request(intake: Any, status: str) -> None:
    waiting = Waiting(1, status, status)
    batch, is_ended = asyncio.run(intake._next_batch(waiting, BATCH))
    assert (len(batch), is_ended) == (1, True)
    with pytest.raises(RefusedError, match=f"{status} told"):
        asyncio.run(intake._next_batch(waiting, BATCH))


def consumer(waiting: int, delivered: int) -> ConsumerInfo:
    return ConsumerInfo(
        name="hub",
        stream_name="s",
        config=None,  # type: ignore[arg-type]  # nobody reads it
        delivered=SequenceInfo(delivered, delivered),
        num_waiting=waiting,
        created=None,  # type: ignore[arg-type]
    )


def test_a_consumer_that_nobody_asks_stands_still() -> None:
    still, step_ns = Standstill(), round(0.6e9 * STANDSTILL_S)
    looks = [
        consumer(1, 5),
        consumer(0, 5),
        consumer(0, 5),
        consumer(0, 6),
        consumer(0, 6),
        consumer(0, 6),
        consumer(1, 6),
    ]
    found = [still.holds(look, number * step_ns) for number, look in enumerate(looks)]
    assert found == [False, False, True, False, False, True, False]


def test_a_server_without_tls_gets_no_password() -> None:
    """The first line of a server is not secret, so whoever is on the way can leave out that TLS is wanted."""
    received: list[bytes] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b'INFO {"server_id":"x","version":"2.9.10","max_payload":1000,"auth_required":true}\r\n')
        received.append(await reader.read(1000))
        writer.close()

    async def ignore(*_: Any) -> None:
        return

    async def attempt() -> None:
        server = await asyncio.start_server(answer, "127.0.0.1", 0)
        url = f"tls://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        options = connect_options(NatsConfig(servers=(url,)), Path, "nats") | {"user": "lab", "password": "secret"}
        with pytest.raises(Error, match="offers no TLS"):
            async with connected(nats, options, ignore, ignore):
                pass
        server.close()
        await server.wait_closed()

    asyncio.run(asyncio.wait_for(attempt(), 60))
    assert b"".join(received) == b""


def test_a_connection_that_died_silently_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library closes it after unanswered pings, but does not report that it is lost if TLS cannot be ended."""
    attempts: list[Dead] = []

    class Dead:
        is_closed = True

        def jetstream(self) -> None:
            return

        async def publish(self, *_: object) -> None:
            return

    @asynccontextmanager
    async def connects(*_: object) -> AsyncIterator[Dead]:
        attempts.append(Dead())
        yield attempts[-1]

    monkeypatch.setattr("livessl.server.forwarding.link.connected", connects)
    desk = SiteDesk(hub_site(tmp_path, "lab", ["nats://127.0.0.1:1"]))
    alerts = [{"kind": "alert", "key": f"a{n}", "raised_utc": "2026-01-01T00:00:00Z"} for n in range(2)]
    desk.link.messages.take_alerts(alerts)
    desk.link.messages.take_alerts([])
    assert [each.kind for each in desk.outbox.unsent(10)] == ["alert", "alert"]
    desk.start()
    wait_until(lambda: len(attempts) > 2, "further connections")
    desk.close()
    assert desk.link.failure is None


@given(first=st.integers(1, 2**59))
def test_an_outbox_says_at_which_number_it_begins(first: int) -> None:
    assert first_number(outbox_name(first)) == first
    assert first_number("0123456789012345") == first_number("a.b") == 1  # of other releases


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsServer]:
    with running_nats(tmp_path_factory.mktemp("nats")) as made:
        yield made


def connections(server: NatsServer, name: str) -> list[dict[str, object]]:
    answer = httpx.get(f"http://127.0.0.1:{server.monitor}/connz?subs=1").json()
    return [each for each in answer["connections"] if each["name"] == name]


async def delete_stream(url: str) -> None:
    client = await nats.connect(url)
    await client.jetstream().delete_stream(STREAM)
    await client.close()


def test_a_deleted_stream_is_made_again_and_nothing_is_lost(server: NatsServer, tmp_path: Path) -> None:
    hub_file = make_hub("hub.sqlite", [server.url], tmp_path)
    with running_hub(hub_file) as hub, running_site(hub_site(tmp_path, "lab.2", [server.url])) as desk:
        desk.finish(*sounds("lab.2", 0, 2))
        wait_until(lambda: len(ids_at(hub.url, "lab.2")) == 2, "events")
        asyncio.run(delete_stream(server.url))
        desk.finish(*sounds("lab.2", 2, 2))
        wait_until(lambda: len(ids_at(hub.url, "lab.2")) == 4, "events")
        assert ids_at(hub.url, "lab.2") == [f"lab.2-{number}" for number in range(4)]


def has_sent(desk: SiteDesk, count: int) -> bool:
    return desk.link.sent >= count


def test_many_windows_need_one_subscription_and_a_message_too_large_is_given_up(
    server: NatsServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A second start sends what waits under a new name, as a restored database would repeat numbers."""
    hub_file = make_hub("hub.sqlite", [server.url], tmp_path)
    with running_hub(hub_file) as hub, running_site(hub_site(tmp_path, "lab.3", [server.url])) as desk:
        for number in range(5):
            desk.finish(*sounds("lab.3", number, 1))
            wait_until(partial(has_sent, desk, number + 2), "the beginning and the events, in windows of their own")
        wait_until(lambda: len(ids_at(hub.url, "lab.3")) == 5, "events")
        assert [each["subscriptions"] for each in connections(server, "livessl lab.3")] == [1]
        first_name = desk.outbox.head().outbox
        desk.outbox.put([Outgoing("event", 0, {"text": "x" * 2_000_000})])
        wait_until(lambda: desk.link.dropped == 1 and not desk.outbox.unsent(1), "the end of a large message")
    assert "max_payload" in caplog.text
    with running_site(hub_site(tmp_path, "lab.3", [server.url])) as desk:
        wait_until(lambda: desk.outbox.head().outbox != first_name, "a new name")
