"""Decides in which order rules judge events: those final before a restart first, then by site time.

It runs on the thread of the alerts, and does not know what the rules say.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial

from livessl.clock import Clock
from livessl.server.alerts.backlog import Backlog, Batch, final_until_ns
from livessl.server.alerts.history import past_pages
from livessl.server.alerts.in_force import AlertsInForce
from livessl.server.api.encode import JsonObject
from livessl.server.event_traces import EventTraces
from livessl.server.store import Store, StoreError

_log = logging.getLogger(__name__)


class EventOrder:
    """The events of a site that wait to be judged, and those of the past that were not.

    Parameters
    ----------
    site : str
        Name of the site.
    clock : Clock
    store : Store
        Has the events that were final before a restart.
    announce : callable
        Gets the alerts that are raised.
    traces : EventTraces or None
        Adds spans of alerts; None if nothing is traced.
    is_caught_up : bool
        Whether no past event is to be judged, because no rule is about events.
    """

    def __init__(
        self,
        site: str,
        clock: Clock,
        store: Store,
        announce: Callable[[Sequence[JsonObject]], None],
        traces: EventTraces | None,
        *,
        is_caught_up: bool,
    ) -> None:
        self._site = site
        self._clock = clock
        self._store = store
        self._announce = announce
        self._traces = traces
        self._is_caught_up = is_caught_up
        self._live_ns: tuple[int, int] | None = None  # site time that was judged before the past could be read
        self.backlog = Backlog(site, store)
        """Takes the events from the fusion thread."""
        self.lacks_store = False
        """True while past events wait because the store cannot be read."""

    def look_back(self) -> None:
        """Judge the past again before the next events, because rules about events came into force."""
        self._is_caught_up, self._live_ns = False, None

    def judge_waiting(self, in_force: AlertsInForce) -> None:
        """Judge the events that wait; those of the past, and those that were missed, only if the store can be read."""
        failure: StoreError | None = None
        try:
            if not self._is_caught_up:
                self._catch_up(in_force)
                self._is_caught_up = True
        except StoreError as error:
            failure = error
        try:
            self.backlog.work_off(partial(self._judge_batch, in_force))
        except StoreError as error:
            failure = error
        if failure is not None and not self.lacks_store:
            _log.error("%s", failure)
        self.lacks_store = failure is not None

    def _catch_up(self, in_force: AlertsInForce) -> None:
        """Judge the events that became final before a restart and were not judged; at first, skip all of the past."""
        final_ns = final_until_ns(self._store, self._site)
        judged_ns = in_force.outbox.judged_until_ns(self._site)
        live_ns, live_until_ns = (final_ns, 0) if self._live_ns is None else self._live_ns
        if judged_ns is not None and (before_ns := min(final_ns, live_ns)) > judged_ns:
            for page, until_ns in past_pages(self._store, judged_ns, before_ns):
                self._announce(in_force.runner.judge_events(page, until_ns))
        done_ns = max(final_ns if judged_ns is None else judged_ns, live_until_ns)
        if judged_ns is None or done_ns > judged_ns:
            in_force.runner.skip(done_ns)

    def _judge_batch(self, in_force: AlertsInForce, batch: Batch) -> None:
        """Judge events that came; while the past waits, the time before which all are judged stays where it is."""
        until_ns = batch.until_ns if self._is_caught_up else None
        began_ns = 0 if self._traces is None else self._clock.now_ns()
        alerts = in_force.runner.judge_events(batch.events, until_ns, early=batch.until_ns is None)
        if self._traces is not None:
            for alert in alerts:
                self._traces.alerted(alert, began_ns, self._clock.now_ns())
        self._announce(alerts)
        if batch.until_ns is not None and not self._is_caught_up:
            first_ns = min((time_ns for _, time_ns in batch.events), default=batch.until_ns)
            since_ns, newest_ns = (first_ns, 0) if self._live_ns is None else self._live_ns
            self._live_ns = min(since_ns, first_ns), max(newest_ns, batch.until_ns)
