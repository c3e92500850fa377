"""The alerts of a running server: its rules judge events and conditions, and its deliverers send the alerts.

It takes in events without waiting, and reports to `health` what keeps alerts from being delivered.

The fusion thread only appends to a bounded queue. Events that find no room there are read from the event store later.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from livessl.core.types import FRAME_NS
from livessl.errors import RunError
from livessl.server.alerts.dead_letters import DeadLetters
from livessl.server.alerts.delivery import Deliverer
from livessl.server.alerts.event_order import EventOrder
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.history import DryRuns
from livessl.server.alerts.in_force import AlertsInForce, Surroundings, outbox_path
from livessl.server.alerts.outbox import DeliveryState, Outbox, OutboxError
from livessl.server.alerts.retention import Retention
from livessl.server.alerts.rule_runner import RuleRunner
from livessl.server.alerts.rules import RuleState
from livessl.server.alerts.thread import AlertThread, TurnTooLongError
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.site_time import SiteTime
from livessl.site.alert_models import AlertsConfig
from livessl.site.models import Site

TAKE_OVER_S: Final = 10.0
"""Longest wait, in seconds, for the thread when rules are replaced; it may be judging a long past."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Conditions:
    """Sources of the rules about arrays and findings.

    Parameters
    ----------
    array_states : ArrayStates
    set_up_watch : SetUpWatch
        Has the findings.
    site_time : SiteTime
        Knows whether a replay runs: then conditions are not judged. Its events and changes of zones are not passed on
        to here at all (`event_log`, `distribution`).
    """

    array_states: ArrayStates
    set_up_watch: SetUpWatch
    site_time: SiteTime

    def judge(self, runner: RuleRunner, now_ns: int) -> Sequence[JsonObject]:
        """Return the alerts that rules raise at a time about the present arrays and findings; none during a replay."""
        if self.site_time.is_replay:
            return ()
        return runner.judge_conditions(self.array_states.describe(levels=False), self.set_up_watch.state, now_ns)


class Alerts:
    """Rules, actions and outbox of a site.

    The fusion thread calls `take_early`, `take_final` and `take_change`; every thread may call the rest.

    Parameters
    ----------
    site : Site
    around : Surroundings
        Clock, store, zones and evidence.
    conditions : Conditions
    publish : callable
        Gets each alert for subscribers, on the thread of the alerts.

    Raises
    ------
    ConfigError
        If an action cannot be made.
    OutboxError
        If the outbox cannot be used.
    """

    def __init__(
        self, site: Site, around: Surroundings, conditions: Conditions, publish: Callable[[JsonObject], None]
    ) -> None:
        self._site = site
        self._around = around
        self._conditions = conditions
        self._publish = publish
        outbox = Outbox(outbox_path(site))
        try:
            self._in_force = AlertsInForce(site, outbox, around)
        except BaseException:
            outbox.close()
            raise
        self._events = EventOrder(
            site.site, around.clock, around.store, self._announce, around.traces,
            is_caught_up=not self._in_force.judges_events,
        )  # fmt: skip
        self._retention = Retention(site.store.retention_days)
        self._is_failing = False
        self._starting = threading.RLock()
        self._changing = threading.Lock()  # a rule is armed either before or after it is replaced
        self._thread = AlertThread(self._turn, lambda: self.deliverers.values())
        self.dead_letters = DeadLetters(lambda: self._in_force, around.clock, self._thread.wake_deliverers)
        """Deliveries that were given up."""

    # --- for the fusion thread

    @property
    def unqueued(self) -> int:
        """Events and changes that did not fit into their queues; final events are judged from the store instead."""
        return self._events.backlog.unqueued

    @property
    def waiting(self) -> int:
        """Batches of events that wait to be judged."""
        return len(self._events.backlog)

    def take_early(self, event: JsonObject, time_ns: int) -> None:
        """Take in an event that may still be replaced, and its start in site time."""
        if self._in_force.judges_early:
            self._events.backlog.add_early(event, time_ns)
            self._thread.wake()

    def take_final(self, events: Sequence[tuple[JsonObject, int]], until: int) -> None:
        """Take in final events, each with its start, and the frame index before which all events are final."""
        if self._in_force.judges_events:
            self._events.backlog.add_final(events, until * FRAME_NS)
            self._thread.wake()

    def take_change(self, change: JsonObject, time_ns: int) -> None:
        """Take in what a track does in a zone, and its site time; what does not fit is given up, and counted."""
        if self._in_force.judges_tracks:
            self._events.backlog.add_change(change, time_ns)
            self._thread.wake()

    # --- for the API

    @property
    def outbox(self) -> Outbox:
        """Alerts, deliveries and the rules' states."""
        return self._in_force.outbox

    @property
    def evidence(self) -> Evidence:
        """Pictures and clips of alerts."""
        return self._around.evidence

    @property
    def failure(self) -> BaseException | None:
        """The error that has ended the thread, if one has."""
        return self._thread.failure

    @property
    def config(self) -> AlertsConfig:
        """The rules and actions that are in force."""
        return self._in_force.config

    @property
    def dry_runs(self) -> DryRuns:
        """Tries the rules that are in force on the history."""
        return self._in_force.dry_runs

    @property
    def deliverers(self) -> Mapping[str, Deliverer]:
        """The deliverer of each action that is in force, by name."""
        return self._in_force.deliverers

    @property
    def problems(self) -> list[str]:
        """Sentences for the reasons of `health`."""
        found = []
        if self._is_failing:
            found.append(f"alerts.outbox: cannot be used, so that alerts wait: {self.waiting} batches of events")
        if self._events.lacks_store:
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
        return self._in_force.runner.states

    def arm(self, rule: str, armed: bool) -> None:
        """Arm or disarm a rule: see `RuleRunner.arm`."""
        with self._changing:
            self._in_force.runner.arm(rule, armed)

    def note_in_journal(self, alert: JsonObject) -> None:
        """Note that the journal has an alert; if that fails, the next start puts it there again, under the same key."""
        try:
            self.outbox.note_in_journal(alert["key"])
        except OutboxError as error:
            _log.debug("%s", error)  # the thread reports it

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
            if not self._thread.is_started:
                self._replace(site)
                self.start()
                return
        try:
            self._thread.exchange(partial(self._replace, site), TAKE_OVER_S)
        except TurnTooLongError:
            raise RunError(
                f"alerts: the thread that judges was busy for {TAKE_OVER_S:g} s, and the former rules stay in force; "
                "reload again later"
            ) from None

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
            self._site, self._in_force = site, in_force
        if outbox is not former:
            former.close()
        if in_force.judges_events and not before.judges_events:
            self._events.look_back()

    def start(self) -> None:
        """Begin to judge and to deliver, unless it has begun; a site that never had rules needs no thread."""
        with self._starting:
            if not self._thread.is_started and (self.config.rules or self.outbox.path is not None):
                self._thread.start()

    def stop(self) -> None:
        """Stop, and close the outbox; what waits is delivered after the next start."""
        self._thread.stop()
        self.outbox.close()

    # --- on the thread

    def _turn(self) -> bool:
        """Judge what waits; return False if the outbox or the store cannot be used."""
        try:
            self._judge()
            self._is_failing = False
        except (OutboxError, sqlite3.Error) as error:
            if not self._is_failing:
                _log.error("%s", error)
            self._is_failing = True
        return not (self._is_failing or self._events.lacks_store)

    def _judge(self) -> None:
        self._events.judge_waiting(self._in_force)
        self._events.backlog.work_off_changes(
            lambda changes: self._announce(self._in_force.runner.judge_changes(changes))
        )
        now_ns = self._around.clock.now_ns()
        if self._in_force.judges_conditions:
            self._announce(self._conditions.judge(self._in_force.runner, now_ns))
        self._retention.delete_old(self.outbox, now_ns)

    def _announce(self, alerts: Sequence[JsonObject]) -> None:
        """Log and publish new alerts, and have them delivered."""
        for alert in alerts:
            _log.info("alert of rule %r: %s", alert["rule"], alert["text"])
            self._publish(alert)
        if alerts:
            self._thread.wake_deliverers()
