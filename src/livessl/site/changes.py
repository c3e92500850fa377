"""Decides which changed keys of the site file a running server takes over, and which need a restart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from livessl.core.types import ArraySpec
from livessl.site.findings import dotted
from livessl.site.models import Site
from livessl.site.place import Place

NEEDS_RESTART: Final[frozenset[Place]] = frozenset({("alerts", "outbox")})
"""Keys in `RULES_AND_ZONES` that nevertheless need a restart."""

RULES_AND_ZONES: Final = ("zones", "alerts")
"""Sections that a running server takes over."""

_POSES: Final = frozenset(("microphones_m", "geometry", "position_m", "orientation_deg", "uncertainty"))
_WHOLE_SITE: Final = frozenset(("calibration", "speed_of_sound_m_s", "temperature_c", "uncertainty"))


def changed_keys(before: Site, after: Site) -> list[Place]:
    """Return the keys of the site file whose values differ, in the order of the reference.

    An entry that only one of them has, such as a zone, is one key; a changed one gives the key of each value. Keys that
    no running server looks at are left out.
    """
    found = _differences(before.model_dump(mode="json"), after.model_dump(mode="json"), ())
    return [place for place in found if place[-1] != "wav_offset_s"]


def is_taken_over(place: Place) -> bool:
    """Return whether a running server takes over a change of this key: of zones, or of rules and actions."""
    return place[0] in RULES_AND_ZONES and place[:2] not in NEEDS_RESTART


def is_of_poses(place: Place) -> bool:
    """Return whether a key is about where microphones are, how well that is known, or the speed of sound."""
    if place[0] == "arrays":
        return len(place) > 2 and place[2] in _POSES
    return place[0] in _WHOLE_SITE


def moved_arrays(before: Site, after: Site) -> list[str]:
    """Return the arrays whose places differ, also because of a file that the site file names."""
    known = {spec.name: spec for spec in before.processed}
    return [spec.name for spec in after.processed if spec.name in known and not _is_same_place(known[spec.name], spec)]


def names_of(places: list[Place]) -> list[str]:
    """Return keys as text, such as `zones.door.bounds_m`."""
    return [dotted(place) for place in places]


def _is_same_place(one: ArraySpec, other: ArraySpec) -> bool:
    return one.uncertainty == other.uncertainty and np.array_equal(one.microphones_m, other.microphones_m)


def _differences(before: Any, after: Any, place: Place) -> Iterator[Place]:
    if not (isinstance(before, Mapping) and isinstance(after, Mapping)):
        if before != after:
            yield place
        return
    for key in {**before, **after}:
        if key in before and key in after:
            yield from _differences(before[key], after[key], (*place, key))
        else:
            yield (*place, key)
