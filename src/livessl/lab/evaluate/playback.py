"""Recordings of several devices through a site's pipelines and fusion, block by block, as live."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from livessl.core.types import Block, Float32Array, Output
from livessl.site.build.fusion import make_fusion
from livessl.site.build.pipeline import make_pipeline
from livessl.site.models import Site

START_NS: Final = 1_800_000_000_000_000_000
"""Site time, in nanoseconds since the epoch, at which every recording begins; the value is arbitrary."""

BLOCK_S: Final = 0.04
"""Length, in seconds, of a device's blocks."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """The recording of one device.

    Parameters
    ----------
    samples : (K, n) float32
    true_rate_hz : float
        Rate at which the device really samples.
    late_ns : int
        How far the device's clock is ahead, in nanoseconds: its stamps are too late by that much.
    """

    samples: Float32Array
    true_rate_hz: float
    late_ns: int


def play(
    site: Site, recorded: Mapping[str, Recorded], nominal_rate_hz: float, method: str, *, updates: bool
) -> Iterator[Output]:
    """Send the recordings of a site's arrays through a pipeline each and the common fusion; yield its outputs.

    Parameters
    ----------
    site : Site
    recorded : mapping of array name to Recorded
        Recordings that begin at `START_NS`.
    nominal_rate_hz : float
        Rate that the devices report.
    method : str
        Name of the estimator.
    updates : bool
        Whether windows are located and tracks made, besides events.
    """
    fusion = make_fusion(site, method, updates=updates)
    pipelines = {
        name: make_pipeline(site, {name: range(1, len(each.samples) + 1)}, nominal_rate_hz)
        for name, each in recorded.items()
    }
    now_ns = START_NS
    for now_ns, name, block in heapq.merge(*(_blocks(name, each) for name, each in recorded.items()), key=_when):
        yield from fusion.step(pipelines[name].push(block), now_ns)
    yield from fusion.step([message for pipeline in pipelines.values() for message in pipeline.flush()], now_ns)
    yield from fusion.flush(now_ns)


def _blocks(name: str, recorded: Recorded) -> Iterator[tuple[int, str, Block]]:
    """Yield the blocks of a device, each with the true time at which it is complete and the array's name."""
    size = round(BLOCK_S * recorded.true_rate_hz)
    for first in range(0, recorded.samples.shape[1], size):
        samples = recorded.samples[:, first : first + size].copy()
        begin_ns, end_ns = (
            START_NS + round(1e9 * index / recorded.true_rate_hz) for index in (first, first + samples.shape[1])
        )
        yield end_ns, name, Block(first, samples, begin_ns + recorded.late_ns)


def _when(entry: tuple[int, str, Block]) -> tuple[int, str]:
    return entry[:2]
