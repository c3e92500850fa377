"""Holds the poses that are in force; brings others into force (accept, undo, reload) without a restart."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.clock import Clock
from livessl.core.types import ArraySpec
from livessl.errors import ConfigError, RunError
from livessl.site.build.calibrated import array_faults, with_calibration
from livessl.site.calibration_file import (
    calibration_path,
    can_undo,
    contents,
    extended,
    kept_path,
    put_back,
    read_calibration,
    undo_calibration,
    write_calibration,
)
from livessl.site.findings import dotted
from livessl.site.models import CalibratedArray, CalibrationFile, Site

_log = logging.getLogger(__name__)

Commit = Callable[[], None]
"""Brings into force what was prepared; it cannot fail."""

Follower = Callable[[Site], Commit]
"""Prepares to take over the poses of a site, which may fail and changes nothing; called on any thread."""

_KEYS: Final = ("arrays", "uncertainty", "calibration", "temperature_c", "speed_of_sound_m_s", "c_m_s")
_TAKEN: Final = (*_KEYS, "specs", "processed")
"""Fields that are taken over from a site that was loaded anew: keys of its file, the speed of sound, and the arrays."""


class SetUpChangedError(RunError):
    """A set-up that differs in more than poses: the server has to start again for it."""


class OutOfDateError(RunError):
    """Poses that were proposed for others than those in force."""


class CalibrationFileError(RunError):
    """The calibration file cannot be written."""


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A site that can come into force, the arrays that it changes, and what brings it into force."""

    site: Site
    changed: list[str]
    commits: tuple[Commit, ...]


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
        """Have this prepare for every site whose poses come into force; one that fails prevents that for all."""
        self._followers.append(follower)

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Keep everybody else from changing the poses or the calibration file during a context."""
        with self._lock:
            yield

    def take_over(self, site: Site) -> list[str]:
        """Take over the poses, their uncertainty and the speed of sound of a site that was loaded anew.

        Answers in flight are finished with the poses before; what begins later is located with the new ones. Everything
        else of the site is left out. It can take seconds, because the tables of the estimator are computed.

        Returns
        -------
        list of str
            Names of the arrays whose pose, or the uncertainty of it, has changed.

        Raises
        ------
        SetUpChangedError
            If arrays have other names, numbers of microphones, bands or members, or do not fit the room that the server
            runs with: then it has to start again.
        """
        with self._lock:
            return self._bring_into_force(self._prepared(site))

    def _prepared(self, site: Site) -> _Prepared:
        fault = _difference(self.site, site)
        if fault is not None:
            raise SetUpChangedError(f"{fault}; start the server again to change that")
        changed = self._changed(site)
        if all(getattr(site, key) == getattr(self.site, key) for key in _KEYS) and not changed:
            return _Prepared(self.site, [], ())
        now = self.site.model_copy(update={key: getattr(site, key) for key in _TAKEN})
        if not changed and site.c_m_s == self.site.c_m_s:
            return _Prepared(now, [], ())
        faults = array_faults(now)
        if faults:
            reasons = "; ".join(f"{dotted(where)}: {what}" for where, what in faults)
            raise SetUpChangedError(f"{reasons}; if the room has changed as well, start the server again")
        return _Prepared(now, changed, tuple(follower(now) for follower in self._followers))

    def _bring_into_force(self, prepared: _Prepared) -> list[str]:
        for commit in prepared.commits:
            commit()
        self.site = prepared.site
        if prepared.commits:
            _log.info("new poses are in force: %s", ", ".join(prepared.changed) or "a new speed of sound")
            self._publish({"kind": "poses", "arrays": self.describe_arrays(), "changed": prepared.changed})
        return prepared.changed

    def _changed(self, site: Site) -> list[str]:
        """Return the names of the arrays whose pose, or the uncertainty of it, is another in this site."""
        before = {spec.name: spec for spec in self.site.processed}
        return [spec.name for spec in site.processed if _differs(before[spec.name], spec)]

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

    def calibrated(self, site: Site) -> Site:
        """Return a site that was read before with its calibration file as it is now.

        Raises
        ------
        ConfigError
            With every fault of the file.
        """
        return with_calibration(site, read_calibration(calibration_path(site)))

    def accept(
        self,
        arrays: Mapping[str, CalibratedArray],
        method: str,
        sounds: int = 0,
        c_m_s: float = 0.0,
        proposed_for: Site | None = None,
    ) -> list[str]:
        """Write arrays into the calibration file and take it over; return the names of the arrays that changed.

        Nothing is written where neither the poses in force nor those of the file would change.

        Parameters
        ----------
        arrays : mapping of array to CalibratedArray
        method : str
            How they were measured.
        sounds : int
            Number of sounds that they rest on.
        c_m_s : float
            Measured speed of sound, m/s; 0 if it was not.
        proposed_for : Site or None
            The site that was in force when the arrays were measured; None for any.

        Raises
        ------
        OutOfDateError
            If other poses have come into force since; then nothing has changed.
        ConfigError
            If the arrays do not fit the site, or the file before cannot be read; then nothing has changed.
        CalibrationFileError
            If the file cannot be written; then nothing has changed.
        """
        with self._lock:
            if proposed_for is not None and proposed_for is not self.site:
                raise OutOfDateError("other poses have come into force since this was proposed; measure again")
            path = calibration_path(self.site)
            before = read_calibration(path)
            calibration = extended(before, arrays, method, self._clock.now_ns(), sounds, c_m_s)
            prepared = self._prepared(with_calibration(self.site, calibration))
            if not prepared.changed and self._is_in_force(before):
                return []
            return self._replaced(path, lambda: write_calibration(path, calibration), prepared)

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
            prepared = self._prepared(with_calibration(self.site, read_calibration(kept_path(path))))
            return self._replaced(path, lambda: undo_calibration(path), prepared)

    def _replaced(self, path: Path, replace: Callable[[], None], prepared: _Prepared) -> list[str]:
        """Replace the file, then bring into force what was prepared; if that fails, the file is as it was."""
        try:
            before = contents(path)
            replace()
        except OSError as error:
            raise _unwritable(path, error) from error
        try:
            return self._bring_into_force(prepared)
        except BaseException:
            if self.site is not prepared.site:
                put_back(before)
            raise

    def _is_in_force(self, calibration: CalibrationFile) -> bool:
        """Return whether a calibration of this site has the arrays where they are."""
        try:
            return not self._changed(with_calibration(self.site, calibration))
        except ConfigError:
            return False

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
