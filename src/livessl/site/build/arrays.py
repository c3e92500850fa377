"""Decides where the microphones are (pose, geometry file, calibration, joint arrays), and the speed of sound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from livessl.core.geometry import as_positions_m, circle, line, posed, speed_of_sound_m_s, tetrahedron
from livessl.core.joint_array import joined
from livessl.core.types import ArraySpec, FloatArray, Uncertainty
from livessl.errors import ConfigError, Fault
from livessl.site.calibration_file import read_calibration
from livessl.site.findings import read_model, unknown_array
from livessl.site.models import (
    ArrayConfig,
    CalibratedArray,
    CalibrationFile,
    GeometryFile,
    Orientation,
    Shape,
    Site,
    SiteFile,
    UncertaintyConfig,
)
from livessl.site.place import Finding, Place

DEFAULT_SPEED_OF_SOUND_M_S: Final = 343.0
"""Speed of sound in m/s where the site file gives neither speed nor temperature: that of air at 20 degrees Celsius."""


def build_site(file: SiteFile, directory: Path) -> tuple[Site, list[Finding]]:
    """Return a site with its arrays, and the faults of the arrays that could not be built and are left out.

    Parameters
    ----------
    file : SiteFile
    directory : Path
        Folder that the names of geometry files are relative to.
    """
    measured, strangers = _measured(file, directory)
    specs, faults = _array_specs(file, directory, measured)
    processed, joint_faults = _processed_specs(file, specs)
    site = Site.model_construct(
        **dict(iter(file)),
        directory=directory,
        c_m_s=_speed_of_sound_m_s(file),
        specs=specs,
        processed=processed,
        drawn_zones={},
    )
    return site, [*strangers, *faults, *joint_faults]


def recalibrated(site: Site, calibration: CalibrationFile) -> tuple[Site, list[Finding]]:
    """Return a site with the arrays as a calibration has them, and the faults of those that cannot be built."""
    specs, faults = _array_specs(site, site.directory, calibration.arrays)
    processed, joint_faults = _processed_specs(site, specs)
    changed = site.model_copy(update={"specs": specs, "processed": processed})
    return changed, [*_strangers(calibration, site), *faults, *joint_faults]


def _speed_of_sound_m_s(file: SiteFile) -> float:
    if file.speed_of_sound_m_s is not None:
        return file.speed_of_sound_m_s
    if file.temperature_c is not None:
        return speed_of_sound_m_s(file.temperature_c)
    return DEFAULT_SPEED_OF_SOUND_M_S


def _array_specs(
    file: SiteFile, directory: Path, measured: Mapping[str, CalibratedArray]
) -> tuple[tuple[ArraySpec, ...], list[Finding]]:
    specs: list[ArraySpec] = []
    faults: list[Finding] = []
    for name, array in file.arrays.items():
        try:
            positions = _microphones_m(array, directory)
            if name in measured:
                positions = _replaced(name, positions, as_positions_m(measured[name].microphones_m))
        except ConfigError as error:
            faults.append((("arrays", name, "geometry"), "; ".join(str(fault) for fault in error.faults)))
            continue
        if array.band_hz is not None and array.band_hz[0] >= array.band_hz[1]:
            what = f"expected [low, high] with low < high, got {list(array.band_hz)}"
            faults.append((("arrays", name, "band_hz"), what))
            continue
        if file.band_hz[0] < file.band_hz[1]:
            calibrated = _calibrated(measured.get(name))
            known = Uncertainty(**(file.uncertainty.model_dump() | calibrated | _given(array.uncertainty)))
            specs.append(ArraySpec(name, positions, array.band_hz or file.band_hz, known))
    return tuple(specs), faults


def _calibrated(measured: CalibratedArray | None) -> dict[str, float]:
    """Return what the calibration says of its own accuracy; older files may say nothing."""
    if measured is None:
        return {}
    stds = {"position_m": measured.position_std_m, "orientation_deg": measured.orientation_std_deg}
    return {key: value for key, value in stds.items() if value > 0.0}


def _given(uncertainty: UncertaintyConfig | None) -> dict[str, float]:
    """Return what an array's own entry says; the rest is the site's."""
    return {} if uncertainty is None else uncertainty.model_dump(exclude_unset=True)


def _processed_specs(file: SiteFile, specs: tuple[ArraySpec, ...]) -> tuple[tuple[ArraySpec, ...], list[Finding]]:
    """Return the arrays as they are processed; the members of a faulty joint array stay separate."""
    by_name = {spec.name: spec for spec in specs}
    faults = [*_joint_faults(file)]
    faulty = {path[1] for path, _ in faults}
    joint: list[ArraySpec] = []
    for name, members in file.joint.items():
        if name in faulty or not set(members) <= set(by_name):
            continue
        nodes = {member: file.node_of(member) for member in members}
        clocks = {member: f"node {node!r}" if node else "no node" for member, node in nodes.items()}
        try:
            joint.append(joined([by_name[member] for member in members], clocks, name))
        except ValueError as error:
            faults.append((("joint", name), str(error).removeprefix(f"array {name!r}: ")))
    taken = {member for spec in joint for member in file.joint[spec.name]}
    return (*(spec for spec in specs if spec.name not in taken), *joint), faults


def _joint_faults(file: SiteFile) -> Iterator[Finding]:
    """Yield faults of joint arrays that show before their microphones are known."""
    used: dict[str, str] = {}
    for name, members in file.joint.items():
        if name in file.arrays:
            yield ("joint", name), "expected a name that no array has; rename it"
        for member in members:
            here: Place = ("joint", name, member)
            if member not in file.arrays:
                yield here, unknown_array(member, file.arrays)
            elif member in used:
                yield here, f"already joined in {used[member]!r}; remove it from one of them"
            used[member] = name
        offsets_s = {file.arrays[member].wav_offset_s for member in members if member in file.arrays}
        if len(offsets_s) > 1:
            each = ", ".join(f"{offset_s:g}" for offset_s in sorted(offsets_s))
            yield (
                ("joint", name),
                f"expected arrays of one wav_offset_s, since they are recorded together, got {each}; correct one",
            )


def _microphones_m(array: ArrayConfig, directory: Path) -> FloatArray:
    """Return absolute positions (K, 3) in metres."""
    if array.microphones_m is not None:
        return as_positions_m(array.microphones_m)
    if isinstance(array.geometry, str):
        shape_m = as_positions_m(_geometry_file(directory / array.geometry).microphones_m)
    else:
        assert array.geometry is not None
        shape_m = _shape_m(array.geometry)
    turn = array.orientation_deg or Orientation()
    assert array.position_m is not None
    return posed(shape_m, array.position_m, turn.yaw, turn.pitch, turn.roll)


def _measured(file: SiteFile, directory: Path) -> tuple[dict[str, CalibratedArray], list[Finding]]:
    """Return the arrays that the calibration file holds: none if it is still to be written."""
    if file.calibration is None:
        return {}, []
    try:
        calibrated = read_calibration(directory / file.calibration)
    except ConfigError as error:
        return {}, [(("calibration",), str(fault)) for fault in error.faults]
    return dict(calibrated.arrays), _strangers(calibrated, file)


def _strangers(calibrated: CalibrationFile, file: SiteFile) -> list[Finding]:
    """Return a fault for each array of a calibration that the site does not have."""
    unknown = sorted(calibrated.arrays.keys() - file.arrays)
    return [(("calibration",), unknown_array(name, file.arrays)) for name in unknown]


def _replaced(name: str, filed_m: FloatArray, measured_m: FloatArray) -> FloatArray:
    """Return the measured positions after checking that there are as many."""
    if len(filed_m) != len(measured_m):
        what = f"expected {len(filed_m)} microphones in the calibration file, got {len(measured_m)}; calibrate again"
        raise ConfigError([Fault(f"arrays.{name}", what)])
    return measured_m


def _shape_m(shape: Shape) -> FloatArray:
    """Return positions (K, 3) around the shape's own origin, metres."""
    if shape.tetrahedron is not None:
        return tetrahedron(shape.tetrahedron.edge_m)
    if shape.circle is not None:
        return circle(shape.circle.radius_m, shape.circle.count, shape.circle.clockwise)
    assert shape.line is not None
    return line(shape.line.spacing_m, shape.line.count)


def _geometry_file(path: Path) -> GeometryFile:
    return read_model(GeometryFile, path, "geometry file")
