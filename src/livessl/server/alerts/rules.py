"""Rules on events: which events match, and which of those alert. Values in, values out; the dry run uses the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Final, Self

import numpy as np

from livessl.core.types import FloatArray
from livessl.server.alerts.membership import probability_in
from livessl.server.alerts.schedule import is_open
from livessl.server.api.encode import JsonObject
from livessl.site.alert_models import AlertRule, EventCondition
from livessl.site.build.grid import search_grid
from livessl.site.models import Site

NS_PER_S: Final = 1_000_000_000

MAX_ALERTED: Final = 16
"""Past alerts of a rule whose hold-off is remembered; a final result comes less than so many alerts after its early
one."""


class Verdict(StrEnum):
    """Decision of a rule about an event or a condition; all but the first two are counted as suppressed."""

    ALERT = "alert"
    NO_MATCH = "no-match"
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
            "ongoing": list(self.ongoing),
            "alerts": self.alerts,
            "suppressed": dict(self.suppressed),
        }

    @classmethod
    def restored(cls, stored: Mapping[str, Any]) -> Self:
        """Return the state that `as_json` gave."""
        recent = tuple((int(time_ns), str(event_id)) for time_ns, event_id in stored["recent"])
        tuples = {"alerted_ns": tuple(stored["alerted_ns"]), "recent": recent, "ongoing": tuple(stored["ongoing"])}
        return cls(**{**stored, **tuples})

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


class Zones:
    """The zones of a site, and the volume that is searched.

    Parameters
    ----------
    site : Site
    """

    def __init__(self, site: Site) -> None:
        self._volume_m = np.array(search_grid(site).bounds_m, dtype=np.float64)
        self._boxes_m: dict[str, FloatArray] = {
            name: np.array(zone.bounds_m, dtype=np.float64) for name, zone in site.zones.items()
        }

    def probability(self, zone: str, event: JsonObject) -> float:
        """Return the probability that an event with a position lies in a zone."""
        position_m = np.array(event["position_m"], dtype=np.float64)
        covariance_m2 = np.array(event["covariance_m2"], dtype=np.float64)
        return probability_in(position_m, covariance_m2, self._boxes_m[zone], self._volume_m)


def match(condition: EventCondition, event: JsonObject, zones: Zones) -> Match | None:
    """Return how an event meets a condition, None if it does not; a refused event meets none."""
    if event["status"] not in condition.statuses or event["position_m"] is None:
        return None
    if event["confidence"] < condition.min_confidence or event["duration_s"] < condition.min_duration_s:
        return None
    level = event["level_dbfs"]
    if condition.min_level_dbfs is not None and (level is None or level < condition.min_level_dbfs):
        return None
    if not condition.zones:
        return Match()
    found = {zone: zones.probability(zone, event) for zone in condition.zones}
    inside = {zone: probability for zone, probability in found.items() if probability >= condition.probability}
    return Match(inside) if inside else None


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
    if verdict in (Verdict.DISARMED, Verdict.OFF_SCHEDULE):
        return verdict, state.noting(verdict, time_ns)
    if condition.within_s is not None:
        same = {event["id"], *event["replaces"]}
        span_ns = round(condition.within_s * NS_PER_S)
        recent = [(at, name) for at, name in state.recent if name not in same]
        recent = sorted([*recent, (time_ns, event["id"])])
        recent = [each for each in recent if each[0] > recent[-1][0] - span_ns]
        if len(recent) < condition.count:
            verdict = Verdict.COUNTING
        elif verdict is Verdict.ALERT:
            recent = []
        state = replace(state, recent=tuple(recent[-condition.count :]))
    return verdict, state.noting(verdict, time_ns)


def judge(rule: AlertRule, state: RuleState, time_ns: int, zone: str | None) -> Verdict:
    """Decide whether a rule may alert about something that began, or was noticed, at this site time."""
    if not state.armed or time_ns < state.armed_since_ns:
        return Verdict.DISARMED
    if not is_open(rule.schedule, time_ns, zone):
        return Verdict.OFF_SCHEDULE
    if any(abs(time_ns - alerted_ns) < rule.hold_off_s * NS_PER_S for alerted_ns in state.alerted_ns):
        return Verdict.HELD_OFF
    return Verdict.ALERT
