"""The default localizer with one faulty array of three, a noise beside an array, two sources, or a walking talker.

`python benchmarks/robustness.py array --events DIR`, `beside`, `sources` or `walk`. The sounds are those of DCASE 2016
task 2, by default the development half. The results are in docs/accuracy/robustness.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from livessl.core.correlate.band import band_power
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.onset import Onset
from livessl.core.stream.activity import ActivityParameters, CausalActivity, exact_mask
from livessl.core.stream.fusion import Fusion
from livessl.core.stream.parameters import FusionParameters
from livessl.core.stream.site_state import SiteState
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, BoolArray, Float32Array, FloatArray, Frame, Track
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.paper import BAND_HZ, C_M_S, CLASSES, ROOM_M, pair, tetrahedron_in_cube
from livessl.lab.evaluate.unit import convolved
from livessl.simulation.moving import place_on_way, render_moving
from livessl.simulation.room import impulse_responses

RATE_HZ: Final = 16000.0
FRAME: Final = round(FRAME_S * RATE_HZ)
PRE_ROLL: Final = 8
LEAD_S: Final = 0.5
NEAR_M: Final = 0.5
CONFIDENT: Final = 0.8
THIRD_M: Final = np.array([1.5, 5.0, 2.0])
BESIDE_M: Final = 0.6
"""Distance, in metres, of the noise from the third array's centre: about 0.3 m from its nearest microphone."""

GRID: Final = Grid(((0.0, ROOM_M[0]), (0.0, ROOM_M[1]), (0.0, ROOM_M[2])), 0.1)

Clips = Mapping[str, Sequence[tuple[str, Float32Array]]]


def arrays() -> tuple[ArraySpec, ArraySpec, ArraySpec]:
    """Return the paper's pair 5 m apart, and a third array to its side."""
    third = THIRD_M + tetrahedron_in_cube(0.5) @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T
    return (*pair(np.array(ROOM_M) / 2.0, 1, 5), ArraySpec("c", third, BAND_HZ))


def turned(spec: ArraySpec, yaw_deg: float) -> ArraySpec:
    """Return an array as a site file with a wrong yaw describes it."""
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return ArraySpec(spec.name, (spec.microphones_m - spec.centre_m) @ rotation.T + spec.centre_m, spec.band_hz)


def responses_from(place_m: FloatArray, specs: Sequence[ArraySpec], rt60s_s: Sequence[float]) -> Float32Array:
    """Return the responses (R, K, n) from a position to all microphones."""
    microphones_m = np.vstack([spec.microphones_m for spec in specs])
    return impulse_responses(
        ROOM_M, place_m, microphones_m, rt60s_s, sample_rate_hz=RATE_HZ, c_m_s=C_M_S, own_lengths=True, compiled=True
    )


def recorded(wet: Float32Array, lead: int, snr_db: float, rng: np.random.Generator) -> Float32Array:
    """Add noise before and during the sound, and round to 16 bits with 6 dB of headroom."""
    samples = np.pad(wet, ((0, 0), (lead, 0)))
    if np.isfinite(snr_db):
        rms = np.sqrt(np.square(wet).mean(dtype=np.float64) * 10.0 ** (-snr_db / 10.0))
        samples = samples + (rms * rng.standard_normal(samples.shape)).astype(np.float32)
    return np.asarray(np.rint(samples * (16384.0 / np.abs(samples).max())) / 32768.0, dtype=np.float32)


def active_frames(samples: Float32Array) -> BoolArray:
    """Return which frames are active by the paper's rule, one mask for all channels: (F,)."""
    count = samples.shape[1] // FRAME
    squares = np.square(samples[:, : count * FRAME]).mean(axis=0, dtype=np.float64)
    return exact_mask(squares.reshape(count, FRAME).mean(axis=1))


def sounds_of(
    estimator: Onset, specs: Sequence[ArraySpec], samples: Float32Array, active: BoolArray
) -> dict[str, Sound]:
    """Prepare the arrays' sound of an event for an estimator, as the fusion does."""
    loud = np.flatnonzero(active)
    frames = range(max(0, int(loud[0]) - PRE_ROLL), int(loud[-1]) + 1)
    sounds = {}
    for spec, part in zip(specs, np.split(samples, len(specs)), strict=True):
        listener = estimator.onset_front_end(spec.name, RATE_HZ)
        moments = tuple(listener.push(part[:, k * FRAME : (k + 1) * FRAME], quiet=not active[k]) for k in frames)
        segment = part[:, frames[0] * FRAME : frames[-1] * FRAME + FRAME]
        sounds[spec.name] = Sound((segment,), RATE_HZ, moments, sources=2)
    return sounds


def row_of(label: str, errors_m: Sequence[float], located: Sequence[bool], named: Sequence[bool] | None = None) -> str:
    """Return one row of a table."""
    error, answered = np.array(errors_m), np.array(located)
    median = f"{np.median(error[answered]):.3f}" if answered.any() else "-"
    wrong, lost = np.mean(answered & (error > NEAR_M)), np.mean(~answered | (error > NEAR_M))
    naming = "" if named is None else f"{100 * np.mean(named):.0f} %"
    return f"| {label} | {len(error)} | {median} | {100 * wrong:.1f} % | {100 * lost:.1f} % | {naming} |"


def is_located(found: Localization) -> bool:
    """Return whether an event with this result would be published as located."""
    return found.refused is None and found.confidence >= CONFIDENT


def one_wrong_array(clips: Clips, positions: int, seed: int) -> None:
    """Compare three arrays, the third of them good, turned, moved or with a dead microphone, and two arrays only."""
    a, b, c = arrays()
    moved = ArraySpec("c", c.microphones_m + np.array([0.4, 0.3, 0.0]), BAND_HZ)
    believed = {"all good": [a, b, c], "turned by 30°": [a, b, turned(c, 30.0)], "moved by 0.5 m": [a, b, moved]}
    estimators = {name: Onset(specs, GRID, C_M_S) for name, specs in believed.items()}
    for rt60_s, snr_db in ((0.4, np.inf), (1.0, 10.0), (2.0, 10.0)):
        rows: dict[str, list[tuple[float, bool, bool]]] = {}
        for number in range(positions):
            rng = np.random.default_rng([seed, number])
            source_m = rng.uniform(0.0, 1.0, 3) * ROOM_M
            response = responses_from(source_m, (a, b, c), [rt60_s])[0]
            for ours in clips.values():
                wet = convolved(ours[int(rng.integers(len(ours)))][1], response)
                lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * RATE_HZ)
                samples = recorded(wet, lead, snr_db, rng)
                active = active_frames(samples)
                dead = samples.copy()
                dead[9] = np.rint(rng.standard_normal(samples.shape[1])) / 32768.0
                signals = {"": samples, "one microphone dead": dead}
                first = estimators["all good"]
                sounds = {name: sounds_of(first, [a, b, c], signal, active) for name, signal in signals.items()}
                for name, estimator in estimators.items():
                    _judge(rows.setdefault(name, []), estimator, sounds[""], source_m)
                    suspect = sounds[""] | {"c": replace(sounds[""]["c"], suspect=True)}
                    _judge(rows.setdefault(f"{name}, suspect", []), estimator, suspect, source_m)
                for name in list(signals)[1:]:
                    _judge(rows.setdefault(name, []), first, sounds[name], source_m)
                two = {name: sounds[""][name] for name in "ab"}
                _judge(rows.setdefault("none: two good ones only", []), first, two, source_m)
        print(f"\nRT60 {rt60_s:g} s, {'clean' if np.isinf(snr_db) else f'{snr_db:g} dB'}\n")
        print("| the third array | events | median (m) | wrong | lost | outlier |\n|---|---|---|---|---|---|")
        for name, each in rows.items():
            print(row_of(name, *map(list, zip(*each, strict=True))), flush=True)


def _judge(
    rows: list[tuple[float, bool, bool]], estimator: Onset, sounds: Mapping[str, Sound], source_m: FloatArray
) -> None:
    alone = {name: replace(sound, sources=1) for name, sound in sounds.items()}
    found = estimator.locate(alone)
    error_m = float(np.linalg.norm(found.position_m - source_m))
    rows.append((error_m, is_located(found), "c" in (found.outliers or ())))


def noise_beside(clips: Clips, positions: int, seed: int) -> None:
    """Place a fan or a talking radio beside the third array, as loud there as a sound elsewhere in the room."""
    specs = arrays()
    estimator = Onset(specs, GRID, C_M_S)
    print("| | events | sound located | noise located | only noise located | other positions |")
    print("|---|---|---|---|---|---|")
    for rt60_s in (0.4, 1.0):
        rows: dict[str, list[tuple[bool, bool, bool, bool]]] = {"nothing": [], "a fan": [], "a radio": []}
        for number in range(positions):
            rng = np.random.default_rng([seed, number])
            source_m, towards = rng.uniform(0.0, 1.0, 3) * ROOM_M, rng.standard_normal(3)
            while np.linalg.norm(source_m - THIRD_M) < 1.5:
                source_m = rng.uniform(0.0, 1.0, 3) * ROOM_M
            beside_m = THIRD_M + BESIDE_M * towards / np.linalg.norm(towards)
            response, near = (responses_from(place_m, specs, [rt60_s])[0] for place_m in (source_m, beside_m))
            for ours in clips.values():
                wet = convolved(ours[int(rng.integers(len(ours)))][1], response)
                lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * RATE_HZ)
                length = lead + wet.shape[1]
                talk = np.concatenate([clips["speech"][k][1] for k in rng.permutation(len(clips["speech"]))])
                goes_on = {
                    "a fan": rng.standard_normal(length, dtype=np.float32),
                    "a radio": np.resize(np.roll(talk, int(rng.integers(len(talk)))), length),
                }
                clear = recorded(wet, lead, 20.0, rng)
                active = active_frames(clear)
                for name, outcomes in rows.items():
                    samples = clear
                    if name in goes_on:
                        noise = convolved(goes_on[name], near)[:, :length]
                        level = np.sqrt(np.square(clear[8:, lead:]).mean() / np.square(noise[8:, lead:]).mean())
                        samples = np.asarray(0.5 * (clear + np.float32(level) * noise), dtype=np.float32)
                    found_m = _located(estimator, specs, samples, active)
                    errors = [[float(np.linalg.norm(p - at_m)) for at_m in (source_m, beside_m)] for p in found_m]
                    right, there = (any(error[k] < NEAR_M for error in errors) for k in (0, 1))
                    stray = any(min(error) >= NEAR_M for error in errors)
                    outcomes.append((right, there, there and not right, stray))
        for name, outcomes in rows.items():
            shares = " | ".join(f"{100 * share:.0f} %" for share in np.mean(outcomes, axis=0))
            print(f"| RT60 {rt60_s:g} s, {name} | {len(outcomes)} | {shares} |", flush=True)


def two_sources(clips: Clips, positions: int, seed: int) -> None:
    """Play two clips of different classes with equally loud frames within 0.1 s of each other, and one alone."""
    specs = arrays()[:2]
    estimator = Onset(specs, GRID, C_M_S)
    names = list(clips)
    print("| | events | both within 0.5 m | first | wrong second |\n|---|---|---|---|---|")
    for rt60_s, snr_db in ((0.4, np.inf), (0.4, 10.0), (1.0, np.inf), (2.0, np.inf), (2.0, 10.0)):
        both: list[bool] = []
        first: list[bool] = []
        wrong: list[bool] = []
        ghosts: list[bool] = []
        for number in range(positions):
            rng = np.random.default_rng([seed, number])
            places_m = rng.uniform(0.0, 1.0, (2, 3)) * ROOM_M
            while np.linalg.norm(places_m[0] - places_m[1]) < 1.5:
                places_m[1] = rng.uniform(0.0, 1.0, 3) * ROOM_M
            responses = [responses_from(place_m, specs, [rt60_s])[0] for place_m in places_m]
            for k, name in enumerate(names):
                pool = clips[name], clips[names[(k + 1 + int(rng.integers(3))) % 4]]
                wets = [
                    convolved(ours[int(rng.integers(len(ours)))][1], r) for ours, r in zip(pool, responses, strict=True)
                ]
                wets = [wet / np.float32(loudest_rms(wet)) for wet in wets]
                late = int(rng.uniform(0.0, 0.1) * RATE_HZ)
                starts = (0, late) if rng.random() < 0.5 else (late, 0)
                length = max(start + wet.shape[1] for start, wet in zip(starts, wets, strict=True))
                mixed = np.zeros((8, length), dtype=np.float32)
                for start, wet in zip(starts, wets, strict=True):
                    mixed[:, start : start + wet.shape[1]] += wet
                lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * RATE_HZ)
                found = _located(estimator, specs, recorded(mixed, lead, snr_db, rng))
                errors = [[float(np.linalg.norm(p - place_m)) for place_m in places_m] for p in found]
                first.append(bool(errors) and min(errors[0]) < NEAR_M)
                right = len(found) == 2 and min(max(errors[0][i], errors[1][1 - i]) for i in (0, 1)) < NEAR_M
                both.append(right)
                wrong.append(len(found) == 2 and not right)
                ghosts.append(len(_located(estimator, specs, recorded(wets[0], lead, snr_db, rng))) == 2)
        label = f"RT60 {rt60_s:g} s, {'clean' if np.isinf(snr_db) else f'{snr_db:g} dB'}"
        shares = [f"{100 * np.mean(each):.1f} %" for each in (both, first, wrong)]
        print(f"| {label}, two | {len(both)} | {' | '.join(shares)} |")
        print(f"| {label}, one | {len(ghosts)} | | | {100 * np.mean(ghosts):.1f} % |", flush=True)


def loudest_rms(wet: Float32Array) -> float:
    """Return the RMS of the loudest 50 ms over all microphones."""
    count = wet.shape[1] // FRAME
    return float(np.sqrt(np.square(wet[:, : count * FRAME]).mean(axis=0).reshape(count, FRAME).mean(axis=1).max()))


def _located(
    estimator: Onset, specs: Sequence[ArraySpec], samples: Float32Array, active: BoolArray | None = None
) -> list[FloatArray]:
    found = estimator.locate(sounds_of(estimator, specs, samples, active_frames(samples) if active is None else active))
    first = [found.position_m] if is_located(found) else []
    return [*first, *(other.position_m for other in found.others)]


def walks(clips: Clips, count: int, seed: int, rt60_s: float, live_sources: int, talkers: int) -> None:
    """Track talkers that walk straight across the room at 1 m/s by the fusion."""
    specs = arrays()[:2]
    print("| walk | states of tracks | RMSE (m) | tracks | share of the longest |\n|---|---|---|---|---|")
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        recordings, ways = [], []
        for _ in range(talkers):
            order = rng.permutation(len(clips["speech"]))
            talk = np.concatenate([clips["speech"][k][1] for k in order])[: round(6.0 * RATE_HZ)]
            low, high = np.array([0.8, 0.8, 1.4]), np.array([7.2, 9.2, 1.8])
            start_m, towards_m = rng.uniform(low, high), rng.uniform(low, high)
            while np.linalg.norm(towards_m - start_m) < len(talk) / RATE_HZ:
                start_m, towards_m = rng.uniform(low, high), rng.uniform(low, high)
            end_s = float(np.linalg.norm(towards_m - start_m))
            ways.append(([0.0, end_s], [start_m, towards_m]))
            microphones_m = np.vstack([spec.microphones_m for spec in specs])
            wet = render_moving(
                talk, *ways[-1], microphones_m, room_size_m=ROOM_M, rt60_s=rt60_s, sample_rate_hz=RATE_HZ,
                c_m_s=C_M_S, compiled=True,
            )  # fmt: skip
            recordings.append(wet / np.float32(loudest_rms(wet)))
        length = max(wet.shape[1] for wet in recordings)
        mixed = sum(np.pad(wet, ((0, 0), (0, length - wet.shape[1]))) for wet in recordings)
        lead = round(1.0 * RATE_HZ)
        tracks = _tracks(specs, recorded(np.asarray(mixed), lead, 30.0, rng), live_sources)
        for talker in range(talkers):
            mine: dict[int, list[float]] = {}
            for track in tracks:
                at_s = (
                    track.time_ns / 1e9 - LEAD_NS / 1e9 - lead / RATE_HZ - 0.012
                )  # about the travel time to the arrays
                errors = [float(np.linalg.norm(place_on_way(*each, [at_s])[0] - track.position_m)) for each in ways]
                if int(np.argmin(errors)) == talker:
                    mine.setdefault(track.id, []).append(errors[talker])
            every = [error for errors in mine.values() for error in errors]
            longest = max(mine.values(), key=len, default=[])
            share = len(longest) / max(1, len(every))
            rmse = np.sqrt(np.mean(np.square(every))) if every else np.nan
            print(f"| {number}.{talker} | {len(every)} | {rmse:.3f} | {len(mine)} | {share:.2f} |", flush=True)


LEAD_NS: Final = 20 * 1_700_000_000 * FRAME_NS
"""Site time at which a recording begins."""


def _tracks(specs: Sequence[ArraySpec], samples: Float32Array, live_sources: int) -> list[Track]:
    fusion = Fusion(SiteState("walk", specs, Onset(specs, GRID, C_M_S), FusionParameters(live_sources=live_sources)))
    gates = [CausalActivity(ActivityParameters()) for _ in specs]
    tracks: list[Track] = []
    for k in range(samples.shape[1] // FRAME):
        frames = []
        for spec, gate, part in zip(specs, gates, np.split(samples, len(specs)), strict=True):
            piece = np.ascontiguousarray(part[:, k * FRAME : (k + 1) * FRAME])
            power = float(band_power(piece, RATE_HZ, BAND_HZ).mean())
            frame_index = LEAD_NS // FRAME_NS + k
            frames.append(
                Frame(spec.name, k + 1, frame_index, frame_index * FRAME_NS, RATE_HZ, piece, power, gate.push(power))
            )
        outputs = fusion.step(frames, (frame_index + 1) * FRAME_NS)
        tracks += [output for output in outputs if isinstance(output, Track)]
    return tracks


def main() -> None:
    """Run one of the four experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("array", "beside", "sources", "walk"))
    parser.add_argument("--events", type=Path, required=True, help="folder of DCASE 2016 task 2 clips")
    parser.add_argument("--positions", type=int, default=30, help="number of positions or walks")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--half", choices=("development", "test"), default="development")
    parser.add_argument("--rt60", type=float, default=0.6, help="reverberation time of the walks, in seconds")
    parser.add_argument("--live-sources", type=int, choices=(1, 2), default=1, help="sources per window in the walks")
    parser.add_argument("--talkers", type=int, choices=(1, 2), default=1, help="talkers in the walks")
    given = parser.parse_args()
    first = ("development", "test").index(given.half)
    clips = {name: each[first::2] for name, each in read_clips(given.events, CLASSES, RATE_HZ).items()}
    if given.what == "array":
        one_wrong_array(clips, given.positions, given.seed)
    elif given.what == "beside":
        noise_beside(clips, given.positions, given.seed)
    elif given.what == "sources":
        two_sources(clips, given.positions, given.seed)
    else:
        walks(clips, given.positions, given.seed, given.rt60, given.live_sources, given.talkers)


if __name__ == "__main__":
    main()
