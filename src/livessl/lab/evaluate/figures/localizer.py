"""Figures of the localizer's campaigns: errors and confidence in a room, cases side by side, walks and their tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livessl.core.types import BoolArray, FloatArray
from livessl.lab.evaluate.figures.canvas import COLOURS, panels, save
from livessl.lab.evaluate.paper import ROOM_M


@dataclass(frozen=True, slots=True)
class LocalizerCurve:
    """Errors of one condition of the localizer's campaign.

    Parameters
    ----------
    label : str
        The condition, for the legend.
    error_m : mapping of method to (n,) float64
        Errors in ascending order, infinite where the event was refused; the standard method comes first.
    off : (n,) bool
        For the last method's events by falling confidence: True where the position is more than 0.5 m off.
    """

    label: str
    error_m: Mapping[str, FloatArray]
    off: BoolArray


def draw_localizer(directory: Path, curves: Sequence[LocalizerCurve]) -> None:
    """Draw the share of events within a distance and, against the share of events kept, the share of those off."""
    figure, axes = panels(1, 2, (11.0, 4.6))
    share, risk = axes[0]
    for colour, curve in zip(COLOURS, curves, strict=False):
        for style, (method, error_m) in zip((":", "-"), curve.error_m.items(), strict=True):
            label, shares = f"{curve.label}, {method}", np.arange(1, len(error_m) + 1) / len(error_m)
            share.semilogx(error_m, shares, style, color=colour, label=label)
        kept = np.arange(1, len(curve.off) + 1)
        risk.plot(kept / len(kept), np.cumsum(curve.off) / kept, color=colour, label=curve.label)
    share.set(xlabel="error (m)", ylabel="share of events", xlim=(0.003, 10.0), ylim=(0.0, 1.0))
    risk.set(xlabel="share of events kept", ylabel="share of these over 0.5 m off", xlim=(0.5, 1.0), ylim=(0.0, None))
    for axis in (share, risk):
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize=7)
    save(figure, directory / "localizer.png")


@dataclass(frozen=True, slots=True)
class ScenarioPoint:
    """Results of one case of a scenario in one condition.

    Parameters
    ----------
    case, panel, label : str
        Place along the axis, panel, and curve.
    filled : bool
        Whether the marker is filled.
    median_m : (float, float, float)
        Median error and the ends of its interval; NaN where nothing was located.
    lost : float
        Share of events that are lost.
    """

    case: str
    panel: str
    label: str
    filled: bool
    median_m: tuple[float, float, float]
    lost: float


def draw_scenario(directory: Path, name: str, points: Sequence[ScenarioPoint]) -> None:
    """Draw median errors and shares lost by case, in one column of axes for each panel."""
    cases, titles = (list(dict.fromkeys(texts)) for texts in zip(*((p.case, p.panel) for p in points), strict=True))
    labels = {filled: list(dict.fromkeys(p.label for p in points if p.filled == filled)) for filled in (False, True)}
    figure, axes = panels(2, len(titles), (max(5.0, 0.9 * len(cases)) * len(titles), 7.5))
    for column, title in enumerate(titles):
        medians, lost = axes[0, column], axes[1, column]
        for filled, texts in labels.items():
            for index, (colour, label) in enumerate(zip(COLOURS, texts, strict=False)):
                curve = [p for p in points if (p.panel, p.label) == (title, label)]
                at = np.array([cases.index(p.case) for p in curve]) + 0.12 * (index + 0.5 * filled) - 0.2
                median_m, low_m, high_m = np.array([p.median_m for p in curve]).T
                look: dict[str, Any] = {
                    "color": colour,
                    "markerfacecolor": colour if filled else "white",
                    "label": label,
                }
                medians.errorbar(at, median_m, (median_m - low_m, high_m - median_m), fmt="o", markersize=4, **look)
                lost.plot(at, [100.0 * p.lost for p in curve], "o", markersize=4, **look)
        medians.set(title=title, ylabel="median error (m)", yscale="log")
        lost.set(ylabel="lost (%)", ylim=(0.0, None))
        for axis in (medians, lost):
            axis.set_xticks(range(len(cases)), cases, rotation=20, ha="right")
            axis.grid(visible=True, axis="y", alpha=0.3)
        medians.legend(fontsize=7)
    save(figure, directory / f"{name}.png")


@dataclass(frozen=True, slots=True)
class Walk:
    """Positions of a talker, (T, 3), and the positions of each track, (S, 3), in metres."""

    way_m: FloatArray
    tracks_m: Sequence[FloatArray]


def draw_walks(directory: Path, walks: Sequence[Walk]) -> None:
    """Draw walks and their tracks from above."""
    columns = min(3, len(walks))
    rows = -(-len(walks) // columns)
    figure, axes = panels(rows, columns, (4.0 * columns, 5.0 * rows))
    for axis, walk in zip(axes.flat, walks, strict=False):
        axis.plot(*walk.way_m[:, :2].T, ".", color="0.75", markersize=6)
        for index, places_m in enumerate(walk.tracks_m):
            axis.plot(*places_m[:, :2].T, ".-", color=COLOURS[index % len(COLOURS)], markersize=3, linewidth=0.8)
        axis.set(xlim=(0, ROOM_M[0]), ylim=(0, ROOM_M[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    save(figure, directory / "walks.png", dpi=110)
