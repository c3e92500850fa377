"""Runs doctor and calibration on a site: findings with inputs, verification, measured and refined poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.blind_spots import blind_spots
from livessl.core.commission.diagnosis import verify
from livessl.core.commission.finding import Finding
from livessl.core.commission.findings import channel_findings, find_faults, set_up_findings, sharp_delays, stds_s
from livessl.core.commission.next_place import proposed_place
from livessl.core.commission.places import Delays, Microphones, PlaceSearch
from livessl.core.commission.refine import refine
from livessl.core.commission.resection import MeasuredSetUp, measure_poses
from livessl.core.commission.set_up import ORIENTATION_STD_DEG, POSITION_STD_M, Freedom, Known, careful
from livessl.core.types import FloatArray, Observation, Uncertainty
from livessl.site.build.grid import search_grid
from livessl.site.build.inputs import with_inputs
from livessl.site.models import Site

OUTSIDE_M: Final = 5.0
"""Distance from the room, in metres, beyond which a place is a mistake: an origin or a unit that is not the site's."""


LEAST_POSITION_STD_M: Final = 0.01
LEAST_ORIENTATION_STD_DEG: Final = 0.4
"""Least standard deviations of a pose along each axis, in metres and degrees: those after a good calibration."""


class PlaceOutsideError(ValueError):
    """A place that is said to be measured is far outside the room."""


def require_near_room(site: Site, places_m: FloatArray) -> None:
    """Refuse places (S, 3), metres, that are far outside the room.

    Raises
    ------
    PlaceOutsideError
        With the first of them.
    """
    size_m = np.array(site.room.size_m)
    off = ((places_m < -OUTSIDE_M) | (places_m > size_m + OUTSIDE_M)).any(axis=1)
    if off.any():
        place, room = (", ".join(f"{x:g}" for x in one) for one in (places_m[off][0], size_m))
        raise PlaceOutsideError(
            f"expected places in the room, 0, 0, 0 to {room} m, or within {OUTSIDE_M:g} m of it, got {place}; measure "
            "from the corner that is the site's origin, in metres"
        )


def find_set_up_faults(site: Site, sounds: Sequence[Sequence[Observation]]) -> list[Finding]:
    """Find what the observations of some sounds say about a site's channels, poses and speed of sound."""
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    bounds_m = np.array(search_grid(site).bounds_m)
    return with_inputs(site, find_faults(microphones, sounds, bounds_m, site.c_m_s, freedom_of(site)))


def hidden_by(site: Site, sounds: Sequence[Sequence[Observation]]) -> tuple[BlindSpot, ...]:
    """Return the faults of poses that the observations of some sounds could not have shown.

    Their sizes hold where the set-up is nearly as filed: where no finding is about the poses.
    """
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    joint = [sound for sound in sounds if len(sound) > 1]
    delays = sharp_delays(microphones, joint, channel_findings(microphones, sounds))
    known = Known(freedom_of(site), stds_s(delays, joint))
    return blind_spots(microphones, delays, np.array(search_grid(site).bounds_m), site.c_m_s, known)


def freedom_of(site: Site) -> dict[str, Freedom]:
    """Return how far each array may be from where the site has it.

    That is what a careful set-up may be off by where `uncertainty` has its default, and in proportion to it elsewhere,
    such as after a calibration, but no less than a calibration can know.
    """
    usual = Uncertainty()
    freedom: dict[str, Freedom] = {}
    for spec in site.processed:
        known = spec.uncertainty
        position_m = max(LEAST_POSITION_STD_M, POSITION_STD_M * known.position_m / usual.position_m)
        turn_deg = max(LEAST_ORIENTATION_STD_DEG, ORIENTATION_STD_DEG * known.orientation_deg / usual.orientation_deg)
        freedom |= careful({spec.name: spec.microphones_m}, position_m, turn_deg)
    return freedom


def verify_set_up(site: Site, sounds: Sequence[Sequence[Observation]], places_m: FloatArray) -> list[Finding]:
    """Find what explains the delays of sounds that were made at measured places.

    Parameters
    ----------
    site : Site
    sounds : sequence of sequences of Observation
        What the arrays observed of each sound.
    places_m : (S, 3) float64
        Where the sounds were made, metres.

    Raises
    ------
    PlaceOutsideError
        If one of them is far outside the room.
    """
    require_near_room(site, places_m)
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    of_channels = channel_findings(microphones, sounds)
    delays = sharp_delays(microphones, sounds, of_channels)
    if not delays:
        return with_inputs(site, of_channels)
    diagnosis = verify({name: microphones[name] for name in delays}, delays, places_m, site.c_m_s)
    return with_inputs(site, [*of_channels, *set_up_findings(diagnosis, at_known_places=True)])


def observed_delays(site: Site, sounds: Sequence[Sequence[Observation]]) -> tuple[Microphones, Delays]:
    """Return the microphones, and the delays of the arrays that clearly received any of some sounds."""
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    return microphones, sharp_delays(microphones, sounds, [])


def measure_set_up(
    site: Site, sounds: Sequence[Sequence[Observation]], places_m: FloatArray, place_std_m: float
) -> MeasuredSetUp:
    """Measure the poses of the arrays and the speed of sound by sounds at measured places.

    Parameters
    ----------
    site : Site
    sounds : sequence of sequences of Observation
    places_m : (S, 3) float64
        Where the sounds were made, metres.
    place_std_m : float
        How exactly the places are known along each axis, metres.

    Raises
    ------
    PlaceOutsideError
        If a place is far outside the room.
    ValueError
        If no array received enough of the sounds.
    """
    require_near_room(site, places_m)
    microphones, delays = observed_delays(site, sounds)
    return measure_poses(microphones, delays, places_m, site.c_m_s, place_std_m)


def refine_set_up(
    site: Site, sounds: Sequence[Sequence[Observation]], known: Collection[str], position_std_m: float
) -> MeasuredSetUp:
    """Measure the poses of all arrays but the known ones, and the speed of sound, by sounds at unknown places.

    Parameters
    ----------
    site : Site
    sounds : sequence of sequences of Observation
    known : collection of str
        Arrays that are where the site has them.
    position_std_m : float
        How exactly the positions of the others are known along each axis, metres.

    Raises
    ------
    ValueError
        If there are too few sounds, or no array to refine.
    """
    microphones, delays = observed_delays(site, sounds)
    return refine(microphones, delays, np.array(search_grid(site).bounds_m), site.c_m_s, known, None, position_std_m)


def place_sounds(site: Site, sounds: Sequence[Sequence[Observation]]) -> FloatArray:
    """Return where sounds (S, 3) were by their delays alone, metres; NaN where fewer than two arrays received one."""
    microphones, delays = observed_delays(site, sounds)
    if not delays:
        return np.full((len(sounds), 3), np.nan)
    counts = np.sum([np.isfinite(measured).sum(axis=1) > 1 for measured in delays.values()], axis=0)
    found = PlaceSearch(np.array(search_grid(site).bounds_m), site.c_m_s)
    positions_m = found.fit({name: microphones[name] for name in delays}, delays).positions_m
    return np.where((counts > 1)[:, None], positions_m, np.nan)


def next_clap_place(site: Site, places_m: FloatArray, place_std_m: float) -> FloatArray | None:
    """Return the place (3,) at which another clap would improve the poses most, metres; None if no place is free.

    Parameters
    ----------
    site : Site
    places_m : (S, 3) float64
        Places of the claps so far, metres; S may be 0.
    place_std_m : float
        How exactly places are known along each axis, metres.
    """
    microphones = {spec.name: spec.microphones_m for spec in site.processed}
    return proposed_place(microphones, places_m, np.array(search_grid(site).bounds_m), site.c_m_s, place_std_m)
