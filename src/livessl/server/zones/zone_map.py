"""Decides from which probability on an event names a zone, and when it lies in an excluded zone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from livessl.server.zones.membership import PreparedZones, Prism
from livessl.site.build.grid import search_grid
from livessl.site.models import Site
from livessl.site.zone_models import Zone

NAMED: Final = 0.05
"""Least probability of a zone that events name; it is above the error of the published covariance's digits."""

EXCLUDED: Final = 0.5
"""Probability of an excluded zone from which on what lies there is excluded."""


def no_zone(name: str, zones: Iterable[str]) -> str:
    """Return the sentence that a site has no zone of this name, with the names of its `zones`."""
    known = ", ".join(zones)
    return f"no zone {name!r}; zones are {known}" if known else f"no zone {name!r}; this site has no zones"


class ZoneMap:
    """Zones by name, with the volume that is searched. It never changes.

    Parameters
    ----------
    site : Site
    drawn : mapping of str to Zone or None
        Zones that operators have drawn; None for those that the site was loaded with.
    """

    def __init__(self, site: Site, drawn: Mapping[str, Zone] | None = None) -> None:
        self.drawn: Mapping[str, Zone] = dict(site.drawn_zones if drawn is None else drawn)
        """The zones that operators have drawn."""
        self.zones: Mapping[str, Zone] = {**site.zones, **self.drawn}
        """All zones."""
        self.height_m = site.room.size_m[2]
        """Height of the room, up to which zones reach that give none."""
        volume_m = np.array(search_grid(site).bounds_m, dtype=np.float64)
        self._prepared = PreparedZones([_prism(zone) for zone in self.zones.values()], volume_m)
        self._last: tuple[bytes, dict[str, float]] = (b"", {})  # each rule asks about the same event

    def holding(self, position_m: Sequence[float] | None) -> list[str]:
        """Return the names of the zones in which a position lies."""
        return [] if position_m is None else [name for name, zone in self.zones.items() if zone.contains(position_m)]

    def probabilities(self, position_m: Any, covariance_m2: Any) -> dict[str, float]:
        """Return the probability of each zone that a source is in it.

        Parameters
        ----------
        position_m : (3,) array_like
            In metres.
        covariance_m2 : (3, 3) array_like
            Its covariance, in square metres.
        """
        mean_m, spread_m2 = np.array(position_m, dtype=np.float64), np.array(covariance_m2, dtype=np.float64)
        asked, (known, found) = mean_m.tobytes() + spread_m2.tobytes(), self._last
        if asked != known:
            found = dict(zip(self.zones, self._prepared.probabilities(mean_m, spread_m2).tolist(), strict=True))
            self._last = asked, found  # as a whole: every thread may ask
        return found

    def memberships(self, position_m: Any, covariance_m2: Any) -> dict[str, float]:
        """Return the zones in which a source may be, each with its probability of at least `NAMED`."""
        found = self.probabilities(position_m, covariance_m2)
        return {name: probability for name, probability in found.items() if probability >= NAMED}

    def excluding(self, holding: Sequence[str], memberships: Mapping[str, float]) -> list[str]:
        """Return the excluded zones in which something lies, or is with a probability of at least `EXCLUDED`."""
        return [
            name
            for name, zone in self.zones.items()
            if zone.exclude and (name in holding or memberships.get(name, 0.0) >= EXCLUDED)
        ]


def fixed_zones(site: Site) -> Callable[[], ZoneMap]:
    """Return what always returns the zones that a site was loaded with."""
    zones = ZoneMap(site)
    return lambda: zones


def _prism(zone: Zone) -> Prism:
    low, high = zone.heights_m or (-np.inf, np.inf)
    return Prism(np.array(zone.outline_m, dtype=np.float64), low, high)
