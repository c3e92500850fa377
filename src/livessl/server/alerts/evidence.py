"""Makes the attachments of alerts (picture and clip), and decides how long an alert waits for its clip."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

from livessl.server.alerts.picture import picture_of
from livessl.server.api.encode import JsonObject
from livessl.server.clips.reader import UnreadableClipError
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site

CLIP_WAIT_S: Final = 15.0
"""Longest wait, in seconds, for the clip of an alert, which is cut some seconds after the end of the event."""

QUEUED_S: Final = 3.0
"""Time, in seconds, after which an event that waits for no clip gets none."""

LOOK_S: Final = 0.25
"""Interval, in seconds, at which it is checked whether the clip has been cut."""

MAX_CLIP_BYTES: Final = 8_000_000
"""Largest clip, in bytes, that is attached; many mail servers refuse larger mails."""


class ClipSource(Protocol):
    """Finds the clips of events; every thread may call it."""

    def best_file(self, event_id: str) -> Path | None:
        """Return the recording that people listen to first; None if there is none, or none yet."""
        ...

    def is_waiting(self, event_id: str) -> bool:
        """Return whether the clip of an event is still to be cut."""
        ...


class Evidence:
    """Makes the attachments of alerts, on any thread.

    Parameters
    ----------
    site : callable
        Returns the site with the poses that are in force.
    zones : callable
        Returns the zones that are in force.
    clips : ClipSource or None
        None if the site keeps no clips.
    """

    def __init__(self, site: Callable[[], Site], zones: Callable[[], ZoneMap], clips: ClipSource | None) -> None:
        self._site = site
        self._zones = zones
        self._clips = clips

    def picture(self, alert: JsonObject, size_px: int | None = None) -> bytes | None:
        """Return the picture of an alert as PNG; None for one that is about no place."""
        size = {} if size_px is None else {"size_px": size_px}
        return picture_of(alert, self._site(), self._zones(), **size)

    async def clip(self, alert: JsonObject, *, waits: bool = True) -> Path | None:
        """Return the clip of an alert's event as soon as it is there, within `CLIP_WAIT_S`.

        None if the site keeps no clips, the alert is about no event, there is none by then, it cannot be read, or it is
        larger than `MAX_CLIP_BYTES`; without `waits`, if there is none now.
        """
        if self._clips is None or alert["event"] is None:
            return None
        event_id = alert["event"]["id"]
        for look in range(round(CLIP_WAIT_S / LOOK_S)):
            try:
                path = self._clips.best_file(event_id)
            except UnreadableClipError:  # the folder of the clips has logged it
                return None
            if path is not None:
                return path if path.stat().st_size <= MAX_CLIP_BYTES else None
            if not waits or (look * LOOK_S >= QUEUED_S and not self._clips.is_waiting(event_id)):
                break
            await asyncio.sleep(LOOK_S)
        return None
