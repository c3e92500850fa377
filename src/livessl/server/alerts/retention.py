"""Retention of alerts: deletes those that are older than `store.retention_days`."""

from __future__ import annotations

from typing import Final

from livessl.server.alerts.delivery import NS_PER_S
from livessl.server.alerts.outbox import Outbox

EXPIRE_NS: Final = 600 * NS_PER_S
"""Interval, in nanoseconds, at which old alerts are deleted."""

DAY_NS: Final = 86_400 * NS_PER_S


class Retention:
    """Deletes old alerts now and then.

    Parameters
    ----------
    days : float or None
        Age in days at which alerts are deleted; None keeps them for ever.
    """

    def __init__(self, days: float | None) -> None:
        self._days = days
        self._deleted_ns = 0

    def delete_old(self, outbox: Outbox, now_ns: int) -> None:
        """Delete the old alerts of an outbox, unless that was done within `EXPIRE_NS`.

        Raises
        ------
        OutboxError
            If the outbox cannot be used.
        """
        if self._days is not None and now_ns - self._deleted_ns >= EXPIRE_NS:
            self._deleted_ns = now_ns
            outbox.expire(max(now_ns - round(self._days * DAY_NS), 0))
