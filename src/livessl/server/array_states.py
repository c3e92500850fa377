"""Reports the states of the arrays to API and log, and keeps which arrays an operator has disabled.

`ArrayHealth.state` decides a state; this module passes on what the nodes and the operator report.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from livessl import wire
from livessl.clock import Clock, utc_text
from livessl.core.stream.array_health import ArrayState, ArrayStatus, NodeReport
from livessl.core.stream.final_pass import TwoPassFusion
from livessl.server.api.encode import JsonObject, array_status
from livessl.server.api.encode_reports import node_report
from livessl.server.ingest import Ingest
from livessl.server.node_clocks import clock_finding, clock_is_behind
from livessl.server.overload import Overload
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.site_time import SiteTime
from livessl.server.store import Store, StoreError
from livessl.site.build.inputs import with_inputs
from livessl.site.build.pipeline import activity_parameters
from livessl.site.models import Site

REPORT_NS: Final = 500_000_000
"""Interval between two reports on the arrays, nanoseconds."""

WATCH_NS: Final = 100_000_000
"""Interval at which the states are compared, nanoseconds; a change is reported at once."""

_log = logging.getLogger(__name__)


class ArrayStates:
    """Reports the states of the arrays, and decides which of them are disabled.

    Every thread may call `describe`, `disabled` and `enable`; the rest is for the fusion thread.

    Parameters
    ----------
    site : Site
    clock : Clock
    store : Store
        Remembers which arrays are disabled.
    site_time : SiteTime
    ingest : Ingest
        Counts what the nodes sent.
    overload : Overload
        Knows what is shed.
    set_up_watch : SetUpWatch
        Knows what past sounds say of an array.
    publish : callable
        Gets the message `arrays` for subscribers.
    """

    def __init__(
        self,
        site: Site,
        clock: Clock,
        store: Store,
        site_time: SiteTime,
        ingest: Ingest,
        overload: Overload,
        set_up_watch: SetUpWatch,
        publish: Callable[[JsonObject], None],
    ) -> None:
        self._site = site
        self._nodes = {spec.name: site.node_of(spec.name) for spec in site.processed}
        self._activity = activity_parameters(site)
        self._clock = clock
        self._store = store
        self._site_time = site_time
        self._ingest = ingest
        self._overload = overload
        self._set_up_watch = set_up_watch
        self._publish = publish
        self._fusion: TwoPassFusion | None = None
        self._disabled: frozenset[str] = frozenset()  # replaced as a whole, never changed: readers need no lock
        self._switching = threading.Lock()
        self._runs: dict[str, str] = {}  # of each node, the latest
        self._reported: dict[str, str] = {}
        self._reported_ns = self._watched_ns = 0
        try:
            self._restore()
        except StoreError as error:
            _log.error("%s; no array is disabled until then", error)
            store.when_ready(self._restore)

    def _restore(self) -> None:
        """Disable the arrays that were disabled when the server ended."""
        with self._switching:
            self._disabled |= self._store.disabled(self._site.site)

    def follow(self, fusion: TwoPassFusion) -> None:
        """Describe the arrays as this fusion sees them, from now on; past sounds say nothing about them any more."""
        self._fusion = fusion
        self._set_up_watch.forget()
        self._ingest.node_reports.forget()

    def join(self, hello: wire.Hello) -> None:
        """Note that a node has joined; what its arrays received before a restart says nothing about the set-up now."""
        if self._runs.get(hello.node, hello.run_id) != hello.run_id:
            self._set_up_watch.forget_arrays(hello.arrays.keys())
        self._runs[hello.node] = hello.run_id

    @property
    def disabled(self) -> frozenset[str]:
        """Names of the disabled arrays."""
        return self._disabled

    def enable(self, array: str, enabled: bool) -> None:
        """Enable or disable an array, and have the store remember it.

        The frames of a disabled array are received and acknowledged and its levels are shown, but no event is made of
        them, and no result waits for them.

        Raises
        ------
        StoreError
            If the store cannot write it; the array then stays as it was.
        """
        with self._switching:
            self._store.enable(self._site.site, array, enabled)
            self._disabled = self._disabled - {array} if enabled else self._disabled | {array}

    def describe(self, *, levels: bool = True) -> list[JsonObject]:
        """Return the state of every array as JSON objects, without waiting for a localization in progress.

        It is that of the time at which the messages arrived that the fusion took last: an array whose messages wait
        for a busy server is not silent.

        Without `levels` the levels of the channels are left out; they cost an FFT for each array.
        """
        if self._fusion is None:
            return []
        nodes = {spec.name: self._node_report(spec.name) for spec in self._site.processed}
        heard_ns = self._site_time.now_ns() - self._overload.unheard_ns()
        statuses = self._fusion.status(heard_ns, nodes, levels=levels)
        return [self._described(status, self._fusion) for status in statuses]

    def watch(self) -> None:
        """Publish and log the states if one has changed, and publish them at least every `REPORT_NS`."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._watched_ns < WATCH_NS:
            return
        self._watched_ns = now_ns
        if now_ns - self._reported_ns < REPORT_NS:
            states = {array["name"]: array["state"] for array in self.describe(levels=False)}
            if all(state == self._reported.get(name) for name, state in states.items()):
                return
        self._reported_ns = now_ns
        self._note_findings(now_ns)
        arrays = self.describe()
        for array in arrays:
            before = self._reported.get(array["name"])
            if before not in (None, array["state"]):
                why = f": {array['reason']}" if array["reason"] else ""
                _log.info("array %r is %s%s", array["name"], array["state"], why)
            self._reported[array["name"]] = array["state"]
        now_utc = utc_text(self._site_time.now_ns())
        self._publish(
            {
                "kind": "arrays",
                "now_utc": now_utc,
                "mode": self._site_time.mode,
                "arrays": arrays,
                "overload": self._overload.message,
            }
        )

    def _described(self, status: ArrayStatus, fusion: TwoPassFusion) -> JsonObject:
        status = replace(status, counters=self._counters(status, fusion))
        described = array_status(status, self._nodes[status.name], self._activity)
        report = node_report(
            self._ingest.node_reports.of(status.name), self._clock.monotonic_ns(), self._faults_of(status.name)
        )
        return {**described, **report, "enabled": status.state is not ArrayState.DISABLED}

    def _faults_of(self, array: str) -> dict[int, list[str]]:
        """Return the codes of the faults of each channel, from 1, of an array."""
        faults: dict[int, list[str]] = {}
        for finding in self._set_up_watch.state.findings:
            if finding.array == array and finding.channel is not None:
                faults.setdefault(finding.channel, []).append(finding.fault)
        return faults

    def _node_report(self, array: str) -> NodeReport:
        return NodeReport(
            problem=self._ingest.problem_of(array),
            is_live=self._ingest.is_live(array, self._clock.monotonic_ns()),
            is_disabled=array in self._disabled,
            finding=self._clock_fault(array) or self._set_up_watch.finding_of(array),
        )

    def _note_findings(self, now_ns: int) -> None:
        """Pass on what the nodes report and what their clocks show, with or without sounds."""
        behind = {name: behind_s for name in self._nodes if (behind_s := self._behind_s(name)) is not None}
        self._set_up_watch.note_clocks(behind)
        reports = self._ingest.node_reports
        reported = with_inputs(self._site, reports.findings(self._nodes, now_ns))
        of_clocks = (clock_finding(array, behind_s) for array, behind_s in behind.items())
        self._set_up_watch.note_reports([*reported, *of_clocks], are_complete=reports.are_complete(now_ns))

    def _clock_fault(self, array: str) -> str | None:
        """Return in words that an array's clock is behind."""
        behind_s = self._behind_s(array)
        return None if behind_s is None else clock_is_behind(behind_s)

    def _behind_s(self, array: str) -> float | None:
        """Return by how much an array's clock is behind; delays of a replay or of an overload say nothing."""
        if self._site_time.mode != "live" or self._overload.message is not None:
            return None
        return self._ingest.node_clocks.behind_s(array)

    def _counters(self, status: ArrayStatus, fusion: TwoPassFusion) -> dict[str, int]:
        name = status.name
        return {
            **status.counters,
            "duplicates": self._ingest.duplicates[name] + fusion.input.duplicates.get(name, 0),
            "sequence_gaps": self._ingest.sequence_gaps[name],
            "backfilled": fusion.input.backlog_frames.get(name, 0),
            "asked": fusion.asked.get(name, 0),
            "helped": fusion.helped.get(name, 0),
            "too_late": fusion.input.too_late.get(name, 0),
            "shed": self._ingest.shed[name] + fusion.input.thinned[name],
        }
