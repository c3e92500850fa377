"""Traces of one sound: from the frames that a node sends to the alert, by the server's and the node's own spans."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from alert_desk import PATIENT, alert_site
from livessl.errors import UseError
from livessl.traces import ENDPOINTS, Traces, event_subject, frame_subject, traced, traces_in_use, use_traces
from scene_server import capture_scene
from small_site import running_server, wait_until

STEPS = {"event", "reception", "fusion", "estimate", "publish", "alert", "alert.deliver"}


@contextmanager
def in_memory() -> Iterator[InMemorySpanExporter]:
    """Trace this process into memory."""
    exporter = InMemorySpanExporter()
    traces = Traces(exporter, "livessl-test", "small", at_once=True)
    use_traces(traces)
    try:
        yield exporter
    finally:
        use_traces(None)
        traces.stop()


def trace_id(span: ReadableSpan) -> int:
    assert span.context is not None
    return int(span.context.trace_id)


def time_ns(span: ReadableSpan) -> tuple[int, int]:
    assert span.start_time is not None
    assert span.end_time is not None
    return span.start_time, span.end_time


def test_sound_is_followed_from_the_frames_of_the_node_to_the_delivered_alert(tmp_path: Path) -> None:
    rules = {"any": {"events": {}, "hold_off_s": 0, "actions": ["run"]}}
    site = alert_site(tmp_path, actions={"run": {**PATIENT, "command": ["true"]}}, rules=rules)
    with in_memory() as exporter, running_server(site) as server:

        def spans(name: str) -> list[ReadableSpan]:
            return [span for span in exporter.get_finished_spans() if span.name == name]

        capture_scene(server)
        wait_until(lambda: len(spans("alert.deliver")) >= 2, "both alerts")
        [*roots] = spans("event")
        assert len(roots) == 2
        sent = {trace_id(span): span for span in spans("capture.send")}
        for root in roots:
            below = [span for span in exporter.get_finished_spans() if trace_id(span) == trace_id(root)]
            assert {span.name for span in below} == STEPS
            assert {span.parent.span_id for span in below if span.parent is not None} == {root.context.span_id}
            steps = {span.name: time_ns(span) for span in below}
            began_ns, ended_ns = time_ns(root)
            for order in (["reception", "fusion", "publish"], ["fusion", "alert", "alert.deliver"]):
                starts = [steps[name][0] for name in order]
                assert starts == sorted(starts), "each step begins after the one before"
            assert steps["reception"][1] == steps["fusion"][0]
            assert began_ns < steps["estimate"][0] <= steps["publish"][0] <= steps["publish"][1] <= ended_ns
            linked = [link.context.trace_id for link in root.links]
            assert set(linked) <= set(sent), "every frame of the event was sent by the node"
            arrays = {str((sent[each].attributes or {})["livessl.array"]) for each in linked}
            assert arrays == {"north", "south"}
            last_sent_ns = max(time_ns(sent[each])[1] for each in linked)
            assert began_ns < last_sent_ns < ended_ns


@settings(max_examples=20)
@given(st.text(), st.text(), st.integers(0, 10**12), st.integers(0, 10**12))
def test_ids_follow_from_the_subject_alone(one: str, other: str, first: int, second: int) -> None:
    exporters = InMemorySpanExporter(), InMemorySpanExporter()
    for exporter in exporters:
        traces = Traces(exporter, "livessl-test", "small", at_once=True)
        traces.root("a", frame_subject(one, first), 1, 2, {})
        traces.root("b", frame_subject(other, second), 1, 2, {}, [frame_subject(one, first)])
        traces.child("c", frame_subject(one, first), 1, 2, {}, "full")
    (a, b, c), again = (exporter.get_finished_spans() for exporter in exporters)
    assert [trace_id(span) for span in (a, b)] == [trace_id(span) for span in again[:2]]
    assert (trace_id(a) == trace_id(b)) is ((one, first) == (other, second))
    assert b.links[0].context.span_id == a.context.span_id
    assert c.parent is not None
    assert (trace_id(c), c.parent.span_id) == (trace_id(a), a.context.span_id)
    assert not c.status.is_ok


@pytest.fixture
def receiver() -> Iterator[tuple[str, list[ExportTraceServiceRequest]]]:
    """A receiver of OTLP over HTTP: its address, and what came."""
    came: list[ExportTraceServiceRequest] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            came.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", came
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_spans_reach_a_receiver_that_the_environment_names(
    receiver: tuple[str, list[ExportTraceServiceRequest]], monkeypatch: pytest.MonkeyPatch
) -> None:
    url, came = receiver
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", url)
    with traced("livessl-server", "lab"):
        traces = traces_in_use()
        assert traces is not None
        traces.root("event", event_subject("lab-1"), 1, 2, {"livessl.event": "lab-1"})
    assert traces_in_use() is None
    [resource] = [each for request in came for each in request.resource_spans]
    found = {attribute.key: attribute.value.string_value for attribute in resource.resource.attributes}
    assert (found["service.name"], found["service.instance.id"]) == ("livessl-server", "lab")
    assert [span.name for each in resource.scope_spans for span in each.spans] == ["event"]


def test_nothing_is_traced_unless_the_environment_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ENDPOINTS:
        monkeypatch.delenv(name, raising=False)
    with traced("livessl-server", "lab"):
        assert traces_in_use() is None
    monkeypatch.setenv(ENDPOINTS[0], "http://127.0.0.1:9")
    monkeypatch.setenv("OTEL_SDK_DISABLED", "true")
    with traced("livessl-server", "lab"):
        assert traces_in_use() is None


def test_missing_extra_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENDPOINTS[0], "http://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    with pytest.raises(UseError, match=r"pip install 'livessl\[telemetry\]'"), traced("livessl-server", "lab"):
        pass
