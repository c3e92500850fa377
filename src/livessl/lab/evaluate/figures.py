"""The paper's figures, drawn from our own results and rooms: PNG and SVG. It computes no statistics of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.signal import oaconvolve

from livessl.core.correlate.gcc_phat import CrossSpectra, microphone_pairs
from livessl.core.correlate.spectra import whole_segment
from livessl.core.types import ArraySpec, BoolArray, Float32Array, FloatArray
from livessl.lab.evaluate.maps import PairMatrices, reach_samples
from livessl.lab.evaluate.paper import (
    BAND_HZ,
    C_M_S,
    EXPERIMENTS,
    METHODS,
    OFFICE_M,
    ROOM_M,
    System,
    pair,
    tetrahedron_in_cube,
)
from livessl.lab.evaluate.statistics import Interval, Results
from livessl.simulation.room import impulse_responses

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Distinct for colour-blind readers (Okabe and Ito)."""

SOURCE_M: Final = np.array([6.1, 7.3, 1.4])
"""Where the sound of the explaining figures is: off the grid and off symmetry."""

RATE_HZ: Final = 16000.0
LONGER_S: Final = 0.8
"""The reverberation of the explaining figures."""

TITLES: Final[Mapping[str, str]] = {
    "gcc": "GCC-PHAT of one pair 0.5 m and 3 m apart, anechoic and at RT 0.8 s; dashed: the true delay",
    "angle-error": "Angular error of one sample's rounding against the spacing of a pair",
    "maps-size": "SRP maps of a small and a large array at RT 0.8 s, at the source's height; cross: the source",
    "maps-pair": "SRP maps of two arrays 5 m apart and their sum, at RT 0.8 s, at the source's height",
    "topology": "Rooms and arrays",
    "one-array": "Median error against reverberation time: one array, three methods, two sizes",
    "diversity": "Median error against reverberation time: two arrays 0 to 5 m apart, 8 microphones, and one array",
    "office": "Errors in the simulated office, RT 0.7 s; the notch is the median's 99 % interval",
}
"""Every figure, and what it shows."""


def draw_all(directory: Path, campaigns: Mapping[str, Results]) -> dict[str, str]:
    """Draw what the campaigns at hand allow; returns the names of the figures, and what they show.

    Campaigns of the paper have its figures; any other has its medians.
    """
    directory.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "livessl"  # the same figure, the same bytes
    explaining = {
        "gcc": _gcc,
        "angle-error": _angle_error,
        "maps-size": _maps_of_sizes,
        "maps-pair": _maps_of_a_pair,
        "topology": _topology,
    }
    papers = {"one-array": _one_array, "diversity": _diversity, "office": _office}
    drawings: dict[str, Callable[[], Figure]] = {}
    titles: dict[str, str] = {}
    if papers.keys() & campaigns.keys():
        drawings |= explaining
    for name, results in campaigns.items():
        drawings[name] = partial(papers.get(name, _all_medians), results)
        titles[name] = TITLES.get(name, f"Median error against reverberation time: {name}")
    for name, draw in drawings.items():
        figure = draw()
        figure.savefig(directory / f"{name}.png", dpi=130, metadata={"Software": None})
        figure.savefig(directory / f"{name}.svg", metadata={"Date": None})
    return {name: titles.get(name) or TITLES[name] for name in drawings}


@dataclass(frozen=True, slots=True)
class LocalizerCurve:
    """One condition of the localizer's campaign.

    Parameters
    ----------
    label : str
    error_m : mapping of method to (n,) float64
        Ascending, infinite where refused; the standard first.
    off : (n,) bool
        Of the events of the last method, the surest first: whether it was off.
    """

    label: str
    error_m: Mapping[str, FloatArray]
    off: BoolArray


def draw_localizer(directory: Path, curves: Sequence[LocalizerCurve]) -> None:
    """Draw what share of events is within a distance, and what share of the surest is off."""
    directory.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "livessl"
    figure, axes = _figure(1, 2, (11.0, 4.6))
    share, risk = axes[0]
    for colour, curve in zip(COLOURS, curves, strict=False):
        for style, (method, error_m) in zip((":", "-"), curve.error_m.items(), strict=True):
            label, shares = f"{curve.label}, {method}", np.arange(1, len(error_m) + 1) / len(error_m)
            share.semilogx(error_m, shares, style, color=colour, label=label)
        kept = np.arange(1, len(curve.off) + 1)
        risk.plot(kept / len(kept), np.cumsum(curve.off) / kept, color=colour, label=curve.label)
    share.set(xlabel="error (m)", ylabel="share of events", xlim=(0.003, 10.0), ylim=(0.0, 1.0))
    risk.set(xlabel="share of events kept", ylabel="of these over 0.5 m off", xlim=(0.5, 1.0), ylim=(0.0, None))
    for axis in (share, risk):
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(directory / "localizer.png", dpi=130, metadata={"Software": None})
    figure.savefig(directory / "localizer.svg", metadata={"Date": None})


@dataclass(frozen=True, slots=True)
class ScenarioPoint:
    """One case of a scenario in one condition.

    Parameters
    ----------
    case, panel, label : str
        Place along the axis, panel, and curve.
    filled : bool
    median_m : (float, float, float)
        Median error and its interval; NaN where nothing was located.
    lost : float
        Share of events.
    """

    case: str
    panel: str
    label: str
    filled: bool
    median_m: tuple[float, float, float]
    lost: float


def draw_scenario(directory: Path, name: str, points: Sequence[ScenarioPoint]) -> None:
    """Draw median errors and shares lost by case, a panel for each of the points' panels."""
    directory.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "livessl"
    cases, panels = (list(dict.fromkeys(texts)) for texts in zip(*((p.case, p.panel) for p in points), strict=True))
    labels = {filled: list(dict.fromkeys(p.label for p in points if p.filled == filled)) for filled in (False, True)}
    figure, axes = _figure(2, len(panels), (max(5.0, 0.9 * len(cases)) * len(panels), 7.5))
    for column, panel in enumerate(panels):
        medians, lost = axes[0, column], axes[1, column]
        for filled, texts in labels.items():
            for index, (colour, label) in enumerate(zip(COLOURS, texts, strict=False)):
                curve = [p for p in points if (p.panel, p.label) == (panel, label)]
                at = np.array([cases.index(p.case) for p in curve]) + 0.12 * (index + 0.5 * filled) - 0.2
                median_m, low_m, high_m = np.array([p.median_m for p in curve]).T
                look: dict[str, Any] = {
                    "color": colour,
                    "markerfacecolor": colour if filled else "white",
                    "label": label,
                }
                medians.errorbar(at, median_m, (median_m - low_m, high_m - median_m), fmt="o", markersize=4, **look)
                lost.plot(at, [100.0 * p.lost for p in curve], "o", markersize=4, **look)
        medians.set(title=panel, ylabel="median error (m)", yscale="log")
        lost.set(ylabel="lost (%)", ylim=(0.0, None))
        for axis in (medians, lost):
            axis.set_xticks(range(len(cases)), cases, rotation=20, ha="right")
            axis.grid(visible=True, axis="y", alpha=0.3)
        medians.legend(fontsize=7)
    figure.savefig(directory / f"{name}.png", dpi=130, metadata={"Software": None})
    figure.savefig(directory / f"{name}.svg", metadata={"Date": None})


@dataclass(frozen=True, slots=True)
class Walk:
    """Where a talker was, (T, 3), and the places of each track, (S, 3), in metres."""

    way_m: FloatArray
    tracks_m: Sequence[FloatArray]


def draw_walks(directory: Path, walks: Sequence[Walk]) -> None:
    """Draw walks and their tracks from above."""
    directory.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "livessl"
    columns = min(3, len(walks))
    figure, axes = _figure(-(-len(walks) // columns), columns, (4.0 * columns, 5.0 * -(-len(walks) // columns)))
    for axis, walk in zip(axes.flat, walks, strict=False):
        axis.plot(*walk.way_m[:, :2].T, ".", color="0.75", markersize=6)
        for index, places_m in enumerate(walk.tracks_m):
            axis.plot(*places_m[:, :2].T, ".-", color=COLOURS[index % len(COLOURS)], markersize=3, linewidth=0.8)
        axis.set(xlim=(0, ROOM_M[0]), ylim=(0, ROOM_M[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    figure.savefig(directory / "walks.png", dpi=110, metadata={"Software": None})
    figure.savefig(directory / "walks.svg", metadata={"Date": None})


def sigma_theta_deg(theta_deg: FloatArray, spacing_m: FloatArray | float, sample_rate_hz: float) -> FloatArray:
    """Angular error of a delay rounded to samples: arcsin(sin theta + c/(fs d sqrt 12)) - theta, from broadside.

    NaN where the delay leaves the range that a pair can see.
    """
    theta = np.radians(theta_deg)
    sine = np.sin(theta) + C_M_S / (sample_rate_hz * np.asarray(spacing_m) * np.sqrt(12.0))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.degrees(np.arcsin(sine) - theta))


def _figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.0, 4.5)) -> tuple[Figure, Any]:
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _heard(microphones_m: FloatArray, rt60_s: float) -> Float32Array:
    """Half a second of noise from `SOURCE_M`, as the microphones hear it."""
    responses = impulse_responses(
        ROOM_M, SOURCE_M, microphones_m, [rt60_s], sample_rate_hz=RATE_HZ, c_m_s=C_M_S, compiled=True
    )[0]
    sound = np.random.default_rng(0).standard_normal((1, int(RATE_HZ / 2)))
    return np.asarray(oaconvolve(responses, sound, axes=1), dtype=np.float32)


def _gcc() -> Figure:
    figure, axes = _figure(2, 2, (8.0, 5.0))
    for row, spacing_m in zip(axes, (0.5, 3.0), strict=True):
        ends = np.array([[0.0, -spacing_m / 2.0, 0.0], [0.0, spacing_m / 2.0, 0.0]]) + np.array(ROOM_M) / 2.0
        distance_m = np.linalg.norm(ends - SOURCE_M, axis=1)
        for axis, rt60_s in zip(row, (0.0, LONGER_S), strict=True):
            reach = int(spacing_m / C_M_S * RATE_HZ) + 8
            spectra = whole_segment(_heard(ends, rt60_s), RATE_HZ, reach)
            values = CrossSpectra(spectra, microphone_pairs(2), RATE_HZ, BAND_HZ).correlations(reach).real[0]
            axis.plot(np.arange(-reach, reach + 1) / RATE_HZ * 1e3, values, color=COLOURS[0], linewidth=1.0)
            axis.axvline((distance_m[1] - distance_m[0]) / C_M_S * 1e3, color=COLOURS[1], linestyle="--", linewidth=1.0)
            axis.set(title=f"{spacing_m:g} m, RT {rt60_s:g} s", xlabel="lag (ms)", ylabel="GCC-PHAT")
    return figure


def _angle_error() -> Figure:
    figure, axes = _figure()
    spacing_m = np.geomspace(0.05, 5.0, 200)
    for colour, theta_deg in zip(COLOURS, (0.0, 30.0, 60.0, 80.0), strict=False):
        error_deg = sigma_theta_deg(np.array(theta_deg), spacing_m, 44100.0)
        axes[0, 0].loglog(spacing_m, error_deg, color=colour, label=f"{theta_deg:g}° from broadside")
    axes[0, 0].set(xlabel="spacing (m)", ylabel="angular error (°), 44.1 kHz")
    axes[0, 0].legend()
    axes[0, 0].grid(visible=True, which="both", alpha=0.3)
    return figure


def _power(specs: tuple[ArraySpec, ...]) -> list[FloatArray]:
    """Maps of arrays on the paper's grid at `LONGER_S`, at the source's height: (x, y) each."""
    experiment = EXPERIMENTS["one-array"]
    grid = experiment.grid(experiment.spacing_m)
    mapper = PairMatrices(grid, RATE_HZ, C_M_S, band_limit=True)
    level = int(np.abs(grid.axis_m(2) - SOURCE_M[2]).argmin())
    maps = []
    for spec in specs:
        reach = reach_samples(spec.aperture_m, RATE_HZ, C_M_S)
        pairs = microphone_pairs(len(spec.microphones_m))
        spectra = whole_segment(_heard(spec.microphones_m, LONGER_S), RATE_HZ, reach)
        lags = CrossSpectra(spectra, pairs, RATE_HZ, spec.band_hz).correlations(reach).real[None]
        maps.append(mapper.power(spec, pairs, lags.astype(np.float32))[:, 0].reshape(grid.shape)[:, :, level])
    return [np.asarray(each, dtype=np.float64) for each in maps]


def _show_maps(maps: list[tuple[str, FloatArray]], microphones_m: list[FloatArray]) -> Figure:
    figure, axes = _figure(1, len(maps), (3.4 * len(maps), 4.2))
    for axis, (title, power), places in zip(axes[0], maps, microphones_m, strict=True):
        image = axis.imshow(power.T, origin="lower", extent=(0, ROOM_M[0], 0, ROOM_M[1]), cmap="viridis")
        axis.plot(places[:, 0], places[:, 1], "w.", markersize=4)
        axis.plot(SOURCE_M[0], SOURCE_M[1], "x", color="red", markersize=9, markeredgewidth=2)
        axis.set(title=title, xlabel="x (m)", ylabel="y (m)")
        figure.colorbar(image, ax=axis, shrink=0.7)
    return figure


def _maps_of_sizes() -> Figure:
    systems = EXPERIMENTS["one-array"].systems
    maps = _power(tuple(system.arrays[0] for system in systems))
    titles = [f"{system.name} ({edge})" for system, edge in zip(systems, ("0.5 m", "3 m"), strict=True)]
    return _show_maps(list(zip(titles, maps, strict=True)), [system.microphones_m for system in systems])


def _maps_of_a_pair() -> Figure:
    one, other = pair(np.array(ROOM_M) / 2.0, 1, 5.0)
    maps = _power((one, other))
    both = np.vstack([one.microphones_m, other.microphones_m])
    return _show_maps(
        [("one", maps[0]), ("the other", maps[1]), ("sum", maps[0] + maps[1])],
        [one.microphones_m, other.microphones_m, both],
    )


def _topology() -> Figure:
    figure, axes = _figure(1, 3, (11.0, 4.6))
    centre_m = np.array(ROOM_M) / 2.0
    sizes = [
        System(name, (ArraySpec(name, centre_m + tetrahedron_in_cube(edge_m), BAND_HZ),))
        for name, edge_m in (("small, 0.5 m", 0.5), ("large, 3 m", 3.0))
    ]
    apart = [System(f"{metres} m apart", pair(centre_m, 1, metres)) for metres in (0, 3, 5)]
    office = [System(f"{metres} m apart", pair(np.array(OFFICE_M) / 2.0, 0, metres)) for metres in (0, 3)]
    for axis, room_m, systems, title in zip(
        axes[0],
        (ROOM_M, ROOM_M, OFFICE_M),
        (sizes, apart, office),
        ("one array", "two arrays", "office"),
        strict=True,
    ):
        for colour, system in zip(COLOURS, systems, strict=False):
            places = system.microphones_m
            axis.plot(places[:, 0], places[:, 1], "o", color=colour, markersize=4, label=system.name)
        axis.set(xlim=(0, room_m[0]), ylim=(0, room_m[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)", title=title)
        axis.legend(fontsize=8)
    return figure


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
    figure, axes = _figure(size=(7.5, 5.0))
    for colour, (system, name) in zip(COLOURS, (("small", "0.5 m"), ("large", "3 m")), strict=False):
        for style, method in (("o-", "srp-phat"), ("s--", "cepstral"), ("^:", "averaged")):
            _curve(axes[0, 0], results, system, method, colour, style, f"{name}, {method}")
    _finish(axes[0, 0])
    return figure


def _diversity(results: Results) -> Figure:
    figure, axes = _figure(size=(7.5, 5.0))
    systems = [*(f"pair-{metres}m" for metres in range(6))]
    for colour, system in zip(COLOURS, systems, strict=False):
        _curve(axes[0, 0], results, system, "srp-phat", colour, "o-", f"two arrays, {system[5:-1]} m")
    _curve(axes[0, 0], results, "joint-8", "srp-phat", "black", "s--", "8 microphones, joint")
    _curve(axes[0, 0], results, "small", "srp-phat", "grey", "^:", "one array")
    _finish(axes[0, 0])
    return figure


def _all_medians(results: Results) -> Figure:
    """Every system, and every method of it."""
    figure, axes = _figure(size=(7.5, 5.0))
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
    figure, axes = _figure(size=(7.5, 4.5))
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
