"""Draws a site with matplotlib: floor plan, side view, and each array with the numbers of its microphones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.core.types import ArraySpec
from livessl.lab.plan.figure import require_matplotlib
from livessl.site.models import Site

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS: Final = 4
"""Number of enlarged arrays in a row."""

MOST_ARRAYS: Final = 16
"""Largest number of enlarged arrays; of more arrays, the first ones in the site file are drawn."""

MARGIN: Final = 0.06
"""Margin of a view, as a share of its longest side."""

_INK: Final = "#222222"
_ARRAY: Final = "#d62728"
_ZONE: Final = "#1f77b4"


def draw(site: Site, path: Path) -> None:
    """Write the layout as a PNG.

    Raises
    ------
    FigureError
        If matplotlib is missing.
    OSError
        If the file cannot be written.
    """
    require_matplotlib("--png")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = site.specs[:MOST_ARRAYS]
    rows = -(-len(shown) // COLUMNS)
    x, y, z = site.room.size_m
    plan_height = float(np.clip(6.0 * y / x, 2.5, 9.0))
    side_height = float(np.clip(6.0 * z / x, 1.6, 4.0))
    figure = Figure(figsize=(11.0, plan_height + side_height + 2.8 * rows + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2 + rows, COLUMNS, height_ratios=[plan_height, side_height, *([2.6] * rows)])
    plan = figure.add_subplot(grid[0, :])
    _view(plan, site, (0, 1), "floor plan")
    spread = np.ptp([spec.centre_m for spec in site.specs], axis=0)
    _view(figure.add_subplot(grid[1, :]), site, (int(spread[1] > spread[0]), 2), "side view")
    for index, spec in enumerate(shown):
        _enlarged(figure.add_subplot(grid[2 + index // COLUMNS, index % COLUMNS]), spec)
    figure.suptitle(f"{site.site}: room {x:g} x {y:g} x {z:g} m", color=_INK)
    figure.savefig(path, dpi=110, metadata={"Software": "livessl"})


def _view(ax: Axes, site: Site, axes: tuple[int, int], title: str) -> None:
    from matplotlib.patches import Polygon, Rectangle

    right, up = axes
    width, height = site.room.size_m[right], site.room.size_m[up]
    ax.add_patch(Rectangle((0, 0), width, height, fill=False, edgecolor=_INK, linewidth=1.5))
    for name, zone in site.all_zones.items():
        box_m = zone.box_m(site.room.size_m[2])
        (x0, x1), (y0, y1) = box_m[right], box_m[up]
        corners = list(zone.outline_m) if axes == (0, 1) else [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        hatch = "//" if zone.exclude else None
        ax.add_patch(Polygon(corners, facecolor=_ZONE, alpha=0.15, edgecolor=_ZONE, linestyle="--", hatch=hatch))
        ax.annotate(name, ((x0 + x1) / 2, (y0 + y1) / 2), ha="center", va="center", fontsize=8, color=_ZONE)
    for spec in site.specs:
        ax.plot(spec.microphones_m[:, right], spec.microphones_m[:, up], "o", color=_ARRAY, markersize=3)
        ax.annotate(
            spec.name,
            (float(spec.centre_m[right]), float(spec.microphones_m[:, up].min())),
            xytext=(0, -6),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            color=_INK,
        )
    margin = MARGIN * max(width, height)
    ax.set_xlim(-margin, width + margin)
    ax.set_ylim(-margin, height + margin)
    _finish(ax, ("xyz"[right], "xyz"[up]), title)


def _enlarged(ax: Axes, spec: ArraySpec) -> None:
    """Draw an array from above with microphone numbers; microphones above one another share a label."""
    places = np.round(spec.microphones_m[:, :2], 3)
    numbers: dict[tuple[float, float], list[int]] = {}
    for number, (x, y) in enumerate(places.tolist(), 1):
        numbers.setdefault((x, y), []).append(number)
    ax.plot(*places.T, "o", color=_ARRAY, markersize=13, markeredgecolor="white")
    for place, here in numbers.items():
        ax.annotate(
            ",".join(map(str, here)), place, ha="center", va="center", fontsize=7, color="white", fontweight="bold"
        )
    middle, reach = places.mean(axis=0), max(0.7 * float(np.ptp(places, axis=0).max()), 0.01)
    ax.set_xlim(middle[0] - reach, middle[0] + reach)
    ax.set_ylim(middle[1] - reach, middle[1] + reach)
    _finish(ax, ("x", "y"), f"{spec.name}, from above")
    ax.tick_params(labelsize=7)


def _finish(ax: Axes, axes: Sequence[str], title: str) -> None:
    ax.set_aspect("equal")
    ax.spines[:].set_visible(False)
    ax.set_title(title, fontsize=10, color=_INK)
    ax.set_xlabel(f"{axes[0]} (m)", fontsize=8)
    ax.set_ylabel(f"{axes[1]} (m)", fontsize=8)
