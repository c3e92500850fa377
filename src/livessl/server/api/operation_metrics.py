"""Prometheus metrics of the running program: version, and whether it runs with what its site file says."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily, Metric

from livessl import __version__
from livessl.server.parts import Parts


def operation_metrics(parts: Parts) -> Iterator[Metric]:
    """Gauges of the program and of its site file."""
    site, reloader = parts.site, parts.reloader
    yield InfoMetricFamily(
        "livessl",
        "Version of the program, name of the site and localization method.",
        {"version": __version__, "site": site.site, "method": site.fusion.method},
    )
    yield GaugeMetricFamily(
        "livessl_reload_successful",
        "1 if the site file could be used when it was last read, otherwise 0.",
        float(reloader.is_usable),
    )
    yield GaugeMetricFamily(
        "livessl_keys_need_restart",
        "Keys of the site file, as it was last read, that take effect only with the next start.",
        len(reloader.needs_restart),
    )
