"""Metrics of a hub and its sites in the text format of Prometheus.

The library's own encoder takes six times as long, which would be most of the answer with a thousand sites, so the text
is written here. A test holds both to the same text.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from fastapi import APIRouter, Response
from prometheus_client.utils import floatToGoString

from livessl.federation.archive import Archive
from livessl.federation.intake import Intake
from livessl.federation.overview import Contact
from livessl.schema.answers import errors
from livessl.server.api.metrics import CONTENT_TYPE

Kind = Literal["gauge", "counter"]


def metrics_route(archive: Archive, intake: Intake) -> APIRouter:
    """`GET /metrics`."""
    router = APIRouter()

    @router.get(
        "/metrics",
        tags=["state"],
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **errors(503)},
    )
    def get_metrics() -> Response:
        """Metrics in the text format of Prometheus."""
        text = hub_text(intake) + sites_text(archive.contacts())
        return Response(text, media_type=CONTENT_TYPE)

    return router


def hub_text(intake: Intake) -> str:
    """Return the counts of the hub itself."""
    return (
        family("livessl_hub_takes_in", "gauge", "1 while this hub takes messages in.", [("", intake.has_turn)])
        + family("livessl_hub_taken_total", "counter", "Messages taken in.", [("", intake.taken)])
        + family("livessl_hub_rejected_total", "counter", "Messages that could not be stored.", [("", intake.rejected)])
    )


def sites_text(contacts: Sequence[Contact]) -> str:
    """Return the states of all sites."""
    labels = [labelled("site", contact.site) for contact in contacts]

    def of_each(name: str, kind: Kind, text: str, values: Iterable[float]) -> str:
        return family(name, kind, text, zip(labels, values, strict=True))

    return (
        of_each("livessl_site_up", "gauge", "1 unless the site is away.", (not each.is_away for each in contacts))
        + of_each(
            "livessl_site_age_seconds",
            "gauge",
            "Seconds since the site's last contact.",
            (round(each.age_s, 3) for each in contacts),
        )
        + of_each(
            "livessl_site_waiting",
            "gauge",
            "Messages that waited at the site.",
            (each.waiting for each in contacts),
        )
        + of_each(
            "livessl_site_missing_total",
            "counter",
            "Messages that never came.",
            (each.missing for each in contacts),
        )
    )


def labelled(name: str, value: str) -> str:
    """Return a label with its value, as it stands behind the name of a metric."""
    escaped = value.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
    return f'{{{name}="{escaped}"}}'


def family(name: str, kind: Kind, text: str, samples: Iterable[tuple[str, float]]) -> str:
    """Return a family of metrics.

    Parameters
    ----------
    name : str
        Name of its samples.
    kind : str
    text : str
        What it is, in one line without a backslash.
    samples : iterable of (str, float)
        Labels as `labelled` returns them, or nothing, and value.
    """
    lines = "".join([f"{name}{labels} {floatToGoString(value)}\n" for labels, value in samples])
    return f"# HELP {name} {text}\n# TYPE {name} {kind}\n{lines}"
