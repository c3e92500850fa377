"""Decides when a site counts as away (offline) at the hub, and makes the overview of a site that the API describes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Final, NamedTuple

from livessl.clock import utc_text
from livessl.server.api.encode import JsonObject

AWAY_S: Final = 30.0
"""Silence, in seconds, after which a site counts as away; it reports on itself every 5 s."""

_utc_text: Final = lru_cache(maxsize=10_000)(utc_text)
"""`utc_text`, which takes a quarter of the time of an answer about a thousand sites. From one answer to the next, most
of them have no newer event, and contacts are noted for many sites at once."""


class Contact(NamedTuple):
    """A site, as the hub's database has it.

    Parameters
    ----------
    site : str
        Its name.
    age_s : float
        Seconds since something came from it; not below 0, though the clocks of hubs differ.
    contact_ns : int
        When that was, in nanoseconds since the epoch.
    missing : int
        Messages that never came.
    newest_ns : int
        Start of its newest event, in nanoseconds since the epoch; 0 if there is none.
    report : JsonObject
        Its last report on itself; empty before the first one.
    """

    site: str
    age_s: float
    contact_ns: int
    missing: int
    newest_ns: int
    report: JsonObject

    @property
    def is_away(self) -> bool:
        """True if nothing has come from the site for `AWAY_S`."""
        return self.age_s > AWAY_S

    @property
    def waiting(self) -> int:
        """Messages that waited at the site at its last report."""
        return int(self.report.get("waiting", 0))

    @property
    def states(self) -> Mapping[str, str]:
        """State of each array by name at the last report, which names all of them; empty before the first one."""
        states: Mapping[str, str] = self.report.get("arrays", {})
        return states


def describe(contact: Contact, states: Mapping[str, str]) -> JsonObject:
    """Return a site as `GET sites` shows it.

    Parameters
    ----------
    contact : Contact
    states : mapping of str to str
        State of each of its arrays by name.
    """
    return {
        "site": contact.site,
        "status": _condition(contact, states),
        "contact_utc": _utc_text(contact.contact_ns),
        "age_s": round(contact.age_s, 3),
        "version": contact.report.get("version"),
        "location_deg": contact.report.get("location_deg"),
        "hall": contact.report.get("hall"),
        "arrays": states,
        "waiting": contact.waiting,
        "missing": contact.missing,
        "newest_event_utc": _utc_text(contact.newest_ns) if contact.newest_ns else None,
    }


def _condition(contact: Contact, states: Mapping[str, str]) -> str:
    """Return the condition of a site: `away` if nothing comes from it, else by its arrays as its own health has it.

    A site that has not named its arrays yet is starting; one whose arrays are all disabled is degraded.
    """
    if contact.is_away:
        return "away"
    enabled = {state for state in states.values() if state != "disabled"}
    if states and not enabled:
        return "degraded"
    return "ok" if enabled == {"healthy"} else "starting" if enabled <= {"starting", "healthy"} else "degraded"
