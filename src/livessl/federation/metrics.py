"""Metrics of a hub and its sites in the text format of Prometheus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fastapi import APIRouter, Response
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from livessl.federation.archive import Archive
from livessl.federation.intake import Intake
from livessl.federation.overview import Contact
from livessl.schema.answers import errors
from livessl.server.api.metrics import CONTENT_TYPE


def metrics_route(archive: Archive, intake: Intake) -> APIRouter:
    """`GET /metrics`."""
    router, registry = APIRouter(), CollectorRegistry()
    registry.register(_Metrics(archive, intake))

    @router.get(
        "/metrics",
        tags=["state"],
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **errors(503)},
    )
    def get_metrics() -> Response:
        """Metrics in the text format of Prometheus."""
        return Response(generate_latest(registry), media_type=CONTENT_TYPE)

    return router


class _Metrics(Collector):
    """Counts and states of the hub and its sites."""

    def __init__(self, archive: Archive, intake: Intake) -> None:
        self._archive = archive
        self._intake = intake

    def describe(self) -> list[Metric]:
        """Promise nothing, so that registering asks no database."""
        return []

    def collect(self) -> Iterator[Metric]:
        intake = self._intake
        yield GaugeMetricFamily("livessl_hub_takes_in", "1 while this hub takes messages in.", float(intake.has_turn))
        yield CounterMetricFamily("livessl_hub_taken", "Messages taken in.", intake.taken)
        yield CounterMetricFamily("livessl_hub_rejected", "Messages that could not be stored.", intake.rejected)
        ignored = self._archive.halls.ignored
        yield CounterMetricFamily("livessl_hub_halls_ignored", "Messages whose hall does not list their site.", ignored)
        yield from site_metrics(self._archive.contacts())


def site_metrics(contacts: Iterable[Contact]) -> list[Metric]:
    """Return the states of sites, a value of each for every site."""
    site_up = GaugeMetricFamily("livessl_site_up", "1 unless the site is away.", labels=["site"])
    age = GaugeMetricFamily("livessl_site_age_seconds", "Seconds since the site's last contact.", labels=["site"])
    waiting = GaugeMetricFamily("livessl_site_waiting", "Messages that waited at the site.", labels=["site"])
    missing = CounterMetricFamily("livessl_site_missing", "Messages that never came.", labels=["site"])
    for contact in contacts:
        labels = [contact.site]
        site_up.add_metric(labels, float(not contact.is_away))
        age.add_metric(labels, round(contact.age_s, 3))
        waiting.add_metric(labels, contact.waiting)
        missing.add_metric(labels, contact.missing)
    return [site_up, age, waiting, missing]
