"""Options of a subscription: kinds, zone, confidence, track, rate, start, certificate, and when to give up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypedDict

from livessl.clock import instant_ns, utc_text
from livessl.errors import UseError


class Options(TypedDict, total=False):
    """Options of `connect` and `aconnect`."""

    kinds: Iterable[str]
    """Message kinds: `event`, `update`, `track`, `arrays`, `alert`, `zone`, `zones`, `poses`; all, and `hello`,
    if absent."""
    zone: str
    """Only messages about this zone; those that are about no place pass."""
    min_confidence: float
    """Least confidence of events and updates, 0 to 1."""
    track: int
    """Number of the only track whose states and changes in zones are wanted."""
    max_rate_hz: float
    """Most updates of a sound, states of a track, and states of the arrays a second."""
    since: datetime | str
    """Begin with the stored events that began then or later: a time with its offset from UTC, RFC 3339 as text."""
    ca_file: str | Path
    """PEM file of the authority that has signed the server's certificate; by default those that the system trusts."""
    give_up_s: float
    """Seconds without a connection after which `UnreachableError` is raised; by default the client never gives up."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """The messages that a client subscribes to.

    Parameters
    ----------
    kinds : frozenset of str or None
        None for all.
    query : dict of str to str
        Query of the live WebSocket.
    filters : dict of str to str
        Those of its parameters that searches for events have as well.
    since : str or None
        RFC 3339.
    """

    kinds: frozenset[str] | None = None
    query: dict[str, str] = field(default_factory=dict)
    filters: dict[str, str] = field(default_factory=dict)
    since: str | None = None

    @property
    def has_events(self) -> bool:
        """True if events are wanted."""
        return self.kinds is None or "event" in self.kinds

    @classmethod
    def of(cls, options: Options) -> Wanted:
        """Return what a user's options ask for.

        Raises
        ------
        UseError
            If a value cannot be sent. The server checks the others.
        """
        given = options.get("kinds")
        if isinstance(given, str):
            raise UseError(f"kinds: expected several texts such as [{given!r}], got one text")
        kinds = None if given is None else frozenset(given)
        names = ("zone", "min_confidence", "track", "max_rate_hz")
        query = {name: str(options[name]) for name in names if options.get(name) is not None}  # type: ignore[literal-required]
        filters = {name: value for name, value in query.items() if name in ("zone", "min_confidence")}
        if kinds is not None:
            query["kinds"] = ",".join(sorted(kinds))
        return cls(kinds, query, filters, rfc3339(options.get("since"), "since"))


def rfc3339(time: datetime | str | None, name: str) -> str | None:
    """Return a time as text.

    Raises
    ------
    UseError
        If it does not say its offset from UTC.
    """
    if isinstance(time, datetime):
        if time.tzinfo is None:
            raise UseError(f"{name}: expected a time with an offset from UTC, got {time}; add tzinfo=datetime.UTC")
        return utc_text(instant_ns(time))
    return time
