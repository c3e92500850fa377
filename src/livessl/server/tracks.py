"""Keeps the newest state of all live tracks; `core.stream.tracker` begins and ends tracks."""

from __future__ import annotations

from livessl.core.types import Track, TrackState
from livessl.server.api.encode import JsonObject
from livessl.server.trails import Trails
from livessl.server.zones.presence import Presence


class Tracks:
    """The newest message of every track that has not ended. The fusion thread writes, every thread may read.

    Parameters
    ----------
    presence : Presence
        Receives the same tracks, to follow them through the zones.
    trails : Trails
        Receives the same tracks, to write them into the journal.
    """

    def __init__(self, presence: Presence, trails: Trails) -> None:
        self._presence = presence
        self._trails = trails
        self._messages: dict[int, JsonObject] = {}  # replaced as a whole, never changed, so that readers need no lock

    def all(self) -> list[JsonObject]:
        """Return the live tracks, in the order in which they began or were last updated."""
        return list(self._messages.values())

    def note(self, track: Track, message: JsonObject) -> None:
        """Keep the newest message of a track; drop the track if it has ended."""
        self._presence.take(track, message)
        self._trails.take(track, message)
        others = {number: other for number, other in self._messages.items() if number != track.id}
        self._messages = others if track.state is TrackState.END else {**others, track.id: message}

    def end_all(self) -> list[JsonObject]:
        """Drop all tracks; return the messages that report their end."""
        self._presence.end_all()
        self._trails.end_all()
        ended, self._messages = self._messages.values(), {}
        return [{**message, "state": str(TrackState.END)} for message in ended]
