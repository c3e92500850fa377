"""Reads past events for alerts: those not judged before a restart, and those of a dry run of a rule."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from livessl.clock import utc_ns
from livessl.server.alerts.rules import SUPPRESSED, Match, RuleState, Verdict, judge_event, match
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.tile import Tile
from livessl.server.store import Query, Store
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.alert_models import AlertRule, AlertsConfig, EventCondition

Meets = Callable[[EventCondition, JsonObject], Match | None]

PAGE: Final = 500
"""Number of events that are read from the store at one time, so that other threads do not wait long for the store."""

MAX_TRIED: Final = 100_000
"""Largest number of events, the newest ones, that a dry run reads: about half a minute on a busy server."""

EXAMPLES: Final = 20
"""Largest number of alerts that a dry run lists."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """Result of a dry run.

    Parameters
    ----------
    events : int
        Number of events of that time that were tried.
    matched : int
        Number of events that meet the rule's condition.
    alerts : int
        Number of alerts that the rule would have raised.
    suppressed : dict of str to int
        Number of events that match but would not have raised an alert, by verdict.
    latest : list of JsonObject
        Events of the latest alerts, newest first: their `id` and `time_utc`.
    complete : bool
        Whether all events of that time were tried.
    """

    events: int
    matched: int
    alerts: int
    suppressed: dict[str, int]
    latest: list[JsonObject]
    complete: bool


def past_pages(store: Store, since_ns: int, before_ns: int) -> Iterator[tuple[list[tuple[JsonObject, int]], int]]:
    """Yield the stored events that began in a span of site time, page by page, oldest first.

    Each page has its events with their starts, and the site time before which all events have then been yielded. There
    is one page at least.
    """
    query: Query | None = Query(since_ns=since_ns, until_ns=before_ns - 1, limit=PAGE, oldest_first=True)
    while query is not None:
        page, query = _page(store, query)
        # events of the same instant may follow on the next page
        yield page, before_ns if query is None or query.before is None else query.before.time_ns


class DryRunBusyError(Exception):
    """Another dry run has not ended yet."""


class DryRuns:
    """Tries rules on the stored events, one at a time; every thread may call it.

    Parameters
    ----------
    config : AlertsConfig
    store : Store
    zones : callable
        Returns the zones that are in force.
    tile : Tile or None
        The tile of the site in a hall of several servers; None for a site that has its room to itself.
    """

    def __init__(
        self, config: AlertsConfig, store: Store, zones: Callable[[], ZoneMap], tile: Tile | None = None
    ) -> None:
        self._tile = tile
        self._config = config
        self._store = store
        self._zones = zones
        self._trying = threading.Lock()

    def run(self, rule: str, since_ns: int, before_ns: int) -> DryRun:
        """Return the alerts that a rule on events would have raised in a span of site time.

        Raises
        ------
        DryRunBusyError
            If another dry run has not ended, because each may read a hundred thousand events.
        """
        if not self._trying.acquire(blocking=False):
            raise DryRunBusyError
        try:
            meets = partial(match, zones=self._zones(), tile=self._tile)
            return try_rule(self._config.rules[rule], self._store, meets, self._config.timezone, since_ns, before_ns)
        finally:
            self._trying.release()


def try_rule(
    rule: AlertRule, store: Store, meets: Meets, timezone: str | None, since_ns: int, before_ns: int
) -> DryRun:
    """Return the alerts that a rule on events would have raised in a span of site time, if it was always armed.

    `meets` returns how an event meets a condition, or None.

    For each matching event, only the data for the verdict is kept, because the span may have many events.
    """
    condition = rule.events
    assert condition is not None
    tried, matches = 0, []
    query: Query | None = Query(since_ns=since_ns, until_ns=before_ns - 1, limit=PAGE)
    while query is not None and tried < MAX_TRIED:
        page, query = _page(store, query)
        tried += len(page)
        matches += [(_gist(event), at) for event, at in page if meets(condition, event) is not None]
    state, alerts, latest = RuleState(), 0, deque[JsonObject](maxlen=EXAMPLES)
    for event, time_ns in reversed(matches):
        verdict, state = judge_event(rule, state, event, time_ns, timezone)
        if verdict is Verdict.ALERT:
            alerts += 1
            latest.appendleft(event)
    suppressed = {str(verdict): state.suppressed.get(verdict, 0) for verdict in SUPPRESSED}
    return DryRun(tried, len(matches), alerts, suppressed, list(latest), query is None)


def _gist(event: JsonObject) -> JsonObject:
    return {name: event[name] for name in ("id", "replaces", "time_utc")}


def _page(store: Store, query: Query) -> tuple[list[tuple[JsonObject, int]], Query | None]:
    """Return a page of events, each with its start, and the query of the next page or None."""
    events, cursor = store.find(query)
    dated = [(event, utc_ns(event["time_utc"])) for event in events if event["time_utc"] is not None]
    return dated, None if cursor is None else replace(query, before=cursor)
