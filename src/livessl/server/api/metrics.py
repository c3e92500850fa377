"""Prometheus metrics: names and help of the server's, the events' and the arrays' counters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fastapi import APIRouter, Response
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from livessl.core.commission.finding import Severity
from livessl.server.api.alert_metrics import alert_metrics
from livessl.server.api.clip_metrics import clip_metrics
from livessl.server.api.encode import JsonObject
from livessl.server.api.operation_metrics import operation_metrics
from livessl.server.api.report_metrics import report_metrics
from livessl.server.parts import Parts

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


def metrics_route(parts: Parts) -> APIRouter:
    """`GET /metrics`."""
    router = APIRouter()
    registry = CollectorRegistry()
    registry.register(_Metrics(parts))
    ProcessCollector(registry=registry)
    registry.register(parts.latency.histogram)

    @router.get(
        "/metrics",
        tags=["state"],
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    )
    def get_metrics() -> Response:
        """Metrics in the text format of Prometheus."""
        return Response(generate_latest(registry), media_type=CONTENT_TYPE)

    return router


class _Metrics(Collector):
    """Counts and states of the whole server."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    def collect(self) -> Iterator[Metric]:
        yield from operation_metrics(self._parts)
        yield from server_metrics(self._parts)
        yield from event_metrics(self._parts)
        yield from alert_metrics(self._parts)
        yield from clip_metrics(self._parts)
        arrays = self._parts.array_states.describe()
        yield from array_metrics(arrays)
        yield from report_metrics(arrays)


def server_metrics(parts: Parts) -> Iterator[Metric]:
    """Gauges and counters of connections, maps and refusals."""
    yield GaugeMetricFamily("livessl_uptime_seconds", "Seconds since the server started.", parts.site_time.uptime_s())
    findings = GaugeMetricFamily(
        "livessl_findings", "Faults of the set-up that sounds and nodes show.", labels=["severity"]
    )
    found = parts.set_up_watch.state.findings
    for severity in Severity:
        findings.add_metric([severity], sum(one.severity is severity for one in found))
    yield findings
    yield GaugeMetricFamily("livessl_websocket_clients", "Connected live subscribers.", parts.fanout.clients)
    yield GaugeMetricFamily("livessl_map_watchers", "Connected subscribers to power maps.", parts.maps.watchers)
    yield CounterMetricFamily("livessl_maps_drawn", "Power maps drawn on demand.", parts.maps.drawings)
    yield CounterMetricFamily(
        "livessl_messages_superseded",
        "Messages not sent to slow subscribers, because a newer one replaced them or their queue was full.",
        parts.fanout.superseded,
    )
    yield GaugeMetricFamily(
        "livessl_updates_left_out",
        "Windows of this live run that were not localized, because newer ones were due.",
        parts.engine.updates_left_out,
    )
    load = parts.overload.describe()
    yield GaugeMetricFamily(
        "livessl_overload_level", "How much work is shed; 0 while the server keeps up.", load["level"]
    )
    yield GaugeMetricFamily(
        "livessl_fusion_delay_seconds", "Longest wait of a message before it was processed.", load["delay_s"]
    )
    yield GaugeMetricFamily("livessl_fusion_busy", "Share of the time that the fusion works.", load["busy"])
    yield CounterMetricFamily(
        "livessl_updates_shed",
        "Windows that were not localized because the server was overloaded.",
        load["updates_shed"],
    )
    malformed = parts.receiver.ingest.malformed
    yield CounterMetricFamily("livessl_messages_refused", "Malformed messages from nodes.", malformed)
    refused = CounterMetricFamily("livessl_refused", "Peers and requests refused.", labels=["door", "reason"])
    for (door, reason), count in parts.refusals.counts().items():
        refused.add_metric([door, reason], count)
    yield refused


def event_metrics(parts: Parts) -> Iterator[Metric]:
    """Gauges and counters of events."""
    log = parts.event_log
    yield CounterMetricFamily("livessl_events", "Events published since the server started.", log.published)
    yield CounterMetricFamily("livessl_events_unkept", "Events that could not be stored.", log.discarded)
    what = "Entries of the journal, and messages for the hub, that could not be stored."
    yield CounterMetricFamily("livessl_entries_unkept", what, log.discarded_others)
    yield GaugeMetricFamily("livessl_events_unsaved", "Events that wait to be stored.", log.unsaved)
    stored = parts.store.count()
    if stored is not None:
        yield GaugeMetricFamily("livessl_events_stored", "Events in the database.", stored)
    if parts.hub_link is not None:
        yield CounterMetricFamily("livessl_hub_sent", "Messages that the hub's stream has taken.", parts.hub_link.sent)
        dropped = parts.hub_link.dropped
        yield CounterMetricFamily("livessl_hub_dropped", "Messages larger than NATS takes, given up.", dropped)
        yield GaugeMetricFamily("livessl_hub_waiting", "Messages that wait for the hub.", parts.hub_link.waiting)
    yield CounterMetricFamily("livessl_sink_failures", "Events that a sink did not accept.", parts.sinks.failures)


def array_metrics(arrays: Iterable[JsonObject]) -> Iterator[Metric]:
    """Gauges and counters of every array, from the objects that `GET arrays` answers."""
    up = GaugeMetricFamily("livessl_array_up", "1 while the array is healthy, otherwise 0.", labels=["array"])
    enabled = GaugeMetricFamily(
        "livessl_array_enabled", "0 while an operator has disabled the array, otherwise 1.", labels=["array"]
    )
    age = GaugeMetricFamily("livessl_array_age_seconds", "Seconds since the array's last message.", labels=["array"])
    level = GaugeMetricFamily("livessl_array_level_dbfs", "In-band level of the array in dBFS.", labels=["array"])
    agreement = GaugeMetricFamily(
        "livessl_array_sounds",
        "Of the last ten sounds that three arrays or more detected, those in which the array agreed or disagreed "
        "with the others.",
        labels=["array", "verdict"],
    )
    off = GaugeMetricFamily(
        "livessl_array_clock_offset_seconds",
        "Seconds by which the array's clock is ahead of the reference, measured from sounds that both detected.",
        labels=["array", "reference"],
    )
    unsure = GaugeMetricFamily(
        "livessl_array_clock_offset_std_seconds",
        "Standard deviation of the clock offset in seconds.",
        labels=["array", "reference"],
    )
    counts = CounterMetricFamily("livessl_array", "Counters of the array by name.", labels=["array", "what"])
    for array in arrays:
        up.add_metric([array["name"]], float(array["state"] == "healthy"))
        enabled.add_metric([array["name"]], float(array["enabled"]))
        if array["age_s"] is not None:
            age.add_metric([array["name"]], array["age_s"])
        if array["level_dbfs"] is not None:
            level.add_metric([array["name"]], array["level_dbfs"])
        for verdict, count in array["agreement"].items():
            agreement.add_metric([array["name"], verdict], count)
        if (clock := array["clock_offset"]) is not None:
            off.add_metric([array["name"], clock["reference"]], clock["offset_s"])
            unsure.add_metric([array["name"], clock["reference"]], clock["std_s"])
        for what, count in array["counters"].items():
            counts.add_metric([array["name"], what], count)
    yield from (up, enabled, age, level, agreement, off, unsure, counts)
