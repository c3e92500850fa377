"""Figures of the paper's campaigns: medians against reverberation time, and the office's errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from livessl.lab.evaluate.figures import explaining
from livessl.lab.evaluate.figures.canvas import COLOURS, panels, save
from livessl.lab.evaluate.paper import METHODS
from livessl.lab.evaluate.statistics import Interval, Results

CAPTIONS: Final[Mapping[str, str]] = {
    "gcc": "GCC-PHAT of one pair 0.5 m and 3 m apart, anechoic and at RT 0.8 s; dashed: the true delay",
    "angle-error": "Angular error of one sample's rounding against the spacing of a pair",
    "maps-size": "SRP maps of a small and a large array at RT 0.8 s, at the source's height; cross: the source",
    "maps-pair": "SRP maps of two arrays 5 m apart and their sum, at RT 0.8 s, at the source's height",
    "topology": "Rooms and arrays",
    "one-array": "Median error against reverberation time: one array, three methods, two sizes",
    "diversity": "Median error against reverberation time: two arrays 0 to 5 m apart, 8 microphones, and one array",
    "office": "Errors in the simulated office, RT 0.7 s; the notch is the median's 99 % interval",
}
"""Caption of every figure of the paper, by its name."""


def draw_all(directory: Path, campaigns: Mapping[str, Results]) -> dict[str, str]:
    """Draw the figures that the campaigns at hand allow, and return their names and captions.

    The paper's campaigns get the paper's figures; any other campaign gets a figure of its medians.
    """
    papers = {"one-array": _one_array, "diversity": _diversity, "office": _office}
    drawings: dict[str, Callable[[], Figure]] = {}
    captions: dict[str, str] = {}
    if papers.keys() & campaigns.keys():
        drawings |= {
            "gcc": explaining.gcc,
            "angle-error": explaining.angle_error,
            "maps-size": explaining.maps_of_sizes,
            "maps-pair": explaining.maps_of_a_pair,
            "topology": explaining.topology,
        }
    for name, results in campaigns.items():
        drawings[name] = partial(papers.get(name, _all_medians), results)
        captions[name] = CAPTIONS.get(name, f"Median error against reverberation time: {name}")
    for name, draw in drawings.items():
        save(draw(), directory / f"{name}.png")
    return {name: captions.get(name) or CAPTIONS[name] for name in drawings}


def _curve(axis: Any, results: Results, system: str, method: str, colour: str, style: str, label: str) -> None:
    rt60s_s = [rt60_s for rt60_s in results.rt60s_s if (system, method, rt60_s) in results.values]
    if not rt60s_s:
        return
    intervals = [Interval.of(results.medians(system, method, rt60_s)) for rt60_s in rt60s_s]
    axis.plot(rt60s_s, [interval.value for interval in intervals], style, color=colour, label=label, markersize=4)
    low, high = [interval.low for interval in intervals], [interval.high for interval in intervals]
    axis.fill_between(rt60s_s, low, high, color=colour, alpha=0.15, linewidth=0)


def _finish(axis: Any) -> None:
    axis.axhline(np.sqrt(3.0) / 2.0, color="grey", linestyle=":", linewidth=1.0, label="diagonal of a cell, 0.87 m")
    axis.set(xlabel="nominal reverberation time (s)", ylabel="median error (m)", ylim=(0.0, None))
    axis.grid(visible=True, alpha=0.3)
    axis.legend(fontsize=8)


def _one_array(results: Results) -> Figure:
    figure, axes = panels(size_inches=(7.5, 5.0))
    for colour, (system, name) in zip(COLOURS, (("small", "0.5 m"), ("large", "3 m")), strict=False):
        for style, method in (("o-", "srp-phat"), ("s--", "cepstral"), ("^:", "averaged")):
            _curve(axes[0, 0], results, system, method, colour, style, f"{name}, {method}")
    _finish(axes[0, 0])
    return figure


def _diversity(results: Results) -> Figure:
    figure, axes = panels(size_inches=(7.5, 5.0))
    systems = [*(f"pair-{metres}m" for metres in range(6))]
    for colour, system in zip(COLOURS, systems, strict=False):
        _curve(axes[0, 0], results, system, "srp-phat", colour, "o-", f"two arrays, {system[5:-1]} m")
    _curve(axes[0, 0], results, "joint-8", "srp-phat", "black", "s--", "8 microphones, joint")
    _curve(axes[0, 0], results, "small", "srp-phat", "grey", "^:", "one array")
    _finish(axes[0, 0])
    return figure


def _all_medians(results: Results) -> Figure:
    """Draw the medians of every system and method."""
    figure, axes = panels(size_inches=(7.5, 5.0))
    columns = list(dict.fromkeys(condition[:2] for condition in results.values))
    systems = list(dict.fromkeys(system for system, _ in columns))
    styles = dict(zip(METHODS, ("o-", "s--", "^:"), strict=True))
    for system, method in columns:
        colour = COLOURS[systems.index(system) % len(COLOURS)]
        _curve(axes[0, 0], results, system, method, colour, styles[method], f"{system}, {method}")
    axes[0, 0].set(xlabel="nominal reverberation time (s)", ylabel="median error (m)", ylim=(0.0, None))
    axes[0, 0].grid(visible=True, alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    return figure


def _office(results: Results) -> Figure:
    figure, axes = panels(size_inches=(7.5, 4.5))
    rt60_s = results.rt60s_s[0]
    names = {"small": "one array", "joint-8": "8 joint"} | {f"pair-{metres}m": f"{metres} m" for metres in range(4)}
    shown = [system for system in names if (system, "srp-phat", rt60_s) in results.values]
    errors = [results.values[system, "srp-phat", rt60_s]["error_m"].ravel() for system in shown]
    intervals = [Interval.of(results.medians(system, "srp-phat", rt60_s)) for system in shown]
    axes[0, 0].boxplot(
        errors, notch=True, conf_intervals=[(interval.low, interval.high) for interval in intervals], showfliers=False
    )
    axes[0, 0].set_xticks(range(1, len(shown) + 1), [names[system] for system in shown])
    axes[0, 0].set(ylabel="error (m); outliers not shown", ylim=(0.0, None))
    axes[0, 0].grid(visible=True, axis="y", alpha=0.3)
    return figure
