"""Applies the rules of a site to events, tracks, arrays and findings, and stores new alerts with the rules' states.

`rules` decides whether a rule alerts (conditions on events, counts, hold-off), `schedule` when, and `conditions` about
arrays and findings. This module starts no thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from livessl.clock import Clock
from livessl.server.alerts.conditions import ConditionWatch, Observed, observe_arrays, observe_findings
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.outbox import Outbox, Raised
from livessl.server.alerts.rules import RuleState, Verdict, judge_and_note, judge_event, match
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.tile import Tile
from livessl.server.set_up_watch import SetUpState
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site


class _Case(NamedTuple):
    """A case that a rule has to decide.

    Parameters
    ----------
    rule : str
    keys : sequence of str
        Key of the alert, then further keys that an earlier alert about the case may have.
    decide : callable
        Returns the verdict and the new state for a state of the rule.
    make : callable
        Makes the alert for a time in nanoseconds.
    """

    rule: str
    keys: Sequence[str]
    decide: Callable[[RuleState], tuple[Verdict, RuleState]]
    make: Callable[[int], JsonObject]


class RuleRunner:
    """Keeps the rules of a site with their states. Every thread may call it.

    Parameters
    ----------
    site : Site
    clock : Clock
    outbox : Outbox
        Contains the earlier states, and stores new states together with alerts.
    messages : AlertMessages
    zones : callable
        Returns the zones that are in force.

    Raises
    ------
    OutboxError
        If the states cannot be read or kept.
    """

    def __init__(
        self, site: Site, clock: Clock, outbox: Outbox, messages: AlertMessages, zones: Callable[[], ZoneMap]
    ) -> None:
        self._site = site.site
        self._rules = site.alerts.rules
        self._zone = site.alerts.timezone
        self._clock = clock
        self._outbox = outbox
        self._messages = messages
        self._zones = zones
        self._tile = Tile.of(site)
        self._lock = threading.Lock()
        self._watches = {
            name: ConditionWatch(rule, self._zone)
            for name, rule in self._rules.items()
            if rule.kind in ("arrays", "findings")
        }
        stored = outbox.states()
        self._states = {name: _restored(stored.get(name), armed=rule.armed) for name, rule in self._rules.items()}
        changed = {name: state for name, state in self._states.items() if stored.get(name) != state}
        if changed:
            outbox.commit([], changed, clock.now_ns())

    @property
    def states(self) -> dict[str, RuleState]:
        """The state of each rule."""
        with self._lock:
            return dict(self._states)

    def arm(self, name: str, armed: bool) -> None:
        """Arm or disarm a rule permanently. Events and states that began before it was armed raise no alerts.

        Raises
        ------
        OutboxError
            If that cannot be kept.
        """
        with self._lock:
            before = self._states[name]
            since_ns = self._clock.now_ns() if armed and not before.armed else before.armed_since_ns
            state = replace(before, armed=armed, file_armed=self._rules[name].armed, armed_since_ns=since_ns)
            self._commit([], {name: state})

    def judge_events(
        self, events: Sequence[tuple[JsonObject, int]], until_ns: int | None, *, early: bool = False
    ) -> list[JsonObject]:
        """Judge events in order of time; return the new alerts.

        Parameters
        ----------
        events : sequence of (JsonObject, int)
            Events with their starts in nanoseconds of site time.
        until_ns : int or None
            Site time before which all final events have then been judged.
        early : bool
            Whether the events may still be replaced; only rules with `early` judge such events.

        Raises
        ------
        OutboxError
            If nothing could be stored. In this case no state has changed, and the events can be judged again.
        """
        zones = self._zones()

        def cases(event: JsonObject, time_ns: int) -> Iterator[_Case]:
            for name, rule in self._rules.items():
                if rule.events is None or (early and not rule.events.early):
                    continue
                found = match(rule.events, event, zones, self._tile)
                if found is not None:
                    # any of these keys says that this sound has alerted, as an early event or before a restart
                    keys = [self._messages.key(name, each) for each in (event["id"], *event["replaces"])]
                    decide = partial(judge_event, rule, event=event, time_ns=time_ns, zone=self._zone)
                    make = partial(self._messages.of_event, name, event, found, rule.events.count)
                    yield _Case(name, keys, decide, make)

        return self._judge(events, cases, until_ns)

    def judge_changes(self, changes: Sequence[tuple[JsonObject, int]]) -> list[JsonObject]:
        """Judge changes of tracks in zones, each with its site time in nanoseconds; return the new alerts.

        Raises
        ------
        OutboxError
            If nothing could be kept.
        """

        def cases(change: JsonObject, time_ns: int) -> Iterator[_Case]:
            for name, rule in self._rules.items():
                watched = rule.tracks
                if watched is None or change["zone"] not in watched.zones or change["change"] not in watched.changes:
                    continue
                key = self._messages.key_of_change(name, change, time_ns)
                decide = partial(judge_and_note, rule, time_ns=time_ns, zone=self._zone)
                yield _Case(name, [key], decide, partial(self._messages.of_change, name, change, time_ns))

        return self._judge(changes, cases)

    def judge_conditions(self, arrays: Sequence[JsonObject], set_up: SetUpState, now_ns: int) -> list[JsonObject]:
        """Judge the states of the arrays, and the findings about the set-up; return the new alerts.

        Raises
        ------
        OutboxError
            If nothing could be kept.
        """
        with self._lock:
            states: dict[str, RuleState] = {}
            raised: list[Raised] = []
            for name, watch in self._watches.items():
                observed = self._observed(name, arrays, set_up)
                alerts, state = watch.look(observed, self._states[name], now_ns)
                if state != self._states[name]:
                    states[name] = state
                raised += [Raised(alert, since_ns, self._rules[name].actions) for alert, since_ns in alerts]
            return self._commit(raised, states) if states else []

    def skip(self, until_ns: int) -> None:
        """Treat all events before a site time as judged, because there were no alerts yet.

        Raises
        ------
        OutboxError
            If that cannot be kept.
        """
        with self._lock:
            self._commit([], {}, until_ns)

    def _judge(
        self,
        given: Sequence[tuple[JsonObject, int]],
        cases: Callable[[JsonObject, int], Iterable[_Case]],
        until_ns: int | None = None,
    ) -> list[JsonObject]:
        """Judge items, each with its site time, by the rules about them; return the new alerts."""
        with self._lock:
            states: dict[str, RuleState] = {}
            raised: dict[str, Raised] = {}
            for happened, time_ns in given:
                for case in cases(happened, time_ns):
                    if not raised.keys().isdisjoint(case.keys) or self._outbox.has(case.keys):
                        continue
                    verdict, states[case.rule] = case.decide(states.get(case.rule, self._states[case.rule]))
                    if verdict is Verdict.ALERT:
                        actions = self._rules[case.rule].actions
                        raised[case.keys[0]] = Raised(case.make(self._clock.now_ns()), time_ns, actions)
            return self._commit(list(raised.values()), states, until_ns)

    def _observed(self, name: str, arrays: Sequence[JsonObject], set_up: SetUpState) -> Observed:
        rule = self._rules[name]
        if rule.arrays is not None:
            return observe_arrays(name, rule, arrays, self._messages)
        return observe_findings(name, rule, set_up, self._states[name].ongoing, self._messages)

    def _commit(
        self, raised: Sequence[Raised], states: dict[str, RuleState], until_ns: int | None = None
    ) -> list[JsonObject]:
        judged = None if until_ns is None else (self._site, until_ns)
        if not raised and not states and judged is None:
            return []
        new = self._outbox.commit(raised, states, self._clock.now_ns(), judged)
        self._states.update(states)
        return new


def _restored(stored: RuleState | None, *, armed: bool) -> RuleState:
    """Return the state of a rule at the start, `armed` as the site file says unless an operator decided otherwise."""
    if stored is None:
        return RuleState(armed=armed, file_armed=armed)
    return stored if stored.file_armed == armed else replace(stored, armed=armed, file_armed=armed)
