"""Makes the JSON of nodes' reports (levels, drift, machine) in the arrays' states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from livessl.core.commission.channels import SILENCE_DBFS
from livessl.core.types import ChannelLevel, HostState
from livessl.server.api.encode import JsonObject
from livessl.server.node_reports import NodeFigures

SETTLED_PPM: Final = 5.0
"""Error of a drift, parts per million, up to which it counts as known."""


def node_report(figures: NodeFigures | None, now_ns: int, faults: Mapping[int, Sequence[str]]) -> JsonObject:
    """Encode a node's last report of an array.

    Parameters
    ----------
    figures : NodeFigures or None
        None if the node has reported nothing.
    now_ns : int
        Present time, nanoseconds by the monotonic clock.
    faults : mapping of channel to codes
        Faults of the channels, from 1.
    """
    if figures is None:
        return {"channels": [], "channels_age_s": None, "drift": None, "host": None}
    return {
        "channels": [_channel(level, faults.get(number, ())) for number, level in enumerate(figures.levels, 1)],
        "channels_age_s": round(max(0.0, (now_ns - figures.received_ns) / 1e9), 1),
        "drift": _drift(figures),
        "host": None if figures.host is None else _host(figures.host),
    }


def _drift(figures: NodeFigures) -> str:
    """Return how well the drift is known: an error of 5 ppm moves a clock by 0.3 ms in a minute."""
    if figures.host is not None and figures.host.sound_server:
        return "unmeasurable"
    error_ppm = figures.drift_error_ppm
    return "settling" if error_ppm is None or error_ppm > SETTLED_PPM else "known"


def _channel(level: ChannelLevel, faults: Sequence[str]) -> JsonObject:
    return {
        "peak_dbfs": _level(level.peak_dbfs),
        "rms_dbfs": _level(level.rms_dbfs),
        "noise_dbfs": _level(level.noise_dbfs),
        "clipped": level.clipped,
        "mean": _rounded(level.mean, 5),
        "hum_hz": _rounded(level.hum_hz, 1),
        "hum_dbfs": _level(level.hum_dbfs),
        "faults": list(faults),
    }


def _host(host: HostState) -> JsonObject:
    return {
        "synchronized": host.synchronized,
        "service": host.service or None,
        "reference": host.reference or None,
        "error_s": _rounded(host.error_s, 6),
        "lost_blocks": host.lost_blocks,
        "load": _rounded(host.load, 2),
    }


def _level(value_dbfs: float | None) -> float | None:
    """Return a level; None also for digital silence, which has none."""
    return None if value_dbfs is None or value_dbfs <= SILENCE_DBFS else round(value_dbfs, 1)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
