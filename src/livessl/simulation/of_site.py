"""Places random sounds in a site's own room, and renders the recordings of its arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from livessl.core.types import ArraySpec, Float32Array
from livessl.simulation.scene import GAP_S, NamedSound, Scene, make_scene, render, synthesised_sounds
from livessl.site.load import load_site
from livessl.site.models import Site

DEFAULT_RATE_HZ = 44100.0
"""Default sampling rate, in hertz, of sites whose devices have none: the paper's."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated scene as the arrays of a site would record it.

    Parameters
    ----------
    scene : Scene
        Room and sources: `scene.sources` has the true positions and start times.
    recordings : mapping of array name to (channels, n) float32
        Recording of each array; all begin together.
    sample_rate_hz : float
        Sampling rate of the recordings.
    """

    scene: Scene
    recordings: Mapping[str, Float32Array]
    sample_rate_hz: float


def simulate(
    site: Site | Path | str,
    *,
    rt60_s: float = 0.7,
    count: int = 8,
    sample_rate_hz: float | None = None,
    sounds: Sequence[NamedSound] | None = None,
    seed: int = 0,
) -> Simulation:
    """Simulate sounds at random places in a site's room, recorded by its arrays.

    Parameters
    ----------
    site : Site, Path or str
        A site, or the path of a site file.
    rt60_s : float
        Reverberation time, seconds.
    count : int
        Number of sounds, one after the other.
    sample_rate_hz : float or None
        Sampling rate, hertz; None takes the rate of the site's first device, or 44100.
    sounds : sequence of (name, (n,) float32) or None
        Sounds to play, at that rate; None takes the project's own sounds.
    seed : int
        The same seed and arguments give the same recordings.

    Raises
    ------
    ValueError
        If there is no such scene: see `make_scene`.
    """
    site = site if isinstance(site, Site) else load_site(site)
    rate_hz = sample_rate_hz or next(iter(device_rates_hz(site).values()), DEFAULT_RATE_HZ)
    scene = scene_of(site, rt60_s=rt60_s, sounds=sounds, count=count, sample_rate_hz=rate_hz, seed=seed)
    recordings = {spec.name: samples for spec, samples in rendered(site, scene, seed=seed)}
    return Simulation(scene, recordings, rate_hz)


def scene_of(
    site: Site,
    *,
    rt60_s: float,
    count: int,
    sample_rate_hz: float,
    sounds: Sequence[NamedSound] | None = None,
    seed: int,
    gap_s: float = GAP_S,
) -> Scene:
    """Place sounds at random in a site's room, away from its arrays: see `simulate` and `make_scene`."""
    return make_scene(
        site.room.size_m,
        rt60_s=rt60_s,
        sounds=synthesised_sounds(sample_rate_hz, seed) if sounds is None else sounds,
        count=count,
        sample_rate_hz=sample_rate_hz,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=seed,
        gap_s=gap_s,
    )


def at_places(scene: Scene, places_m: Sequence[Sequence[float]]) -> Scene:
    """Return a scene with its sounds, one after the other, at given places (x, y, z) in metres.

    Raises
    ------
    ValueError
        If a place is outside the room, or the number of places differs from that of the sounds.
    """
    x, y, z = scene.room_size_m
    for place in places_m:
        if not all(0.0 < at < size for at, size in zip(place, scene.room_size_m, strict=True)):
            given = ", ".join(f"{at:g}" for at in place)
            raise ValueError(f"--at: expected a place inside the room of {x:g} x {y:g} x {z:g} m, got {given}")
    sources = tuple(
        replace(source, position_m=np.array(place, dtype=np.float64))
        for source, place in zip(scene.sources, places_m, strict=True)
    )
    return replace(scene, sources=sources)


def rendered(
    site: Site,
    scene: Scene,
    arrays: Sequence[str] | None = None,
    *,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[ArraySpec, Float32Array]]:
    """Yield each array of a site, or each of those named, with its recording of a scene (channels, n).

    An array's noise depends only on the seed and on its position in the site file, so arrays may be rendered apart.
    """
    chosen = [(number, spec) for number, spec in enumerate(site.specs) if arrays is None or spec.name in arrays]
    total = len(chosen) * len(scene.sources)
    for turn, (number, spec) in enumerate(chosen):

        def report(done: int, of_array: int, before: int = turn * len(scene.sources)) -> None:  # noqa: ARG001
            if progress is not None:
                progress(before + done, total)

        yield spec, render(scene, spec.microphones_m, seed=seed + 1 + number, progress=report)


def device_rates_hz(site: Site) -> dict[str, float]:
    """Return the sampling rate of each array's device, hertz; arrays whose device has none in the site are left out."""
    return {
        array: node.device.sample_rate_hz
        for node in site.nodes.values()
        if node.device.sample_rate_hz is not None
        for array in node.arrays
    }
