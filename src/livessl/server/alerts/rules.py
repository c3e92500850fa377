"""Decides whether a rule alerts: which events match it, its arming, schedule, hold-off and count.

`rule_runner` applies the rules of a running server, and a dry run the same functions to stored events. `schedule`
says when a rule may alert. `conditions` follows arrays and findings. Values in, values out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Final, Self

from livessl.server.alerts.schedule import is_open
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.tile import Tile
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.alert_models import AlertRule, EventCondition

NS_PER_S: Final = 1_000_000_000

MAX_ALERTED: Final = 16
"""Past alerts of a rule whose hold-off is remembered; a final result comes less than so many alerts after its early
one."""

MAX_NOTED: Final = 64
"""Events of a rule whose verdict is remembered, so that one that is judged again is counted once. A final result comes
less than so many matches after its early one."""


class Verdict(StrEnum):
    """Decision of a rule about an event or a condition; all but the first three are counted as suppressed.

    `counted`: an earlier alert about several events has counted this one.
    """

    ALERT = "alert"
    NO_MATCH = "no-match"
    COUNTED = "counted"
    DISARMED = "disarmed"
    OFF_SCHEDULE = "off-schedule"
    COUNTING = "counting"
    HELD_OFF = "held-off"


SUPPRESSED: Final = (Verdict.DISARMED, Verdict.OFF_SCHEDULE, Verdict.COUNTING, Verdict.HELD_OFF)
"""Verdicts on matches that did not alert."""


@dataclass(frozen=True, slots=True)
class RuleState:
    """State of a rule that survives restarts.

    Parameters
    ----------
    armed : bool
    file_armed : bool
        What the site file said when `armed` was set; once the file says something else, it decides.
    armed_since_ns : int
        Site time from which it is armed; nothing that began earlier alerts.
    alerted_ns : tuple of int
        Site times of what alerted last, oldest first: several, because a sound may be judged out of turn.
    recent : tuple of (int, str)
        Site time and id of the events that count towards the next alert.
    counted : tuple of str
        Ids of events that counted towards the last alerts, and count no more when they are judged again.
    noted : tuple of str
        Ids of the last events that did not alert and are counted as suppressed.
    ongoing : tuple of str
        Conditions that have alerted and still last, such as an array that is lost.
    alerts : int
        Alerts so far.
    suppressed : mapping of str to int
        Matches that did not alert, by verdict.
    """

    armed: bool = True
    file_armed: bool = True
    armed_since_ns: int = 0
    alerted_ns: tuple[int, ...] = ()
    recent: tuple[tuple[int, str], ...] = ()
    counted: tuple[str, ...] = ()
    noted: tuple[str, ...] = ()
    ongoing: tuple[str, ...] = ()
    alerts: int = 0
    suppressed: Mapping[str, int] = field(default_factory=dict)

    def as_json(self) -> JsonObject:
        """Return the state as a JSON object."""
        return {
            "armed": self.armed,
            "file_armed": self.file_armed,
            "armed_since_ns": self.armed_since_ns,
            "alerted_ns": list(self.alerted_ns),
            "recent": [list(each) for each in self.recent],
            "counted": list(self.counted),
            "noted": list(self.noted),
            "ongoing": list(self.ongoing),
            "alerts": self.alerts,
            "suppressed": dict(self.suppressed),
        }

    @classmethod
    def restored(cls, stored: Mapping[str, Any]) -> Self:
        """Return the state that `as_json` gave."""
        recent = tuple((int(time_ns), str(event_id)) for time_ns, event_id in stored["recent"])
        tuples = {name: tuple(stored.get(name, ())) for name in ("alerted_ns", "counted", "noted", "ongoing")}
        return cls(**{**stored, **tuples, "recent": recent})

    @property
    def last_ns(self) -> int | None:
        """Site time of the latest thing that alerted; None if nothing has."""
        return max(self.alerted_ns, default=None)

    def noting(self, verdict: Verdict, time_ns: int) -> Self:
        """Return the state after a verdict."""
        if verdict is Verdict.ALERT:
            alerted_ns = tuple(sorted((*self.alerted_ns, time_ns))[-MAX_ALERTED:])
            return replace(self, alerted_ns=alerted_ns, alerts=self.alerts + 1)
        if verdict in SUPPRESSED:
            return replace(self, suppressed={**self.suppressed, verdict: self.suppressed.get(verdict, 0) + 1})
        return self


@dataclass(frozen=True, slots=True)
class Match:
    """An event that meets the conditions of a rule: the rule's zones that it lies in, each with its probability."""

    zones: Mapping[str, float] = field(default_factory=dict)

    @property
    def probability(self) -> float | None:
        """Probability of the most probable zone; None for a rule without zones."""
        return max(self.zones.values(), default=None)


def match(condition: EventCondition, event: JsonObject, zones: ZoneMap, tile: Tile | None = None) -> Match | None:
    """Return how an event meets a condition, None if it does not; a refused or an excluded event meets none.

    In a hall of several servers, an event that only concerns their tiles meets no condition without zones.
    """
    if event["status"] not in condition.statuses or event["position_m"] is None:
        return None
    if event["confidence"] < condition.min_confidence or event["duration_s"] < condition.min_duration_s:
        return None
    level = event["level_dbfs"]
    if condition.min_level_dbfs is not None and (level is None or level < condition.min_level_dbfs):
        return None
    found = zones.probabilities(event["position_m"], event["covariance_m2"])
    # a rule can be older than a zone: one that was deleted holds nothing
    inside = {zone: found[zone] for zone in condition.zones if found.get(zone, 0.0) >= condition.probability}
    if (condition.zones and not inside) or _is_excluded(event, zones, found):
        return None
    if tile is not None and not condition.zones and not tile.concerns(event):
        return None
    return Match(inside)


def _is_excluded(event: JsonObject, zones: ZoneMap, found: Mapping[str, float]) -> bool:
    """Return whether an event was excluded when it was located, or is by the zones now, as for a dry run.

    `found` has the probability of each zone.
    """
    return bool(event.get("excluded", False) or zones.excluding(zones.holding(event["position_m"]), found))


def judge_and_note(rule: AlertRule, state: RuleState, time_ns: int, zone: str | None) -> tuple[Verdict, RuleState]:
    """Decide whether a rule alerts about something that began at this site time; return the state after it, too."""
    verdict = judge(rule, state, time_ns, zone)
    return verdict, state.noting(verdict, time_ns)


def judge_event(
    rule: AlertRule, state: RuleState, event: JsonObject, time_ns: int, zone: str | None
) -> tuple[Verdict, RuleState]:
    """Decide whether an event that matches a rule alerts; return the verdict, and the rule's state after it.

    Parameters
    ----------
    rule : AlertRule
        A rule on events.
    state : RuleState
    event : JsonObject
        The event; judging it twice counts it once.
    time_ns : int
        Its start, in nanoseconds of site time.
    zone : str or None
        Time zone of the schedule.
    """
    verdict = judge(rule, state, time_ns, zone)
    condition = rule.events
    assert condition is not None
    same = {event["id"], *event["replaces"]}
    if not same.isdisjoint(state.counted):
        kept = max(MAX_NOTED, 2 * condition.count)
        return Verdict.COUNTED, replace(state, counted=_newest(state.counted, [event["id"]], kept))
    if condition.within_s is not None and verdict not in (Verdict.DISARMED, Verdict.OFF_SCHEDULE):
        verdict, state = _count(condition, condition.within_s, verdict, state, (time_ns, event["id"]), same)
    if verdict not in SUPPRESSED:
        return verdict, state.noting(verdict, time_ns)
    noted = _newest(state.noted, [event["id"]], MAX_NOTED)
    if same.isdisjoint(state.noted):
        state = state.noting(verdict, time_ns)
    return verdict, replace(state, noted=noted)


def _count(
    condition: EventCondition,
    within_s: float,
    verdict: Verdict,
    state: RuleState,
    new: tuple[int, str],
    same: Collection[str],
) -> tuple[Verdict, RuleState]:
    """Count an event, its time and id, in place of the `same` ones; return the verdict that follows, and the state."""
    recent = sorted([*(each for each in state.recent if each[1] not in same), new])
    recent = [each for each in recent if each[0] > recent[-1][0] - round(within_s * NS_PER_S)]
    if len(recent) < condition.count:
        verdict = Verdict.COUNTING
    elif verdict is Verdict.ALERT:
        kept = max(MAX_NOTED, 2 * condition.count)
        state = replace(state, counted=_newest(state.counted, [name for _, name in recent], kept))
        recent = []
    return verdict, replace(state, recent=tuple(recent[-condition.count :]))


def _newest(known: Sequence[str], new: Sequence[str], most: int) -> tuple[str, ...]:
    """Return known and new ids, each once, the oldest dropped beyond `most`."""
    return tuple(dict.fromkeys((*known, *new)))[-most:]


def judge(rule: AlertRule, state: RuleState, time_ns: int, zone: str | None) -> Verdict:
    """Decide whether a rule may alert about something that began, or was noticed, at this site time."""
    if not state.armed or time_ns < state.armed_since_ns:
        return Verdict.DISARMED
    if not is_open(rule.schedule, time_ns, zone):
        return Verdict.OFF_SCHEDULE
    if any(abs(time_ns - alerted_ns) < rule.hold_off_s * NS_PER_S for alerted_ns in state.alerted_ns):
        return Verdict.HELD_OFF
    return Verdict.ALERT
