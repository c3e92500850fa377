"""Signal-to-noise ratio that an enhanced clip gains over the best single microphone.

`python benchmarks/clips.py [--positions N] [--seed S] [--write docs/accuracy/clips.md]` simulates, in a room of
8 x 10 x 4 m with two tetrahedra 5 m apart, the project's own sounds at random places. Reverberation times are 0.4 and
1 s. Noise is white (independent in each microphone) or diffuse (isotropic in three dimensions), at 10 and 0 dB.
The place that is given to the beams is wrong by a random vector (`PLACE_STD_M`).

How it is measured: the weights are computed from the mixture alone. The same weights are then applied to three parts of
the mixture: the sound with its reflections of the first 50 ms (`early`), the later reverberation (`late`), and the
noise. `SNR` is early over noise, `SNIR` early over noise and late together, both in the arrays' band and while the
sound lasts. The best microphone is the one with the greatest ratio of the same kind among all eight; the given 10 and
0 dB are its SNR. No spectral weighting follows the beams: each frequency keeps the level that the sound has there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import butter, oaconvolve, sosfilt
from tqdm import tqdm

from livessl.core.enhance.beam import ArraySound, Method
from livessl.core.enhance.enhance import Enhancement, plan
from livessl.core.geometry import tetrahedron
from livessl.core.types import ArraySpec, Float32Array, FloatArray
from livessl.simulation.room import impulse_responses
from livessl.simulation.scene import NamedSound, Source, make_scene, synthesised_sounds

ROOM_M: Final = (8.0, 10.0, 4.0)
CENTRES_M: Final = ((4.0, 2.5, 2.0), (4.0, 7.5, 2.0))
EDGE_M: Final = 0.5
BAND_HZ: Final = (100.0, 6000.0)
RATE_HZ: Final = 16000
C_M_S: Final = 343.0
RT60S_S: Final = (0.4, 1.0)
SNRS_DB: Final = (10.0, 0.0)
NOISES: Final = ("white", "diffuse")
METHODS: Final[tuple[Method, ...]] = ("delay-and-sum", "mvdr")
EARLY_S: Final = 0.05
"""Reflections up to this time after the direct sound count as sound: they help a listener (ISO 3382-1, C50)."""
PRE_ROLL_S: Final = 0.4
"""Quiet before the sound, as long as the nodes' pre-roll."""
TAIL_S: Final = 0.3
"""Length of the recording after the sound, as long as the nodes' hang-over."""
PLACE_STD_M: Final = 0.1
"""Standard deviation of the place's error on each axis, metres."""
CLOCK_STD_S: Final = 0.003
"""Standard deviation of the second array's clock, seconds: nodes set by NTP."""


AIMS_DB: Final = (6.0, 3.0)
"""Median gain that is aimed at in each of the rooms."""

HEAD: Final = """\
# How much clearer enhanced sound is

This page compares the [enhanced signal](../clips.md#the-enhanced-signal) of an event with the best single microphone,
simulated in a room of 8 x 10 x 4 m with two tetrahedra of 0.5 m, 5 m apart. {positions} sounds (doors, keys, phones,
voices, all synthesised) are at random places for each reverberation time; the place given to the beams is off by
{place_m:g} m (standard deviation) on each axis, and the second array's clock by 3 ms. The column *SNR* is the
ratio at the best microphone; *both arrays* is the share of sounds for which the beams of both arrays were added.
`python benchmarks/clips.py --positions {positions} --seed {seed} --write docs/accuracy/clips.md`
writes this page; the first lines of that program say how it measures. Constants were chosen with other scenes, of
seed 1.

The SNR is the ratio of the sound with its reflections of the first {early_ms} ms to the noise; the SNIR is its ratio to
noise and later reverberation together. Both are taken in the band of 100 to 6000 Hz while the sound lasts. The weights
are computed from the mixture alone and then applied to the parts. Gains in dB: median (10th to 90th percentile of the
sounds).

| RT60 | noise | SNR | SNR: delay-and-sum | **SNR: the clips** | SNIR: delay-and-sum | SNIR: the clips | both arrays |
|---|---|---|---|---|---|---|---|"""

TAIL: Final = """
Over all kinds of noise and ratios, the SNR gain of the clips' beams against what was aimed at:

| RT60 | aim | median | |
|---|---|---|---|
{summary}

Four microphones of equal noise can gain 6 dB over their mean, and a second array that is as near as the first 3 dB
more. The gain over the best microphone is smaller, because that microphone is better than the mean of its array, and
because one array is mostly nearer than the other. In long reverberation at 0 dB the beams of two arrays often do not
correlate enough to be aligned; the better one is then alone.
"""


@dataclass(frozen=True)
class Scene:
    """The parts of what all microphones receive of one sound: (8, n) each, in the order of the arrays."""

    name: str
    position_m: FloatArray
    early: Float32Array
    late: Float32Array
    duration_s: float

    @property
    def sound_s(self) -> tuple[float, float]:
        """When the direct sound reaches the first and leaves the last microphone, in seconds."""
        far_s = np.linalg.norm(microphones_m() - self.position_m, axis=1) / C_M_S
        return PRE_ROLL_S + float(far_s.min()), PRE_ROLL_S + float(far_s.max()) + self.duration_s


def specs() -> tuple[ArraySpec, ...]:
    """Return the two arrays."""
    return tuple(
        ArraySpec(name, tetrahedron(EDGE_M) + np.array(centre), BAND_HZ)
        for name, centre in zip(("north", "south"), CENTRES_M, strict=True)
    )


def microphones_m() -> FloatArray:
    """Return all microphones (8, 3)."""
    return np.concatenate([spec.microphones_m for spec in specs()])


def placed(sounds: Sequence[NamedSound], count: int, rt60_s: float, seed: int) -> Iterator[tuple[Source, Float32Array]]:
    """Yield sounds at random places, and the impulse responses (8, L) from there to all microphones."""
    made = make_scene(
        ROOM_M, rt60_s=rt60_s, sounds=sounds, count=count, sample_rate_hz=RATE_HZ, c_m_s=C_M_S,
        keep_away_m=np.array(CENTRES_M), seed=seed,
    )  # fmt: skip
    for source in made.sources:
        (responses,) = impulse_responses(
            ROOM_M, source.position_m, microphones_m(), [rt60_s], sample_rate_hz=RATE_HZ, c_m_s=C_M_S, compiled=True
        )
        yield source, responses


def scenes(positions: int, rt60_s: float, seed: int) -> Iterator[Scene]:
    """Yield sounds at random places in a room."""
    for source, responses in placed(synthesised_sounds(RATE_HZ, seed), positions, rt60_s, seed):
        direct_s = np.linalg.norm(microphones_m() - source.position_m, axis=1) / C_M_S
        edges = np.round((direct_s + EARLY_S) * RATE_HZ).astype(int)
        is_early = np.arange(responses.shape[1]) < edges[:, None]
        count = round((PRE_ROLL_S + TAIL_S + float(direct_s.max())) * RATE_HZ) + len(source.sound)
        early, late = (_received(part * responses, source.sound, count) for part in (is_early, ~is_early))
        yield Scene(source.name, source.position_m, early, late, len(source.sound) / RATE_HZ)


def _received(responses: FloatArray | Float32Array, sound: Float32Array, count: int) -> Float32Array:
    first = round(PRE_ROLL_S * RATE_HZ)
    wet = oaconvolve(responses, sound[None], axes=1)[:, : count - first]
    received = np.zeros((len(responses), count), dtype=np.float32)
    received[:, first : first + wet.shape[1]] = wet
    return received


def noise(kind: str, count: int, rng: np.random.Generator) -> FloatArray:
    """Return noise (8, count) of equal power in all microphones: white, or with the coherence of a diffuse field."""
    white = rng.standard_normal((len(microphones_m()), count))
    if kind == "white":
        return white
    spectra = np.fft.rfft(white, axis=1)
    mixing = _mixing()[np.round(np.linspace(0, len(_mixing()) - 1, spectra.shape[1])).astype(int)]
    return np.fft.irfft(np.einsum("fkl,lf->kf", mixing, spectra), count, axis=1)


@cache
def _mixing() -> FloatArray:
    """Return the square roots (4096, 8, 8) of the coherence sinc(2 f d / c) of a diffuse field, by frequency."""
    apart_m = np.linalg.norm(microphones_m()[:, None] - microphones_m(), axis=2)
    frequencies_hz = np.linspace(0.0, RATE_HZ / 2.0, 4096)
    values, vectors = np.linalg.eigh(np.sinc(2.0 * frequencies_hz[:, None, None] * apart_m / C_M_S))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.transpose(0, 2, 1))


def in_band_power(signals: FloatArray | Float32Array, span_s: tuple[float, float]) -> FloatArray:
    """Return the mean powers of signals (..., n) in the arrays' band and a span of time."""
    band = butter(4, BAND_HZ, "bandpass", fs=RATE_HZ, output="sos")
    begin, end = (round(at_s * RATE_HZ) for at_s in span_s)
    return np.asarray(np.square(sosfilt(band, signals, axis=-1)[..., begin:end]).mean(axis=-1))


def ratio_db(sound: Any, noise_power: Any) -> FloatArray:
    """Return a ratio of powers in dB."""
    return np.asarray(10.0 * np.log10(sound / noise_power))


def array_sounds(mixture: Float32Array, scene: Scene, clock_s: float) -> list[ArraySound]:
    """Return what the arrays recorded; the second one's clock is ahead by `clock_s`."""
    found, count = [], mixture.shape[1]
    begin = round((scene.sound_s[0] - 0.01) * RATE_HZ)
    for number, (spec, samples) in enumerate(zip(specs(), np.split(mixture, 2), strict=True)):
        at = np.arange(count)
        quiet, sound = at < begin, (at >= begin) & (at < round((scene.sound_s[1] + 0.1) * RATE_HZ))
        time_ns = round(1e9 * clock_s) if number else 0
        found.append(ArraySound(spec, time_ns, RATE_HZ, samples, np.ones(count, dtype=np.bool_), quiet, sound))
    return found


def gains_db(scene: Scene, kind: str, snr_db: float, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Return the gains of each method in one mixture, by the kind of ratio."""
    hiss = noise(kind, scene.early.shape[1], rng)
    loudest = in_band_power(scene.early, scene.sound_s) / in_band_power(hiss, scene.sound_s)
    hiss = (hiss * np.sqrt(loudest.max() / 10.0 ** (snr_db / 10.0))).astype(np.float32)
    mixture = scene.early + scene.late + hiss
    place_m = scene.position_m + PLACE_STD_M * rng.standard_normal(3)
    sounds = array_sounds(mixture, scene, CLOCK_STD_S * rng.standard_normal())
    early, late, quiet = (in_band_power(part, scene.sound_s) for part in (scene.early, scene.late, hiss))
    best = {"SNR": ratio_db(early, quiet).max(), "SNIR": ratio_db(early, quiet + late).max()}
    found: dict[str, dict[str, float]] = {}
    for method in METHODS:
        made = plan(sounds, place_m, C_M_S, method)
        early, late, quiet = (_power_of(made, part, scene) for part in (scene.early, scene.late, hiss))
        reached = {"SNR": ratio_db(early, quiet), "SNIR": ratio_db(early, quiet + late)}
        found[method] = {name: float(reached[name] - best[name]) for name in best}
        found[method]["arrays"] = float(sum(part.share > 0 for part in made.parts))
    return found


def _power_of(made: Enhancement, part: Float32Array, scene: Scene) -> FloatArray:
    by_array = {spec.name: samples for spec, samples in zip(specs(), np.split(part, 2), strict=True)}
    begin_s = PRE_ROLL_S - made.time_ns / 1e9  # the clip's axis is that of emission
    return in_band_power(made.apply(by_array), (begin_s, begin_s + scene.duration_s))


def medians(positions: int, seed: int) -> list[dict[str, Any]]:
    """Return one row for each room, kind of noise and ratio: the gains of all its sounds, by method and kind."""
    rows = []
    for rt60_s in RT60S_S:
        rooms = list(tqdm(scenes(positions, rt60_s, seed), f"RT {rt60_s:g} s", positions, leave=False))
        for kind, snr_db in ((kind, snr_db) for kind in NOISES for snr_db in SNRS_DB):
            rng = np.random.default_rng([seed, round(10 * rt60_s), NOISES.index(kind), round(snr_db)])
            each = [gains_db(scene, kind, snr_db, rng) for scene in rooms]
            rows.append({"rt60_s": rt60_s, "noise": kind, "snr_db": snr_db, "gains_db": each})
    return rows


def report(rows: Sequence[Mapping[str, Any]], positions: int, seed: int) -> str:
    """Return the page of the results."""
    lines = [HEAD.format(positions=positions, seed=seed, early_ms=round(1e3 * EARLY_S), place_m=PLACE_STD_M)]
    for row in rows:
        cells = [f"{row['rt60_s']:g} s", row["noise"], f"{row['snr_db']:g} dB"]
        for method, ratio in ((method, ratio) for ratio in ("SNR", "SNIR") for method in METHODS):
            low, middle, high = np.percentile([each[method][ratio] for each in row["gains_db"]], [10, 50, 90])
            cells.append(f"{middle:.1f} ({low:.1f} to {high:.1f})")
        both = np.mean([each["mvdr"]["arrays"] for each in row["gains_db"]]) - 1.0
        lines.append(f"| {' | '.join(cells)} | {100 * both:.0f} % |")
    return "\n".join(lines) + "\n" + TAIL.format(summary=summary(rows))


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the medians over all kinds of noise and ratios of each room, against their aims."""
    found = []
    for rt60_s, aim_db in zip(RT60S_S, AIMS_DB, strict=True):
        gains = [each["mvdr"]["SNR"] for row in rows if row["rt60_s"] == rt60_s for each in row["gains_db"]]
        middle = float(np.median(gains))
        word = "reached" if middle >= aim_db else "missed"
        found.append(f"| {rt60_s:g} s | {aim_db:g} dB | {middle:.2f} dB | {word} |")
    return "\n".join(found)


def main() -> None:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--positions", type=int, default=40, help="sounds in each room (default: 40)")
    parser.add_argument("--seed", type=int, default=2, help="seed of places, sounds and noise (default: 2)")
    parser.add_argument("--write", type=Path, help="file for the page")
    arguments = parser.parse_args()
    page = report(medians(arguments.positions, arguments.seed), arguments.positions, arguments.seed)
    print(page)
    if arguments.write is not None:
        arguments.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
