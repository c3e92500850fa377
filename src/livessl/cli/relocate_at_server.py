"""The events of a running server, which locates them again from its recordings: `livessl relocate --url`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlencode

from livessl.cli.output import complain
from livessl.cli.server_answers import RefusedError, ask_for, order
from livessl.clock import utc_text
from livessl.schema.answers import EventPage, Site
from livessl.schema.relocation import Relocated
from livessl.schema.values import Event
from livessl.server.api.clip_schema import EventClips

ANSWER_S: Final = 600.0
"""Longest wait, in seconds, for a server that locates an event: sounds of a minute take long beside live ones."""

PAGE: Final = 200
"""Events that are asked for at a time."""

OF_ONE_EVENT: Final = (404, 409, 503)
"""Statuses of answers that are about one event; after others, the next event would be refused as well."""

DECISIVE: Final = {"site", "version", "room", "grid", "speed_of_sound_m_s", "band_hz", "activity", "arrays", "joint"}
"""Fields of `GET site` that decide the answers."""

ANSWERED: Final = {"moved_arrays", "stored", "again", "other_sources", "distance_m"}
"""Fields of the answer to `POST relocate` that are passed on."""

JsonObject = dict[str, Any]


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
        """Digest of method, set-up, and what the server says of its site and release."""
        site = ask_for(Site, self.url, "site", self.token_file).model_dump(mode="json", include=DECISIVE)
        return hashlib.sha256(json.dumps([self.method, self.set_up, site], sort_keys=True).encode()).hexdigest()[:16]

    def ids(self, since_ns: int | None, until_ns: int | None) -> list[str]:
        """Return the ids of the events that have recordings, oldest first; ask for each whether it has."""
        found, recorded = self._located(since_ns, until_ns), []
        for event_id in reversed(found):
            clips = ask_for(EventClips, self.url, f"events/{quote(event_id)}/clips", self.token_file)
            recorded += [] if clips.state == "none" else [event_id]
        if missing := len(found) - len(recorded):
            complain(f"{missing} of {len(found)} located events have no recordings and are left out", kind="note")
        return recorded

    def _located(self, since_ns: int | None, until_ns: int | None) -> list[str]:
        """Return the ids of all located events, newest first."""
        span = {"since": since_ns, "until": until_ns}
        wanted: dict[str, Any] = {"status": "located", "limit": PAGE}
        wanted |= {name: utc_text(time_ns) for name, time_ns in span.items() if time_ns is not None}
        found: list[str] = []
        while True:
            page = ask_for(EventPage, self.url, f"events?{urlencode(wanted)}", self.token_file)
            found += [event.id for event in page.events]
            if page.next_cursor is None:
                return found
            wanted["cursor"] = page.next_cursor

    def relocate(self, event_ids: Sequence[str]) -> Iterator[JsonObject]:
        """Yield the answers, or why there is none, one event after the other.

        Raises
        ------
        RefusedError
            If the server would refuse every event.
        """
        for event_id in event_ids:
            yield self._relocate(event_id)

    def _relocate(self, event_id: str) -> JsonObject:
        found: JsonObject = {
            "kind": "relocation",
            "event_id": event_id,
            "time_utc": None,
            "method": self.method,
            "set_up": self.set_up,
            "digest": self.digest,
            "moved_arrays": [],
            "stored": None,
            "again": None,
            "other_sources": [],
            "distance_m": None,
            "error": None,
        }
        wanted = {"method": self.method, "set_up": self.set_up}
        event = f"events/{quote(event_id)}"
        try:
            about = ask_for(Event, self.url, event, self.token_file)
            found |= about.model_dump(mode="json", include={"time_utc"})
            answer = order(Relocated, self.url, f"{event}/relocate", self.token_file, wanted, ANSWER_S)
        except RefusedError as error:
            if error.status not in OF_ONE_EVENT:
                raise
            return found | {"error": error.reason or str(error)}
        return found | answer.model_dump(mode="json", include=ANSWERED)
