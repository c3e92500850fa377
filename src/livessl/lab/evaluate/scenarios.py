"""Scenarios of the localizer's campaign: which arrays take part, and which faults they have.

They are plain values. Everything is in the paper's room. A case is simulated with the true arrays and localized with
the believed ones, as a faulty site file describes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import speed_of_sound_m_s
from livessl.core.types import ArraySpec, FloatArray
from livessl.lab.evaluate.paper import C_M_S, ROOM_M, pair

HALVES: Final = ("development", "test")
"""The halves of the clips: constants are fitted on the first, results are reported on the second."""

LOCALIZER: Final = "localizer"
"""Name of the experiment that compares `onset` with the paper's standard."""

ROOMS: Final = "rooms"
"""The scenario that is run by default."""

NOISE: Final = "noise"
"""The scenario in other rooms than the paper's, with the noise that rooms have: `livessl.lab.evaluate.noise`."""


@dataclass(frozen=True, slots=True)
class Case:
    """Arrays, and a fault of all of them or of one.

    Parameters
    ----------
    name : str
        Name in the results, unique among all cases.
    arrays : str
        Names of the arrays, one letter each.
    moved_m, turned_deg : float
        Distance of an array's believed centre from the true one, and angle about a random axis between the poses.
    warmer_c : float
        Believed minus true temperature of the air, in degrees Celsius.
    dead : bool
        Whether an array's second microphone gives only zeros.
    of_one : bool
        Whether only one array has the fault: each in turn, by the number of the position.
    without_it : bool
        Whether the faulty array is excluded.
    """

    name: str
    arrays: str
    moved_m: float = 0.0
    turned_deg: float = 0.0
    warmer_c: float = 0.0
    dead: bool = False
    of_one: bool = False
    without_it: bool = False

    @property
    def c_m_s(self) -> float:
        """Believed speed of sound, in m/s; the true one is the paper's."""
        return C_M_S + speed_of_sound_m_s(ROOM_C + self.warmer_c) - speed_of_sound_m_s(ROOM_C)

    @property
    def misplaced(self) -> bool:
        """True if poses are drawn anew at every position."""
        return self.moved_m > 0.0 or self.turned_deg > 0.0

    @property
    def spoilt(self) -> bool:
        """True if exactly one of the arrays that take part has a fault."""
        return self.of_one and not self.without_it

    def faulty(self, number: int) -> str:
        """Return the names of the arrays that have the fault at a position."""
        return self.arrays[number % len(self.arrays)] if self.of_one else self.arrays

    def used(self, number: int) -> str:
        """Return the names of the arrays that take part at a position."""
        return self.arrays.replace(self.faulty(number), "") if self.without_it else self.arrays

    def believed(self, number: int, rng: np.random.Generator) -> list[ArraySpec]:
        """Return the arrays as the site file describes them."""
        specs = []
        for name in self.used(number):
            spec = ARRAYS[name]
            if self.misplaced and name in self.faulty(number):
                rotation = _rotation(_direction(rng), np.radians(self.turned_deg))
                shift_m = self.moved_m * _direction(rng)
                moved_m = spec.centre_m + (spec.microphones_m - spec.centre_m) @ rotation.T + shift_m
                spec = ArraySpec(name, moved_m, spec.band_hz)
            specs.append(spec)
        return specs


@dataclass(frozen=True, slots=True)
class Scenario:
    """Cases on the same sounds; the first is the reference of all others.

    Parameters
    ----------
    title, about : str
        Heading and description in the report.
    cases : tuple of Case
    """

    title: str
    about: str
    cases: tuple[Case, ...]


ROOM_C: Final = 20.0
"""Temperature, in degrees Celsius, at which the speed of sound is about the paper's."""


def _named(*pairs: tuple[str, tuple[ArraySpec, ArraySpec]]) -> dict[str, ArraySpec]:
    return {
        name: ArraySpec(name, spec.microphones_m, spec.band_hz)
        for names, specs in pairs
        for name, spec in zip(names, specs, strict=True)
    }


_CENTRE_M = np.array(ROOM_M) / 2.0

ARRAYS: Final[Mapping[str, ArraySpec]] = _named(
    ("ab", pair(_CENTRE_M, 1, 5.0)),
    ("cd", pair(_CENTRE_M, 0, 5.0)),
    ("ef", pair(_CENTRE_M, 1, 3.0)),
    ("gh", pair(_CENTRE_M, 1, 1.0)),
)
"""All arrays of the scenarios: tetrahedra of 0.5 m, in pairs about the room's centre."""

TWO: Final = Case("two arrays", "ab")
_FOUR: Final = Case("four arrays", "abcd")
_THREE: Final = Case("three arrays", "abc")

SCENARIOS: Final[Mapping[str, Scenario]] = {
    ROOMS: Scenario("Reverberation and noise", "Two tetrahedra of 0.5 m, 5 m apart.", (TWO,)),
    "arrays": Scenario(
        "One to four arrays",
        "Tetrahedra of 0.5 m around the room's centre: two 5 m apart along the room, one and then two more 5 m apart "
        "across it. One array alone measures little but the direction.",
        (TWO, Case("one array", "a"), _THREE, _FOUR),
    ),
    "removed": Scenario(
        "Each of four arrays removed",
        "a and b stand 5 m apart along the room, c and d across it.",
        (_FOUR, *(Case(f"without {name}", "abcd".replace(name, "")) for name in "abcd")),
    ),
    "separations": Scenario(
        "How far two arrays are apart",
        "Two tetrahedra of 0.5 m around the room's centre.",
        (TWO, Case("3 m apart", "ef"), Case("1 m apart", "gh")),
    ),
    "poses": Scenario(
        "Wrong poses",
        "Both arrays' centres and orientations are off in the site file, each in a direction and about an axis of its "
        "own, drawn anew at every position.",
        (
            TWO,
            Case("2 cm off", "ab", moved_m=0.02),
            Case("turned by 2 degrees", "ab", turned_deg=2.0),
            Case("2 cm off, turned by 2 degrees", "ab", moved_m=0.02, turned_deg=2.0),
        ),
    ),
    "temperature": Scenario(
        "Wrong temperature",
        "The speed of sound in the site file is that of air 10 degrees colder or warmer.",
        (TWO, Case("10 degrees too cold", "ab", warmer_c=-10.0), Case("10 degrees too warm", "ab", warmer_c=10.0)),
    ),
    "bad-array": Scenario(
        "One bad array of three",
        "Each array has the fault in turn, by the number of the position: its pose in the site file is turned by 30 "
        "degrees about a random axis, or one of its microphones gives only zeros. The case of the two others alone "
        "shows what can be reached without the faulty array.",
        (
            _THREE,
            Case("the two others", "abc", of_one=True, without_it=True),
            Case("one turned by 30 degrees", "abc", turned_deg=30.0, of_one=True),
            Case("one microphone dead", "abc", dead=True, of_one=True),
        ),
    ),
}
"""Scenarios by their names on the command line."""


@dataclass(frozen=True, slots=True)
class SessionCase:
    """A session with two arrays: its sounds, and the fault of the second array's clock.

    Parameters
    ----------
    name : str
        Name in the results.
    rounds : int
        Number of times that each class of sound is played, from a new position each time.
    pairs : bool
        Whether sounds are played two at once.
    alone : bool
        Whether the second sound of each such pair is omitted.
    walks : bool or None
        Whether a talker, the only sound, walks (True) or stands (False); None for no talker.
    late_s, drift_ppm : float
        Time by which the second array's clock is ahead, so that its stamps are too late; deviation of its device's
        sample rate from the nominal one.
    """

    name: str
    rounds: int = 1
    pairs: bool = False
    alone: bool = False
    walks: bool | None = None
    late_s: float = 0.0
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True)
class SessionScenario:
    """Sessions on the same sounds; the first case is the reference of all others.

    Parameters
    ----------
    title, about : str
        Heading and description in the report.
    rt60_s : float
        Default reverberation time, in seconds.
    cases : tuple of SessionCase
    """

    title: str
    about: str
    rt60_s: float
    cases: tuple[SessionCase, ...]


SESSION_SNR_DB: Final = 20.0
"""Default level of the sounds above the sensor noise, in dB."""

SESSIONS: Final[Mapping[str, SessionScenario]] = {
    "clocks": SessionScenario(
        "Clocks that disagree",
        "Eight sounds, two of each class, follow one another, each from its own position. The clock of the second "
        "array's node is ahead of the first's, or its device samples faster than its nominal rate.",
        0.4,
        (
            SessionCase("clocks agree", rounds=2),
            SessionCase("50 ms off", rounds=2, late_s=0.05),
            SessionCase("150 ms off", rounds=2, late_s=0.15),
            SessionCase("100 ppm fast", rounds=2, drift_ppm=100.0),
            SessionCase("150 ms off, 100 ppm fast", rounds=2, late_s=0.15, drift_ppm=100.0),
        ),
    ),
    "two-sources": SessionScenario(
        "Two sources at once",
        "Two sounds of different classes and of the same mean power begin within 0.1 s of one another, at least 1.5 m "
        "apart. A session has two such pairs, one after the other. In the case *alone* only the first sound of each "
        "pair is played.",
        0.4,
        (SessionCase("alone", pairs=True, alone=True), SessionCase("two at once", pairs=True)),
    ),
    "walking": SessionScenario(
        "A talker who walks",
        "A person talks for about 9 s, with short pauses, and walks at 1 m/s from place to place, 1.5 m high and at "
        "least 1 m from the walls, or stands where the walk began.",
        0.6,
        (SessionCase("stands", walks=False), SessionCase("walks", walks=True)),
    ),
}
"""Scenarios through the whole fusion, by their names on the command line; each is a campaign of its own."""


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _rotation(axis: FloatArray, angle: float) -> FloatArray:
    """Return the matrix (3, 3) of a rotation about a unit axis (3,), by Rodrigues' formula; the angle is in radians."""
    cross = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
