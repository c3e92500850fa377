"""Decides what a client receives after a lost connection: catches up from the event log, without gaps or duplicates.

The waits before a new connection are in `retry`. This module knows no socket.

`conversation` is a generator of steps for one connection, and `Memory` is what outlives the connection. Events come
over the WebSocket, and after every new connection also from the server's log of stored events; each is delivered once.
The log is read once in a while besides, so that a client that runs for months remembers a bounded number of events.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, NamedTuple, get_args

from pydantic import TypeAdapter, ValidationError

from livessl.client.options import Wanted
from livessl.client.reading import NewerServerError, read_answer
from livessl.schema.alerts import Alert
from livessl.schema.answers import EventLog, EventPage
from livessl.schema.messages import (
    MESSAGES,
    ArraysMessage,
    EventMessage,
    Gap,
    Hello,
    Message,
    PosesMessage,
    TrackMessage,
    UpdateMessage,
    ZoneMessage,
    ZonesMessage,
)
from livessl.schema.values import Event

REMEMBERED: Final = 20_000
"""Most events that are remembered to recognize a second copy. A server holds at most 10 000 that it has published and
not stored, and `COMPARED` more can follow until the log is read again."""

COMPARED: Final = 1000
"""Events after which the log is read although no connection was lost."""

RETRY_S: Final = 2.0
"""Seconds after which the log is read again if the server could not answer, or had not stored all events."""

PAGE: Final = 500
"""Events that are asked for at once."""

_KINDS: Final = frozenset(get_args(model.model_fields["kind"].annotation)[0] for model in MESSAGES)

Received = (
    Hello
    | Event
    | UpdateMessage
    | TrackMessage
    | ArraysMessage
    | PosesMessage
    | Alert
    | ZoneMessage
    | ZonesMessage
    | Gap
)
"""Values that a client delivers. An event is an `EventMessage` if it came live, and an `Event` if it was missed."""


@dataclass(frozen=True, slots=True)
class Get:
    """Step: send `GET /api/v1/PATH`; its result is the body, or None if the server cannot answer now."""

    path: str
    query: dict[str, str]


@dataclass(frozen=True, slots=True)
class Receive:
    """Step: wait for the next message of the WebSocket; its result is the text, or None after so many seconds."""

    patience_s: float | None = None


@dataclass(frozen=True, slots=True)
class Deliver:
    """Step: hand a message to the user; it has no result."""

    message: Received


Steps = Generator[Get | Receive | Deliver, str | bytes | None, None]


@dataclass(slots=True)
class Memory:
    """Knowledge of a client that outlives one connection."""

    last_seq: int | None = None
    """Number of the last message received."""
    position: str | None = None
    """Place in the server's log up to which all events are delivered."""
    is_behind: bool = True
    """True if the log is to be read."""
    unread: int = 0
    """Events delivered since the log was read."""
    _known: OrderedDict[str, _Known] = field(default_factory=OrderedDict)

    def is_news(self, event: Event) -> bool:
        """Return whether an event is to be delivered, because its answer is neither known nor outdated; remember it.

        After an event came from the log, its other answers come from there, too: a live one may be an older one that
        was still on its way.
        """
        known = self._known.get(event.id, _Known((), is_logged=False))
        answer, is_live = _answer(event), isinstance(event, EventMessage)
        if answer in known.answers:
            return False
        if is_live and known.is_logged:
            self.is_behind = True
            return False
        self._known[event.id] = _Known((*known.answers, answer), is_logged=not is_live)
        self._known.move_to_end(event.id)
        if len(self._known) > REMEMBERED:
            self._known.popitem(last=False)
        self.unread += 1
        return True


class _Known(NamedTuple):
    """The hashes of the answers that were delivered of an event, and whether one came from the log."""

    answers: tuple[int, ...]
    is_logged: bool


def _answer(event: Event) -> int:
    """Return a hash of what an event says about the sound."""
    covariance = (value for row in event.covariance_m2 or () for value in row)
    when = event.time_utc or event.start_s
    what = (
        event.confidence,
        event.status,
        tuple(event.replaces),
        *event.arrays,
        *(event.position_m or ()),
        *covariance,
    )
    return hash((when, event.duration_s, *what))


def live_query(memory: Memory, wanted: Wanted) -> dict[str, str]:
    """Return the query of the next connection's WebSocket."""
    return wanted.query if memory.last_seq is None else {**wanted.query, "since_seq": str(memory.last_seq)}


def conversation(memory: Memory, wanted: Wanted, monotonic_s: Callable[[], float]) -> Steps:
    """The steps of a connection, until the user or the connection ends it.

    Parameters
    ----------
    memory : Memory
    wanted : Wanted
    monotonic_s : callable
        Returns seconds by a monotonic clock.

    Raises
    ------
    NewerServerError, ForeignAnswerError
        If a message or an answer cannot be read.
    """
    memory.is_behind = True
    next_read_s = monotonic_s()
    hello = parse((yield Receive()))
    if not isinstance(hello, Hello):
        raise NewerServerError("expected a message of the kind 'hello' first, got another; update livessl")
    if memory.last_seq is None:
        memory.last_seq = hello.last_seq
    if wanted.kinds is None:
        yield Deliver(hello)
    while True:
        now_s = monotonic_s()
        memory.is_behind |= memory.unread >= COMPARED
        if wanted.has_events and memory.is_behind and now_s >= next_read_s:
            yield from _read_log(memory, wanted)
            now_s = monotonic_s()
            next_read_s = now_s + RETRY_S if memory.is_behind else now_s
        text = yield Receive(max(next_read_s - now_s, 0.0) if wanted.has_events and memory.is_behind else None)
        message = None if text is None else parse(text)
        if isinstance(message, Gap):
            memory.is_behind = True
            if wanted.kinds != frozenset({"event"}):  # the log has the events
                yield Deliver(message)
        elif message is not None and not isinstance(message, Hello):
            memory.last_seq = message.seq
            if not isinstance(message, EventMessage) or memory.is_news(message):
                yield Deliver(message)


def _read_log(memory: Memory, wanted: Wanted) -> Steps:
    """Deliver the stored events that did not come live; without an answer, try again later."""
    if memory.position is None:
        yield from _begin(memory, wanted)
        return
    has_more = True
    while has_more:
        body = yield Get("event-log", {**wanted.filters, "after": memory.position, "limit": str(PAGE)})
        if body is None:
            return
        page = read_answer(EventLog, body, "event-log")
        if not page.complete:
            reason = "the server does not have all events since the connection was lost; it may have lost its history"
            yield Deliver(Gap(kind="gap", v=1, missed=None, reason=reason))
        for event in page.events:
            if memory.is_news(event):
                yield Deliver(event)
        memory.position, has_more = page.position, page.more
    memory.is_behind, memory.unread = page.unsaved > 0, 0


def _begin(memory: Memory, wanted: Wanted) -> Steps:
    """Note the place in the log from which nothing must be missed, and deliver the events that the user wants first."""
    body = yield Get("event-log", {})
    if body is None:
        return
    begin, events, cursor = read_answer(EventLog, body, "event-log"), list[Event](), ""
    while wanted.since is not None and cursor is not None:
        query = {**wanted.filters, "since": wanted.since, "limit": str(PAGE)}
        body = yield Get("events", query if cursor == "" else {**query, "cursor": cursor})
        if body is None:
            return
        page = read_answer(EventPage, body, "events")
        events += page.events
        cursor = page.next_cursor  # type: ignore[assignment]
    memory.position, memory.is_behind = begin.position, begin.unsaved > 0  # there is no further request that could fail
    for event in reversed(events):
        if memory.is_news(event):
            yield Deliver(event)
    memory.unread = 0


def parse(text: str | bytes | None) -> Any:
    """Return the message in a text; None if it is of a kind that this client does not know, which it may ignore.

    Raises
    ------
    NewerServerError
        If it is of a known kind, and cannot be read.
    """
    try:
        return _messages().validate_json(text or b"")
    except ValidationError as error:
        kind = _kind_of(text)
        if kind is not None and kind not in _KINDS:
            return None
        fault = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in fault["loc"])
        what = f"cannot read a message of the kind {kind!r}: {where}: {fault['msg']}"
        raise NewerServerError(f"{what}; update livessl, the server is newer") from error


@cache
def _messages() -> TypeAdapter[Any]:
    return TypeAdapter(Message)


def _kind_of(text: str | bytes | None) -> str | None:
    try:
        kind = json.loads(text or b"")["kind"]
    except (ValueError, KeyError, TypeError):
        return None
    return str(kind)
