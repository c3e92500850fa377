"""Holds the zones in force, which operators draw, change and delete; words why a change is refused."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final

from livessl.errors import RunError
from livessl.server.zones.zone_map import ZoneMap, no_zone
from livessl.site.checks import zone_faults
from livessl.site.models import Site
from livessl.site.zone_models import Zone
from livessl.site.zones_file import MAX_DRAWN, read_zones, write_zones

SITE_FILE: Final = "site-file"
DRAWN: Final = "drawn"
"""Owners of a zone: the site file, or the server, by `zones_file`."""

_log = logging.getLogger(__name__)


class ZoneRefusedError(RunError):
    """A zone cannot be changed: the site file owns it, or a rule needs it."""


class ZonesFileError(RunError):
    """The file of the drawn zones cannot be written."""


class ZoneBook:
    """Holds the zones that are in force; every thread may call it.

    Parameters
    ----------
    site : Site
    publish : callable
        Gets the message that the zones have changed.
    """

    def __init__(self, site: Site, publish: Callable[[dict[str, Any]], None]) -> None:
        self._site = site
        self._publish = publish
        self._lock = threading.Lock()
        self.current = ZoneMap(site)
        """The zones now; replaced as a whole, so that readers need no lock."""

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the zones by name, as the API describes them."""
        return describe_zones(self.current)

    def put(self, name: str, zone: Zone) -> None:
        """Add a zone, or replace the drawn one of that name.

        Raises
        ------
        ValueError
            If its name cannot be used, or the zone lies outside the room.
        ZoneRefusedError
            If the site file owns it or names no file for drawn zones, if there are `MAX_DRAWN` drawn zones already, or
            if it is excluded and a rule uses it.
        ZonesFileError
            If it cannot be kept; then nothing has changed.
        """
        fault = next((what for _, what in zone_faults(self._site, name, zone)), None)
        if fault is not None:
            raise ValueError(fault)
        with self._lock:
            drawn = self._changeable(name)
            if name not in drawn and len(drawn) >= MAX_DRAWN:
                raise ZoneRefusedError(f"expected at most {MAX_DRAWN} drawn zones; delete one first")
            users = self._users(name)
            if zone.exclude and users:
                raise ZoneRefusedError(
                    f"zone {name!r}: rule {users[0]!r} alerts about it, and nothing alerts in an excluded zone; "
                    "take it out of the rule first"
                )
            self._set({**drawn, name: zone})

    def delete(self, name: str) -> None:
        """Delete a drawn zone.

        Raises
        ------
        LookupError
            If there is none of that name.
        ZoneRefusedError
            If the site file owns it, or a rule needs it.
        ZonesFileError
            If that cannot be kept; then nothing has changed.
        """
        with self._lock:
            if name not in self.current.zones:
                raise LookupError(no_zone(name, self.current.zones))
            drawn = self._changeable(name)
            users = self._users(name)
            if users:
                raise ZoneRefusedError(f"zone {name!r}: rule {users[0]!r} needs it; take it out of the rule first")
            self._set({other: zone for other, zone in drawn.items() if other != name})

    def take_over(self, site: Site) -> bool:
        """Take over the zones of a site file that was read anew, and of its `zones_file`; return whether any differ.

        Rooms and the name of `zones_file` must be those of before.

        Raises
        ------
        ConfigError
            If `zones_file` cannot be used; then nothing has changed.
        """
        with self._lock:  # the file of the drawn zones may have been written since the site was read
            name = self._site.zones_file
            drawn = {} if name is None else read_zones(self._site.file(name))
            self._site = site
            if self.current.drawn == drawn and self.current.zones == {**site.zones, **drawn}:
                return False
            self._show(ZoneMap(site, drawn))
            return True

    def _changeable(self, name: str) -> Mapping[str, Zone]:
        """Return the drawn zones, if the zone of that name may be changed."""
        if name in self._site.zones:
            raise ZoneRefusedError(f"zone {name!r} belongs to the site file; change it there, or use another name")
        if self._site.zones_file is None:
            raise ZoneRefusedError("the site file names no file for drawn zones; add zones_file: zones.yaml")
        return self.current.drawn

    def _users(self, name: str) -> list[str]:
        return [rule for rule, each in self._site.alerts.rules.items() if name in each.zones]

    def _set(self, drawn: Mapping[str, Zone]) -> None:
        assert self._site.zones_file is not None
        path = self._site.file(self._site.zones_file)
        try:
            write_zones(path, drawn)
        except OSError as error:
            raise ZonesFileError(
                f"zones_file: {path} cannot be written: {error.strerror}; free space on its disk, or make its folder "
                "writable"
            ) from error
        self._show(ZoneMap(self._site, drawn))

    def _show(self, zones: ZoneMap) -> None:
        """Put zones in force, and publish them."""
        self.current = zones
        _log.info("%d zones are in force, of which %d are drawn", len(zones.zones), len(zones.drawn))
        self._publish({"kind": "zones", "by_name": self.describe()})


def describe_zones(zones: ZoneMap) -> dict[str, dict[str, Any]]:
    """Return zones by name, as the API describes them."""
    return {
        name: {
            "bounds_m": [list(bounds) for bounds in zone.box_m(zones.height_m)],
            "polygon_m": None if zone.polygon_m is None else [list(point) for point in zone.polygon_m],
            "z_m": None if zone.heights_m is None else list(zone.heights_m),
            "exclude": zone.exclude,
            "loiter_s": zone.loiter_s,
            "owner": DRAWN if name in zones.drawn else SITE_FILE,
        }
        for name, zone in zones.zones.items()
    }
