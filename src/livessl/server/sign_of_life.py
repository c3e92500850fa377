"""What a server reports to its service manager: that it serves, that its fusion goes on, and its condition in words."""

from __future__ import annotations

from collections.abc import Callable

from livessl.server.api.routes import condition
from livessl.server.parts import Parts
from livessl.service_manager import ServiceManager


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

    def give(self) -> None:
        """Report, if the fusion thread has taken a turn since the last call."""
        turns = self._parts.engine.turns
        if turns != self._turns and self._is_listening():
            self._turns = turns
            self._service.turn(self._describe)

    def _describe(self) -> str:
        status, reasons = condition(self._parts, self._parts.array_states.describe(levels=False))
        return f"{status}: {'; '.join(reasons)}" if reasons else f"{status}; dashboard on {self._url}"
