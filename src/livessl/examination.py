"""Runs `livessl doctor` on recordings: what is wrong with a set-up, on which channel of which array, and the cure.

A running server does the same in `server/set_up_watch.py`; the words of the findings are in
`core/commission/findings.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.channels import ChannelMeter
from livessl.core.commission.clocks import Rises, find_clock_faults
from livessl.core.commission.crosstalk import CrosstalkMeter
from livessl.core.commission.envelopes import EnvelopeMeter
from livessl.core.commission.finding import OF_SET_UP, Finding, Severity, are_poses_in_doubt, in_order
from livessl.core.commission.observe import observe
from livessl.core.types import Event, Observation
from livessl.recordings.assign import AssignedRecording
from livessl.site.build.inputs import with_inputs
from livessl.site.build.layout import layout_findings
from livessl.site.build.set_up import find_set_up_faults, hidden_by
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
    blind_spots : tuple of BlindSpot
        Faults of poses that these sounds could not have shown.
    """

    findings: tuple[Finding, ...]
    sounds: int
    blind_spots: tuple[BlindSpot, ...] = ()

    @property
    def is_faultless(self) -> bool:
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
        As in `livessl.locate`. Use ten sounds from different places. With fewer than three, only the samples, the
        clocks and the site file are examined.

    Raises
    ------
    ConfigError, DeviceError
        As in `livessl.locate`.
    """
    loaded, parts = offline.assigned(site, recordings, sample_rate_hz)
    return examine_parts(loaded, parts)


@dataclass(frozen=True, slots=True)
class Gathered:
    """The observations that an examination rests on.

    Parameters
    ----------
    events : tuple of Event
        The located events. Their `received` is empty: `sounds` holds what was observed in it.
    sounds : tuple of tuple of Observation
        The arrays' observations of each sound.
    findings : tuple of Finding
        Faults that show in the samples and in the clocks.
    """

    events: tuple[Event, ...]
    sounds: tuple[tuple[Observation, ...], ...]
    findings: tuple[Finding, ...]


def examine_parts(
    site: Site, parts: Sequence[AssignedRecording], progress: Callable[[int], None] | None = None
) -> Examination:
    """Examine a site's set-up with recordings that are assigned to its arrays: see `examine`.

    Raises
    ------
    DeviceError
        If recordings of arrays that the site joins do not belong together.
    """
    return conclude(site, gather(site, parts, progress))


def gather(site: Site, parts: Sequence[AssignedRecording], progress: Callable[[int], None] | None = None) -> Gathered:
    """Gather what recordings say: see `examine_parts`."""
    outputs = offline.run(site, parts, UnpacedClock(), progress=progress)
    events, sounds = [], []
    for event in (output for output in outputs if isinstance(output, Event)):
        if event.received:
            sounds.append(observe(event.received))
        events.append(replace(event, received=()))
    metered = [_metered(site, part) for part in parts]
    of_samples = (finding for findings, _ in metered for finding in findings)
    of_clocks = _of_clocks(site, {part.array: rises for part, (_, rises) in zip(parts, metered, strict=True)})
    return Gathered(tuple(events), tuple(sounds), (*of_samples, *of_clocks))


def conclude(site: Site, gathered: Gathered) -> Examination:
    """Draw the conclusions from what was gathered."""
    findings = [*gathered.findings, *find_set_up_faults(site, gathered.sounds), *layout_findings(site)]
    shown = in_order(with_inputs(site, _without_consequences(findings)))
    # the size of a blind spot is computed from the filed set-up, so it needs one without known faults
    hidden = () if are_poses_in_doubt(shown) else hidden_by(site, gathered.sounds)
    return Examination(tuple(shown), len(gathered.sounds), hidden)


def _without_consequences(findings: Sequence[Finding]) -> list[Finding]:
    """Leave out findings that follow from another one.

    These are:

    - whatever else a `dead` channel shows;
    - `noisy` for a channel with a wrong `level` or `clipping`;
    - `crosstalk` for a `duplicate` or `deaf` channel;
    - faults of the set-up if there is a `clock` fault, because the arrays then receive different sounds at one time.
    """
    faults: dict[tuple[str | None, int | None], set[str]] = {}
    for one in findings:
        faults.setdefault((one.array, one.channel), set()).add(one.fault)
    return [
        one
        for one in findings
        if "dead" not in (others := faults[one.array, one.channel] - {one.fault})
        and not (one.fault == "noisy" and others & {"level", "clipping"})
        and not (one.fault == "crosstalk" and others & {"duplicate", "deaf"})
        and not (one.fault in OF_SET_UP and "clock" in faults.get((None, None), set()))
    ]


def _of_clocks(site: Site, rises: Mapping[str, Rises]) -> Iterator[Finding]:
    """Compare when sounds rise by each clock: one for each node, and one for each array without a node."""
    by_clock: dict[str, Rises] = {}
    for array, one in rises.items():
        by_clock.setdefault(site.node_of(array) or array, one)
    return find_clock_faults(by_clock)


def _metered(site: Site, part: AssignedRecording) -> tuple[list[Finding], Rises]:
    """Find the faults that the samples of an array show, and when its sound rises."""
    rate_hz, rows = part.recording.sample_rate_hz, np.array(part.channels) - 1
    microphones_m = next(spec.microphones_m for spec in site.specs if spec.name == part.array)
    meters = ChannelMeter(len(rows), rate_hz), CrosstalkMeter(microphones_m, rate_hz, site.c_m_s)
    envelope = EnvelopeMeter(rate_hz)
    for block in part.recording.blocks(0):
        samples = block.samples[rows]
        envelope.push(block.first_index, samples)
        for meter in meters:
            meter.push(samples)
    findings = [finding for meter in meters for finding in meter.faults(part.array)]
    return findings, Rises(part.start_ns / 1e9, envelope.rises())
