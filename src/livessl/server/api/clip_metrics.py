"""Prometheus metrics of clips and of live listening."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from livessl.server.parts import Parts


def clip_metrics(parts: Parts) -> Iterator[Metric]:
    """Gauges and counters of those who listen, and of the clips, if the site keeps any."""
    yield GaugeMetricFamily("livessl_listeners", "Clients that listen live to a microphone.", parts.listeners.count)
    clips = parts.clips
    if clips is None:
        return
    figures = clips.folder.figures
    yield GaugeMetricFamily("livessl_clips_stored", "Events with recordings.", figures.count)
    yield GaugeMetricFamily("livessl_clips_bytes", "Size of all recordings.", figures.nbytes)
    yield GaugeMetricFamily(
        "livessl_clips_unreadable",
        "Events with recordings that could not be read when they were last needed.",
        figures.unreadable,
    )
    yield GaugeMetricFamily("livessl_clips_waiting", "Events whose recordings are being made.", clips.waiting)
    results = CounterMetricFamily(
        "livessl_clips", "What has become of events that should have recordings.", labels=["result"]
    )
    for result, count in asdict(clips.counts).items():
        results.add_metric([result], count)
    yield results
    yield CounterMetricFamily(
        "livessl_clips_frames_dropped",
        "Frames that no recording can contain because memory was full.",
        clips.frames_dropped,
    )
