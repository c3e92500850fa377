"""Words why proposed poses cannot come into force, and decides when poses are good enough. It keeps nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from livessl.core.types import FloatArray
from livessl.errors import ConfigError
from livessl.site.build.calibrated import with_calibration
from livessl.site.models import CalibratedArray, CalibrationFile, Site

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredSetUp

AGREES_M: Final = 0.3
"""Distance, in metres, between a clap and its place up to which the two agree with the measured poses."""


@dataclass(frozen=True, slots=True)
class ClapFit:
    """Distances by which a sound at a measured place misses it, with the poses before and after.

    Parameters
    ----------
    number : int
        Number of the sound.
    place_m : (3,) float64
        Where it was made, metres.
    before_m, after_m : float or None
        Distance from there to where its delays place it, metres; None if two arrays did not receive it.
    """

    number: int
    place_m: FloatArray
    before_m: float | None
    after_m: float | None

    @property
    def agrees(self) -> bool | None:
        """True if it agrees with the proposed poses; None where that cannot be said."""
        return None if self.after_m is None else self.after_m <= AGREES_M


def refusal_of(site: Site, measured: MeasuredSetUp, stored: Mapping[str, CalibratedArray]) -> str | None:
    """Return in words why measured poses cannot come into force; None if they can."""
    return _undetermined(measured) or misfit_with_site(site, stored)


def contradiction(claps: Sequence[ClapFit]) -> str | None:
    """Return in words which claps contradict too many others; None if enough agree."""
    if sum(clap.agrees is not False for clap in claps) >= _least_agreeing(len(claps)):
        return None
    off = ", ".join(str(index) for index, clap in enumerate(claps, 1) if clap.agrees is False)
    return f"claps {off} contradict the others by more than {AGREES_M:g} m; measure their places again"


def misfit_with_site(site: Site, stored: Mapping[str, CalibratedArray]) -> str | None:
    """Return in words why a site with these arrays could not be loaded; None if it could."""
    try:
        with_calibration(site, CalibrationFile(arrays=dict(stored)))
    except ConfigError as error:
        return "; ".join(fault.what for fault in error.faults)
    return None


def is_enough(site: Site, measured: MeasuredSetUp) -> bool:
    """Return whether the poses of all arrays are known as well as is useful."""
    from livessl.core.commission.next_place import AIM_DEG, AIM_M

    return len(measured.poses) == len(site.processed) and all(
        pose.position_std_m <= AIM_M and pose.orientation_std_deg <= AIM_DEG for pose in measured.poses.values()
    )


def _undetermined(measured: MeasuredSetUp) -> str | None:
    """Return in words which poses are not determined; None if all are."""
    from livessl.core.commission.resection import MOST_STD_DEG, MOST_STD_M

    doubtful = [
        f"{name!r} is known to {pose.position_std_m:.2f} m and {pose.orientation_std_deg:.1f} degrees"
        for name, pose in measured.poses.items()
        if not pose.is_determined
    ]
    return (
        f"{', '.join(doubtful)}; at most {MOST_STD_M:g} m and {MOST_STD_DEG:g} degrees are accepted"
        if doubtful
        else None
    )


def _least_agreeing(count: int) -> int:
    """Return how many of some claps have to agree: all but one in four, and four at least."""
    return max(4, count - count // 4)
