"""The localizer's own campaign: `onset` against the paper's standard in many scenarios; fit of the confidence.

The clips of each class are divided in the order of their names: the first, third, … are for development, the others for
tests. Positions depend on the seed. All cases of a position share its responses and recordings. The module draws no
figure and writes no report.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.geometry import angle_deg
from livessl.core.locate.estimator import Estimator, Localization, Sound, create
from livessl.core.stream.activity import exact_mask, runs
from livessl.core.stream.verdict import judged
from livessl.core.types import FRAME_S, ArraySpec, BoolArray, Float32Array, FloatArray
from livessl.lab.evaluate.paper import C_M_S, EXPERIMENTS, ROOM_M
from livessl.lab.evaluate.parquet import NAME
from livessl.lab.evaluate.scenarios import ARRAYS, HALVES, LOCALIZER, ROOMS, SCENARIOS, TWO, Case
from livessl.lab.evaluate.unit import PEAK, Clips, Row, convolved
from livessl.simulation.room import impulse_responses

METHODS: Final = ("srp-phat", "onset")
"""The paper's standard, and the default."""

RT60S_S: Final = (0.0, 0.4, 1.0, 2.0)
SNRS_DB: Final = (float("inf"), 20.0, 10.0)
SPACING_M: Final = 0.1
"""Spacing, in metres, of the grid that `srp-phat` searches before it refines."""

POSITIONS: Final = 200
"""Number of positions by default."""

LEAD_S: Final = 0.5
"""Noise, in seconds, before the sound: the material of the pre-roll."""

PRE_ROLL_FRAMES: Final = 8
"""Frames before the first active one that a node sends by default: 0.4 s."""

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        *((name, NAME) for name in ("case", "method", "sound", "clip")),
        *((name, pa.float32()) for name in ("rt60_s", "snr_db", "active_s")),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "bearing_deg", "mahalanobis2")),
        ("status", NAME),
        ("outvoted", NAME),
        *((name, pa.float32()) for name in ("confidence", "margin", "standing")),
    ]
)
"""One row per event, condition, case and method. `bearing_deg` is the error of the direction from the nearest array,
`mahalanobis2` the squared error in units of the covariance. `margin` and `standing` are the features of `onset`'s
confidence, so that its constants can be fitted again without another run. `outvoted` names the outlier arrays."""

_NOISE, _POSE = 1, 2
"""Keys of the random streams of noise and of poses, so that a case gets the same draws whatever other cases are run."""


@dataclass(frozen=True, slots=True)
class LocalizerSettings:
    """All settings that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Number of positions of the source, anywhere in the paper's room; each plays one random clip of every class.
    rt60s_s : tuple of float
    snrs_db : tuple of float
        Level of the event's mean power at the microphones of the two arrays 5 m apart above the white sensor noise;
        infinity for no noise.
    seed : int
    sample_rate_hz : float
    spacing_m : float
        Spacing of the grid that `srp-phat` searches before it refines.
    half : str
        Half of the clips to use: one of `HALVES`.
    scenarios : tuple of str
        Names of `SCENARIOS`.
    """

    positions: int
    rt60s_s: tuple[float, ...] = RT60S_S
    snrs_db: tuple[float, ...] = SNRS_DB
    seed: int = 0
    sample_rate_hz: float = 16000.0
    spacing_m: float = SPACING_M
    half: str = HALVES[1]
    scenarios: tuple[str, ...] = (ROOMS,)
    experiment: str = LOCALIZER

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name."""
        return asdict(self)

    @property
    def cases(self) -> tuple[Case, ...]:
        """The cases of all scenarios, each once."""
        return tuple(dict.fromkeys(case for name in self.scenarios for case in SCENARIOS[name].cases))


class LocalizerPosition:
    """Turns the number of a position into its rows. Made once in each worker.

    Parameters
    ----------
    settings : LocalizerSettings
    clips : Clips
        All clips; the settings choose the half that is used.
    """

    def __init__(self, settings: LocalizerSettings, clips: Clips) -> None:
        self._settings = settings
        self._clips = half_of(clips, settings.half)
        self._arrays = sorted(set(TWO.arrays).union(*(case.arrays for case in settings.cases)))
        self._grid = EXPERIMENTS["diversity"].grid(settings.spacing_m)
        specs = [ARRAYS[name] for name in self._arrays]
        speeds_m_s = {case.c_m_s for case in settings.cases if not case.misplaced}
        self._rightly_placed = {c_m_s: self._estimators(specs, c_m_s) for c_m_s in speeds_m_s}

    def rows(self, number: int) -> list[Row]:
        """Simulate and localize position `number`: one row per event, condition, case and method."""
        settings = self._settings
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
        source_m = np.asarray(rng.uniform(0.0, 1.0, 3) * ROOM_M)
        chosen = {name: clips[int(rng.integers(len(clips)))] for name, clips in self._clips.items()}
        lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * settings.sample_rate_hz)
        responses = impulse_responses(
            ROOM_M,
            source_m,
            np.vstack([ARRAYS[name].microphones_m for name in self._arrays]),
            settings.rt60s_s,
            sample_rate_hz=settings.sample_rate_hz,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        installed = [(case, *self._installed(case, number)) for case in settings.cases]
        rows: list[Row] = []
        for name, (clip, sound) in chosen.items():
            for rt60_s, response in zip(settings.rt60s_s, responses, strict=True):
                wet = dict(zip(self._arrays, np.split(convolved(sound, response), len(self._arrays)), strict=True))
                for snr_db in settings.snrs_db:
                    noise = _seed(settings.seed, number, _NOISE, f"{name} {rt60_s:g} {snr_db:g}")
                    event = _Event(_recorded(wet, lead, snr_db, noise), settings.sample_rate_hz)
                    head = {"position": number, "sound": name, "clip": clip, "rt60_s": rt60_s, "snr_db": snr_db}
                    for case, specs, estimators in installed:
                        dead = case.faulty(number) if case.dead else ""
                        for method, estimator in estimators.items():
                            sounds = {spec.name: event.sound(estimator, spec, case.c_m_s, dead) for spec in specs}
                            row = head | {"case": case.name, "method": method}
                            rows.append(row | found_row(estimator, sounds, specs, source_m))
        return rows

    def _installed(self, case: Case, number: int) -> tuple[list[ArraySpec], dict[str, Estimator]]:
        specs = case.believed(number, np.random.default_rng(_seed(self._settings.seed, number, _POSE, case.name)))
        if case.misplaced:
            return specs, self._estimators(specs, case.c_m_s)
        return specs, self._rightly_placed[case.c_m_s]

    def _estimators(self, specs: Sequence[ArraySpec], c_m_s: float) -> dict[str, Estimator]:
        return {method: create(method, specs, self._grid, c_m_s) for method in METHODS}


class _Event:
    """The recordings of one event, with each array's sound prepared once for all cases in which it is the same."""

    def __init__(self, recorded: Mapping[str, Float32Array], sample_rate_hz: float) -> None:
        self._recorded = recorded
        self._rate_hz = sample_rate_hz
        self._sounds: dict[tuple[str, str, float, bool], Sound] = {}

    def sound(self, estimator: Estimator, spec: ArraySpec, c_m_s: float, dead: str) -> Sound:
        key = (estimator.name, spec.name, c_m_s, spec.name in dead)
        if key not in self._sounds:
            samples = self._recorded[spec.name]
            if spec.name in dead:
                samples = samples.copy()
                samples[1] = 0.0
            self._sounds[key] = sound_of(estimator, spec, samples, _active(samples, self._rate_hz), self._rate_hz)
        return self._sounds[key]


def half_of(clips: Clips, half: str) -> Clips:
    """Return one of the `HALVES` of the clips of each class: every other clip, in the order of their names."""
    first = HALVES.index(half)
    return {name: each[first :: len(HALVES)] for name, each in clips.items()}


def sound_of(
    estimator: Estimator, spec: ArraySpec, samples: Float32Array, active: BoolArray, sample_rate_hz: float
) -> Sound:
    """Prepare an array's recording (K, n) of an event for an estimator, in frames of 50 ms, as the fusion does.

    The frames run from the pre-roll to the last active one; `active` (F,) says which frames are active.
    """
    frame = round(FRAME_S * sample_rate_hz)
    segments = tuple(samples[:, start * frame : stop * frame] for start, stop in runs(active))
    listener = estimator.onset_front_end(spec.name, sample_rate_hz)
    if listener is None:
        return Sound(segments, sample_rate_hz)
    loud = np.flatnonzero(active)
    frames = range(max(0, int(loud[0]) - PRE_ROLL_FRAMES), int(loud[-1]) + 1)
    onsets = [listener.push(samples[:, k * frame : (k + 1) * frame], quiet=not active[k]) for k in frames]
    return Sound(segments, sample_rate_hz, onsets)


def found_row(
    estimator: Estimator, sounds: Mapping[str, Sound], specs: Sequence[ArraySpec], source_m: FloatArray
) -> Row:
    """Locate a sound and compare the result with the truth: the columns that all scenarios share."""
    return compared(estimator.locate(sounds), sounds, specs, source_m)


def compared(found: Localization, sounds: Mapping[str, Sound], specs: Sequence[ArraySpec], source_m: FloatArray) -> Row:
    """Compare what was found with the truth: the columns that all scenarios share."""
    outliers = found.outliers or {}
    error = found.position_m - source_m
    nearest_m = min((spec.centre_m for spec in specs), key=lambda centre_m: float(np.linalg.norm(centre_m - source_m)))
    row: Row = {
        "active_s": max(
            sum(piece.shape[1] for piece in each.segments) / each.sample_rate_hz for each in sounds.values()
        ),
        "error_m": float(np.linalg.norm(error)),
        "bearing_deg": angle_deg(found.position_m - nearest_m, source_m - nearest_m),
        "mahalanobis2": float(error @ np.linalg.solve(found.covariance_m2, error)),
        "status": str(judged(found, [spec for spec in specs if spec.name not in {*outliers, *found.unneeded}])[0]),
        "outvoted": "".join(sorted(outliers)),
    }
    row |= {f"{axis}_m": value for axis, value in zip("xyz", source_m, strict=True)}
    row |= {f"found_{axis}_m": value for axis, value in zip("xyz", found.position_m, strict=True)}
    if found.features is not None:
        row |= {"confidence": found.confidence, "margin": found.features.margin, "standing": found.features.peak_to_rms}
    return row


def development_fit(columns: Mapping[str, Any], near_m: float) -> tuple[float, float, float]:
    """Fit the confidence by logistic regression: return the intercept and the weights of margin and standing.

    Parameters
    ----------
    columns : mapping of name to (n,)
        `error_m`, `margin` and `standing` of the events of `onset`.
    near_m : float
        Largest error, in metres, that counts as right.
    """
    features = np.stack([np.ones(len(columns["margin"])), columns["margin"], columns["standing"]], axis=1)
    right = np.asarray(columns["error_m"]) <= near_m
    weights = np.zeros(3)
    for _ in range(50):  # Newton's method; a small ridge keeps it finite if every event is right
        likely = 1.0 / (1.0 + np.exp(-features @ weights))
        gradient = features.T @ (right - likely) - 1e-3 * weights
        hessian = (features.T * (likely * (1.0 - likely))) @ features + 1e-3 * np.eye(3)
        weights = weights + np.linalg.solve(hessian, gradient)
    intercept, of_margin, of_standing = (float(weight) for weight in weights)
    return intercept, of_margin, of_standing


def _seed(seed: int, number: int, purpose: int, name: str) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(number, purpose, zlib.crc32(name.encode())))


def _recorded(
    wet: Mapping[str, Float32Array], lead: int, snr_db: float, noise: np.random.SeedSequence
) -> dict[str, Float32Array]:
    """Add noise before and during the sound at each array, set its level, round to 16 bits."""
    power = np.mean([np.square(wet[name]).mean(dtype=np.float64) for name in TWO.arrays])
    rms = np.float32(np.sqrt(power * 10.0 ** (-snr_db / 10.0)))
    recorded = {}
    for name, clean in wet.items():
        samples = np.pad(clean, ((0, 0), (lead, 0)))
        if rms > 0.0:
            own = np.random.SeedSequence(noise.entropy, spawn_key=(*noise.spawn_key, ord(name)))
            samples += rms * np.random.default_rng(own).standard_normal(samples.shape, dtype=np.float32)
        scale = np.float32(PEAK * 32768.0 / np.abs(samples).max())
        recorded[name] = np.asarray(np.rint(samples * scale) / np.float32(32768.0), dtype=np.float32)
    return recorded


def _active(samples: Float32Array, sample_rate_hz: float) -> BoolArray:
    """Return which whole frames of 50 ms of an array's recording (K, n) are active: (F,)."""
    frame = round(FRAME_S * sample_rate_hz)
    count = samples.shape[1] // frame
    squares = np.square(samples[:, : count * frame]).mean(axis=0, dtype=np.float64)
    return exact_mask(squares.reshape(count, frame).mean(axis=1))
