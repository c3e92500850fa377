"""Examines the set-up with the sounds that are located, in a thread of its own: `livessl doctor`, all the time.

It keeps the observations of the last sounds only, so that findings end once the set-up is mended.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from typing import Final

from livessl.core.commission.finding import LEAST_SOUNDS, Finding, Severity
from livessl.core.types import Event, Observation
from livessl.server.heard_sounds import HeardSounds
from livessl.server.overload import Overload
from livessl.site.models import Site

KEPT_SOUNDS: Final = 12
"""Number of sounds that are examined together: ten show most faults."""

WAIT_S: Final = 1.0
"""Interval, in seconds, at which the thread looks for new sounds, and at which it can be stopped."""

_log = logging.getLogger(__name__)


class SetUpWatch:
    """Examines the set-up.

    The fusion thread calls `take` and `forget`; every thread may read `findings` and `finding_of`.

    Parameters
    ----------
    site : Site
    overload : Overload
        Nothing is examined while sound arrives faster than it is located.
    """

    def __init__(self, site: Site, overload: Overload) -> None:
        self._site = site
        self._overload = overload
        self._lock = threading.Lock()
        self.heard = HeardSounds()
        """The last sounds, for whoever calibrates."""
        self._examined = 0  # number of the last sound that was examined
        self._sounds: Sequence[Sequence[Observation]] = ()
        self._run = 0  # number of times that all sounds were forgotten
        self._findings: tuple[Finding, ...] = ()
        self._by_array: Mapping[str, str] = {}
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Faults of the set-up, errors first."""
        return self._findings

    @property
    def sounds(self) -> int:
        """Number of sounds that the findings rest on, or will."""
        return len(self._sounds)

    def finding_of(self, array: str) -> str | None:
        """Return the error that concerns an array, in words; None if there is none."""
        return self._by_array.get(array)

    def take(self, event: Event) -> None:
        """Take in a final event."""
        if event.source == 1 and len(event.received) > 0:
            self.heard.take(event)

    def forget(self) -> None:
        """Forget all sounds: those of another run are about another set-up."""
        self.heard.forget()
        with self._lock:
            self._sounds = ()
            self._run += 1
            self._note(())

    def start(self) -> None:
        """Begin to examine."""
        self._thread = threading.Thread(target=self._work, name="set-up", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and wait for the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def examine(self) -> None:
        """Examine the sounds if there are new ones; the thread calls it, and a test may."""
        with self._lock:
            known, run = list(self._sounds), self._run
        new = self.heard.after(self._examined)
        if not new:
            return
        from livessl.site.build.set_up import (
            find_set_up_faults,
        )  # scipy's optimizer takes memory, and no event needs it

        self._examined = new[-1].number
        sounds = [*known, *(sound.observations for sound in new)][-KEPT_SOUNDS:]
        findings = tuple(find_set_up_faults(self._site, sounds)) if len(sounds) >= LEAST_SOUNDS else ()
        with self._lock:
            if run == self._run:
                self._sounds = sounds
                self._note(findings)

    def _note(self, findings: tuple[Finding, ...]) -> None:
        known = {finding.message.partition(":")[0] for finding in self._findings}
        for finding in findings:
            if finding.message.partition(":")[0] not in known:
                _log.warning("%s; %s", finding.message, finding.cure)
        self._findings = findings
        self._by_array = {
            array: f"{finding.message}; {finding.cure}"
            for finding in reversed(findings)
            if finding.severity is Severity.ERROR
            for array in ([finding.array] if finding.array is not None else [one.name for one in self._site.processed])
        }

    def _work(self) -> None:
        try:
            while not self._stop.wait(WAIT_S):
                if self._overload.message is None:
                    self.examine()
        except BaseException as error:
            self.failure = error
            _log.exception("the examination of the set-up has failed; the server ends")
            raise
