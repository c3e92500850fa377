"""Figures that explain the paper's argument: correlations, angular errors, maps and the layout of its arrays."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import oaconvolve

from livessl.core.correlate.gcc_phat import CrossSpectra
from livessl.core.correlate.spectra import whole_segment
from livessl.core.geometry import microphone_pairs
from livessl.core.types import ArraySpec, Float32Array, FloatArray
from livessl.lab.evaluate.figures.canvas import COLOURS, panels
from livessl.lab.evaluate.maps import PairMatrices, reach_samples
from livessl.lab.evaluate.paper import (
    BAND_HZ,
    C_M_S,
    EXPERIMENTS,
    OFFICE_M,
    ROOM_M,
    System,
    pair,
    tetrahedron_in_cube,
)
from livessl.lab.plan.prediction import angle_error_deg
from livessl.simulation.room import impulse_responses

SOURCE_M: Final = np.array([6.1, 7.3, 1.4])
"""Position of the source, off the grid and off every symmetry."""

RATE_HZ: Final = 16000.0
REVERBERANT_S: Final = 0.8
"""Reverberation time of the reverberant examples: about where the paper's small array begins to fail."""


def gcc() -> Figure:
    """Draw the GCC-PHAT of a narrow and of a wide pair, anechoic and reverberant."""
    figure, axes = panels(2, 2, (8.0, 5.0))
    for row, spacing_m in zip(axes, (0.5, 3.0), strict=True):
        ends = np.array([[0.0, -spacing_m / 2.0, 0.0], [0.0, spacing_m / 2.0, 0.0]]) + np.array(ROOM_M) / 2.0
        distance_m = np.linalg.norm(ends - SOURCE_M, axis=1)
        for axis, rt60_s in zip(row, (0.0, REVERBERANT_S), strict=True):
            reach = int(spacing_m / C_M_S * RATE_HZ) + 8
            spectra = whole_segment(_recorded(ends, rt60_s), RATE_HZ, reach)
            values = CrossSpectra(spectra, microphone_pairs(2), RATE_HZ, BAND_HZ).correlations(reach).real[0]
            axis.plot(np.arange(-reach, reach + 1) / RATE_HZ * 1e3, values, color=COLOURS[0], linewidth=1.0)
            axis.axvline((distance_m[1] - distance_m[0]) / C_M_S * 1e3, color=COLOURS[1], linestyle="--", linewidth=1.0)
            axis.set(title=f"{spacing_m:g} m, RT {rt60_s:g} s", xlabel="lag (ms)", ylabel="GCC-PHAT")
    return figure


def angle_error() -> Figure:
    """Draw the angular error that rounding lags to whole samples causes, against the spacing of a pair."""
    figure, axes = panels()
    spacing_m = np.geomspace(0.05, 5.0, 200)
    for colour, theta_deg in zip(COLOURS, (0.0, 30.0, 60.0, 80.0), strict=False):
        error_deg = angle_error_deg(theta_deg, spacing_m, 44100.0, C_M_S)
        axes[0, 0].loglog(spacing_m, error_deg, color=colour, label=f"{theta_deg:g}° from broadside")
    axes[0, 0].set(xlabel="spacing (m)", ylabel="angular error (°), 44.1 kHz")
    axes[0, 0].legend()
    axes[0, 0].grid(visible=True, which="both", alpha=0.3)
    return figure


def maps_of_sizes() -> Figure:
    """Draw the maps of a small and of a large array."""
    systems = EXPERIMENTS["one-array"].systems
    maps = _power(tuple(system.arrays[0] for system in systems))
    titles = [f"{system.name} ({edge})" for system, edge in zip(systems, ("0.5 m", "3 m"), strict=True)]
    return _show_maps(list(zip(titles, maps, strict=True)), [system.microphones_m for system in systems])


def maps_of_a_pair() -> Figure:
    """Draw the maps of two arrays 5 m apart, and their sum."""
    one, other = pair(np.array(ROOM_M) / 2.0, 1, 5.0)
    maps = _power((one, other))
    both = np.vstack([one.microphones_m, other.microphones_m])
    return _show_maps(
        [("one", maps[0]), ("the other", maps[1]), ("sum", maps[0] + maps[1])],
        [one.microphones_m, other.microphones_m, both],
    )


def topology() -> Figure:
    """Draw the rooms and the arrays of the experiments from above."""
    figure, axes = panels(1, 3, (11.0, 4.6))
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


def _recorded(microphones_m: FloatArray, rt60_s: float) -> Float32Array:
    """Half a second of noise from `SOURCE_M`, as the microphones record it: (K, n)."""
    responses = impulse_responses(
        ROOM_M, SOURCE_M, microphones_m, [rt60_s], sample_rate_hz=RATE_HZ, c_m_s=C_M_S, compiled=True
    )[0]
    sound = np.random.default_rng(0).standard_normal((1, int(RATE_HZ / 2)))
    return np.asarray(oaconvolve(responses, sound, axes=1), dtype=np.float32)


def _power(specs: tuple[ArraySpec, ...]) -> list[FloatArray]:
    """Compute each array's map at the source's height, with reverberation: one of shape (x, y) for each array."""
    experiment = EXPERIMENTS["one-array"]
    grid = experiment.grid(experiment.spacing_m)
    mapper = PairMatrices(grid, RATE_HZ, C_M_S, band_limit=True)
    level = int(np.abs(grid.axis_m(2) - SOURCE_M[2]).argmin())
    maps = []
    for spec in specs:
        reach = reach_samples(spec.aperture_m, RATE_HZ, C_M_S)
        pairs = microphone_pairs(len(spec.microphones_m))
        spectra = whole_segment(_recorded(spec.microphones_m, REVERBERANT_S), RATE_HZ, reach)
        lags = CrossSpectra(spectra, pairs, RATE_HZ, spec.band_hz).correlations(reach).real[None]
        maps.append(mapper.power(spec, pairs, lags.astype(np.float32))[:, 0].reshape(grid.shape)[:, :, level])
    return [np.asarray(each, dtype=np.float64) for each in maps]


def _show_maps(maps: list[tuple[str, FloatArray]], microphones_m: list[FloatArray]) -> Figure:
    figure, axes = panels(1, len(maps), (3.4 * len(maps), 4.2))
    for axis, (title, power), places in zip(axes[0], maps, microphones_m, strict=True):
        image = axis.imshow(power.T, origin="lower", extent=(0, ROOM_M[0], 0, ROOM_M[1]), cmap="viridis")
        axis.plot(places[:, 0], places[:, 1], "w.", markersize=4)
        axis.plot(SOURCE_M[0], SOURCE_M[1], "x", color="red", markersize=9, markeredgewidth=2)
        axis.set(title=title, xlabel="x (m)", ylabel="y (m)")
        figure.colorbar(image, ax=axis, shrink=0.7)
    return figure
