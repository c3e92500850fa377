"""The alerts of a running server: a thread judges events and conditions, and delivers what the rules raise.

The fusion thread only appends to a bounded queue. What does not fit there is judged from the event store instead.
"""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from livessl.clock import Clock
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.types import FRAME_NS
from livessl.server.alerts.actions import ActionSetting, make_action
from livessl.server.alerts.courier import NS_PER_S, REST_S, Courier
from livessl.server.alerts.history import DryRun, past_events, try_rule
from livessl.server.alerts.judge import Judge
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.outbox import DeliveryState, Outbox, OutboxError
from livessl.server.alerts.rules import RuleState, Zones
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.site_time import SiteTime
from livessl.server.store import Store, StoreError
from livessl.site.alert_checks import outbox_file
from livessl.site.models import Site

MAX_QUEUE: Final = 1000
"""Most batches of events that wait to be judged: hours of sounds, unless the outbox's disk is full."""

POLL_S: Final = 0.5
"""Interval, in seconds, at which arrays and findings are looked at."""

EXPIRE_NS: Final = 600 * NS_PER_S
"""Interval, in nanoseconds, at which old alerts are deleted."""

DAY_NS: Final = 86_400 * NS_PER_S

STOP_S: Final = 3.0
"""Longest wait, in seconds, for the thread when the server stops."""

_log = logging.getLogger(__name__)


class _Batch(NamedTuple):
    """Events with their starts; for final ones, the site time before which all events are final, otherwise None."""

    events: Sequence[tuple[JsonObject, int]]
    until_ns: int | None


class Alerts:
    """Rules, actions and outbox of a site.

    The fusion thread calls `take_early` and `take_final`; every thread may call the rest.

    Parameters
    ----------
    site : Site
    clock : Clock
    store : Store
        Has the events that were final before a restart.
    array_states : ArrayStates
    set_up_watch : SetUpWatch
    site_time : SiteTime
        Knows whether a replay runs; its events never alert.
    publish : callable
        Gets each alert for subscribers, on the thread of the alerts.
    url : str
        Address of the server, for links, unless the site file gives another one.

    Raises
    ------
    ConfigError
        If an action cannot be made.
    OutboxError
        If the outbox cannot be used.
    """

    def __init__(
        self,
        site: Site,
        clock: Clock,
        store: Store,
        array_states: ArrayStates,
        set_up_watch: SetUpWatch,
        site_time: SiteTime,
        publish: Callable[[JsonObject], None],
        url: str = "",
    ) -> None:
        self._site = site
        self._config = site.alerts
        self._clock = clock
        self._store = store
        self._array_states = array_states
        self._set_up_watch = set_up_watch
        self._site_time = site_time
        self._publish = publish
        kinds = {rule.kind for rule in self._config.rules.values()}
        self._judges_events = "events" in kinds
        self._judges_early = any(rule.events and rule.events.early for rule in self._config.rules.values())
        self._judges_conditions = bool(kinds - {"events"})
        self.outbox = Outbox(outbox_file(site) if self._config.rules else None)
        """Alerts, deliveries and the rules' states."""
        base = self._config.url or url + site.server.http.root_path
        try:
            self._judge = Judge(site, clock, self.outbox, AlertMessages(site, base))
            self.couriers = {name: self._courier(name, base) for name in self._config.actions}
            """The courier of each action, by name."""
        except BaseException:
            self.outbox.close()
            raise
        self._queue: deque[_Batch] = deque()
        self._missed: tuple[int, int] | None = None  # site time from and before which events did not fit into the queue
        self._missing = threading.Lock()
        self.unqueued = 0
        """Events that did not fit into the queue; final ones are judged from the store instead."""
        self._expired_ns = 0
        self._is_failing = False
        self._trying = threading.Lock()
        self._news, self._end = asyncio.Event(), asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    def _courier(self, name: str, url: str) -> Courier:
        config = self._config.actions[name]
        rules = [rule for rule, each in self._config.rules.items() if name in each.actions]
        others = sorted((self._config.rules.keys() | self.outbox.states().keys()) - set(rules))
        action = make_action(ActionSetting(name, config, self._site, self._clock, rules, others, url))
        return Courier(name, config, action, self.outbox, self._clock)

    # --- for the fusion thread

    def take_early(self, event: JsonObject, time_ns: int) -> None:
        """Take in an event that may still be replaced, and its start in site time."""
        if not self._judges_early:
            return
        if len(self._queue) < MAX_QUEUE:
            self._queue.append(_Batch([(event, time_ns)], None))
            self._wake()
        else:  # its final result is judged all the same
            self.unqueued += 1

    def take_final(self, events: Sequence[tuple[JsonObject, int]], until: int) -> None:
        """Take in final events, each with its start, and the frame index before which all events are final."""
        if not self._judges_events:
            return
        until_ns = until * FRAME_NS
        with self._missing:
            if self._missed is None and len(self._queue) < MAX_QUEUE:
                self._queue.append(_Batch(events, until_ns))
            else:  # and so on until the missed ones are judged, so that all are judged in order
                self.unqueued += len(events)
                first_ns = min(time_ns for _, time_ns in events)
                self._missed = (first_ns if self._missed is None else self._missed[0], until_ns)
        self._wake()

    # --- for the API

    @property
    def problems(self) -> list[str]:
        """Sentences for the reasons of `health`."""
        found = []
        if self._is_failing:
            found.append(f"alerts.outbox: cannot be used, so that alerts wait: {len(self._queue)} batches of events")
        for (action, state), count in self.counts().items():
            if state == DeliveryState.DEAD:
                what = "1 alert was" if count == 1 else f"{count} alerts were"
                found.append(f"alerts.actions.{action}: {what} given up; see GET alerts/dead-letters")
        return found

    def counts(self) -> dict[tuple[str, str], int]:
        """Return the number of deliveries by action and state; nothing while the outbox cannot be read."""
        try:
            return self.outbox.counts()
        except OutboxError as error:
            _log.debug("%s", error)  # the thread reports it
            return {}

    @property
    def states(self) -> dict[str, RuleState]:
        """The state of each rule, by name."""
        return self._judge.states

    def arm(self, rule: str, armed: bool) -> None:
        """Arm or disarm a rule: see `Judge.arm`."""
        self._judge.arm(rule, armed)

    def resend(self, number: int) -> bool:
        """Let a dead letter be delivered again; False if there is none of that number."""
        found = self.outbox.resend(number, self._clock.now_ns())
        self._wake_couriers()
        return found

    def dry_run(self, rule: str, since_ns: int, before_ns: int) -> DryRun:
        """Return what a rule on events would have done in a span of site time; one call runs at a time."""
        with self._trying:
            zones, zone = Zones(self._site), self._config.timezone
            return try_rule(self._config.rules[rule], self._store, zones, zone, since_ns, before_ns)

    # --- the thread

    def start(self) -> None:
        """Begin to judge and to deliver; a site without rules needs no thread."""
        if not self._config.rules:
            return
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, args=(self._loop,), name="alerts", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and close the outbox; what waits is delivered after the next start."""
        if self._thread is not None:
            self._call(self._end.set)
            self._thread.join(timeout=STOP_S)
        self.outbox.close()

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.run_until_complete(self._work())
        except BaseException as error:
            self.failure = error
            _log.exception("the thread of the alerts has failed; the server ends")
            raise
        finally:
            loop.close()

    async def _work(self) -> None:
        """Judge and deliver until `stop`."""
        tasks = [asyncio.create_task(work) for work in (self._judge_all(), *(c.run() for c in self.couriers.values()))]
        ending = asyncio.create_task(self._end.wait())
        try:
            done, _ = await asyncio.wait([*tasks, ending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (*tasks, ending):
                task.cancel()
            await asyncio.gather(*tasks, ending, return_exceptions=True)
        for task in done:
            task.result()  # raises the error that ended it, if there was one

    async def _judge_all(self) -> None:
        """Judge what comes, and first what came before a restart, until cancelled."""
        caught_up = False
        while True:
            self._news.clear()
            wait_s = POLL_S
            try:
                if not caught_up:
                    self._catch_up()
                    caught_up = True
                self._turn()
                self._is_failing = False
            except (OutboxError, StoreError, sqlite3.Error) as error:
                if not self._is_failing:
                    _log.error("%s", error)
                self._is_failing, wait_s = True, REST_S
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()
            if self._is_failing:
                await asyncio.sleep(REST_S)

    def _catch_up(self) -> None:
        """Judge the events that became final before a restart and were not judged; at first, skip all of the past."""
        if not self._judges_events:
            return
        until = self._store.finalized(self._site.site).until
        final_ns = 0 if until is None else until * FRAME_NS
        judged_ns = self.outbox.judged_until_ns(self._site.site)
        if judged_ns is None:
            self._judge.skip(final_ns)
        elif final_ns > judged_ns:
            self._announce(self._judge.judge_events(past_events(self._store, judged_ns, final_ns), final_ns))

    def _turn(self) -> None:
        while self._queue:
            batch = self._queue[0]
            self._announce(self._judge.judge_events(batch.events, batch.until_ns, early=batch.until_ns is None))
            self._queue.popleft()
        while (missed := self._missed) is not None:
            since_ns, before_ns = missed
            self._announce(self._judge.judge_events(past_events(self._store, since_ns, before_ns), before_ns))
            with self._missing:
                newest = before_ns if self._missed is None else self._missed[1]
                self._missed = None if newest == before_ns else (before_ns, newest)
        now_ns = self._clock.now_ns()
        if self._judges_conditions and not self._site_time.is_replay:
            set_up = self._set_up_watch.state
            findings = set_up.findings if set_up.sounds >= LEAST_SOUNDS else None
            arrays = self._array_states.describe(levels=False)
            self._announce(self._judge.judge_conditions(arrays, findings, now_ns))
        days = self._site.store.retention_days
        if days is not None and now_ns - self._expired_ns >= EXPIRE_NS:
            self._expired_ns = now_ns
            self.outbox.expire(now_ns - round(days * DAY_NS))

    def _announce(self, alerts: Sequence[JsonObject]) -> None:
        """Log and publish new alerts, and have them delivered."""
        for alert in alerts:
            _log.info("alert of rule %r: %s", alert["rule"], alert["text"])
            self._publish(alert)
        if alerts:
            self._wake_couriers()

    def _wake(self) -> None:
        self._call(self._news.set)

    def _wake_couriers(self) -> None:
        for courier in self.couriers.values():
            self._call(courier.wake)

    def _call(self, work: Callable[[], None]) -> None:
        """Have something done on the thread's loop, if it runs."""
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # it has just been closed
                loop.call_soon_threadsafe(work)
