"""Traces of OpenTelemetry: spans that follow one sound from the microphones to an alert (extra `telemetry`).

Processes need not pass anything on for that: the ids of a trace are a digest of what it is about, such as the id of an
event. A span that another process or thread adds later finds its trace by itself. Without traces its SDK is not
imported.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Final

from livessl import __version__
from livessl.errors import UseError

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import SpanContext

ENDPOINTS: Final = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
"""Environment variables of OpenTelemetry that name the receiver of spans; without one of them nothing is traced."""

Attributes = Mapping[str, str | int | float | bool | Sequence[str]]


def frame_subject(array: str, frame_index: int) -> str:
    """Return what the trace of a frame is about."""
    return f"frame {array} {frame_index}"


def event_subject(event_id: str) -> str:
    """Return what the trace of an event is about."""
    return f"event {event_id}"


class Traces:
    """Makes spans whose ids follow from what they are about; every thread may call it.

    Parameters
    ----------
    exporter : SpanExporter
        Gets the spans.
    service : str
        Name of the program, such as `livessl-server`.
    instance : str
        Which of them: the name of the site or of the node.
    at_once : bool
        Export each span when it ends, as a test needs it; otherwise in batches, on a thread of its own.
    """

    def __init__(self, exporter: SpanExporter, service: str, instance: str, *, at_once: bool = False) -> None:
        from opentelemetry import trace
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor, SimpleSpanProcessor
        from opentelemetry.sdk.trace.sampling import Decision

        self._api = trace
        self._sampled = Decision.RECORD_AND_SAMPLE
        self._ids = _ids_of_subjects()
        resource = Resource.create(
            {"service.name": service, "service.instance.id": instance, "service.version": __version__}
        )
        self._provider: TracerProvider = TracerProvider(resource=resource, id_generator=self._ids)
        self._provider.add_span_processor(SimpleSpanProcessor(exporter) if at_once else BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("livessl", __version__)

    def root(
        self,
        name: str,
        subject: str,
        start_ns: int,
        end_ns: int,
        attributes: Attributes,
        links: Iterable[str] = (),
    ) -> None:
        """Add the first span of the trace of a subject.

        Parameters
        ----------
        name : str
        subject : str
        start_ns, end_ns : int
            Nanoseconds since the epoch.
        attributes : mapping of str to value
        links : iterable of str
            Subjects of other traces that this one goes back to.
        """
        linked = [self._api.Link(self._context(other)) for other in links]
        with self._ids.of(subject):
            span = self._tracer.start_span(name, _no_parent(), attributes=attributes, links=linked, start_time=start_ns)
        span.end(max(start_ns, end_ns))

    def child(
        self, name: str, subject: str, start_ns: int, end_ns: int, attributes: Attributes, fault: str | None = None
    ) -> None:
        """Add a span below the first one of the trace of a subject, which may be of another process or still to come.

        Parameters
        ----------
        name : str
        subject : str
        start_ns, end_ns : int
            Nanoseconds since the epoch.
        attributes : mapping of str to value
        fault : str or None
            What went wrong, if something did.
        """
        parent = self._api.set_span_in_context(self._api.NonRecordingSpan(self._context(subject)), _no_parent())
        span = self._tracer.start_span(name, parent, attributes=attributes, start_time=start_ns)
        if fault is not None:
            span.set_status(self._api.Status(self._api.StatusCode.ERROR, fault))
        span.end(max(start_ns, end_ns))

    def frame_sent(self, array: str, frame_index: int, end_ns: int, sent_ns: int) -> None:
        """Add the span of a frame from its end to the moment at which it was handed to the network."""
        attributes: Attributes = {"livessl.array": array, "livessl.frame_index": frame_index}
        self.root("capture.send", frame_subject(array, frame_index), end_ns, sent_ns, attributes)

    def stop(self) -> None:
        """Export what is left, and stop."""
        self._provider.shutdown()

    def _context(self, subject: str) -> SpanContext:
        """Return the context of the first span of a subject's trace, sampled as that span is."""
        trace_id, span_id = _ids_from(subject)
        decision = self._provider.sampler.should_sample(None, trace_id, subject).decision
        is_sampled = decision is self._sampled
        flags = self._api.TraceFlags.SAMPLED if is_sampled else self._api.TraceFlags.DEFAULT
        return self._api.SpanContext(trace_id, span_id, is_remote=True, trace_flags=self._api.TraceFlags(flags))


_in_use: Traces | None = None


def traces_in_use() -> Traces | None:
    """Return the traces of this process; None if nothing is traced."""
    return _in_use


def use_traces(traces: Traces | None) -> None:
    """Let the parts of this process that are made from now on add spans to these traces, or to none."""
    global _in_use
    _in_use = traces


@contextmanager
def traced(service: str, instance: str) -> Iterator[None]:
    """Trace this process during a context, if the environment asks for it.

    Raises
    ------
    UseError
        If it asks for traces, and the extra `telemetry` is not installed.
    """
    wanted = next((name for name in ENDPOINTS if os.environ.get(name)), None)
    if wanted is None or os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true":
        yield
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    except ImportError as error:
        raise UseError(
            f"{wanted}: traces need the extra `telemetry` ({error}); run `pip install 'livessl[telemetry]'`, or unset "
            "the variable"
        ) from error
    traces = Traces(OTLPSpanExporter(), service, instance)
    use_traces(traces)
    try:
        yield
    finally:
        use_traces(None)
        traces.stop()


def _ids_from(subject: str) -> tuple[int, int]:
    """Return the ids of the trace of a subject and of its first span: neither is 0, which would be no id."""
    digest = blake2b(subject.encode(), digest_size=24).digest()
    return int.from_bytes(digest[:16], "big") or 1, int.from_bytes(digest[16:], "big") or 1


def _no_parent() -> Any:
    from opentelemetry.context import Context

    return Context()


def _ids_of_subjects() -> Any:
    """Return a generator of ids that gives those of a subject on request, and random ones otherwise."""
    from opentelemetry.sdk.trace.id_generator import RandomIdGenerator

    class Ids(RandomIdGenerator):
        def __init__(self) -> None:
            self._wanted = threading.local()

        @contextmanager
        def of(self, subject: str) -> Any:
            self._wanted.ids = _ids_from(subject)
            try:
                yield
            finally:
                self._wanted.ids = None

        def generate_trace_id(self) -> int:
            ids = getattr(self._wanted, "ids", None)
            return super().generate_trace_id() if ids is None else int(ids[0])

        def generate_span_id(self) -> int:
            ids = getattr(self._wanted, "ids", None)
            return super().generate_span_id() if ids is None else int(ids[1])

    return Ids()
