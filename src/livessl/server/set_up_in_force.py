"""The set-up that is in force in a running server: poses change by a calibration, and no restart is needed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.clock import Clock
from livessl.core.types import ArraySpec
from livessl.errors import ConfigError, RunError
from livessl.site.build.calibrated import with_calibration
from livessl.site.calibration_file import (
    calibration_path,
    can_undo,
    extended,
    kept_path,
    read_calibration,
    undo_calibration,
    write_calibration,
)
from livessl.site.models import CalibratedArray, CalibrationFile, Site

_log = logging.getLogger(__name__)

Follower = Callable[[Site], None]
"""Takes over the poses of a site; called on any thread."""

_TAKEN: Final = (
    *("arrays", "uncertainty", "calibration", "temperature_c", "speed_of_sound_m_s"),
    *("c_m_s", "specs", "processed"),
)
"""What is taken over of a site that was loaded anew."""


class SetUpChangedError(RunError):
    """A set-up that differs in more than poses: the server has to start again for it."""


class CalibrationFileError(RunError):
    """The calibration file cannot be written."""


class SetUpInForce:
    """Holds the site with the poses that are in force; every thread may call it.

    Parameters
    ----------
    site : Site
    clock : Clock
    publish : callable
        Gets the message that poses have changed.
    """

    def __init__(self, site: Site, clock: Clock, publish: Callable[[dict[str, Any]], None]) -> None:
        self.site = site
        """The site with the poses in force. It is replaced as a whole: read it once for values that belong together."""
        self._clock = clock
        self._publish = publish
        self._followers: list[Follower] = []
        self._lock = threading.RLock()

    def follow(self, follower: Follower) -> None:
        """Have this called with every site whose poses come into force; the first follower that fails prevents that."""
        self._followers.append(follower)

    def take_over(self, site: Site) -> list[str]:
        """Take over the poses, their uncertainty and the speed of sound of a site that was loaded anew.

        Answers in flight are finished with the poses before; what begins later is located with the new ones. Everything
        else of the site is left out. It can take seconds, because the tables of the estimator are computed.

        Returns
        -------
        list of str
            Names of the arrays that are elsewhere, or are known to be so differently well.

        Raises
        ------
        SetUpChangedError
            If arrays have other names, numbers of microphones, bands or members: then the server has to start again.
        """
        with self._lock:
            fault = _difference(self.site, site)
            if fault is not None:
                raise SetUpChangedError(f"{fault}; start the server again to change that")
            before = {spec.name: spec for spec in self.site.processed}
            changed = [spec.name for spec in site.processed if _differs(before[spec.name], spec)]
            if not changed and site.c_m_s == self.site.c_m_s:
                return []
            now = self.site.model_copy(update={key: getattr(site, key) for key in _TAKEN})
            for follower in self._followers:
                follower(now)
            self.site = now
            _log.info("new poses are in force: %s", ", ".join(changed) or "a new speed of sound")
            self._publish({"kind": "poses", "arrays": self.describe_arrays(), "changed": changed})
            return changed

    # --- the calibration file

    def reload(self) -> list[str]:
        """Read the calibration file again and take it over; return the names of the arrays that changed.

        Raises
        ------
        ConfigError
            With every fault of the file; then nothing has changed.
        SetUpChangedError
            See `take_over`.
        """
        with self._lock:
            return self.take_over(with_calibration(self.site, read_calibration(calibration_path(self.site))))

    def accept(
        self, arrays: Mapping[str, CalibratedArray], method: str, sounds: int = 0, c_m_s: float = 0.0
    ) -> list[str]:
        """Write arrays into the calibration file and take it over; return the names of the arrays that changed.

        Parameters
        ----------
        arrays : mapping of array to CalibratedArray
        method : str
            How they were measured.
        sounds : int
            Number of sounds that they rest on.
        c_m_s : float
            Measured speed of sound, m/s; 0 if it was not.

        Raises
        ------
        ConfigError
            If the arrays do not fit the site, or the file before cannot be read; then nothing has changed.
        CalibrationFileError
            If the file cannot be written; then nothing has changed.
        """
        with self._lock:
            path = calibration_path(self.site)
            calibration = extended(read_calibration(path), arrays, method, self._clock.now_ns(), sounds, c_m_s)
            site = with_calibration(self.site, calibration)
            try:
                write_calibration(path, calibration)
            except OSError as error:
                raise _unwritable(path, error) from error
            return self.take_over(site)

    def undo(self) -> list[str]:
        """Put back the calibration file before the last change and take it over; return the arrays that changed.

        Raises
        ------
        LookupError
            If there is none.
        ConfigError
            If that file does not fit the site any more; then nothing has changed.
        CalibrationFileError
            If the file cannot be replaced; then nothing has changed.
        """
        with self._lock:
            path = calibration_path(self.site)
            if not can_undo(path):
                raise LookupError("there is no calibration before this one to go back to")
            site = with_calibration(self.site, read_calibration(kept_path(path)))
            try:
                undo_calibration(path)
            except OSError as error:
                raise _unwritable(path, error) from error
            return self.take_over(site)

    # --- for the API

    def describe(self) -> dict[str, Any]:
        """Return the calibration in force, as the API describes it."""
        path = calibration_path(self.site)
        problem = None
        try:
            calibration = read_calibration(path)
        except ConfigError as error:
            calibration, problem = CalibrationFile(arrays={}), str(error)
        return {
            "file": self.site.calibration or path.relative_to(self.site.directory).as_posix(),
            "arrays": sorted(calibration.arrays),
            "method": calibration.method or None,
            "measured_utc": calibration.measured_utc or None,
            "sounds": calibration.sounds,
            "can_undo": can_undo(path),
            "problem": problem,
        }

    def describe_arrays(self) -> dict[str, Any]:
        """Return the arrays by name, as the API describes them."""
        return {
            spec.name: {
                "position_m": spec.centre_m.round(4).tolist(),
                "microphones_m": spec.microphones_m.round(4).tolist(),
                "band_hz": list(spec.band_hz),
            }
            for spec in self.site.processed
        }


def _unwritable(path: Path, error: OSError) -> CalibrationFileError:
    return CalibrationFileError(
        f"{path} cannot be written: {error.strerror}; free space on its disk, or let the server's user write into its "
        "folder"
    )


def _differs(one: ArraySpec, other: ArraySpec) -> bool:
    return not np.array_equal(one.microphones_m, other.microphones_m) or one.uncertainty != other.uncertainty


def _difference(before: Site, after: Site) -> str | None:
    """Return in words how the arrays of two sites differ in more than their poses; None if they do not."""
    known, found = ({spec.name: spec for spec in site.processed} for site in (before, after))
    if list(known) != list(found):
        return f"expected the arrays {', '.join(known)} in this order, got {', '.join(found)}"
    for name, spec in known.items():
        counts = len(spec.microphones_m), len(found[name].microphones_m)
        if counts[0] != counts[1]:
            return f"array {name!r}: expected {counts[0]} microphones, got {counts[1]}"
        if spec.band_hz != found[name].band_hz or spec.parts != found[name].parts:
            return f"array {name!r}: its band or its members have changed"
        if before.node_of(name) != after.node_of(name):
            return f"array {name!r}: expected node {before.node_of(name)}, got {after.node_of(name)}"
    return None
