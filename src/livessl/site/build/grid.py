"""The search grid of a site; `core.geometry.Grid` makes its points."""

from __future__ import annotations

from livessl.core.geometry import Grid
from livessl.site.models import Site


def search_grid(site: Site) -> Grid:
    """Return the grid of the given bounds, or else of the whole room."""
    x, y, z = site.room.size_m
    return Grid(site.grid.bounds_m or ((0.0, x), (0.0, y), (0.0, z)), site.grid.spacing_m)
