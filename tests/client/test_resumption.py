"""What a client delivers while connections and servers come and go: every event, and each answer of it once."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.client import resumption
from livessl.client.options import Options, Wanted
from livessl.client.reading import NewerServerError
from livessl.client.resumption import (
    Deliver,
    Get,
    Memory,
    Receive,
    Steps,
    conversation,
    live_query,
    parse,
)
from messages import event_message, update_message

PAST = 3
"""Messages that the server of this test keeps: few, so that gaps are common."""

PAGE = 2
"""Events in an answer of its log."""

EVENTS_ONLY = Wanted.of(Options(kinds=["event"]))


@dataclass
class ModelServer:
    """A server that publishes before it stores, and publishes again after a crash what was not stored."""

    is_durable: bool
    life: int = 0
    seq: int = 1000
    past: list[dict[str, Any]] = field(default_factory=list)
    unsaved: list[dict[str, Any]] = field(default_factory=list)
    log: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    number: int = 0
    clients: list[list[str]] = field(default_factory=list)
    is_available: bool = True
    is_full: bool = False

    def publish(self, event: dict[str, Any]) -> None:
        self.seq += 1
        message = {"v": 1, "seq": self.seq, **event}
        self.past = [*self.past, message][-PAST:]
        for queue in self.clients:
            queue.append(json.dumps(message))
        self.unsaved.append(event)

    def store(self) -> None:
        if self.unsaved and not self.is_full:
            event = self.unsaved.pop(0)
            self.log = [(number, other) for number, other in self.log if other["id"] != event["id"]]
            self.number += 1
            self.log.append((self.number, event))

    def restart(self) -> None:
        self.clients = []
        self.life += 1
        self.seq = 1000 * (self.life + 1)
        self.past, again = [], self.unsaved
        if not self.is_durable:  # the nodes have acknowledged frames of what was stored, and send the others again
            self.log, self.number = [], 0
        self.unsaved = []
        for event in again:
            self.publish(event)

    def connect(self, query: dict[str, str]) -> list[str]:
        queue = [json.dumps(hello(self.seq))]
        if "since_seq" in query:
            since = int(query["since_seq"])
            if not self.seq - len(self.past) <= since <= self.seq:
                queue.append(json.dumps({"kind": "gap", "v": 1, "missed": None, "reason": "too old"}))
            queue += [json.dumps(message) for message in self.past if message["seq"] > since]
        self.clients.append(queue)
        return queue

    def answer(self, step: Get) -> bytes | None:
        if not self.is_available:
            return None
        while self.unsaved and not self.is_full:  # a reader waits for what was published before
            self.store()
        life = 0 if self.is_durable else self.life + 1
        head = {"v": 1, "complete": True, "more": False, "events": [], "unsaved": len(self.unsaved)}
        if "after" not in step.query:
            return json.dumps({**head, "position": f"{life}-{self.number}"}).encode()
        of_life, after = map(int, step.query["after"].split("-"))
        begin = after if of_life == life else 0
        rows = [row for row in self.log if row[0] > begin]
        more, rows = len(rows) > PAGE, rows[:PAGE]
        position = rows[-1][0] if more else max(self.number, begin)
        events = [event for _, event in rows]
        page = {"complete": of_life == life, "more": more, "events": events, "position": f"{life}-{position}"}
        return json.dumps({**head, **page}).encode()


def hello(seq: int) -> dict[str, Any]:
    return {
        "kind": "hello", "v": 1, "seq": seq, "last_seq": seq, "now_utc": "2026-01-01T00:00:00Z", "site": "small",
        "mode": "live", "role": "admin", "arrays": [], "overload": None,
    }  # fmt: skip


@dataclass
class ModelClient:
    """Carries out the steps of a client against a model of a server."""

    server: ModelServer
    wanted: Wanted = EVENTS_ONLY
    memory: Memory = field(default_factory=Memory)
    delivered: list[Any] = field(default_factory=list)
    steps: Steps | None = None
    pending: Any = None
    queue: list[str] = field(default_factory=list)
    now_s: float = 0.0

    def cut(self) -> None:
        self.steps = None

    def step(self) -> bool:
        """Carry out a step, and deliver what it yields; return False if the client waits for a message."""
        if self.steps is None:
            self.queue = self.server.connect(live_query(self.memory, self.wanted))
            self.steps = conversation(self.memory, self.wanted, lambda: self.now_s)
            self.pending = next(self.steps)
        match self.pending:
            case Receive() if not self.queue and self.pending.patience_s is None:
                return False
            case Receive():
                result: Any = self.queue.pop(0) if self.queue else None
                self.now_s += 0.001 if result is not None else self.pending.patience_s or 0.0
            case Get():
                result = self.server.answer(self.pending)
        self.pending = self.steps.send(result)
        while isinstance(self.pending, Deliver):
            self.delivered.append(self.pending.message)
            self.pending = next(self.steps)
        return True

    def settle(self) -> None:
        for _ in range(10_000):
            if not self.step():
                return
        pytest.fail("the client asks for ever")


def answers(client: ModelClient) -> list[tuple[str, float]]:
    return [(message.id, message.confidence) for message in client.delivered if message.kind == "event"]


ACTIONS = st.lists(
    st.sampled_from(
        ["publish", "publish", "late", "store", "store", "step", "step", "step", "cut", "restart", "away", "full"]
    ),
    max_size=80,
)


@given(actions=ACTIONS, is_durable=st.booleans())
def test_every_event_is_delivered_and_each_answer_once(actions: list[str], is_durable: bool) -> None:
    server = ModelServer(is_durable)
    client = ModelClient(server)
    client.settle()  # from the first connection on, nothing may be lost
    newest: dict[str, float] = {}
    lost: set[str] = set()
    for action in actions:
        match action:
            case "publish":
                newest[f"small-{len(newest)}"] = 0.5
                server.publish(event_message(id=f"small-{len(newest) - 1}", confidence=0.5))
            case "late" if newest:
                newest[f"small-{len(newest) - 1}"] += 0.001
                name = f"small-{len(newest) - 1}"
                server.publish(event_message(id=name, confidence=newest[name], late=True))
            case "store":
                server.store()
            case "step":
                client.step()
            case "cut":
                client.cut()
            case "restart":
                if not is_durable:  # a history in memory is gone
                    lost |= {event["id"] for _, event in server.log}
                server.restart()
                client.cut()
            case "away":
                server.is_available = not server.is_available
            case "full":
                server.is_full = not server.is_full
    server.is_available, server.is_full = True, False
    client.settle()
    got = answers(client)
    assert len(set(got)) == len(got)
    assert {name: answer for name, answer in dict(got).items() if name not in lost} == {
        name: answer for name, answer in newest.items() if name not in lost
    }


def test_model_loses_events_without_the_log() -> None:
    """The property above is not trivial: the WebSocket alone loses what a restarted server has forgotten."""
    server = ModelServer(is_durable=True)
    client = ModelClient(server, memory=Memory(position="none"))
    client.settle = lambda: None  # type: ignore[method-assign]
    queue = server.connect({})
    server.publish(event_message(id="small-0"))
    server.store()
    server.restart()
    assert len(queue) == 2
    assert [json.loads(text)["kind"] for text in server.connect({"since_seq": "1000"})] == ["hello", "gap"]


def test_history_that_is_lost_is_reported() -> None:
    server = ModelServer(is_durable=False)
    client = ModelClient(server)
    client.settle()
    server.publish(event_message(id="small-0"))
    server.store()
    server.restart()
    client.cut()
    client.settle()
    [gap] = client.delivered
    assert gap.kind == "gap"
    assert "may have lost its history" in gap.reason


def test_stored_events_come_first_and_once() -> None:
    """With `since`, events from before the connection are delivered in order of time, then live ones."""
    server = ModelServer(is_durable=True)
    stored = [event_message(id=f"small-{k}") for k in range(4)]
    for event in stored[:3]:
        server.publish(event)
    wanted = Wanted.of(Options(kinds=["event"], since="2026-01-01T00:00:00Z"))
    client = ModelClient(server, wanted)
    pages = {"": ([2, 1], "more"), "more": ([0], None)}
    answer = server.answer

    def with_history(step: Get) -> bytes | None:
        if step.path != "events":
            return answer(step)
        assert step.query["since"] == wanted.since
        names, cursor = pages[step.query.get("cursor", "")]
        events = [stored[k] for k in names]
        return json.dumps({"v": 1, "events": events, "next_cursor": cursor, "previous_cursor": None}).encode()

    server.answer = with_history  # type: ignore[method-assign]
    client.step()
    server.publish(stored[3])
    client.settle()
    assert [message.id for message in client.delivered] == [event["id"] for event in stored]


def test_memory_is_bounded_and_the_log_is_read_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resumption, "COMPARED", 10)
    monkeypatch.setattr(resumption, "REMEMBERED", 25)
    server = ModelServer(is_durable=True)
    client = ModelClient(server)
    client.settle()
    reads, answer = 0, server.answer

    def counted(step: Get) -> bytes | None:
        nonlocal reads
        reads += 1
        return answer(step)

    server.answer = counted  # type: ignore[method-assign]
    for k in range(60):
        server.publish(event_message(id=f"small-{k}"))
        server.store()
        client.settle()
    assert len(client.delivered) == 60
    assert reads >= 6
    newest, oldest = client.delivered[-1], client.delivered[0]
    assert not client.memory.is_news(newest)
    assert client.memory.is_news(oldest)  # forgotten


def test_failing_log_is_not_read_for_every_message() -> None:
    server = ModelServer(is_durable=True, is_available=False)
    client = ModelClient(server)
    asked: list[float] = []
    answer = server.answer

    def noted(step: Get) -> bytes | None:
        asked.append(client.now_s)
        return answer(step)

    server.answer = noted  # type: ignore[method-assign]
    client.step()
    for k in range(100):
        server.publish(event_message(id=f"small-{k}"))
    for _ in range(120):
        client.step()
    assert len(client.delivered) == 100
    assert len(asked) < 15
    assert min(later - before for before, later in pairwise(asked)) >= 0.99 * resumption.RETRY_S
    assert client.memory.is_behind
    server.is_available = True
    client.settle()
    assert not client.memory.is_behind


def test_withdrawal_is_another_answer() -> None:
    """The event alone is the same; that it replaces the second source is news."""
    memory = Memory()
    for replaces, is_news in (([], True), (["small-2"], True), (["small-2"], False), ([], False)):
        text = json.dumps({"v": 1, "seq": 4, **event_message(id="small-1", replaces=replaces)})
        assert memory.is_news(parse(text)) == is_news


def test_gap_in_other_messages_is_delivered() -> None:
    server = ModelServer(is_durable=True)
    everything = ModelClient(server, Wanted())
    everything.settle()
    assert [message.kind for message in everything.delivered] == ["hello"]
    everything.queue.append(json.dumps({"kind": "gap", "v": 1, "missed": 3, "reason": "too slow"}))
    everything.settle()
    assert everything.delivered[-1].missed == 3


def test_unknown_kinds_and_fields_are_ignored() -> None:
    assert parse('{"kind": "smell", "v": 1, "seq": 4}') is None
    message = parse(json.dumps({"v": 1, "seq": 4, "colour": "red", **update_message()}))
    assert message.kind == "update"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (json.dumps({"v": 1, "seq": 4, **event_message(status="guessed")}), "event.status"),
        ('{"kind": "event"}', "Field required"),
        ("no JSON", "Invalid JSON"),
    ],
)
def test_unreadable_message_says_that_the_server_is_newer(text: str, what: str) -> None:
    with pytest.raises(NewerServerError, match=r"update livessl, the server is newer") as caught:
        parse(text)
    assert what in str(caught.value)
