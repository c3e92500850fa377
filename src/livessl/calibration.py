"""Calibrates from recordings: checks a site by claps at measured places, and measures the poses of its arrays.

The numerics are in `core/commission/`; a running server does the same in `server/proposals.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl import offline
from livessl.arrival_times import arrival_times
from livessl.clock import UnpacedClock
from livessl.core.commission.finding import Finding
from livessl.core.commission.observe import observe
from livessl.core.commission.refine import LEAST_UNKNOWN, refine
from livessl.core.commission.resection import LEAST_PLACES, MeasuredSetUp
from livessl.core.commission.trial import PLACE_STD_M
from livessl.core.types import Event, FloatArray, Observation
from livessl.errors import RunError
from livessl.recordings.assign import AssignedRecording
from livessl.site.build.grid import search_grid
from livessl.site.build.set_up import measure_set_up, observed_delays, verify_set_up
from livessl.site.models import Site

MOST_CLAPS: Final = 64
"""Most known places of one calibration; a longer list is a mistake."""

SAME_S: Final = 0.3
"""Largest difference, in seconds, between the starts of a simulated sound and of the sound that was located.

Half of the pause between two sounds is longer; a frame and the travel of sound are shorter."""


@dataclass(frozen=True, slots=True)
class HeardSound:
    """One sound: where it was located, and what the arrays observed of it.

    Parameters
    ----------
    start_s : float
        When it began: seconds of the recording, or since 1970 of a live one.
    position_m : (3,) float64 or None
        Where it was located, metres; None if that was refused.
    status : str
    reason : str or None
        Why it was not located.
    observations : tuple of Observation
    """

    start_s: float
    position_m: FloatArray | None
    status: str
    reason: str | None
    observations: tuple[Observation, ...]

    @classmethod
    def of(cls, event: Event) -> HeardSound:
        """Return the sound of an event that still has what the arrays received."""
        position_m = None if event.estimate is None else event.estimate.position_m
        return cls(event.start_ns / 1e9, position_m, str(event.status), event.reason, observe(event.received))


@dataclass(frozen=True, slots=True)
class Clap:
    """One sound at a known place.

    Parameters
    ----------
    place_m : (3,) float64
        Where it was made, metres.
    sound : HeardSound
    """

    place_m: FloatArray
    sound: HeardSound

    @property
    def error_m(self) -> float | None:
        """Distance of the position that was found from the place, metres; None if none was found."""
        found_m = self.sound.position_m
        return None if found_m is None else float(np.linalg.norm(found_m - self.place_m))


def sounds_of(
    site: Site, parts: Sequence[AssignedRecording], progress: Callable[[int], None] | None = None
) -> list[HeardSound]:
    """Locate the sounds in recordings, and measure their delays."""
    outputs = offline.run(site, parts, UnpacedClock(), progress=progress)
    return [HeardSound.of(output) for output in outputs if isinstance(output, Event) and output.source == 1]


def claps_of(sounds: Sequence[HeardSound], places_m: FloatArray) -> list[Clap]:
    """Assign sounds to the known places (S, 3) at which they were made, one after the other.

    Raises
    ------
    RunError
        If there are more or fewer sounds than places.
    """
    if len(sounds) != len(places_m):
        found = ", ".join(f"{sound.start_s:.1f} s" for sound in sounds) or "none"
        raise RunError(
            f"expected {len(places_m)} sounds, one at each place in this order, got {len(sounds)} (at {found}); "
            "record the claps again with nothing else audible, or correct --at"
        )
    return [Clap(place_m, sound) for place_m, sound in zip(places_m, sounds, strict=True)]


@dataclass(frozen=True, slots=True)
class KnownSound:
    """One sound of a simulated session.

    Parameters
    ----------
    start_s : float
        Seconds after the beginning of the session.
    place_m : (3,) float64
        Where it was made, metres.
    """

    start_s: float
    place_m: FloatArray


def claps_by_time(sounds: Sequence[HeardSound], known: Sequence[KnownSound], begin_s: float) -> list[Clap]:
    """Return the sounds that begin when a known sound does, each with its place; other sounds are left out.

    Parameters
    ----------
    sounds : sequence of HeardSound
    known : sequence of KnownSound
    begin_s : float
        Time of the beginning of the session, on the scale of the sounds.

    Raises
    ------
    RunError
        If no sound begins at such a time.
    """
    claps = []
    for one in known:
        near = min(sounds, key=lambda sound: abs(sound.start_s - begin_s - one.start_s), default=None)
        if near is not None and abs(near.start_s - begin_s - one.start_s) <= SAME_S:
            claps.append(Clap(one.place_m, near))
    if not claps:
        raise RunError(
            f"--truth: expected sounds at the times of its {len(known)} sounds, got none of the {len(sounds)} in the "
            "recordings at such a time; give the truth.jsonl of the same session"
        )
    return claps


def verified(site: Site, claps: Sequence[Clap]) -> list[Finding]:
    """Find what explains the errors at known places: the faults of channels, and of the order and poses of arrays."""
    return verify_set_up(site, [clap.sound.observations for clap in claps], np.array([clap.place_m for clap in claps]))


def measured_poses(site: Site, claps: Sequence[Clap], place_std_m: float = PLACE_STD_M) -> MeasuredSetUp:
    """Measure the pose of each array that received enough of the claps, and the speed of sound.

    Raises
    ------
    RunError
        If no array received enough of them.
    """
    sounds, places_m = [clap.sound.observations for clap in claps], np.array([clap.place_m for clap in claps])
    try:
        return measure_set_up(site, sounds, places_m, place_std_m)
    except ValueError as error:
        raise RunError(
            f"expected {LEAST_PLACES} claps or more that an array received clearly, got {len(claps)} in all; clap at "
            "more places, eight are best, on all sides of the array and at different heights"
        ) from error


def refined(
    site: Site,
    sounds: Sequence[HeardSound],
    known: Collection[str],
    position_std_m: float,
    parts: Sequence[AssignedRecording] = (),
) -> MeasuredSetUp:
    """Measure the poses of all arrays but those that are known, and the speed of sound, from sounds at unknown places.

    The positions in the site file are right to `position_std_m` along each axis. With the recordings that the sounds
    are in, the times between arrays of one node are used as well.

    Raises
    ------
    RunError
        If there are too few sounds, or no array to refine.
    """
    microphones, delays = observed_delays(site, [sound.observations for sound in sounds])
    bounds_m = np.array(search_grid(site).bounds_m)
    try:
        measured = refine(microphones, delays, bounds_m, site.c_m_s, known, None, position_std_m)
        together = _on_one_clock(site, [part for part in parts if part.array in delays])
        if len(together) < 2:
            return measured
        arrivals = arrival_times(
            together,
            {**microphones, **{name: pose.microphones_m for name, pose in measured.poses.items()}},
            [sound.start_s for sound in sounds],
            measured.places_m,
            measured.c_m_s,
            site.band_hz,
        )
        return refine(microphones, delays, bounds_m, site.c_m_s, known, arrivals, position_std_m)
    except ValueError as error:
        raise RunError(
            f"refine: {error}; make {2 * LEAST_UNKNOWN} short sounds, such as claps, all over the room, near and far, "
            "high and low"
        ) from error


def _on_one_clock(site: Site, parts: Sequence[AssignedRecording]) -> list[AssignedRecording]:
    """Return the recordings of the node that has most arrays; arrays without a node may have clocks of their own."""
    by_node: dict[str, list[AssignedRecording]] = {}
    for part in parts:
        node = site.node_of(part.array)
        if node is not None:
            by_node.setdefault(node, []).append(part)
    return max(by_node.values(), key=len, default=[])
