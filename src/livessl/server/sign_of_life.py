"""Reports to systemd that the server lives (watchdog) while its fusion thread takes turns, and its condition."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from livessl.server.api.routes import condition
from livessl.server.parts import Parts
from livessl.service_manager import STATUS_NS, ServiceManager

DESCRIBE_S: Final = STATUS_NS / 1e9
"""Interval, in seconds, at which the condition is looked at: as often as it is reported."""

_log = logging.getLogger(__name__)


class SignOfLife:
    """Reports that a server is alive, from its event loop, as long as its fusion thread takes turns.

    So a loop that hangs is as visible as a thread that does.

    Parameters
    ----------
    parts : Parts
    service : ServiceManager
    url : str
        Address of the dashboard.
    is_listening : callable
        Returns whether HTTP is served.
    """

    def __init__(self, parts: Parts, service: ServiceManager, url: str, is_listening: Callable[[], bool]) -> None:
        self._parts = parts
        self._service = service
        self._url = url
        self._is_listening = is_listening
        self._turns = 0
        self._words = "started"

    async def describe(self) -> None:
        """Look at the condition from time to time, in another thread: databases and disks that it asks may be slow."""
        has_complained = False
        while self._service.is_there:
            try:
                self._words = await asyncio.to_thread(self._describe)
                has_complained = False
            except Exception:  # noqa: BLE001 - whatever fails there, the server is alive
                if not has_complained:
                    _log.exception("the condition of the server could not be described to the service manager")
                has_complained = True
            await asyncio.sleep(DESCRIBE_S)

    def give(self) -> None:
        """Report, if the fusion thread has taken a turn since the last call; never wait."""
        turns = self._parts.engine.turns
        if turns != self._turns and self._is_listening():
            self._turns = turns
            self._service.turn(lambda: self._words)

    def _describe(self) -> str:
        status, reasons = condition(self._parts, self._parts.array_states.describe(levels=False))
        return f"{status}: {'; '.join(reasons)}" if reasons else f"{status}; dashboard on {self._url}"
