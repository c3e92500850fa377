"""Decides how long a client waits before it connects again (reconnects), and when it gives up."""

from __future__ import annotations

import logging
import random
from typing import Final

from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus, InvalidURI, WebSocketException

from livessl.client.address import Address, RefusedError, may_pass
from livessl.clock import SystemClock
from livessl.errors import RunError

FIRST_WAIT_S: Final = 0.1
"""Wait, in seconds, before the first attempt to connect again."""

LONGEST_WAIT_S: Final = 5.0
"""Longest wait, in seconds, between two attempts."""

GROWTH: Final = 1.6
"""Factor from one wait to the next."""

SILENCE_S: Final = 20.0
"""Silence, in seconds, after which a connection is tested by a ping, and the longest wait for its answer."""

MAX_MESSAGE_BYTES: Final = 16_000_000
"""Longest message; the states of 64 arrays take about 0.2 MB."""

LOST: Final = (OSError, WebSocketException)
"""Errors of a connection."""

_POLICY_VIOLATION: Final = 1008

_log = logging.getLogger(__name__)


def monotonic_s() -> float:
    """Return seconds by the monotonic clock."""
    return SystemClock().monotonic_ns() / 1e9


def socket_log() -> logging.Logger:
    """Return the log of a connection, without debug messages: `websockets` would write the token into them."""
    log = logging.getLogger("livessl.client.socket")
    log.setLevel(logging.INFO)
    return log


class Patience:
    """Waits between attempts to connect.

    Parameters
    ----------
    address : Address
        Named in errors.
    give_up_s : float or None
        Seconds without a connection after which `next_wait_s` raises the last error; None for never.
    """

    def __init__(self, address: Address, give_up_s: float | None) -> None:
        self._address = address
        self._give_up_s = give_up_s
        self._clock = SystemClock()
        self._opened_ns: int | None = None
        self.proven()

    def opened(self) -> None:
        """Note that a connection is open. It has proven nothing: the server may close it at once."""
        self._opened_ns = self._clock.monotonic_ns()

    def proven(self) -> None:
        """Begin anew, as a connection works: the server has answered what the client needs."""
        self._wait_s = FIRST_WAIT_S
        self._lost_ns: int | None = None

    def next_wait_s(self, error: Exception) -> float:
        """Return how many seconds to wait before the next attempt.

        Raises
        ------
        RefusedError
            If another attempt would fail in the same way.
        UnreachableError
            If the user's patience is over.
        """
        reason = self.refusal(error)
        if reason is not None:
            raise reason from error
        now_ns = self._clock.monotonic_ns()
        if self._opened_ns is not None and now_ns - self._opened_ns >= 1e9 * LONGEST_WAIT_S:
            self.proven()
        self._opened_ns = None
        if self._lost_ns is None:
            self._lost_ns = now_ns
            said = str(error) or type(error).__name__
            _log.warning("%s: no connection (%s); trying again%s", self._address.url, said, _hint(error))
        if self._give_up_s is not None and now_ns - self._lost_ns >= 1e9 * self._give_up_s:
            raise (error if isinstance(error, RunError) else self._address.lost(error)) from error
        wait_s, self._wait_s = self._wait_s, min(GROWTH * self._wait_s, LONGEST_WAIT_S)
        return wait_s * random.uniform(0.5, 1.0)  # noqa: S311 - so that clients do not all come back at once

    def refusal(self, error: Exception) -> RunError | None:
        """Return the error to raise if the server, or this client, does not want to try again."""
        url = self._address.url
        before = error.__cause__ or error.__context__
        if isinstance(before, InvalidStatus):  # a redirect that `websockets` cannot follow
            error = before
        if isinstance(error, InvalidStatus) and not may_pass(error.response.status_code):
            status = error.response.status_code
            target = error.response.headers.get("Location") if 300 <= status < 400 else None
            if target is not None:
                what = f"{url}: the server answered {status} to the WebSocket, a redirect to {target}"
                return RefusedError(f"{what}; give that server's address if you trust it")
            cure = self._address.cure(status) or "; check its address"
            return RefusedError(f"{url}: the server answered {status} to the WebSocket{cure}")
        if isinstance(error, ConnectionClosed) and error.rcvd is not None and error.rcvd.code == _POLICY_VIOLATION:
            return RefusedError(f"{url}: {error.rcvd.reason}")
        if isinstance(error, InvalidURI):
            return RefusedError(f"{url}: {error}; correct the address")
        if isinstance(error, OSError):
            lost = self._address.lost(error)
            return lost if isinstance(lost, RefusedError) else None
        return None


def _hint(error: Exception) -> str:
    """Return what to check if something listens at the address, and does not answer as a web server does."""
    is_silent = isinstance(error, TimeoutError) and error.errno is None  # others come from the network
    if not (is_silent or isinstance(error, InvalidMessage)):
        return ""
    return ". Check the port: that of the dashboard (server.http) is needed, not that of the nodes (server.bind)"
