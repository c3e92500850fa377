"""The paper's experiments as data: rooms, arrays, positions, methods; and the same with a site file's arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.joint_array import joined
from livessl.core.types import ArraySpec, FloatArray
from livessl.lab.evaluate.layout import Layout

C_M_S: Final = 343.0
BAND_HZ: Final = (100.0, 6000.0)
ROOM_M: Final = (8.0, 10.0, 4.0)
OFFICE_M: Final = (7.05, 5.64, 2.84)
OFFICE_RT60_S: Final = 0.7
OFFICE_SPAN_M: Final = (4.0, 4.0, 2.0)
"""Size, in metres, of the box of sources about the office's centre."""

RT60S_S: Final = tuple(round(0.2 * step, 1) for step in range(11))
SMALL_M: Final = 0.5
LARGE_M: Final = 3.0
"""Edges, in metres, of the small and of the large tetrahedron."""

METHODS: Final = ("srp-phat", "cepstral", "averaged")
CLASSES: Final = ("doorslam", "keysDrop", "phone", "speech")
"""Classes of sound, as the clips of DCASE 2016 task 2 are named."""


@dataclass(frozen=True, slots=True)
class System:
    """Arrays whose maps are summed to one estimate.

    Parameters
    ----------
    name : str
        Name in the results.
    arrays : tuple of ArraySpec
    methods : tuple of str
        Methods by which the arrays are correlated.
    """

    name: str
    arrays: tuple[ArraySpec, ...]
    methods: tuple[str, ...] = ("srp-phat",)

    @property
    def microphones_m(self) -> FloatArray:
        """Positions of all microphones (K, 3), array by array."""
        return np.vstack([spec.microphones_m for spec in self.arrays])

    @property
    def centre_m(self) -> FloatArray:
        """Mean position of the microphones (3,), the origin of radial, azimuth and elevation errors."""
        return np.asarray(self.microphones_m.mean(axis=0))


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings that a campaign's results depend on, besides the sounds.

    Parameters
    ----------
    experiment : str
        One of `EXPERIMENTS`.
    positions : int
        Number of positions of the source; each plays one random clip of every class.
    rt60s_s : tuple of float
        Nominal reverberation times, in seconds, by Sabine's formula.
    seed : int
        Every position has its own random stream, so its results do not depend on the other positions.
    sample_rate_hz : float
        Sample rate of the simulation; 16 kHz is enough for a band up to 6 kHz.
    spacing_m : float
        Spacing of the cell-centred search grid.
    snr_db : float or None
        Level of the mean power of the whole recording, over the system's microphones, above white sensor noise that is
        independent at each microphone; None, as in the paper, adds no noise.
    segment : str
        The segment of an event that is localized: "longest", or "peak" for the one with the loudest frame.
    band_limit : bool
        Whether the band is limited against spatial aliasing, per pair and grid point; see
        `livessl.core.steering.alias_free_hz`.
    layout : Layout or None
        Room, search volume and arrays; None takes the paper's.
    """

    experiment: str
    positions: int
    rt60s_s: tuple[float, ...]
    seed: int = 0
    sample_rate_hz: float = 16000.0
    spacing_m: float = 0.5
    snr_db: float | None = None
    segment: str = "longest"
    band_limit: bool = True
    layout: Layout | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name; without a layout there is no such key, as in older campaigns."""
        known = asdict(self)
        if self.layout is None:
            del known["layout"]
        return known


@dataclass(frozen=True, slots=True)
class Experiment:
    """A room, the systems in it, and the positions of its sources.

    Parameters
    ----------
    room_m : (float, float, float)
    systems : tuple of System
    place : callable
        Draws a source position (3,) in metres: (generator, number of the position) -> position.
    rt60s_s : tuple of float
        Default reverberation times, in seconds.
    spacing_m : float
        Default spacing of the search grid.
    positions : int
        Default number of positions.
    c_m_s : float
        Speed of sound.
    band_hz : (float, float)
        Lowest and highest frequency of all arrays.
    bounds_m : three (float, float), or None
        Search volume; None is the room.
    """

    room_m: tuple[float, float, float]
    systems: tuple[System, ...]
    place: Callable[[np.random.Generator, int], FloatArray]
    rt60s_s: tuple[float, ...]
    spacing_m: float
    positions: int
    c_m_s: float = C_M_S
    band_hz: tuple[float, float] = BAND_HZ
    bounds_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] | None = None

    @property
    def lag_rate_hz(self) -> float:
        """Least rate, in hertz, of the lags that are kept: a sixth more than twice the upper end of the band."""
        return 7.0 * self.band_hz[1] / 3.0

    def grid(self, spacing_m: float) -> Grid:
        """Make the search grid."""
        x, y, z = self.room_m
        return Grid(self.bounds_m or ((0.0, x), (0.0, y), (0.0, z)), spacing_m)


def tetrahedron_in_cube(edge_m: float) -> FloatArray:
    """Return a regular tetrahedron (4, 3) of every other vertex of a cube, centred at the origin.

    Its mirror image in any axis consists of the other vertices, so that two arrays at 0 m are the cube's eight.
    """
    vertices = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    return np.asarray(vertices * (edge_m / np.sqrt(8.0)))


def pair(centre_m: FloatArray, axis: int, separation_m: float) -> tuple[ArraySpec, ArraySpec]:
    """Return two 0.5 m tetrahedra, mirror images of each other, at a distance along an axis."""
    shift = np.zeros(3)
    shift[axis] = separation_m / 2.0
    mirror = np.ones(3)
    mirror[axis] = -1.0
    one = tetrahedron_in_cube(SMALL_M) + shift
    return ArraySpec("a", centre_m + one, BAND_HZ), ArraySpec("b", centre_m + one * mirror, BAND_HZ)


def _single(name: str, centre_m: FloatArray, edge_m: float, methods: tuple[str, ...]) -> System:
    return System(name, (ArraySpec(name, centre_m + tetrahedron_in_cube(edge_m), BAND_HZ),), methods)


def _joint(centre_m: FloatArray, axis: int) -> System:
    """Return the eight microphones of the pair at 0 m, on one clock, as one array."""
    return System("joint-8", (joined(pair(centre_m, axis, 0.0), {"a": "one", "b": "one"}, "joint-8"),))


def _apart(centre_m: FloatArray, axis: int, separations_m: tuple[int, ...]) -> tuple[System, ...]:
    return tuple(System(f"pair-{metres}m", pair(centre_m, axis, metres)) for metres in separations_m)


def _anywhere(rng: np.random.Generator, number: int) -> FloatArray:  # noqa: ARG001 - the signature of `Experiment.place`
    return np.asarray(rng.uniform(0.0, 1.0, 3) * ROOM_M)


def _over_the_office(rng: np.random.Generator, number: int) -> FloatArray:
    """Draw a position at one of two heights in turn, anywhere in the middle of the floor."""
    x, y, height = OFFICE_SPAN_M
    level = 0.5 if number % 2 else -0.5
    offset = np.array([rng.uniform(-0.5, 0.5) * x, rng.uniform(-0.5, 0.5) * y, level * height])
    return np.asarray(np.array(OFFICE_M) / 2.0 + offset)


_CENTRE_M = np.array(ROOM_M) / 2.0
_OFFICE_CENTRE_M = np.array(OFFICE_M) / 2.0

EXPERIMENTS: Final[dict[str, Experiment]] = {
    "one-array": Experiment(
        ROOM_M,
        (_single("small", _CENTRE_M, SMALL_M, METHODS), _single("large", _CENTRE_M, LARGE_M, METHODS)),
        _anywhere,
        RT60S_S,
        0.5,
        1000,
    ),
    "diversity": Experiment(
        ROOM_M,
        (
            _single("small", _CENTRE_M, SMALL_M, ("srp-phat",)),
            *_apart(_CENTRE_M, 1, (0, 1, 2, 3, 4, 5)),
            _joint(_CENTRE_M, 1),
        ),
        _anywhere,
        RT60S_S,
        0.5,
        1000,
    ),
    "office": Experiment(
        OFFICE_M,
        (
            _single("small", _OFFICE_CENTRE_M, SMALL_M, ("srp-phat",)),
            *_apart(_OFFICE_CENTRE_M, 0, (0, 1, 2, 3)),
            _joint(_OFFICE_CENTRE_M, 0),
        ),
        _over_the_office,
        (OFFICE_RT60_S,),
        0.1,
        80,
    ),
}
"""The paper's experiments by their names on the command line."""


def experiment_of(name: str, layout: Layout | None = None) -> Experiment:
    """Return an experiment of the paper, or the same with another room and other arrays.

    With a layout, `one-array` locates with each array alone, by every method, and `diversity` with each alone and with
    their sums. Sources are anywhere in the search volume.

    Raises
    ------
    ValueError
        If the layout does not allow the experiment.
    """
    paper = EXPERIMENTS[name]
    if layout is None:
        return paper
    if name not in _OTHER_LAYOUTS:
        raise ValueError(f"--site: expected one of {', '.join(_OTHER_LAYOUTS)}, got {name}, which has its own room")
    specs = {array.name: array.spec for array in layout.arrays}
    methods = METHODS if name == "one-array" else ("srp-phat",)
    systems = [System(array, (spec,), methods) for array, spec in specs.items()]
    if name == "diversity":
        if not layout.sums:
            raise ValueError(f"--site: diversity expects two arrays or more, got {', '.join(specs)} only; add another")
        systems += [System(called, tuple(specs[array] for array in arrays)) for called, arrays in layout.sums]
    lower_m, upper_m = np.array(layout.bounds_m).T
    bands_hz = np.array([spec.band_hz for spec in specs.values()])
    return Experiment(
        layout.room_m,
        tuple(systems),
        lambda rng, number: np.asarray(rng.uniform(lower_m, upper_m)),  # noqa: ARG005 - the signature of `Experiment.place`
        paper.rt60s_s,
        layout.spacing_m,
        paper.positions,
        layout.c_m_s,
        (float(bands_hz[:, 0].min()), float(bands_hz[:, 1].max())),
        layout.bounds_m,
    )


_OTHER_LAYOUTS: Final = ("one-array", "diversity")
