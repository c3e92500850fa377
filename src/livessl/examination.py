"""Examines a site's set-up with recordings: what is wrong, on which channel of which array, and what cures it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.commission.channels import ChannelMeter
from livessl.core.commission.clocks import find_clock_faults
from livessl.core.commission.finding import Finding, Severity
from livessl.core.commission.observe import observe
from livessl.core.types import Event
from livessl.recordings.assign import AssignedRecording
from livessl.site.build.set_up import find_set_up_faults, with_inputs
from livessl.site.models import Site


@dataclass(frozen=True, slots=True)
class Examination:
    """Findings about a set-up, and the number of sounds behind them.

    Parameters
    ----------
    findings : tuple of Finding
        Errors first.
    sounds : int
        Number of sounds that were examined.
    """

    findings: tuple[Finding, ...]
    sounds: int

    @property
    def is_sound(self) -> bool:
        """True if no finding is an error."""
        return all(finding.severity is not Severity.ERROR for finding in self.findings)


def examine(
    site: offline.SiteOrPath,
    recordings: Mapping[str, offline.Given],
    sample_rate_hz: float | None = None,
) -> Examination:
    """Examine a site's set-up with recordings.

    Parameters
    ----------
    site : Site, Path or str
        A site, or the path of a site file.
    recordings, sample_rate_hz
        As in `livessl.locate`. Ten sounds from different places show most; three are the least.

    Raises
    ------
    ConfigError, DeviceError
        As in `livessl.locate`.
    """
    loaded, parts = offline.assigned(site, recordings, sample_rate_hz)
    return examine_parts(loaded, parts)


def examine_parts(
    site: Site, parts: Sequence[AssignedRecording], progress: Callable[[int], None] | None = None
) -> Examination:
    """Examine a site's set-up with recordings that are assigned to its arrays: see `examine`.

    Raises
    ------
    DeviceError
        If recordings of arrays that the site joins do not belong together.
    """
    outputs = offline.run(site, parts, UnpacedClock(), progress=progress)
    events = [output for output in outputs if isinstance(output, Event)]
    sounds = [observe(event.received) for event in events if event.received]
    findings = [
        *(finding for part in parts for finding in _of_samples(part)),
        *_of_clocks(site, events),
        *find_set_up_faults(site, sounds),
    ]
    order = list(Severity)
    told = sorted(with_inputs(site, _without_consequences(findings)), key=lambda one: order.index(one.severity))
    return Examination(tuple(told), len(sounds))


def _without_consequences(findings: Sequence[Finding]) -> list[Finding]:
    """Leave out what follows from another finding: whatever a silent channel shows, and the noise of a loud one."""
    faults: dict[tuple[str | None, int | None], set[str]] = {}
    for one in findings:
        faults.setdefault((one.array, one.channel), set()).add(one.fault)
    return [
        one
        for one in findings
        if "dead" not in (others := faults[one.array, one.channel] - {one.fault})
        and not (one.fault == "noisy" and others & {"level", "clipping"})
    ]


def _of_clocks(site: Site, events: Sequence[Event]) -> Iterator[Finding]:
    """Compare when the clocks of the nodes, or of arrays without a node, show the sounds."""
    starts_s: dict[str, list[float]] = {}
    for event in (event for event in events if event.source == 1):
        for clock in {site.node_of(array) or array for array in event.heard_by}:
            starts_s.setdefault(clock, []).append(event.start_ns / 1e9)
    return find_clock_faults(starts_s)


def _of_samples(part: AssignedRecording) -> list[Finding]:
    meter = ChannelMeter(len(part.channels), part.recording.sample_rate_hz)
    rows = np.array(part.channels) - 1
    for block in part.recording.blocks(0):
        meter.push(block.samples[rows])
    return list(meter.faults(part.array))
