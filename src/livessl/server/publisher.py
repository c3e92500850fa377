"""Hands each result of the fusion to those who publish, keep or draw it (events, tracks, updates, maps, clips)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import assert_never

from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import BackfillRequest, Event, Output, Track, Update, Window
from livessl.server.api.encode import JsonObject
from livessl.server.clips.service import Clips
from livessl.server.event_log import EventLog
from livessl.server.run import Run
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.shared_state import SharedState
from livessl.server.tracks import Tracks


class Publisher:
    """Publishes what a run finds, on the fusion thread.

    Parameters
    ----------
    shared : SharedState
    publish : callable
        Gets every message for subscribers.
    request : callable
        Sends a request for missing frames to an array's node.
    event_log : EventLog
    tracks : Tracks
    set_up_watch : SetUpWatch
        Examines the set-up with the final events.
    clips : Clips or None
        Keeps the sound of the final events.
    """

    def __init__(
        self,
        shared: SharedState,
        publish: Callable[[JsonObject], None],
        request: Callable[[BackfillRequest], None],
        event_log: EventLog,
        tracks: Tracks,
        set_up_watch: SetUpWatch,
        clips: Clips | None = None,
    ) -> None:
        self._shared = shared
        self._publish = publish
        self._request = request
        self._event_log = event_log
        self._tracks = tracks
        self._set_up_watch = set_up_watch
        self._clips = clips

    def publish(self, outputs: Iterable[Output | FinalResults], run: Run) -> None:
        """Publish what one step of a run has found; a run that has not received anything finds nothing."""
        messages = run.messages
        if messages is None:
            return
        for output in outputs:
            match output:
                case FinalResults():
                    self._event_log.add_final(output, messages, run.clock_offsets.state())
                    for event in output.events:
                        self._set_up_watch.take(event)
                        if self._clips is not None:
                            self._clips.take_final(event, run.clock_offsets)
                case Event():
                    self._event_log.add_early(output, messages)
                case Update():
                    stages = None if self._shared.site_time.is_replay else self._shared.latency.located(output)
                    self._publish(messages.update(output, stages))
                case Track():
                    message = messages.track(output)
                    self._tracks.note(output, message)
                    self._publish(message)
                case Window():
                    if self._shared.overload.relief.maps:
                        self._shared.maps.show(output, run.fusion.power_maps)
                case BackfillRequest():
                    self._request(output)
                case _:
                    assert_never(output)

    def end_tracks(self) -> None:
        """Publish the end of all tracks."""
        for message in self._tracks.end_all():
            self._publish(message)
