"""Retention of events: deletes stored events that are older than `store.retention_days`.

Alerts are deleted by `alerts/retention.py`, and clips by `clips/service.py`.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from typing import Final, Protocol

from livessl.clock import Clock
from livessl.server.store import StoreError

EXPIRE_S: Final = 600.0
"""Interval, in seconds, at which old events are deleted."""

DAY_NS: Final = 86_400_000_000_000

_log = logging.getLogger(__name__)


class Expiring(Protocol):
    """Something that deletes what is old."""

    def expire(self, before_ns: int, end: threading.Event | None = None) -> int:
        """Delete what began before a time, or a part of it if `end` is set meanwhile; return how many events it was."""
        ...


async def delete_old_events(store: Expiring, clock: Clock, retention_days: float | None) -> None:
    """Delete events older than `retention_days` every `EXPIRE_S`, until cancelled; return at once if it is None."""
    end = threading.Event()
    try:
        while retention_days is not None:
            before_ns = clock.now_ns() - round(retention_days * DAY_NS)
            try:
                if gone := await asyncio.to_thread(store.expire, before_ns, end):
                    _log.info("%d events older than %g days were deleted", gone, retention_days)
            except StoreError as error:
                _log.error("%s", error)
            await asyncio.sleep(EXPIRE_S)
    finally:
        end.set()  # cancelling does not end the thread, and the server would wait for it
