"""Sounds at places that somebody measured: how right the site's positions are, and where its arrays really are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.commission.diagnosis import verify
from livessl.core.commission.finding import Finding
from livessl.core.commission.findings import channel_findings, set_up_findings, sharp_delays
from livessl.core.commission.observe import observe
from livessl.core.commission.resection import LEAST_PLACES, MeasuredPose, measure_pose
from livessl.core.commission.trial import PLACE_STD_M
from livessl.core.types import Event, FloatArray
from livessl.errors import RunError
from livessl.recordings.assign import AssignedRecording
from livessl.site.build.set_up import with_inputs
from livessl.site.models import Site

MOST_CLAPS: Final = 64
"""Most known places: nobody claps at more, and a list of thousands is a mistake."""


@dataclass(frozen=True, slots=True)
class Clap:
    """One sound at a known place.

    Parameters
    ----------
    place_m : (3,) float64
        Where it was made, metres.
    event : Event
    """

    place_m: FloatArray
    event: Event

    @property
    def error_m(self) -> float | None:
        """Distance of the position that was found from the place, metres; None if none was found."""
        estimate = self.event.estimate
        return None if estimate is None else float(np.linalg.norm(estimate.position_m - self.place_m))


def claps_of(
    site: Site,
    parts: Sequence[AssignedRecording],
    places_m: FloatArray,
    progress: Callable[[int], None] | None = None,
) -> list[Clap]:
    """Locate the sounds in recordings that were made at known places (S, 3), one after the other.

    Raises
    ------
    RunError
        If there are more or fewer sounds than places.
    """
    outputs = offline.run(site, parts, UnpacedClock(), progress=progress)
    events = [output for output in outputs if isinstance(output, Event) and output.source == 1]
    if len(events) != len(places_m):
        found = ", ".join(f"{event.start_ns / 1e9:.1f} s" for event in events) or "none"
        raise RunError(
            f"expected {len(places_m)} sounds, one at each place in this order, got {len(events)} (at {found}); "
            "record the claps again with nothing else audible, or correct --at"
        )
    return [Clap(place_m, event) for place_m, event in zip(places_m, events, strict=True)]


def verified(site: Site, claps: Sequence[Clap]) -> list[Finding]:
    """Find what explains the errors at known places: the faults of channels, and of the order and poses of arrays."""
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    sounds = [observe(clap.event.received) for clap in claps]
    of_channels = with_inputs(site, channel_findings(microphones, sounds))
    delays = sharp_delays(microphones, sounds, of_channels)
    microphones = {name: microphones[name] for name in delays}
    if not microphones:
        return of_channels
    diagnosis = verify(microphones, delays, np.array([clap.place_m for clap in claps]), site.c_m_s)
    return [*of_channels, *with_inputs(site, list(set_up_findings(diagnosis)))]


def measured_poses(site: Site, claps: Sequence[Clap], place_std_m: float = PLACE_STD_M) -> Mapping[str, MeasuredPose]:
    """Measure the pose of each array that received enough of the claps.

    Raises
    ------
    RunError
        If no array received enough of them.
    """
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    places_m = np.array([clap.place_m for clap in claps])
    delays = sharp_delays(microphones, [observe(clap.event.received) for clap in claps], [])
    found = {}
    for name, delays_s in delays.items():
        if (np.isfinite(delays_s).sum(axis=1) > 1).sum() >= LEAST_PLACES:
            found[name] = measure_pose(microphones[name], delays_s, places_m, site.c_m_s, place_std_m)
    if not found:
        raise RunError(
            f"expected {LEAST_PLACES} claps or more that an array received clearly, got {len(claps)} in all; clap at "
            "more places, eight are best, on all sides of the array and at different heights"
        )
    return found
