"""The localizer's own campaign: `onset` against the paper's standard, on the same signals, in noise and reverberation.

The sounds of each class are divided, in order of their names: the first, third, … are for development, the others for
tests. Positions differ by the seed. It draws nothing and writes no report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import reduce
from operator import add
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.activity import exact_mask, runs
from livessl.core.estimators import ESTIMATORS, Estimator, Sound
from livessl.core.types import FRAME_S, ArraySpec, BoolArray, Float32Array, FloatArray
from livessl.evaluate.command import HALVES, LOCALIZER
from livessl.evaluate.paper import C_M_S, EXPERIMENTS, ROOM_M, pair
from livessl.evaluate.unit import PEAK, Clips, Row, convolved
from livessl.simulate.room import impulse_responses

METHODS: Final = ("srp-phat", "onset")
SEPARATION_M: Final = 5
RT60S_S: Final = (0.0, 0.4, 1.0, 2.0)
SNRS_DB: Final = (float("inf"), 10.0)
SPACING_M: Final = 0.1
POSITIONS: Final = 200

LEAD_S: Final = 0.5
"""Noise alone before the sound, from which a node would send its pre-roll."""

PRE_ROLL_FRAMES: Final = 8
"""As a node sends it: 0.4 s."""

NAME: Final = pa.dictionary(pa.int32(), pa.string())

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        ("method", NAME),
        ("sound", NAME),
        ("clip", NAME),
        *((name, pa.float32()) for name in ("rt60_s", "snr_db", "active_s")),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "mahalanobis2", "margin", "standing")),
    ]
)
"""One row per event, condition and method. `mahalanobis2` is the error's square in units of the covariance; `margin`
and `standing` are the `Signs` of `onset`'s confidence, so that another fit of it needs no other run."""


@dataclass(frozen=True, slots=True)
class LocalizerSettings:
    """All that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Places of the source, anywhere in the paper's room; each plays one random clip of every class.
    rt60s_s : tuple of float
    snrs_db : tuple of float
        White sensor noise below the mean power of the event at the microphones; infinity for none.
    seed : int
    sample_rate_hz : float
    spacing_m : float
        Of the grid that `srp-phat` searches before it refines.
    half : str
        Of the sounds: one of `HALVES`.
    """

    positions: int
    rt60s_s: tuple[float, ...] = RT60S_S
    snrs_db: tuple[float, ...] = SNRS_DB
    seed: int = 0
    sample_rate_hz: float = 16000.0
    spacing_m: float = SPACING_M
    half: str = HALVES[1]
    experiment: str = LOCALIZER

    def as_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return asdict(self)


class LocalizerPosition:
    """Everything that turns the number of a position into its rows. Made once a worker.

    Parameters
    ----------
    settings : LocalizerSettings
    clips : Clips
        All; the settings say which half counts.
    """

    def __init__(self, settings: LocalizerSettings, clips: Clips) -> None:
        self._settings = settings
        first = HALVES.index(settings.half)
        self._clips = {name: ours[first :: len(HALVES)] for name, ours in clips.items()}
        self._arrays = pair(np.array(ROOM_M) / 2.0, 1, SEPARATION_M)
        grid = EXPERIMENTS["diversity"].grid(settings.spacing_m)
        self._estimators = {name: ESTIMATORS[name](self._arrays, grid, C_M_S) for name in METHODS}

    def rows(self, number: int) -> list[Row]:
        """Simulate and localize position `number`: one row per method, event and condition."""
        settings = self._settings
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
        source_m = np.asarray(rng.uniform(0.0, 1.0, 3) * ROOM_M)
        chosen = {name: clips[int(rng.integers(len(clips)))] for name, clips in self._clips.items()}
        lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * settings.sample_rate_hz)
        responses = impulse_responses(
            ROOM_M,
            source_m,
            np.vstack([spec.microphones_m for spec in self._arrays]),
            settings.rt60s_s,
            sample_rate_hz=settings.sample_rate_hz,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        rows: list[Row] = []
        for name, (clip, sound) in chosen.items():
            for rt60_s, response in zip(settings.rt60s_s, responses, strict=True):
                wet = convolved(sound, response)
                for snr_db in settings.snrs_db:
                    samples = _recorded(wet, lead, snr_db, rng)
                    head = {"position": number, "sound": name, "clip": clip, "rt60_s": rt60_s, "snr_db": snr_db}
                    rows += [head | row for row in self._localized(samples, source_m)]
        return rows

    def _localized(self, samples: Float32Array, source_m: FloatArray) -> list[Row]:
        rows: list[Row] = []
        rate_hz = self._settings.sample_rate_hz
        active = _active(samples, rate_hz)
        for method, estimator in self._estimators.items():
            found = estimator.locate(
                {
                    spec.name: heard(estimator, spec, part, active, rate_hz)
                    for spec, part in zip(self._arrays, np.split(samples, len(self._arrays)), strict=True)
                }
            )
            error = found.position_m - source_m
            row: dict[str, Any] = {
                "method": method,
                "active_s": float(active.sum() * FRAME_S),
                "error_m": float(np.linalg.norm(error)),
                "mahalanobis2": float(error @ np.linalg.solve(found.covariance_m2, error)),
            }
            row |= {f"{axis}_m": value for axis, value in zip("xyz", source_m, strict=True)}
            row |= {f"found_{axis}_m": value for axis, value in zip("xyz", found.position_m, strict=True)}
            if found.signs is not None:
                row |= {"margin": found.signs.margin, "standing": found.signs.standing}
            rows.append(row)
        return rows


def heard(
    estimator: Estimator, spec: ArraySpec, samples: Float32Array, active: BoolArray, sample_rate_hz: float
) -> Sound:
    """What one array hears of an event, as the fusion would tell an estimator: (K, n) cut into frames of 50 ms.

    The frames run from the pre-roll to the last active one.
    """
    frame = round(FRAME_S * sample_rate_hz)
    segments = tuple(samples[:, start * frame : stop * frame] for start, stop in runs(active))
    listener = estimator.listener(spec.name, sample_rate_hz)
    if listener is None:
        return Sound(segments, sample_rate_hz)
    loud = np.flatnonzero(active)
    frames = range(max(0, int(loud[0]) - PRE_ROLL_FRAMES), int(loud[-1]) + 1)
    onsets = (listener.push(samples[:, k * frame : (k + 1) * frame], quiet=not active[k]) for k in frames)
    return Sound(segments, sample_rate_hz, reduce(add, onsets))


def development_fit(columns: Mapping[str, Any], near_m: float) -> tuple[float, float, float]:
    """Intercept and weights of margin and standing that make a right place most likely: logistic regression.

    Parameters
    ----------
    columns : mapping of name to (n,)
        `error_m`, `margin` and `standing` of the events of `onset`.
    near_m : float
        What is right.
    """
    signs = np.stack([np.ones(len(columns["margin"])), columns["margin"], columns["standing"]], axis=1)
    right = np.asarray(columns["error_m"]) <= near_m
    weights = np.zeros(3)
    for _ in range(50):  # Newton; the least ridge keeps it finite where all is right
        likely = 1.0 / (1.0 + np.exp(-signs @ weights))
        gradient = signs.T @ (right - likely) - 1e-3 * weights
        hessian = (signs.T * (likely * (1.0 - likely))) @ signs + 1e-3 * np.eye(3)
        weights = weights + np.linalg.solve(hessian, gradient)
    intercept, of_margin, of_standing = (float(weight) for weight in weights)
    return intercept, of_margin, of_standing


def _recorded(wet: Float32Array, lead: int, snr_db: float, rng: np.random.Generator) -> Float32Array:
    """Put noise before and under the sound, set the level, round to 16 bits."""
    samples = np.pad(wet, ((0, 0), (lead, 0)))
    if np.isfinite(snr_db):
        rms = np.sqrt(np.square(wet).mean(dtype=np.float64) * 10.0 ** (-snr_db / 10.0))
        samples += rng.standard_normal(samples.shape, dtype=np.float32) * np.float32(rms)
    scale = np.float32(PEAK * 32768.0 / np.abs(samples).max())
    return np.asarray(np.rint(samples * scale) / np.float32(32768.0), dtype=np.float32)


def _active(samples: Float32Array, sample_rate_hz: float) -> BoolArray:
    """Which whole frames of 50 ms are active, one mask for all channels."""
    frame = round(FRAME_S * sample_rate_hz)
    count = samples.shape[1] // frame
    squares = np.square(samples[:, : count * frame]).mean(axis=0, dtype=np.float64)
    return exact_mask(squares.reshape(count, frame).mean(axis=1))
