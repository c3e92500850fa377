"""Makes from measured or typed poses what a calibration stores, and the site with these poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from livessl.core.types import FloatArray
from livessl.errors import ConfigError, Fault
from livessl.site.build.arrays import recalibrated
from livessl.site.calibration_file import calibration_path
from livessl.site.checks import cross_faults
from livessl.site.findings import dotted
from livessl.site.models import CalibratedArray, CalibrationFile, Site
from livessl.site.place import Finding

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredSetUp

DIGITS = 4
"""Decimals of a stored position in metres: a tenth of a millimetre."""


def measured_arrays(site: Site, measured: MeasuredSetUp) -> dict[str, CalibratedArray]:
    """Return what is stored of measured arrays; of a joint array, each of its members."""
    return {
        member: CalibratedArray(
            microphones_m=microphones_m.round(DIGITS).tolist(),
            position_std_m=round(pose.position_std_m, 4),
            orientation_std_deg=round(pose.orientation_std_deg, 2),
            misfit_us=[round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
            covariance=[[float(f"{value:.3g}") for value in row] for row in pose.covariance.tolist()],
        )
        for name, pose in measured.poses.items()
        for member, microphones_m in _members(site, name, pose.microphones_m)
    }


def typed_arrays(site: Site, microphones: Mapping[str, FloatArray]) -> dict[str, CalibratedArray]:
    """Return what is stored of arrays whose microphones (K, 3) were set by hand, in metres.

    Nothing is known of their accuracy; the site's uncertainty holds.
    """
    return {
        member: CalibratedArray(microphones_m=microphones_m.round(DIGITS).tolist())
        for name, at_m in microphones.items()
        for member, microphones_m in _members(site, name, at_m)
    }


def with_calibration(site: Site, calibration: CalibrationFile) -> Site:
    """Return a site with the poses of a calibration; arrays that it does not hold are where the site file says.

    Raises
    ------
    ConfigError
        If the arrays do not fit: there is no array of that name, or a microphone is outside the room.
    """
    changed, faults = recalibrated(site, calibration)
    faults += array_faults(changed)
    if faults:
        path = calibration_path(site)
        raise ConfigError([Fault(f"{path}: {dotted(where)}", what) for where, what in faults])
    return changed


def array_faults(site: Site) -> list[Finding]:
    """Return the faults of a site's arrays beside its room and each other."""
    place = [("arrays", name) for name in site.arrays]
    return [finding for finding in cross_faults(site) if finding[0][:2] in place or finding[0][0] == "joint"]


def _members(site: Site, name: str, microphones_m: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield the microphones of an array; of a joint array, those of each of its members."""
    first = 0
    for member in site.members(name):
        count = len(site.array(member).microphones_m)
        yield member, microphones_m[first : first + count]
        first += count
