"""Guided calibration with a running server: asks for a clap at each place, and says which claps were unclear."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.calibration import Clap, HeardSound, measured_poses
from livessl.cli.calibration_words import progress_line
from livessl.core.commission.next_place import AIM_DEG, AIM_M
from livessl.core.commission.observe import LEAST_SHARPNESS
from livessl.core.commission.resection import LEAST_PLACES, MeasuredSetUp
from livessl.core.types import Observation
from livessl.errors import RunError
from livessl.site.build.set_up import next_clap_place

if TYPE_CHECKING:
    from livessl.cli.server_sounds import ServerSounds
    from livessl.site.models import Site

LEAST_GUIDED: Final = 6
"""Fewest claps after which the poses may be good enough: with four or five, one bad clap is not noticed."""

MOST_GUIDED: Final = 12
"""Largest number of proposed places, if the user gives none."""


def ask_for(text: str) -> None:
    """Print what the user is asked to do: to stderr, so that stdout has results only."""
    print(text, file=sys.stderr, flush=True)


def is_clear(sound: HeardSound) -> bool:
    """Return whether an array received a sound clearly."""
    return any(one.sharpness >= LEAST_SHARPNESS for one in sound.observations)


def is_shared(sound: HeardSound) -> bool:
    """Return whether two arrays or more received a sound clearly, each with two channels or more."""

    def is_clear(one: Observation) -> bool:
        return one.sharpness >= LEAST_SHARPNESS and np.isfinite(one.delays_s).sum() > 1

    return sum(map(is_clear, sound.observations)) > 1


def accepts_shared(sound: HeardSound) -> bool:
    """Return whether a sound is shared, and show the user a message if it is not."""
    if not is_shared(sound):
        ask_for("  a sound that no two arrays received clearly; clap louder, or between them")
    return is_shared(sound)


def clap_at(sounds: ServerSounds, place_m: Sequence[float], what: str) -> Clap:
    """Ask for a clap at a place, and wait for it."""
    where = ", ".join(f"{x:.1f}" if round(x, 1) == round(x, 3) else f"{x:.2f}" for x in place_m)

    def accepts(sound: HeardSound) -> bool:
        if not is_clear(sound):
            ask_for("  a sound that no array received clearly; clap louder")
        return is_clear(sound)

    sound = sounds.next_sound(lambda: ask_for(f"clap at {where} ({what})"), f"a clap at {where}", accepts)
    return Clap(np.array(place_m, dtype=np.float64), sound)


def claps_at(sounds: ServerSounds, places_m: Sequence[Sequence[float]], show: Callable[[Clap], None]) -> list[Clap]:
    """Ask for a clap at each of some places; `show` gets each as it comes in."""
    claps = []
    for number, place_m in enumerate(places_m, 1):
        claps.append(clap_at(sounds, place_m, f"{number} of {len(places_m)}"))
        show(claps[-1])
    return claps


def claps_for_poses(
    sounds: ServerSounds,
    site: Site,
    places_m: Sequence[Sequence[float]],
    place_std_m: float,
    show: Callable[[Clap], None],
) -> list[Clap]:
    """Ask for claps until the poses are good enough: at the given places, or at proposed ones if there are none."""
    claps: list[Clap] = []
    for place_m, what in _places(site, places_m, place_std_m, claps):
        claps.append(clap_at(sounds, place_m, what))
        show(claps[-1])
        if len(claps) < LEAST_PLACES:
            continue
        try:
            measured = measured_poses(site, claps, place_std_m)
        except RunError:
            ask_for(f"  no array has received {LEAST_PLACES} of the claps clearly yet")
            continue
        ask_for(f"  {progress_line(measured)}")
        if len(claps) >= LEAST_GUIDED and is_good(site, measured):
            ask_for("good enough")
            break
    return claps


def is_good(site: Site, measured: MeasuredSetUp) -> bool:
    """Return whether the poses of all arrays are known to `AIM_M` and `AIM_DEG`."""
    return len(measured.poses) == len(site.processed) and all(
        pose.position_std_m <= AIM_M and pose.orientation_std_deg <= AIM_DEG for pose in measured.poses.values()
    )


def _places(
    site: Site, places_m: Sequence[Sequence[float]], place_std_m: float, claps: Sequence[Clap]
) -> Iterator[tuple[Sequence[float], str]]:
    for number, place_m in enumerate(places_m, 1):
        yield place_m, f"{number} of {len(places_m)}"
    while not places_m and len(claps) < MOST_GUIDED:
        so_far_m = np.array([clap.place_m for clap in claps]).reshape(-1, 3)
        proposed_m = next_clap_place(site, so_far_m, place_std_m)
        if proposed_m is None:
            return
        yield proposed_m.tolist(), f"{len(claps) + 1}, proposed; to another place, give --at X,Y,Z for each"
