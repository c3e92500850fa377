"""Findings that follow from the site file alone."""

from __future__ import annotations

import pytest

from livessl.core.commission.finding import Severity
from livessl.site.build.layout import layout_findings
from small_site import Changes, site_of

FLAT: Changes = {f"arrays.{name}.geometry": {"circle": {"radius_m": 0.2, "count": 4}} for name in ("north", "south")}


def test_nothing_is_said_of_two_tetrahedra() -> None:
    assert layout_findings(site_of()) == ()


@pytest.mark.parametrize("height_m", [1.2, 1.6])
def test_arrays_in_one_plane_are_ambiguous_unless_the_search_volume_ends_there(height_m: float) -> None:
    heights: Changes = {
        "arrays.north.position_m": [1.9, 1.3, height_m],
        "arrays.south.position_m": [2.2, 3.8, height_m],
    }
    (found,) = layout_findings(site_of(FLAT | heights))
    assert (found.fault, found.array, found.severity) == ("ambiguous_geometry", None, Severity.WARNING)
    assert f"z = {height_m:.2f} m" in found.message
    below = {"grid.bounds_m": [[0.0, 4.0], [0.0, 5.0], [0.0, height_m]]}
    assert layout_findings(site_of(FLAT | heights | below)) == ()


def test_array_that_is_too_wide_for_the_grid_has_aliasing() -> None:
    wide: Changes = {"arrays.south.geometry": {"tetrahedron": {"edge_m": 2.0}}, "grid.spacing_m": 0.5}
    found = {one.array: one for one in layout_findings(site_of(wide))}
    assert found["south"].fault == "aliasing"
    cure_m = float(found["south"].cure.split("about ")[1].split(",")[0])
    finer = {one.array for one in layout_findings(site_of(wide | {"grid.spacing_m": 0.9 * cure_m}))}
    assert "south" not in finer
