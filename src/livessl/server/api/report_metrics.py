"""Prometheus metrics of nodes' channels and machines, as the nodes report them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from livessl.server.api.encode import JsonObject

_LEVELS: Final = {
    "peak_dbfs": ("livessl_channel_peak_dbfs", "Largest magnitude of a sample since the report before, in dBFS."),
    "rms_dbfs": ("livessl_channel_rms_dbfs", "Level of the channel over the whole band, in dBFS."),
    "noise_dbfs": ("livessl_channel_noise_dbfs", "Noise floor of the channel, in dBFS."),
    "hum_dbfs": ("livessl_channel_hum_dbfs", "Level of mains hum in the channel, in dBFS; absent without hum."),
    "mean": ("livessl_channel_mean", "Mean of the channel's samples, full scale 1."),
}


def report_metrics(arrays: Iterable[JsonObject]) -> Iterator[Metric]:
    """Gauges and counters of channels and nodes, from the objects that `GET arrays` answers."""
    arrays = list(arrays)
    gauges = {name: GaugeMetricFamily(*described, labels=["array", "channel"]) for name, described in _LEVELS.items()}
    clipped = CounterMetricFamily(
        "livessl_channel_clipped_samples", "Clipped samples of the channel.", labels=["array", "channel"]
    )
    for array in arrays:
        for number, channel in enumerate(array["channels"], 1):
            labels = [array["name"], str(number)]
            clipped.add_metric(labels, channel["clipped"])
            for name, gauge in gauges.items():
                if channel[name] is not None:
                    gauge.add_metric(labels, channel[name])
    yield from (*gauges.values(), clipped)
    yield from _host_metrics(arrays)


def _host_metrics(arrays: Iterable[JsonObject]) -> Iterator[Metric]:
    """Gauges and counters of the machine of each array's node."""
    synchronized = GaugeMetricFamily(
        "livessl_node_clock_synchronized",
        "1 if the clock of the node's machine follows another one by NTP or PTP, otherwise 0.",
        labels=["array"],
    )
    error = GaugeMetricFamily(
        "livessl_node_clock_error_seconds",
        "Largest error of the node's system clock, in seconds, as its time service reports it.",
        labels=["array"],
    )
    load = GaugeMetricFamily("livessl_node_load", "Load of the node's machine per processor.", labels=["array"])
    lost = CounterMetricFamily(
        "livessl_node_lost_blocks",
        "Blocks of the device lost because the node's machine did not keep up.",
        labels=["array"],
    )
    for array in arrays:
        host, labels = array["host"], [array["name"]]
        if host is None:
            continue
        lost.add_metric(labels, host["lost_blocks"])
        for gauge, value in ((synchronized, host["synchronized"]), (error, host["error_s"]), (load, host["load"])):
            if value is not None:
                gauge.add_metric(labels, float(value))
    yield from (synchronized, error, load, lost)
