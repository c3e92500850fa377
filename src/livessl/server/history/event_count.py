"""Counts the stored events without reading them all, for the metrics."""

from __future__ import annotations

import threading

from livessl.server.history import records
from livessl.server.history.database import Database


class EventCount:
    """Follows the number of events by what is stored and deleted, so that it is counted only once.

    Every thread may call it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._number: int | None = None

    @property
    def number(self) -> int | None:
        """The number of events; None until they have been counted."""
        with self._lock:
            return self._number

    def take(self, database: Database) -> None:
        """Count the events of a database.

        Raises
        ------
        StoreError
            If it cannot be used.
        """
        with database.reading() as connection:
            number = records.count_events(connection)
        with self._lock:
            self._number = number

    def change(self, difference: int) -> None:
        """Add the events that were stored, or subtract those that were deleted."""
        with self._lock:
            if self._number is not None:
                self._number += difference
