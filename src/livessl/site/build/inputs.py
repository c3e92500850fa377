"""Adds the device's input to findings about channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from livessl.core.commission.finding import Finding
from livessl.site.models import Site


def with_inputs(site: Site, findings: Sequence[Finding]) -> list[Finding]:
    """Add the input of the device to each finding about a channel, where the site file says which one it is."""
    return [replace(one, input=_input(site, one)) for one in findings]


def _input(site: Site, finding: Finding) -> int | None:
    if finding.array is None or finding.channel is None:
        return None
    channel = finding.channel
    for array in site.members(finding.array):
        count = len(site.array(array).microphones_m)
        if channel <= count:
            node = site.node_of(array)
            inputs = site.nodes[node].arrays[array] if node is not None else []
            return inputs[channel - 1] if len(inputs) >= channel else None
        channel -= count
    return None
