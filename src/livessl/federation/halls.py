"""Decides which sites are in a hall, by the hub's own file: what a site says of itself is no proof."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Mapping
from typing import Final

from livessl.server.api.encode import JsonObject

MAX_NOTED: Final = 256
"""Most sites, each with a hall, that are remembered as not listed; further ones are only counted."""

_log = logging.getLogger(__name__)


class Halls:
    """The halls of a hub, and what was ignored of sites that are not in them. Every thread may call it.

    Parameters
    ----------
    sites : mapping of str to collection of str
        Names of the sites of each hall, as `halls` in the hub's file has them.
    """

    def __init__(self, sites: Mapping[str, Collection[str]]) -> None:
        self._sites = {hall: frozenset(names) for hall, names in sites.items()}
        self._noted: set[tuple[str, str]] = set()
        self._crowded: set[str] = set()
        self._lock = threading.Lock()
        self.ignored = 0
        """Messages since the start whose hall was ignored."""

    def note_crowd(self, hall: str, count: int) -> None:
        """Log once for each hall that more events are connected than are compared."""
        with self._lock:
            is_news = hall not in self._crowded
            self._crowded.add(hall)
        if is_news:
            _log.warning(
                "hall %r: %d or more events overlap in turns and may be one sound; the earliest marks of such a chain "
                "stay as they are (logged once)",
                hall,
                count,
            )

    def admitted(self, site: str, message: JsonObject) -> JsonObject:
        """Return a message or a report of a site, without its hall if the site is not in that.

        Parameters
        ----------
        site : str
        message : JsonObject
            With a `name` in `hall`, if it has one.
        """
        if not message.get("hall"):
            return message
        hall = str(message["hall"]["name"])
        if site in self._sites.get(hall, ()):
            return message
        with self._lock:
            self.ignored += 1
            is_news = (site, hall) not in self._noted and len(self._noted) < MAX_NOTED
            if is_news:
                self._noted.add((site, hall))
        if is_news:
            _log.warning(
                "site %r says that it is in the hall %r, but halls of the hub's file does not list it there: its "
                "events are compared with no others; if it is right, add the site: halls: {%s: [%s]}",
                site,
                hall,
                hall,
                ", ".join(sorted({*self._sites.get(hall, ()), site})),
            )
        return {**message, "hall": None}
