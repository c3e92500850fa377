"""Findings from the site file alone: ambiguous layouts of microphones, and grids that are too coarse."""

from __future__ import annotations

from collections.abc import Iterator

from livessl.core import mirror
from livessl.core.commission.finding import Finding, Severity
from livessl.site.build.grid import search_grid
from livessl.site.checks import wide_arrays
from livessl.site.models import Site


def layout_findings(site: Site) -> tuple[Finding, ...]:
    """Return what the layout of a site makes ambiguous or inexact, whatever the sounds are."""
    return (*_look_alikes(site), *_aliasing(site))


def _look_alikes(site: Site) -> Iterator[Finding]:
    share = mirror.ambiguous_share(site.processed, search_grid(site), site.c_m_s)
    if share > mirror.MOST_SHARE:
        yield Finding(
            "ambiguous_geometry",
            None,
            None,
            Severity.WARNING,
            1.0,
            f"{mirror.described(site.processed, site.c_m_s)}: in {share:.0%} of the search volume a position and its "
            "mirror image cannot be told apart",
            mirror.CURE,
        )


def _aliasing(site: Site) -> Iterator[Finding]:
    for spec, kept_hz in wide_arrays(site):
        fits_m = site.grid.spacing_m * kept_hz / spec.band_hz[1]
        yield Finding(
            "aliasing",
            spec.name,
            None,
            Severity.WARNING,
            1.0,
            f"{spec.name!r} is {spec.aperture_m:.2f} m wide: on a grid of {site.grid.spacing_m:g} m its maps have "
            f"spatial aliasing above {kept_hz:.0f} Hz, and its band reaches {spec.band_hz[1]:g} Hz",
            f"set grid.spacing_m to about {fits_m:.2g}, or lower the array's band_hz",
        )
