"""Reloads a changed site file without a restart: zones, rules and actions, and where the microphones are.

Which keys need a restart is decided in `site/changes.py`.

A file that cannot be used changes nothing. What a running server cannot take over stays as it was, and is named.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Final, Protocol

from livessl.errors import ConfigError, RunError, UseError
from livessl.server.alerts.service import Alerts
from livessl.server.zones.book import ZoneBook
from livessl.site.changes import changed_keys, is_of_poses, is_taken_over, moved_arrays, names_of
from livessl.site.models import Site
from livessl.site.place import Place

JOIN_S: Final = 3.0
"""Longest wait, in seconds, for a reload that is under way when the server stops."""

_log = logging.getLogger(__name__)


class NoSiteFileError(RunError):
    """A server that was not started from a site file is asked to read one again."""


class Poses(Protocol):
    """Holds where the microphones are while a server runs: `SetUpInForce`."""

    @property
    def site(self) -> Site:
        """The site with the poses that are in force."""
        ...

    def unchanged(self) -> AbstractContextManager[None]:
        """Keep everybody else from changing the poses or the calibration file during a context."""
        ...

    def calibrated(self, site: Site) -> Site:
        """Return a site that was read before with its calibration file as it is now.

        Raises
        ------
        ConfigError
            With every fault of the file.
        """
        ...

    def take_over(self, site: Site) -> list[str]:
        """Take over microphones, poses and the speed of sound; return the names of the arrays that changed.

        Raises
        ------
        RunError
            If that needs a restart; then nothing has changed.
        """
        ...


@dataclass(frozen=True, slots=True)
class Reloaded:
    """Result of a reload.

    Parameters
    ----------
    changed : sequence of str
        Keys of the site file that took effect.
    needs_restart : sequence of str
        Keys that differ from what the server runs with, and take effect with the next start.
    warnings : sequence of str
        Settings that are valid but unlikely to work.
    """

    changed: Sequence[str]
    needs_restart: Sequence[str]
    warnings: Sequence[str]

    def __str__(self) -> str:
        parts = [
            f"{', '.join(self.changed)} took effect" if self.changed else "nothing else has changed",
            *([f"{', '.join(self.needs_restart)} needs a restart"] if self.needs_restart else []),
        ]
        return "; ".join(parts) if self.changed or self.needs_restart else "nothing has changed"


class Reloader:
    """Reads the site file again when it is asked to; every thread and a signal handler may ask.

    Parameters
    ----------
    site : Site
        The site that the server was started with.
    read : callable or None
        Reads and checks the site file, and raises `ConfigError` with all of its faults; None for a server without one.
    zone_book : ZoneBook
    alerts : Alerts
    note : callable or None
        Gets the site after each reload that has changed it, for the journal.
    poses : Poses or None
        None if poses need a restart.
    """

    def __init__(
        self,
        site: Site,
        read: Callable[[], Site] | None,
        zone_book: ZoneBook,
        alerts: Alerts,
        note: Callable[[Site], None] | None = None,
        poses: Poses | None = None,
    ) -> None:
        self._in_force = site
        self._read = read
        self._zone_book = zone_book
        self._alerts = alerts
        self._note = note
        self._poses = poses
        self._lock = threading.Lock()
        self._requests: queue.SimpleQueue[bool] = queue.SimpleQueue()  # its `put` may interrupt itself
        self._thread: threading.Thread | None = None
        self._announced: Callable[[], AbstractContextManager[None]] = nullcontext
        self.is_usable = True
        """False if the site file could not be taken over when it was last read."""
        self.needs_restart: Sequence[str] = ()
        """Keys that differ from what the server runs with, as of the last reload."""
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    def request(self) -> None:
        """Have the file read soon, and the result logged."""
        self._requests.put(True)

    def reload(self) -> Reloaded:
        """Read the file now; return what took effect and what needs a restart.

        Raises
        ------
        ConfigError
            With every fault of the file; then nothing has changed.
        RunError
            If there is no file, or what it says cannot be taken over now; then nothing has changed.
        """
        if self._read is None:
            raise NoSiteFileError("this server was not started from a site file; restart it to change its settings")
        with self._lock, self._announced():
            self.is_usable = False
            result = self._take_over(self._read())
            self.is_usable, self.needs_restart = True, result.needs_restart
            if result.changed and self._note is not None:
                self._note(self._in_force)
        _log.info("the site file was read again: %s", result)
        return result

    def start(self, announced: Callable[[], AbstractContextManager[None]] = nullcontext) -> None:
        """Begin to handle requests, those included that came before.

        Parameters
        ----------
        announced : callable
            Returns a context for the time of each reload, by which others learn of it.
        """
        self._announced = announced
        self._thread = threading.Thread(target=self._work, name="reload", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and wait for the thread."""
        self._requests.put(False)
        if self._thread is not None:
            self._thread.join(timeout=JOIN_S)

    def _take_over(self, site: Site) -> Reloaded:
        places = changed_keys(self._in_force, site)
        taken = self._take_over_rules_and_zones(site, [place for place in places if is_taken_over(place)])
        moved = self._take_over_poses(site, [place for place in places if is_of_poses(place)])
        pending = [place for place in places if not is_taken_over(place) and not is_of_poses(place)]
        return Reloaded([*taken, *moved.changed], [*names_of(pending), *moved.needs_restart], site.warnings)

    def _take_over_rules_and_zones(self, site: Site, places: Sequence[Place]) -> list[str]:
        alerts = site.alerts.model_copy(update={"outbox": self._in_force.alerts.outbox})
        in_force = self._in_force.model_copy(update={"zones": site.zones, "alerts": alerts})
        if alerts != self._in_force.alerts:
            self._alerts.take_over(alerts)  # the only step that may fail, so it comes first
        drawn_before = self._zone_book.current.drawn
        self._zone_book.take_over(in_force)
        self._in_force = in_force
        drawn = [] if self._zone_book.current.drawn == drawn_before else ["zones_file"]
        return [*names_of(list(places)), *drawn]

    def _take_over_poses(self, site: Site, places: Sequence[Place]) -> Reloaded:
        """Take over where the microphones are; what a file of the site says of an array counts as the array's key."""
        if self._poses is None:
            return Reloaded([], _keys_of_poses(self._in_force, site, places), [])
        with self._poses.unchanged():
            keys: list[str] = []
            try:
                # the site was read before its rules were taken over, which takes seconds: other poses may have been
                # accepted since
                site = self._poses.calibrated(site)
                keys = _keys_of_poses(self._poses.site, site, places)
                if not keys:
                    return Reloaded([], [], [])
                self._poses.take_over(site)
            except (ConfigError, RunError) as error:
                _log.warning("%s", error)
                return Reloaded([], keys or _keys_of_poses(self._poses.site, site, places), [])
        self._in_force = self._in_force.model_copy(update=_poses_of(site, self._in_force))
        return Reloaded(keys, [], [])

    def _work(self) -> None:
        try:
            while self._requests.get():
                try:
                    result = self.reload()
                except (UseError, RunError) as error:
                    _log.error("the site file was not taken over, and the former settings stay in force: %s", error)
                else:
                    for warning in result.warnings:
                        _log.warning("%s", warning)
        except BaseException as error:
            self.failure = error
            _log.exception("the thread that reloads has failed; the server ends")
            raise


def _keys_of_poses(before: Site, site: Site, places: Sequence[Place]) -> list[str]:
    """Return the changed keys of poses, and the arrays that files of the site have elsewhere."""
    named = {place[1] for place in places if place[0] == "arrays"}
    moved = moved_arrays(before, site)
    return [*names_of(list(places)), *(f"arrays.{name}" for name in moved if name not in named)]


def _poses_of(site: Site, before: Site) -> dict[str, Any]:
    """Return the keys of a site that poses are made of; other settings of its arrays stay as they were."""
    arrays = {
        name: array.model_copy(update={"band_hz": before.arrays[name].band_hz})
        for name, array in site.arrays.items()
        if name in before.arrays
    }
    whole = ("calibration", "speed_of_sound_m_s", "temperature_c", "uncertainty", "c_m_s", "specs", "processed")
    return {"arrays": arrays, **{name: getattr(site, name) for name in whole}}
