"""`livessl relocate --url`: asks a running server to locate its events again, and waits while it is busy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import quote, urlencode

from livessl.cli.output import complain
from livessl.cli.server_answers import RefusedError, ask_for, order
from livessl.clock import SystemClock, utc_text
from livessl.errors import RunError, UseError
from livessl.schema.answers import EventPage
from livessl.schema.relocation import Relocated, RelocationSettings, unanswered
from livessl.schema.values import Event
from livessl.server.api.clip_schema import EventClips

ANSWER_S: Final = 600.0
"""Longest wait, in seconds, for a server that locates an event: sounds of a minute take long beside live ones."""

PAGE: Final = 200
"""Events that are asked for at a time."""

BUSY_S: Final = 120.0
"""Longest wait, in seconds, for a server that is overloaded, stopping, at another event, or without its database."""

LONGEST_WAIT_S: Final = 10.0
"""Longest time, in seconds, between two requests to a busy server."""

FIRST_WAIT_S: Final = 1.0
"""Time, in seconds, between the first two requests to a busy server; each further one is twice as long."""

BUSY: Final = 503
"""Status of the answers of a busy server."""

NOT_FOUND: Final = 404
"""Status of the answers about what does not exist."""

OF_ONE_EVENT: Final = (NOT_FOUND, 409)
"""Statuses of answers that are about one event; after others, the next event would be refused as well."""

ANSWERED: Final = {"moved_arrays", "stored", "again", "other_sources", "distance_m"}
"""Fields of the answer to `POST relocate` that are passed on."""

JsonObject = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class ServerArchive:
    """The recordings of a running server.

    Parameters
    ----------
    url : str
    token_file : Path or None
        File with the token of an operator.
    method : str or None
        None takes the one by which each event was located.
    set_up : str
        `then` or `now`.
    """

    url: str
    token_file: Path | None
    method: str | None
    set_up: str

    @property
    def place(self) -> str:
        """The address."""
        return self.url

    @cached_property
    def digest(self) -> str:
        """Digest of the server's release and of all its settings that decide the answers, as the server computes it.

        Raises
        ------
        RunError
            If the server is of a release that does not compute it.
        """
        wanted = {name: value for name, value in self._wanted.items() if value is not None}
        path = f"relocation-settings?{urlencode(wanted)}"
        try:
            found = _patiently(lambda: ask_for(RelocationSettings, self.url, path, self.token_file)).digest
        except RefusedError as error:
            if error.status != 404:
                raise
            found = None
        return self._stated(found)

    @property
    def _wanted(self) -> dict[str, str | None]:
        return {"method": self.method, "set_up": self.set_up}

    def _stated(self, digest: str | None) -> str:
        if digest is None:
            raise RunError(
                f"{self.url}: expected a server that states a digest of its settings, got an earlier release; update it"
            )
        return digest

    def ids(self, since_ns: int | None, until_ns: int | None, known: Collection[str] = ()) -> list[str]:
        """Return the ids of the events that have recordings, oldest first; ask for each whether it has.

        The events of which that is `known` are not asked for.
        """
        found, recorded = self._located(since_ns, until_ns), []
        for event_id in reversed(found):
            recorded += [event_id] if event_id in known or self._has_clips(event_id) else []
        if missing := len(found) - len(recorded):
            complain(f"{missing} of {len(found)} located events have no recordings and are left out", kind="note")
        return recorded

    def _has_clips(self, event_id: str) -> bool:
        path = f"events/{quote(event_id)}/clips"
        try:
            return _patiently(lambda: ask_for(EventClips, self.url, path, self.token_file)).state != "none"
        except RefusedError as error:
            if error.status != NOT_FOUND:  # the history may have deleted the event since it was listed
                raise
            return False

    def _located(self, since_ns: int | None, until_ns: int | None) -> list[str]:
        """Return the ids of all located events, newest first."""
        span = {"since": since_ns, "until": until_ns}
        wanted: dict[str, Any] = {"status": "located", "limit": PAGE}
        wanted |= {name: utc_text(time_ns) for name, time_ns in span.items() if time_ns is not None}
        found: list[str] = []
        while True:
            path = f"events?{urlencode(wanted)}"
            page = _patiently(partial(ask_for, EventPage, self.url, path, self.token_file))
            found += [event.id for event in page.events]
            if page.next_cursor is None:
                return found
            wanted["cursor"] = page.next_cursor

    def relocate(self, event_ids: Sequence[str]) -> Iterator[JsonObject]:
        """Yield the answers, or why there is none, one event after the other.

        Raises
        ------
        RefusedError
            If the server would refuse every event, or stays busy for `BUSY_S`.
        UseError
            If the server's settings have changed since the first answer.
        """
        for event_id in event_ids:
            yield self._relocate(event_id)

    def _relocate(self, event_id: str) -> JsonObject:
        found = unanswered(event_id, self.method, self.set_up, self.digest)
        event = f"events/{quote(event_id)}"
        try:
            about = _patiently(lambda: ask_for(Event, self.url, event, self.token_file))
            found |= about.model_dump(mode="json", include={"time_utc"})
            answer = _patiently(
                lambda: order(Relocated, self.url, f"{event}/relocate", self.token_file, self._wanted, ANSWER_S)
            )
        except RefusedError as error:
            if error.status not in OF_ONE_EVENT:
                raise
            return found | {"error": error.reason or str(error)}
        if self._stated(answer.digest) != self.digest:
            raise UseError(
                f"relocate: expected the settings of the first answer at {self.url}, got others: poses, settings or "
                "release have changed meanwhile; start again, with another --out"
            )
        return found | answer.model_dump(mode="json", include=ANSWERED)


def _patiently(ask: Callable[[], T]) -> T:
    """Return an answer; ask again for up to `BUSY_S` while the server is busy, with one message.

    Raises
    ------
    RefusedError
        If the server is still busy then, or refuses for another reason.
    """
    clock = SystemClock()
    begun_ns, wait_s, is_said = clock.monotonic_ns(), FIRST_WAIT_S, False
    while True:
        try:
            return ask()
        except RefusedError as error:
            left_s = BUSY_S - (clock.monotonic_ns() - begun_ns) / 1e9
            if error.status != BUSY or left_s <= 0:
                raise
            if not is_said:
                complain(f"{error.reason or error}; trying again for up to {BUSY_S:.0f} s", kind="note")
                is_said = True
            end_ns = clock.now_ns() + round(1e9 * min(wait_s, left_s))
            while not clock.sleep_until_ns(end_ns):
                pass
            wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)
