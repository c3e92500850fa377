"""Rules on arrays and findings: one alert when an array has been lost, or a fault has been there, for a while."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

from livessl.core.commission.finding import Finding, Severity
from livessl.core.commission.report_watch import REPORTED
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.rules import NS_PER_S, RuleState, Verdict, judge
from livessl.server.api.encode import JsonObject
from livessl.server.set_up_watch import SetUpState
from livessl.site.alert_models import AlertRule

_WEIGHT: Final = {Severity.INFO: 0, Severity.WARNING: 1, Severity.ERROR: 2}


class Observed(NamedTuple):
    """Present state of the conditions that a rule watches.

    Parameters
    ----------
    bad : mapping of str to callable
        The conditions that hold, by subject; each makes the alert about itself from the site time since which it holds
        and the time now.
    unknown : frozenset of str
        Subjects of which nothing is known now: whether they have alerted stays as it was.
    """

    bad: Mapping[str, Callable[[int, int], JsonObject]]
    unknown: frozenset[str] = frozenset()


def observe_arrays(name: str, rule: AlertRule, arrays: Sequence[JsonObject], messages: AlertMessages) -> Observed:
    """Return the arrays in a state that a rule watches; of one that has just been started nothing is known."""
    condition = rule.arrays
    assert condition is not None
    watched = [array for array in arrays if not condition.names or array["name"] in condition.names]
    bad = {
        array["name"]: partial(messages.of_array, name, array)
        for array in watched
        if array["state"] in condition.states
    }
    unknown = {array["name"] for array in watched if array["state"] == "starting"}
    return Observed(bad, frozenset(unknown - set(bad)))


def observe_findings(
    name: str, rule: AlertRule, set_up: SetUpState, ongoing: Collection[str], messages: AlertMessages
) -> Observed:
    """Return the findings that a rule watches.

    Most need some sounds, and some need reports of the nodes. Until these have come, nothing is known of the `ongoing`
    ones, which have alerted before a restart; what is found without them alerts at once.
    """
    condition = rule.findings
    assert condition is not None
    bad = {
        subject_of(finding): partial(messages.of_finding, name, finding, subject_of(finding))
        for finding in set_up.findings
        if _WEIGHT[finding.severity] >= _WEIGHT[condition.severity]
        and (not condition.faults or finding.fault in condition.faults)
    }
    unknown = {subject for subject in ongoing if not set_up.knows(subject.partition(" ")[0])}
    return Observed(bad, frozenset(unknown - set(bad)))


def subject_of(finding: Finding) -> str:
    """Return what names a finding in the state of a rule and in a key: its code, array and channel.

    A report about a node's machine names no array; the node is at the head of its message, before the figures.
    """
    has_no_name = finding.array is None and finding.fault in REPORTED
    place = finding.message.partition(":")[0] if has_no_name else finding.array
    return f"{finding.fault} {place} {finding.channel}"


class ConditionWatch:
    """Remembers since when the conditions of one rule hold.

    Parameters
    ----------
    rule : AlertRule
        A rule on arrays or findings.
    zone : str or None
        Time zone of its schedule.
    """

    def __init__(self, rule: AlertRule, zone: str | None) -> None:
        self._rule = rule
        self._zone = zone
        self._since_ns: dict[str, int] = {}
        self._told: dict[str, Verdict] = {}

    def look(self, observed: Observed, state: RuleState, now_ns: int) -> tuple[list[tuple[JsonObject, int]], RuleState]:
        """Return new alerts, each with the site time since which its condition holds, and the rule's state after them.

        A condition that may not alert yet, because the rule is disarmed, off its schedule or held off, alerts when it
        may, if it still holds.
        """
        lasts_ns = round((0.0 if self._rule.arrays is None else self._rule.arrays.lasts_s) * NS_PER_S)
        known = observed.bad.keys() | observed.unknown
        self._since_ns = {subject: at for subject, at in self._since_ns.items() if subject in known}
        self._told = {subject: verdict for subject, verdict in self._told.items() if subject in known}
        if not set(state.ongoing) <= known:
            state = replace(state, ongoing=tuple(subject for subject in state.ongoing if subject in known))
        alerts: list[tuple[JsonObject, int]] = []
        for subject, alert in observed.bad.items():
            since_ns = self._since_ns.setdefault(subject, now_ns)
            if subject in state.ongoing or now_ns - since_ns < lasts_ns:
                continue
            verdict = judge(self._rule, state, now_ns, self._zone)
            if verdict is Verdict.ALERT:
                alerts.append((alert(since_ns, now_ns), since_ns))
                state = replace(state, ongoing=(*state.ongoing, subject))
            elif self._told.get(subject) is verdict:
                continue  # it is suppressed as before, and counted once
            self._told[subject] = verdict
            state = state.noting(verdict, now_ns)
        return alerts, state
