"""A capture node: one device (or the recordings that stand in for it), its arrays, the link to the server."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Final

from livessl import wire
from livessl.capture.devices import Device, Placed
from livessl.capture.line import Line, played_messages
from livessl.capture.link import Link
from livessl.clock import Clock

DRAIN_NS: Final = 3_000_000_000
"""How long a recording's end waits for the server's last acknowledgement."""

WAIT_NS: Final = 20_000_000

MAX_PENDING: Final = 400
"""A replay faster than real time waits while so many messages are on their way."""

_log = logging.getLogger(__name__)


class UndeliveredError(Exception):
    """Sound that the server never acknowledged."""


Stop = Callable[[], bool]


class Node:
    """Sends what its lines make of the sound.

    Parameters
    ----------
    name : str
        The node's name in the site file.
    endpoint : str
        The server's address.
    lines : sequence of Line
    clock : Clock
    run_id : str
        New at each start.
    replay : bool
        Whether the sound carries past times.
    """

    def __init__(
        self, name: str, endpoint: str, lines: Sequence[Line], clock: Clock, run_id: str, *, replay: bool = False
    ) -> None:
        rates = {array: line.sample_rate_hz for line in lines for array in line.arrays}
        self._endpoint = endpoint
        self._replay = replay
        self._lines = lines
        self._clock = clock
        self.link = Link(endpoint, wire.Hello(name, run_id, rates, replay), clock)

    def run_device(self, device: Device, stop: Stop) -> None:
        """Capture from a device until told to stop; whatever happens to device or server, carry on."""
        (line,) = self._lines
        problem = None
        with device:
            for block in device:
                if stop():
                    break
                if device.problem != problem:
                    problem = device.problem
                    _log.warning("%s", problem) if problem else _log.info("device %r delivers sound", device.name)
                    self.link.tell(problem)
                self.link.send(line.push(block))
        self.link.close(bye=True)

    def run_recordings(
        self, placed: Sequence[Placed], stop: Stop, *, clock: Clock, progress: Callable[[int], None] | None = None
    ) -> None:
        """Play recordings, one for each line, by `clock`; then wait for the last acknowledgement.

        Raises
        ------
        UndeliveredError
            Where the server has not acknowledged everything.
        """
        for end_ns, batch in played_messages(self._lines, placed, clock):
            if stop():
                break
            self.link.send(batch)
            if progress is not None:
                progress(end_ns)
            while self._replay and self.link.pending > MAX_PENDING and not stop():
                self._pause()
        deadline_ns = self._clock.now_ns() + DRAIN_NS
        while self.link.pending and not stop() and self._clock.now_ns() < deadline_ns:
            self._pause()
        undelivered = self.link.pending + self.link.dropped
        refused = self.link.refused
        self.link.close(bye=True)
        if undelivered and not stop():
            why = f"it refused: {refused}" if refused else "is a server running there?"
            raise UndeliveredError(f"{undelivered} messages were never taken by the server at {self._endpoint}; {why}")

    def _pause(self) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + WAIT_NS)
        self.link.service()
