"""Past events for alerts: those that were not judged before a restart, and a dry run of a rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from livessl.clock import utc_ns
from livessl.server.alerts.rules import SUPPRESSED, RuleState, Verdict, Zones, judge_event, match
from livessl.server.api.encode import JsonObject
from livessl.server.store import Query, Store
from livessl.site.alert_models import AlertRule

PAGE: Final = 500
"""Events that are read from the store at a time, so that other threads do not wait for the store for long."""

MAX_TRIED: Final = 100_000
"""Most events that a dry run looks at, the newest ones: about half a minute beside a busy server."""

EXAMPLES: Final = 20
"""Most alerts that a dry run names."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """Result of a dry run.

    Parameters
    ----------
    events : int
        Events of that time that were tried.
    matched : int
        Events that meet the rule's condition.
    alerts : int
        Alerts that the rule would have raised.
    suppressed : dict of str to int
        Events that match and would not have alerted, by verdict.
    latest : list of JsonObject
        Events of the latest alerts, newest first.
    complete : bool
        Whether all events of that time were tried.
    """

    events: int
    matched: int
    alerts: int
    suppressed: dict[str, int]
    latest: list[JsonObject]
    complete: bool


def past_events(store: Store, since_ns: int, before_ns: int) -> list[tuple[JsonObject, int]]:
    """Return the stored events that began in a span of site time, oldest first, each with its start."""
    found: list[tuple[JsonObject, int]] = []
    query: Query | None = Query(since_ns=since_ns, until_ns=before_ns - 1, limit=PAGE)
    while query is not None:
        page, query = _page(store, query)
        found += page
    return found[::-1]


def try_rule(
    rule: AlertRule, store: Store, zones: Zones, timezone: str | None, since_ns: int, before_ns: int
) -> DryRun:
    """Return what a rule on events would have done in a span of site time, armed all the time."""
    condition = rule.events
    assert condition is not None
    tried, matches = 0, []
    query: Query | None = Query(since_ns=since_ns, until_ns=before_ns - 1, limit=PAGE)
    while query is not None and tried < MAX_TRIED:
        page, query = _page(store, query)
        tried += len(page)
        matches += [(event, at) for event, at in page if match(condition, event, zones) is not None]
    state, fired = RuleState(), []
    for event, time_ns in reversed(matches):
        verdict, state = judge_event(rule, state, event, time_ns, timezone)
        if verdict is Verdict.ALERT:
            fired.append(event)
    suppressed = {str(verdict): state.suppressed.get(verdict, 0) for verdict in SUPPRESSED}
    return DryRun(tried, len(matches), len(fired), suppressed, fired[: -EXAMPLES - 1 : -1], query is None)


def _page(store: Store, query: Query) -> tuple[list[tuple[JsonObject, int]], Query | None]:
    """Return a page of events, newest first, each with its start; and the query of the next page or None."""
    events, cursor = store.find(query)
    dated = [(event, utc_ns(event["time_utc"])) for event in events if event["time_utc"] is not None]
    if cursor is None:
        return dated, None
    return dated, Query(since_ns=query.since_ns, until_ns=query.until_ns, limit=query.limit, before=cursor)
