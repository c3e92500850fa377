"""Sounds for `benchmarks/second_source.py`: one source or two, in simulated rooms, some of them described wrongly.

Arrays are where the site file says in half of the cases. In the others they are off by the default `Uncertainty`, and
so is the speed of sound.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import yaml
from scipy.fft import irfft, next_fast_len, rfft

from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import ArraySpec, Float32Array, FloatArray, Uncertainty
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.unit import PEAK, Clips, convolved
from livessl.simulation.room import impulse_responses
from livessl.site.load import parse_site
from livessl.site.models import Site

RATE_HZ: Final = 16000.0
C_M_S: Final = 343.0
BAND_HZ: Final = (100.0, 6000.0)

ROOMS: Final[Mapping[str, Sequence[tuple[tuple[float, float, float], float]]]] = {
    "development": (((8.0, 10.0, 4.0), 0.4), ((5.2, 4.1, 2.7), 0.3), ((6.5, 7.4, 3.0), 0.6)),
    "test": (((7.1, 9.3, 3.6), 0.4), ((4.4, 6.1, 2.5), 0.35), ((9.2, 7.3, 3.4), 0.7)),
}
"""Size in metres and reverberation time in seconds of each half's rooms."""

LAYOUTS: Final = ("two", "four", "pairs", "frames")
"""Two or four tetrahedra of 0.5 m; four frames of two pairs of microphones a metre apart, each pair as an array, or
each frame as one array whose two devices have clocks of their own."""

TURNS: Final = ("two", "one", "two", "one", "near", "fan", "one", "talker")
"""Kinds of sounds in turn; `near` are two sounds at once, too near to one another to be told apart."""

LEAD_S: Final = 1.2
"""Time, in seconds, before the sound: noise, fan or talker alone."""

END_S: Final = 1.0
"""Time after the reverberation of the sound, in seconds."""

TOGETHER_S: Final = 0.1
"""Longest time, in seconds, between the starts of two sounds at once."""

APART_M: Final = 1.5
"""Least distance, in metres, between two sources."""

CLOSE_M: Final = (0.4, 0.95)
"""Least and greatest distance, in metres, between two that are near to one another."""

WALL_M: Final = 0.3
"""Least distance, in metres, of a source from walls, floor and ceiling."""

SNR_DB: Final = (15.0, 30.0)
"""Least and greatest level of a sound's mean power above the noise of the microphones."""

BELOW_DB: Final = (18.0, 36.0)
"""Least and greatest level of a sound's mean power above that of the fan or talker."""

LOUDER_DB: Final = 3.0
"""Greatest difference in level between two sounds at once."""

CLAP_S: Final = (0.002, 0.01)
"""Shortest and longest time constant of the made-up claps, in seconds: bursts of noise that decay."""


@dataclass(frozen=True, slots=True)
class Case:
    """A sound as it was played.

    Parameters
    ----------
    site : Site
        The arrays as the site file describes them.
    samples : mapping of array name to (K, n) float32
    truths_m : (N, 3) float64
        Places of the sounds, the first of which is always played.
    sample_rate_hz : float
    """

    site: Site
    samples: Mapping[str, Float32Array]
    truths_m: FloatArray
    sample_rate_hz: float


def layout(name: str, size_m: FloatArray) -> list[ArraySpec]:
    """Return the arrays of a layout in a room."""
    if name in ("two", "four"):
        shares = ([0.5, 0.22, 0.45], [0.5, 0.78, 0.55], [0.2, 0.55, 0.6], [0.8, 0.45, 0.4])
        return [
            ArraySpec(f"t{k}", posed(tetrahedron(0.5), tuple(share * size_m), 70.0 * k), BAND_HZ)
            for k, share in enumerate(np.array(shares[: 2 if name == "two" else 4]))
        ]
    corners = ([0.12, 0.14], [0.7, 0.16], [0.68, 0.8], [0.14, 0.78])
    specs = []
    for k, (x, y) in enumerate(corners):
        corner_m = np.array([x * size_m[0], y * size_m[1], 0.25 * size_m[2]])
        places_m = corner_m + np.array([[0.015, 0, 0], [1.01, 0, 0], [0, 0, 0], [0, 0, 1.01]])
        if name == "frames":
            specs.append(ArraySpec(f"f{k}", places_m, BAND_HZ))
        else:
            specs += [ArraySpec(f"p{k}{n}", places_m[n : n + 2], BAND_HZ) for n in (0, 2)]
    return specs


def site_of(name: str, specs: Sequence[ArraySpec], size_m: Sequence[float], rng: np.random.Generator | None) -> Site:
    """Return a site file's description of the arrays, exact or off by the default `Uncertainty`."""
    arrays = {}
    for spec in specs:
        places_m = spec.microphones_m
        if rng is not None:
            known = Uncertainty()
            axis = rng.standard_normal(3)
            turn = np.radians(known.orientation_deg) * rng.standard_normal() * axis / np.linalg.norm(axis)
            centred_m = places_m - spec.centre_m
            places_m = places_m + np.cross(turn, centred_m) + known.position_m * rng.standard_normal(3)
        arrays[spec.name] = {"microphones_m": places_m.round(4).tolist(), "band_hz": list(BAND_HZ)}
    warmer_c = 0.0 if rng is None else Uncertainty().temperature_c * rng.standard_normal()
    speed_m_s = C_M_S * (1.0 + 0.5 * warmer_c / 293.0)
    return parse_site(
        yaml.safe_dump(
            {"site": name, "room": {"size_m": list(size_m)}, "speed_of_sound_m_s": float(speed_m_s), "arrays": arrays}
        )
    )


def turn(number: int) -> tuple[str, str]:
    """Return the kind of sound and the layout of a case."""
    return TURNS[number % len(TURNS)], LAYOUTS[(number // 8 + number) % 4]


def simulated(clips: Clips, half: str, seed: int, numbers: Iterable[int]) -> Iterator[tuple[dict[str, Any], Case]]:
    """Simulate cases; room, layout and kind take turns, so that any stretch of numbers has all of them."""
    for number in numbers:
        rng = np.random.default_rng([seed, number, HALVES.index(half)])
        kind, name = turn(number)
        size_m, rt60_s = ROOMS[half][(number // 32 + number // 8 + number) % 3]
        exact = bool((number // 3) % 2)
        specs = layout(name, np.array(size_m))
        site = site_of(f"case{number}", specs, size_m, None if exact else rng)
        truths_m, samples = _played(clips, kind, specs, size_m, rt60_s, rng, clocks=name == "frames" and not exact)
        parts = np.split(samples, np.cumsum([len(spec.microphones_m) for spec in specs])[:-1])
        head = {"number": number, "kind": kind, "layout": name, "rt60_s": rt60_s, "volume_m3": float(np.prod(size_m))}
        by_array = dict(zip((spec.name for spec in specs), parts, strict=True))
        yield head | {"exact": exact}, Case(site, by_array, truths_m, RATE_HZ)


def _played(
    clips: Clips,
    kind: str,
    specs: Sequence[ArraySpec],
    size_m: Sequence[float],
    rt60_s: float,
    rng: np.random.Generator,
    *,
    clocks: bool,
) -> tuple[FloatArray, Float32Array]:
    """Play one case: the true places, and the samples of all microphones."""
    places_m = _places_m(specs, np.array(size_m), rng, near=kind == "near")
    names = rng.permutation([*clips, "clap"])
    wets = [
        _response_to(_dry(clips, name, rng), place_m, specs, size_m, rt60_s)
        for name, place_m in zip(names, places_m, strict=False)
    ]
    late = round(rng.uniform(0.0, TOGETHER_S) * RATE_HZ)
    louder_db, snr_db, below_db = rng.uniform(-LOUDER_DB, LOUDER_DB), rng.uniform(*SNR_DB), rng.uniform(*BELOW_DB)
    begin = round((LEAD_S + rng.uniform(0.0, 0.05)) * RATE_HZ)
    length = begin + max(wet.shape[1] for wet in wets) + late + round(END_S * RATE_HZ)
    samples = np.zeros((len(wets[0]), length), dtype=np.float32)
    samples[:, begin : begin + wets[0].shape[1]] += wets[0]
    count = 1
    if kind in ("two", "near"):
        count = 2
        first = begin + late
        samples[:, first : first + wets[1].shape[1]] += np.float32(10.0 ** (louder_db / 20.0)) * wets[1]
    if kind in ("fan", "talker"):
        dry = rng.standard_normal(length, dtype=np.float32)
        if kind == "talker":
            talk = [clips["speech"][k][1] for k in rng.permutation(len(clips["speech"]))]
            dry = np.resize(np.concatenate([one / _rms(one) for one in talk]), length)
        ongoing = _response_to(dry, places_m[1], specs, size_m, rt60_s)[:, :length]
        samples += np.float32(10.0 ** (-below_db / 20.0)) * ongoing
    samples += np.float32(10.0 ** (-snr_db / 20.0)) * rng.standard_normal(samples.shape, dtype=np.float32)
    if clocks:
        samples = _delayed(samples, _clock_errors_s(specs, rng))
    samples = np.rint(samples * (PEAK * 2.0**15 / np.abs(samples).max())) / np.float32(2.0**15)
    return places_m[:count], np.asarray(samples, dtype=np.float32)


def _places_m(specs: Sequence[ArraySpec], size_m: FloatArray, rng: np.random.Generator, *, near: bool) -> FloatArray:
    """Draw two places apart from one another or `near`, and not next to a microphone."""
    microphones_m = np.vstack([spec.microphones_m for spec in specs])
    least_m, most_m = CLOSE_M if near else (APART_M, np.inf)
    while True:
        places_m = rng.uniform(WALL_M, size_m - WALL_M, (2, 3))
        nearest_m = np.linalg.norm(places_m[:, None] - microphones_m, axis=2).min()
        if least_m <= apart_m(places_m[0], places_m[1]) <= most_m and nearest_m >= WALL_M:
            return np.asarray(places_m)


def _dry(clips: Clips, name: str, rng: np.random.Generator) -> Float32Array:
    """Draw a clip of a class, or make a clap."""
    if name in clips:
        return clips[name][int(rng.integers(len(clips[name])))][1]
    lasts_s = rng.uniform(*CLAP_S)
    time_s = np.arange(round(8.0 * lasts_s * RATE_HZ)) / RATE_HZ
    return np.asarray(rng.standard_normal(len(time_s)) * np.exp(-time_s / lasts_s), dtype=np.float32)


def _response_to(
    dry: Float32Array, place_m: FloatArray, specs: Sequence[ArraySpec], size_m: Sequence[float], rt60_s: float
) -> Float32Array:
    """Return a sound at all microphones, with a mean power of 1."""
    (responses,) = impulse_responses(
        size_m,
        place_m,
        np.vstack([spec.microphones_m for spec in specs]),
        [rt60_s],
        sample_rate_hz=RATE_HZ,
        c_m_s=C_M_S,
        own_lengths=True,
        compiled=True,
    )
    wet = convolved(dry, responses)
    return np.asarray(wet / _rms(wet), dtype=np.float32)


def _rms(samples: Float32Array) -> np.float32:
    return np.float32(np.sqrt(np.square(samples).mean(dtype=np.float64)))


def _clock_errors_s(specs: Sequence[ArraySpec], rng: np.random.Generator) -> FloatArray:
    """Draw the clock error of each device, seconds: the second pair of every frame has a device of its own."""
    return np.concatenate([[0.0, 0.0, *np.repeat(Uncertainty().clock_s * rng.standard_normal(), 2)] for _ in specs])


def _delayed(samples: Float32Array, by_s: FloatArray) -> Float32Array:
    """Delay each channel by a fraction of a sample."""
    size = next_fast_len(samples.shape[1] + 256, real=True)
    turns = np.exp(-2j * np.pi * np.fft.rfftfreq(size, 1.0 / RATE_HZ) * by_s[:, None])
    return np.asarray(irfft(rfft(samples, size, axis=1) * turns, size, axis=1)[:, : samples.shape[1]], dtype=np.float32)


def apart_m(one_m: FloatArray, other_m: FloatArray) -> float:
    """Return the distance between two places, in metres."""
    return float(np.linalg.norm(one_m - other_m))
