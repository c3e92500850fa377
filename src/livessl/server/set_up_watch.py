"""Live doctor: examines the set-up with the sounds that are located, in a thread of its own, and publishes findings.

It keeps the observations of the last sounds only, so that findings end once the set-up is mended. Findings have
hysteresis (`livessl.core.commission.steady`): they do not come and go with single sounds.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.finding import LEAST_SOUNDS, Finding, Severity, are_poses_in_doubt, in_order
from livessl.core.commission.report_watch import REPORTED
from livessl.core.commission.steady import SteadyFindings
from livessl.core.types import Event, Observation
from livessl.server.heard_sounds import HeardSounds
from livessl.server.overload import Overload
from livessl.server.spare_time import SpareTimeThread
from livessl.site.build.layout import layout_findings
from livessl.site.models import Site

KEPT_SOUNDS: Final = 12
"""Number of sounds that are examined together: ten show most faults."""

WAIT_S: Final = 1.0
"""Interval, in seconds, at which the thread looks for new sounds."""

SHARE: Final = 0.02
"""Greatest share of one core's time that examinations take. Where sounds come fast, several are examined at a time."""

URGENT_SHARE: Final = 0.2
"""Greatest share of one core's time while a finding waits to be confirmed or to end: echoes may keep it so for ever."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SetUpState:
    """The set-up as the sounds so far show it.

    Parameters
    ----------
    sounds : int
        Number of sounds that the findings rest on.
    findings : tuple of Finding
        Faults of the set-up, errors first.
    errors : mapping of array to str
        The error that concerns each array, in words; arrays without one are left out.
    are_reports_complete : bool
        Whether the nodes have reported for long enough to show all that their reports can show.
    blind_spots : tuple of BlindSpot
        Faults of poses that these sounds could not have shown; empty while a finding is about poses.
    """

    sounds: int = 0
    findings: tuple[Finding, ...] = ()
    errors: Mapping[str, str] = field(default_factory=dict)
    are_reports_complete: bool = False
    blind_spots: tuple[BlindSpot, ...] = ()

    def knows(self, fault: str) -> bool:
        """Return whether a fault of this code that is no finding is known not to be there, or to have ended."""
        return self.are_reports_complete if fault in REPORTED else self.sounds >= LEAST_SOUNDS


class SetUpWatch:
    """Examines the set-up.

    The fusion thread calls `take`, `forget`, `forget_arrays`, `note_reports` and `note_clocks`; every thread may read
    `state`, which is replaced as a whole.

    Parameters
    ----------
    site : Site
    overload : Overload
        Nothing is examined while sound arrives faster than it is located.
    first_sound : int
        The number after which the numbers of the sounds begin.
    """

    def __init__(self, site: Site, overload: Overload, first_sound: int = 0) -> None:
        self._site = site
        self._lock = threading.Lock()
        self.heard = HeardSounds(first_sound)
        """The last sounds, for calibration."""
        self._examined = 0  # number of the last sound that was examined
        self._sounds: Sequence[Sequence[Observation]] = ()
        self._unjudged = 0  # sounds since findings were last looked for
        self._run = 0  # number of times that all sounds were forgotten
        self._steady = SteadyFindings()
        self._of_layout = layout_findings(site)
        self._of_sounds: tuple[Finding, ...] = ()
        self._blind_spots: tuple[BlindSpot, ...] = ()
        self._reported: tuple[Finding, ...] = ()  # by the nodes' reports, not by sounds
        self._are_reports_complete = False
        self._clocks_off: frozenset[str] = frozenset()  # arrays
        self.state = SetUpState(findings=self._of_layout)
        """The latest state. Read it once for values that belong together."""
        self.thread = SpareTimeThread(
            "set-up",
            self.examine,
            overload,
            wait_s=WAIT_S,
            share=SHARE,
            urgent_share=URGENT_SHARE,
            what="the examination of the set-up",
            is_urgent=lambda: self.is_urgent,
        )
        """Calls `examine`, sooner while a finding waits to be confirmed."""

    @property
    def is_urgent(self) -> bool:
        """True while the next sounds decide whether a finding is published, or ends."""
        return self._steady.is_doubtful

    def finding_of(self, array: str) -> str | None:
        """Return the error that concerns an array, in words; None if there is none."""
        return self.state.errors.get(array)

    def take(self, event: Event) -> None:
        """Take in a final event."""
        if event.source == 1 and len(event.received) > 0:
            self.heard.take(event)

    def note_reports(self, findings: Sequence[Finding], *, are_complete: bool = False) -> None:
        """Take in what the reports of the nodes show now, and whether that is all; new faults are logged."""
        with self._lock:
            self._are_reports_complete = are_complete
            self._log_new(self._reported, findings)
            self._reported = tuple(findings)
            self._publish()

    def note_clocks(self, arrays: Iterable[str]) -> None:
        """Note the arrays whose clocks are known to be off.

        They receive other sounds at the times of an event, which is no fault of their poses: what they received is left
        out, and what was concluded from it so far is forgotten.
        """
        with self._lock:
            known, self._clocks_off = self._clocks_off, frozenset(arrays)
            if self._clocks_off <= known:
                return
            self._sounds = [self._on_time(sound) for sound in self._sounds]
            self._run += 1
            self._steady = SteadyFindings()
            self._note(())

    def forget_arrays(self, arrays: Collection[str]) -> None:
        """Forget what some arrays received, and what was concluded from it: their plugs or poses may be others now.

        The sounds stay available for calibration.
        """
        with self._lock:
            rest = (tuple(one for one in sound if one.array not in arrays) for sound in self._sounds)
            self._sounds = [sound for sound in rest if sound]
            self._unjudged, self._examined = 0, self.heard.last
            self._run += 1
            self._steady = SteadyFindings()
            self._note(())

    def forget(self) -> None:
        """Forget all sounds: those of another run are about another set-up."""
        self.heard.forget()
        with self._lock:
            self._sounds, self._unjudged = (), 0
            self._run += 1
            self._steady = SteadyFindings()
            self._note(())

    def prepare(self, site: Site) -> Callable[[], None]:
        """Return what examines the last sounds anew with the poses of this site; any thread.

        What was wrong may be mended.
        """
        return partial(self._take_over, site, layout_findings(site))

    def _take_over(self, site: Site, of_layout: Sequence[Finding]) -> None:
        with self._lock:
            self._site, self._of_layout = site, tuple(of_layout)
            self._run += 1
            self._steady = SteadyFindings()
            self._unjudged = len(self._sounds)
            self._note(())
        self.thread.wake()

    def examine(self) -> None:
        """Examine the sounds if there are new ones; the thread calls it, and a test may."""
        with self._lock:
            site, known, run = self._site, list(self._sounds), self._run
            is_moved = self._unjudged > 0 and len(known) >= LEAST_SOUNDS
        new = self.heard.after(self._examined)
        if not (new or is_moved):
            return
        # imported late: scipy's optimizer takes memory, and no event needs it
        from livessl.site.build.set_up import find_set_up_faults, hidden_by

        sounds = [*known, *(self._on_time(sound.observations) for sound in new)][-KEPT_SOUNDS:]
        findings = find_set_up_faults(site, sounds) if len(sounds) >= LEAST_SOUNDS else None
        blind_spots = () if findings is None or are_poses_in_doubt(findings) else hidden_by(site, sounds)
        with self._lock:
            if run != self._run:
                return
            self._sounds = sounds
            self._examined = new[-1].number if new else self._examined
            self._unjudged += len(new)
            if findings is None:
                self._note(())
            else:
                self._note(self._steady.note(findings, self._unjudged), blind_spots)
                self._unjudged = 0

    def _on_time(self, sound: Sequence[Observation]) -> Sequence[Observation]:
        """Return what the arrays whose clocks are right received of a sound."""
        return tuple(one for one in sound if one.array not in self._clocks_off) if self._clocks_off else sound

    def _note(self, findings: Sequence[Finding], blind_spots: tuple[BlindSpot, ...] = ()) -> None:
        self._log_new(self._of_sounds, findings)
        self._of_sounds = tuple(findings)
        self._blind_spots = () if are_poses_in_doubt(findings) else blind_spots
        self._publish()

    def _publish(self) -> None:
        """Replace the state."""
        all_arrays = [spec.name for spec in self._site.processed]
        errors = {
            array: f"{finding.message}; {finding.cure}"
            for finding in reversed(self._of_sounds)
            if finding.severity is Severity.ERROR
            for array in ([finding.array] if finding.array is not None else all_arrays)
        }
        findings = in_order([*self._of_sounds, *self._reported, *self._of_layout])
        self.state = SetUpState(
            len(self._sounds), tuple(findings), errors, self._are_reports_complete, self._blind_spots
        )

    @staticmethod
    def _log_new(known: Sequence[Finding], findings: Sequence[Finding]) -> None:
        before = {_subject(finding) for finding in known}
        for finding in findings:
            if _subject(finding) not in before:
                _log.warning("%s; %s", finding.message, finding.cure)


def _subject(finding: Finding) -> tuple[str, str | None, int | None]:
    """Return what a finding of a report is about; its figures change all the time."""
    return finding.fault, finding.array or finding.message.partition(":")[0], finding.channel
