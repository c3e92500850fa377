"""The alerts of a running server: a thread judges events and conditions, and delivers what the rules raise.

The fusion thread only appends to a bounded queue. What does not fit there is judged from the event store instead.
"""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Final

from livessl.clock import Clock
from livessl.core.types import FRAME_NS
from livessl.errors import RunError
from livessl.server.alerts.backlog import Backlog, Batch, final_until_ns
from livessl.server.alerts.courier import NS_PER_S, REST_S, Courier
from livessl.server.alerts.evidence import ClipSource, Evidence
from livessl.server.alerts.history import DryRuns, past_pages
from livessl.server.alerts.in_force import AlertsInForce, Surroundings, outbox_path
from livessl.server.alerts.outbox import DeliveryState, Outbox, OutboxError
from livessl.server.alerts.rules import RuleState
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.event_traces import EventTraces
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.signed_links import SignedLinks
from livessl.server.site_time import SiteTime
from livessl.server.store import Store, StoreError
from livessl.server.zones.shapes import ZoneMap, fixed_zones
from livessl.site.alert_models import AlertsConfig
from livessl.site.models import Site

POLL_S: Final = 0.5
"""Interval, in seconds, at which arrays and findings are looked at."""

EXPIRE_NS: Final = 600 * NS_PER_S
"""Interval, in nanoseconds, at which old alerts are deleted."""

DAY_NS: Final = 86_400 * NS_PER_S

STOP_S: Final = 3.0
"""Longest wait, in seconds, for the thread when the server stops."""

TAKE_OVER_S: Final = 10.0
"""Longest wait, in seconds, for the thread when rules are replaced; it may be judging a long past."""

_log = logging.getLogger(__name__)


class _Change:
    """A change of the rules that is either begun or given up, whatever two threads do at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_begun = self._is_given_up = False

    def begin(self) -> bool:
        """Begin it; return False if it was given up."""
        with self._lock:
            self._is_begun = not self._is_given_up
            return self._is_begun

    def give_up(self) -> bool:
        """Give it up; return False if it has begun."""
        with self._lock:
            self._is_given_up = not self._is_begun
            return self._is_given_up


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
    zones : callable or None
        Returns the zones that are in force; None for those of the site.
    clips : ClipSource or None
        Finds the clips of events; None if the site keeps none.
    traces : EventTraces or None
        Adds spans of alerts; None if nothing is traced.
    poses : callable or None
        Returns the site with the poses that are in force; None if they stay as they are.
    links : SignedLinks or None
        Signs links for people without a token; None if nobody needs one.

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
        zones: Callable[[], ZoneMap] | None = None,
        clips: ClipSource | None = None,
        traces: EventTraces | None = None,
        poses: Callable[[], Site] | None = None,
        links: SignedLinks | None = None,
    ) -> None:
        self._site = site
        self._clock = clock
        self._store = store
        self._array_states = array_states
        self._set_up_watch = set_up_watch
        self._site_time = site_time
        self._publish = publish
        zones = fixed_zones(site) if zones is None else zones
        self.outbox = Outbox(outbox_path(site))
        """Alerts, deliveries and the rules' states."""
        self.evidence = Evidence((lambda: site) if poses is None else poses, zones, clips)
        """Pictures and clips of alerts."""
        self._around = Surroundings(clock, store, zones, url, self.evidence, traces, links)
        try:
            self._in_force = AlertsInForce(site, self.outbox, self._around)
        except BaseException:
            self.outbox.close()
            raise
        self._backlog = Backlog(site.site, store)
        self._expired_ns = 0
        self._is_failing = self._lacks_store = False
        self._is_caught_up = not self._in_force.judges_events
        self._live_ns: tuple[int, int] | None = None  # site time that was judged before the past could be read
        self._news, self._end, self._replaced = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._starting = threading.Lock()
        self._changing = threading.Lock()  # a rule is armed either before or after it is replaced
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    # --- for the fusion thread

    @property
    def unqueued(self) -> int:
        """Events and changes that did not fit into their queues; final events are judged from the store instead."""
        return self._backlog.unqueued

    def take_early(self, event: JsonObject, time_ns: int) -> None:
        """Take in an event that may still be replaced, and its start in site time."""
        if self._in_force.judges_early:
            self._backlog.add_early(event, time_ns)
            self._wake()

    def take_final(self, events: Sequence[tuple[JsonObject, int]], until: int) -> None:
        """Take in final events, each with its start, and the frame index before which all events are final."""
        if self._in_force.judges_events:
            self._backlog.add_final(events, until * FRAME_NS)
            self._wake()

    def take_change(self, change: JsonObject, time_ns: int) -> None:
        """Take in what a track does in a zone, and its site time; what does not fit is given up, and counted."""
        if self._in_force.judges_tracks:
            self._backlog.add_change(change, time_ns)
            self._wake()

    # --- for the API

    @property
    def config(self) -> AlertsConfig:
        """The rules and actions that are in force."""
        return self._in_force.config

    @property
    def dry_runs(self) -> DryRuns:
        """Tries the rules that are in force on the history."""
        return self._in_force.dry_runs

    @property
    def couriers(self) -> Mapping[str, Courier]:
        """The courier of each action that is in force, by name."""
        return self._in_force.couriers

    @property
    def problems(self) -> list[str]:
        """Sentences for the reasons of `health`."""
        found = []
        if self._is_failing:
            found.append(f"alerts.outbox: cannot be used, so that alerts wait: {len(self._backlog)} batches of events")
        if self._lacks_store:
            found.append("alerts.rules: past events are not judged until server.events_db can be read; new ones are")
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
        return self._in_force.judge.states

    def arm(self, rule: str, armed: bool) -> None:
        """Arm or disarm a rule: see `Judge.arm`."""
        with self._changing:
            self._in_force.judge.arm(rule, armed)

    def note_in_journal(self, alert: JsonObject) -> None:
        """Note that the journal has an alert; if that fails, the next start puts it there again, under the same key."""
        try:
            self.outbox.note_in_journal(alert["key"])
        except OutboxError as error:
            _log.debug("%s", error)  # the thread reports it

    def resend(self, number: int) -> None:
        """Let a dead letter be delivered again.

        Raises
        ------
        LookupError
            If there is none of that number, or the site file no longer has its action.
        """
        action = self.outbox.action_of_dead(number)
        if action is None:
            raise LookupError(f"no dead letter {number}; GET alerts/dead-letters lists them")
        if action not in self.couriers:
            cure = "add it to alerts.actions, or dismiss the dead letter with DELETE"
            raise LookupError(
                f"dead letter {number} is for action {action!r}, which the site file does not have; {cure}"
            )
        self.outbox.resend(number, self._clock.now_ns())
        self._wake_couriers()

    def take_over(self, config: AlertsConfig) -> None:
        """Judge and deliver by other rules and actions from now on, as after a restart with them.

        States of rules that stay are kept, and so is what waits to be judged or delivered. An alert that is just being
        delivered is delivered again, under the same key. `outbox` must be that of before.

        Raises
        ------
        ConfigError, RunError
            If an action cannot be made, or the outbox cannot be used; then nothing has changed.
        """
        site = self._site.model_copy(update={"alerts": config})
        with self._starting:
            loop = self._loop
            if loop is None:
                self._replace(site)
                self._start()
                return
        change = _Change()
        replacing = asyncio.run_coroutine_threadsafe(self._replace_on_thread(site, change), loop)
        try:
            replacing.result(TAKE_OVER_S)
        except TimeoutError:
            if not change.give_up():  # it has just been made
                replacing.result()
                return
            raise RunError(
                f"alerts: the thread that judges was busy for {TAKE_OVER_S:g} s, and the former rules stay in force; "
                "reload again later"
            ) from None

    async def _replace_on_thread(self, site: Site, change: _Change) -> None:
        """Replace the rules on the thread that judges, between two of its turns, unless that was given up."""
        if change.begin():
            self._replace(site)
            self._replaced.set()
            self._news.set()

    def _replace(self, site: Site) -> None:
        former, before, path = self.outbox, self._in_force, outbox_path(site)
        outbox = former if former.path is not None or path is None else Outbox(path)  # the site gets its first rules
        with self._changing:
            try:
                in_force = AlertsInForce(site, outbox, self._around)
            except BaseException:
                if outbox is not former:
                    outbox.close()
                raise
            self._site, self._in_force, self.outbox = site, in_force, outbox
        if outbox is not former:
            former.close()
        if in_force.judges_events and not before.judges_events:
            self._is_caught_up, self._live_ns = False, None

    # --- the thread

    def start(self) -> None:
        """Begin to judge and to deliver, unless it has begun; a site that never had rules needs no thread."""
        with self._starting:
            self._start()

    def _start(self) -> None:
        if self._loop is not None or (not self.config.rules and self.outbox.path is None):
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
        tasks = [asyncio.create_task(work) for work in (self._judge_all(), self._deliver_all())]
        ending = asyncio.create_task(self._end.wait())
        try:
            done, _ = await asyncio.wait([*tasks, ending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (*tasks, ending):
                task.cancel()
            await asyncio.gather(*tasks, ending, return_exceptions=True)
        for task in done:
            task.result()  # raises the error that ended it, if there was one

    async def _deliver_all(self) -> None:
        """Run the couriers of the actions that are in force, until cancelled."""
        while True:
            self._replaced.clear()
            replaced = asyncio.create_task(self._replaced.wait())
            couriers = [asyncio.create_task(courier.run()) for courier in self.couriers.values()]
            try:
                await asyncio.wait([*couriers, replaced], return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in (*couriers, replaced):
                    task.cancel()
                await asyncio.gather(*couriers, replaced, return_exceptions=True)
            for task in couriers:
                if not task.cancelled():
                    task.result()  # raises the error that ended it

    async def _judge_all(self) -> None:
        """Judge what comes, and first what came before a restart, until cancelled."""
        while True:
            self._news.clear()
            wait_s = POLL_S
            try:
                self._turn()
                self._is_failing = False
            except (OutboxError, sqlite3.Error) as error:
                if not self._is_failing:
                    _log.error("%s", error)
                self._is_failing = True
            if self._is_failing or self._lacks_store:
                wait_s = REST_S
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()
            if wait_s == REST_S:
                await asyncio.sleep(REST_S)

    def _catch_up(self) -> None:
        """Judge the events that became final before a restart and were not judged; at first, skip all of the past."""
        final_ns = final_until_ns(self._store, self._site.site)
        judged_ns = self.outbox.judged_until_ns(self._site.site)
        live_ns, live_until_ns = (final_ns, 0) if self._live_ns is None else self._live_ns
        if judged_ns is not None and (before_ns := min(final_ns, live_ns)) > judged_ns:
            for page, until_ns in past_pages(self._store, judged_ns, before_ns):
                self._announce(self._in_force.judge.judge_events(page, until_ns))
        done_ns = max(final_ns if judged_ns is None else judged_ns, live_until_ns)
        if judged_ns is None or done_ns > judged_ns:
            self._in_force.judge.skip(done_ns)

    def _judge_batch(self, batch: Batch) -> None:
        """Judge events that came; while the past waits, the time before which all are judged stays where it is."""
        until_ns = batch.until_ns if self._is_caught_up else None
        began_ns = 0 if self._around.traces is None else self._clock.now_ns()
        alerts = self._in_force.judge.judge_events(batch.events, until_ns, early=batch.until_ns is None)
        if self._around.traces is not None:
            for alert in alerts:
                self._around.traces.alerted(alert, began_ns, self._clock.now_ns())
        self._announce(alerts)
        if batch.until_ns is not None and not self._is_caught_up:
            first_ns = min((time_ns for _, time_ns in batch.events), default=batch.until_ns)
            since_ns, newest_ns = (first_ns, 0) if self._live_ns is None else self._live_ns
            self._live_ns = min(since_ns, first_ns), max(newest_ns, batch.until_ns)

    def _judge_waiting(self) -> None:
        """Judge the events that wait; those of the past, and those that were missed, only if the store can be read."""
        failure: StoreError | None = None
        try:
            if not self._is_caught_up:
                self._catch_up()
                self._is_caught_up = True
        except StoreError as error:
            failure = error
        try:
            self._backlog.work_off(self._judge_batch)
        except StoreError as error:
            failure = error
        if failure is not None and not self._lacks_store:
            _log.error("%s", failure)
        self._lacks_store = failure is not None

    def _turn(self) -> None:
        self._judge_waiting()
        self._backlog.work_off_changes(lambda changes: self._announce(self._in_force.judge.judge_changes(changes)))
        now_ns = self._clock.now_ns()
        if self._in_force.judges_conditions and not self._site_time.is_replay:
            arrays = self._array_states.describe(levels=False)
            self._announce(self._in_force.judge.judge_conditions(arrays, self._set_up_watch.state, now_ns))
        days = self._site.store.retention_days
        if days is not None and now_ns - self._expired_ns >= EXPIRE_NS:
            self._expired_ns = now_ns
            self.outbox.expire(max(now_ns - round(days * DAY_NS), 0))

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
