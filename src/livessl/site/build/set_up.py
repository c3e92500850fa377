"""Faults of a site's set-up that sounds show: the findings of the core, with the inputs of the site's devices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livessl.core.commission.diagnosis import verify
from livessl.core.commission.finding import Finding
from livessl.core.commission.findings import channel_findings, find_faults, set_up_findings, sharp_delays
from livessl.core.types import FloatArray, Observation
from livessl.site.build.grid import search_grid
from livessl.site.build.inputs import with_inputs
from livessl.site.models import Site


def find_set_up_faults(site: Site, sounds: Sequence[Sequence[Observation]]) -> list[Finding]:
    """Find what the observations of some sounds say about a site's channels, poses and speed of sound."""
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    findings = find_faults(microphones, sounds, np.array(search_grid(site).bounds_m), site.c_m_s)
    return with_inputs(site, findings)


def verify_set_up(site: Site, sounds: Sequence[Sequence[Observation]], places_m: FloatArray) -> list[Finding]:
    """Find what explains the delays of sounds that were made at measured places.

    Parameters
    ----------
    site : Site
    sounds : sequence of sequences of Observation
        What the arrays observed of each sound.
    places_m : (S, 3) float64
        Where the sounds were made, metres.
    """
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    of_channels = channel_findings(microphones, sounds)
    delays = sharp_delays(microphones, sounds, of_channels)
    if not delays:
        return with_inputs(site, of_channels)
    diagnosis = verify({name: microphones[name] for name in delays}, delays, places_m, site.c_m_s)
    return with_inputs(site, [*of_channels, *set_up_findings(diagnosis)])
