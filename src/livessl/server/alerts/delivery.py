"""Delivers alerts, and decides when one is sent again after a failure (backoff, jitter) and when it is given up.

Defaults of attempts and waits are in `site/alert_models.py` (`AlertAction`).

Each action has one `Deliverer`, which takes its alerts out of the outbox. The defaults of attempts and waits are in
`livessl.site.alert_models.AlertAction`.
"""

from __future__ import annotations

import asyncio
import logging
import zlib
from collections.abc import Callable
from functools import partial
from typing import Final

from livessl.clock import Clock
from livessl.server.alerts.actions import Action, DeliveryError
from livessl.server.alerts.outbox import Due, Outbox, OutboxError
from livessl.server.api.encode import JsonObject
from livessl.server.event_traces import EventTraces
from livessl.site.alert_models import AlertAction

NS_PER_S: Final = 1_000_000_000

REST_S: Final = 1.0
"""Wait, in seconds, after the outbox could not be read or written."""

LOOK_S: Final = 30.0
"""Longest wait, in seconds, before the outbox is read again although nothing is due, because clocks can be set."""

JITTER: Final = 0.1
"""Largest share by which a wait is lengthened, so that alerts that failed together are not all sent again together."""

_log = logging.getLogger(__name__)


class Deliverer:
    """Delivers the alerts that wait for one action, one at a time, in the order in which they are due.

    Parameters
    ----------
    name : str
        Name of the action.
    config : AlertAction
    action : Action
    outbox : Outbox
    clock : Clock
    traces : EventTraces or None
        Adds a span for each attempt; None if nothing is traced.
    complete : callable or None
        Returns an alert together with the fields that are made for each attempt, such as links; None adds nothing.
    """

    def __init__(
        self,
        name: str,
        config: AlertAction,
        action: Action,
        outbox: Outbox,
        clock: Clock,
        traces: EventTraces | None = None,
        complete: Callable[[JsonObject], JsonObject] | None = None,
    ) -> None:
        self.name = name
        self._complete = complete
        self._traces = traces
        self._config = config
        self._action = action
        self._outbox = outbox
        self._clock = clock
        self._news = asyncio.Event()
        self._outcome: Callable[[], None] | None = None
        self.delivered = 0
        """Alerts that arrived since the start."""
        self.failed = 0
        """Attempts that failed since the start."""

    def wake(self) -> None:
        """Read the outbox again at once. Call it on the event loop's thread."""
        self._news.set()

    async def run(self) -> None:
        """Deliver until cancelled."""
        async with self._action.connected(self._reachable):
            while True:
                self._news.clear()
                try:
                    self._note_outcome()
                    due = self._outbox.due(self.name, self._clock.now_ns(), self._longest_wait_ns)
                    if due is not None:
                        self._outcome = await self._attempt(due)
                        continue
                    wait_s = self._wait_s()
                except OutboxError as error:
                    _log.error("%s", error)
                    wait_s = REST_S
                try:
                    async with asyncio.timeout(wait_s):
                        await self._news.wait()
                except TimeoutError:
                    pass

    @property
    def _longest_wait_ns(self) -> int:
        return round(max(self._config.longest_wait_s, self._config.first_wait_s) * NS_PER_S)

    def _reachable(self) -> None:
        try:
            self._outbox.hasten(self.name, self._clock.now_ns())
        except OutboxError as error:  # the alerts are delivered at the times that were set before
            _log.error("%s", error)
        self.wake()

    def _wait_s(self) -> float:
        next_ns = self._outbox.next_due_ns(self.name)
        if next_ns is None:
            return LOOK_S
        return min(LOOK_S, max(0.0, (next_ns - self._clock.now_ns()) / NS_PER_S))

    def _note_outcome(self) -> None:
        """Write the outcome of the last attempt to the outbox before the next one, so that no attempt is repeated."""
        if self._outcome is not None:
            self._outcome()
            self._outcome = None

    async def _deliver(self, alert: JsonObject) -> None:
        """Deliver an alert, and record the attempt as a span if the process is traced."""
        if self._traces is None:
            await self._attempted(alert)
            return
        began_ns, fault = self._clock.now_ns(), None
        try:
            await self._attempted(alert)
        except DeliveryError as error:
            fault = str(error)
            raise
        finally:
            self._traces.delivered(alert, self.name, began_ns, self._clock.now_ns(), fault)

    async def _attempted(self, alert: JsonObject) -> None:
        """Deliver an alert; an unexpected error of the action counts as a failed attempt."""
        try:
            await self._action.deliver(alert if self._complete is None else self._complete(alert))
        except DeliveryError:
            raise
        except Exception as error:
            _log.exception("alerts.actions.%s: an unexpected error", self.name)
            raise DeliveryError(f"{type(error).__name__}: {error}") from error

    async def _attempt(self, due: Due) -> Callable[[], None]:
        """Try to deliver an alert; return a function that writes the outcome to the outbox."""
        key, rule = due.alert["key"], due.alert["rule"]
        try:
            await self._deliver(due.alert)
        except DeliveryError as error:
            self.failed += 1
            attempts = due.attempts + 1
            if error.hopeless or attempts >= self._config.attempts:
                _log.error(
                    "alerts.actions.%s: alert %s of rule %r was given up after %d attempts: %s; it can be sent again",
                    *(self.name, key, rule, attempts, error),
                )
                return partial(self._outbox.failed, due.number, str(error), None)
            asked_s = min(error.retry_after_s or 0.0, self._longest_wait_ns / NS_PER_S)
            wait_s = max(backoff_s(self._config, attempts, key), asked_s)
            level = logging.WARNING if attempts == 1 else logging.INFO
            _log.log(level, "alerts.actions.%s: %s; next attempt in %.0f s", self.name, error, wait_s)
            next_ns = self._clock.now_ns() + round(wait_s * NS_PER_S)
            return partial(self._outbox.failed, due.number, str(error), next_ns)
        self.delivered += 1
        return partial(self._outbox.delivered, due.number)


def backoff_s(config: AlertAction, attempts: int, key: str) -> float:
    """Return the wait, in seconds, after a number of failed attempts.

    The wait doubles with each attempt. A part that depends on the key of the alert is added to it (`JITTER`).
    """
    doubled = config.first_wait_s * 2.0 ** min(attempts - 1, 60)
    spread = zlib.crc32(f"{key} {attempts}".encode()) / 2**32
    return min(doubled, max(config.longest_wait_s, config.first_wait_s)) * (1.0 + JITTER * spread)
