"""Spans of an event in the server (OpenTelemetry): reception, fusion, publication, alerts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from livessl.core.types import FRAME_NS, Event
from livessl.server.api.encode import JsonObject, Stages
from livessl.traces import Traces, event_subject, frame_subject

MAX_LINKS: Final = 128
"""Most frames that an event's span is linked with, spread over its time: the default limit of OpenTelemetry."""


class EventTraces:
    """Adds the spans of events. For the fusion thread; `alerted` and `delivered` are for the thread of the alerts.

    Parameters
    ----------
    traces : Traces
    """

    def __init__(self, traces: Traces) -> None:
        self._traces = traces
        self._step_began_ns = 0

    def begin_step(self, now_ns: int) -> None:
        """Note when the step of the fusion began that locates what is published next."""
        self._step_began_ns = now_ns

    def published(self, event: Event, stages: Stages | None, began_ns: int, ended_ns: int, *, first: bool) -> None:
        """Add the spans of an event that was published between two moments.

        Parameters
        ----------
        event : Event
        stages : Stages or None
            Where the time went; None if it is not known, as for sound that came late.
        began_ns, ended_ns : int
            Nanoseconds since the epoch.
        first : bool
            Whether this is the first answer of the event's id.
        """
        subject = event_subject(event.id)
        arrays = () if event.estimate is None else tuple(event.estimate.arrays)
        attributes: dict[str, Any] = {
            "livessl.event": event.id,
            "livessl.status": str(event.status),
            "livessl.arrays": arrays,
            "livessl.duration_s": event.duration_s,
        }
        if event.estimate is not None:
            attributes["livessl.position_m"] = [float(x) for x in event.estimate.position_m]
            attributes["livessl.confidence"] = event.estimate.confidence
        if first:
            links = [frame_subject(array, index) for array, index in _frames(event, arrays)]
            self._traces.root("event", subject, event.start_ns, ended_ns, attributes, links)
        else:
            self._traces.child("event.corrected", subject, began_ns, ended_ns, attributes)
        if stages is not None:
            complete_ns = event.end_ns + round(stages.waited * 1e9)
            sent_ns = complete_ns + round(stages.sent * 1e9)
            received_ns = sent_ns + round(stages.received * 1e9)
            located_ns = received_ns + round(stages.located * 1e9)
            self._traces.child("reception", subject, sent_ns, received_ns, {})
            self._traces.child("fusion", subject, received_ns, located_ns, {})
        if self._step_began_ns:
            self._traces.child("estimate", subject, self._step_began_ns, began_ns, {"livessl.method": event.method})
        self._traces.child("publish", subject, began_ns, ended_ns, {})

    def alerted(self, alert: JsonObject, began_ns: int, ended_ns: int) -> None:
        """Add the span of the judgement that raised an alert; an alert about a condition has no event to add it to."""
        if alert["event"] is not None:
            attributes = {"livessl.rule": alert["rule"], "livessl.alert": alert["key"]}
            self._traces.child("alert", event_subject(alert["event"]["id"]), began_ns, ended_ns, attributes)

    def delivered(self, alert: JsonObject, action: str, began_ns: int, ended_ns: int, fault: str | None) -> None:
        """Add the span of one attempt to deliver an alert."""
        if alert["event"] is not None:
            attributes = {"livessl.rule": alert["rule"], "livessl.alert": alert["key"], "livessl.action": action}
            subject = event_subject(alert["event"]["id"])
            self._traces.child("alert.deliver", subject, began_ns, ended_ns, attributes, fault)


def _frames(event: Event, arrays: tuple[str, ...]) -> Iterator[tuple[str, int]]:
    """Yield the frames of the arrays that located an event, evenly spread if there are more than `MAX_LINKS`."""
    first, last = event.start_ns // FRAME_NS, (event.end_ns - 1) // FRAME_NS
    each = MAX_LINKS // max(1, len(arrays))
    stride = max(1, -(-(last - first + 1) // max(1, each)))
    for array in arrays[:MAX_LINKS]:
        for index in range(first, last + 1, stride):
            yield array, index
