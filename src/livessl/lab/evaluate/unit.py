"""One position of a campaign of the paper: simulated, recorded by every system, localized by every method.

It stores nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import scipy.fft
from scipy.signal import butter, sosfilt

from livessl.core.correlate.gcc_phat import CrossSpectra
from livessl.core.correlate.spectra import FrontEnd, averaged, cepstral, whole_segment
from livessl.core.geometry import Grid, direction_deg, microphone_pairs
from livessl.core.stream.activity import exact_mask, runs
from livessl.core.types import FRAME_S, ArraySpec, Float32Array, FloatArray, IntArray
from livessl.lab.evaluate.maps import PairMatrices, PairTables, reach_samples
from livessl.lab.evaluate.paper import Experiment, Settings, System, experiment_of
from livessl.lab.evaluate.parquet import NAME
from livessl.simulation.room import impulse_responses

Row = dict[str, Any]
"""One row of a campaign's results, by column."""

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        ("system", NAME),
        ("method", NAME),
        ("sound", NAME),
        ("clip", NAME),
        ("rt60_s", pa.float32()),
        ("t30_s", pa.float32()),
        ("active_s", pa.float32()),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "radial_m", "azimuth_deg", "elevation_deg")),
    ]
)
"""One row per event, condition, system and method: truth, estimate, error and its components seen from the system's
centre."""

FRONT_ENDS: Final[Mapping[str, FrontEnd]] = {
    "srp-phat": whole_segment,
    "cepstral": cepstral,
    "averaged": averaged,
}
"""Front end of each method: it makes the spectra that are correlated."""

PEAK: Final = 0.5
"""Largest sample of a system's recording before it is rounded to 16 bits: 6 dB of headroom."""

Clips = Mapping[str, tuple[tuple[str, Float32Array], ...]]
"""Class of sound -> its clips: name and samples (n,), at the campaign's sample rate."""

MATRIX_POINTS: Final = 8192
"""Most grid points that are mapped by matrices; with more, the matrices of a hundred pairs would fill gigabytes."""


class Mapper(Protocol):
    """Maps whole-sample correlations of one array's C recordings onto the grid."""

    def power(self, spec: ArraySpec, pairs: IntArray, lags: Float32Array) -> Float32Array:
        """Return power (G, C) from correlations (C, P, 2 reach + 1)."""
        ...


@dataclass
class Position:
    """Turns the number of a position into its rows. Made once in each worker, because its matrices are expensive.

    Parameters
    ----------
    settings : Settings
    clips : Clips
    """

    settings: Settings
    clips: Clips
    grid: Grid = field(init=False)
    _experiment: Experiment = field(init=False)
    _every: int = field(init=False)
    _mapper: Mapper = field(init=False)
    _microphones_m: FloatArray = field(init=False)
    _channels: list[list[int]] = field(init=False)

    def __post_init__(self) -> None:
        self._experiment = experiment = experiment_of(self.settings.experiment, self.settings.layout)
        self.grid = experiment.grid(self.settings.spacing_m)
        self._every = max(1, int(self.settings.sample_rate_hz // experiment.lag_rate_hz))
        lag_rate_hz, band_limit = self.settings.sample_rate_hz / self._every, self.settings.band_limit
        make = PairMatrices if self.grid.size <= MATRIX_POINTS else PairTables
        self._mapper = make(self.grid, lag_rate_hz, experiment.c_m_s, band_limit=band_limit)
        every = np.round(np.vstack([system.microphones_m for system in experiment.systems]), 9)
        self._microphones_m, inverse = np.unique(every, axis=0, return_inverse=True)
        ends = np.cumsum([len(system.microphones_m) for system in experiment.systems])
        self._channels = [part.tolist() for part in np.split(np.ravel(inverse), ends[:-1])]

    def rows(self, number: int) -> list[Row]:
        """Simulate and localize position `number`: one row per system, method, event and reverberation time."""
        settings, experiment = self.settings, self._experiment
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
        source_m = experiment.place(rng, number)
        chosen = {name: clips[int(rng.integers(len(clips)))] for name, clips in self.clips.items()}
        noise = np.random.SeedSequence(settings.seed, spawn_key=(number, 1))
        responses = impulse_responses(
            experiment.room_m,
            source_m,
            self._microphones_m,
            settings.rt60s_s,
            sample_rate_hz=settings.sample_rate_hz,
            c_m_s=experiment.c_m_s,
            own_lengths=True,
            compiled=True,
        )
        decay_s = [t30_s(response[0], settings.sample_rate_hz, experiment.band_hz) for response in responses]
        heads: list[Row] = []
        found: list[list[tuple[_Correlations, ...]]] = [[] for _ in experiment.systems]
        for name, (clip, sound) in chosen.items():
            for r, rt60_s in enumerate(settings.rt60s_s):
                wet = convolved(sound, responses[r])
                heads.append(
                    {
                        "position": number,
                        "sound": name,
                        "clip": clip,
                        "rt60_s": rt60_s,
                        "t30_s": decay_s[r],
                        "x_m": source_m[0],
                        "y_m": source_m[1],
                        "z_m": source_m[2],
                    }
                )
                for index, system in enumerate(experiment.systems):
                    samples = recorded(wet[self._channels[index]], settings.snr_db, noise, (len(heads), index))
                    found[index].append(self._correlated(system, samples))
        return [
            row
            for system, events in zip(experiment.systems, found, strict=True)
            for row in self._localized(system, heads, events, source_m)
        ]

    def _correlated(self, system: System, samples: Float32Array) -> tuple[_Correlations, ...]:
        """Correlate a recording (K, n): for each method, each array's correlations around zero lag."""
        rate_hz = self.settings.sample_rate_hz
        start, stop = active_segment(samples, rate_hz, self.settings.segment)
        segment = samples[:, start:stop]
        kept = []
        for method in system.methods:
            lags = []
            first = 0
            for spec in system.arrays:
                count = len(spec.microphones_m)
                reach = self._every * reach_samples(spec.aperture_m, rate_hz / self._every, self._experiment.c_m_s)
                spectra = FRONT_ENDS[method](segment[first : first + count], rate_hz, reach)
                cross = CrossSpectra(spectra, microphone_pairs(count), rate_hz, spec.band_hz)
                lags.append(np.ascontiguousarray(cross.correlations(reach).real[:, :: self._every]))
                first += count
            kept.append(_Correlations(method, (stop - start) / rate_hz, lags))
        return tuple(kept)

    def _localized(
        self, system: System, heads: list[Row], events: list[tuple[_Correlations, ...]], source_m: FloatArray
    ) -> list[Row]:
        rows = []
        for m, method in enumerate(system.methods):
            power = np.zeros((self.grid.size, len(events)), dtype=np.float32)
            for a, spec in enumerate(system.arrays):
                lags = np.stack([one[m].lags[a] for one in events])
                power += self._mapper.power(spec, microphone_pairs(len(spec.microphones_m)), lags)
            for head, one, point in zip(heads, events, power.argmax(axis=0), strict=True):
                estimate_m = self.grid.point_m(int(point))
                rows.append(
                    {"system": system.name, "method": method}
                    | head
                    | {"active_s": one[m].active_s}
                    | _errors(source_m, estimate_m, system.centre_m)
                )
        return rows


@dataclass(frozen=True, slots=True)
class _Correlations:
    """Correlations of one event by one method: for each array (P, 2 reach + 1)."""

    method: str
    active_s: float
    lags: list[Float32Array]


def active_segment(samples: Float32Array, sample_rate_hz: float, which: str) -> tuple[int, int]:
    """Return first sample and end of the segment of a recording (K, n) that is localized.

    All channels share one activity mask. `which` is "longest", or "peak" for the segment with the loudest frame.
    """
    frame = round(FRAME_S * sample_rate_hz)
    count = max(1, samples.shape[1] // frame)
    squares = np.square(samples[:, : count * frame]).mean(axis=0, dtype=np.float64)
    power = np.array([part.mean() for part in np.array_split(squares, count)])
    segments = runs(exact_mask(power))
    if which == "peak":
        loudest = int(power.argmax())
        start, stop = next(segment for segment in segments if segment[0] <= loudest < segment[1])
    else:
        start, stop = max(segments, key=lambda segment: segment[1] - segment[0])  # the first of equals
    return start * frame, min(stop * frame, samples.shape[1])


def t30_s(response: Float32Array, sample_rate_hz: float, band_hz: tuple[float, float]) -> float:
    """Return the time of a decay by 60 dB, from Schroeder's integral at -5 to -35 dB (ISO 3382-1); 0 for no decay.

    It is measured inside the band: below 100 Hz, where images only ever add, simulated rooms ring longer.
    """
    inside = sosfilt(butter(4, band_hz, "bandpass", fs=sample_rate_hz, output="sos"), response.astype(np.float64))
    left = np.cumsum(np.square(inside[::-1]))[::-1]
    with np.errstate(divide="ignore"):
        level_db = 10.0 * np.log10(left / left[0])
    used = np.flatnonzero((level_db <= -5.0) & (level_db >= -35.0))
    if len(used) < 0.03 * sample_rate_hz:
        return 0.0  # only the filter rings
    slope = np.polyfit(used / sample_rate_hz, level_db[used], 1)[0]
    return float(-60.0 / slope)


def convolved(sound: Float32Array, responses: Float32Array) -> Float32Array:
    """Return the sound at each microphone, (K, n), from responses (K, m) without their common silence at the end."""
    sounding = np.flatnonzero(responses.any(axis=0))
    responses = responses[:, : int(sounding[-1]) + 1]
    count = len(sound) + responses.shape[1] - 1
    n_fft = scipy.fft.next_fast_len(count, real=True)
    spectrum = scipy.fft.rfft(responses, n_fft, axis=1) * scipy.fft.rfft(sound, n_fft)
    return np.asarray(scipy.fft.irfft(spectrum, n_fft, axis=1, overwrite_x=True)[:, :count], dtype=np.float32)


def recorded(
    wet: Float32Array, snr_db: float | None, noise: np.random.SeedSequence, key: tuple[int, int]
) -> Float32Array:
    """Add sensor noise to the sound at a system's microphones (K, n), set the level, round to 16 bits.

    The noise is white, independent at each microphone and drawn by `key`. It is `snr_db` below the mean power over all
    microphones and the whole recording; None adds no noise.
    """
    if snr_db is not None:
        rng = np.random.default_rng(np.random.SeedSequence(noise.entropy, spawn_key=(*noise.spawn_key, *key)))
        rms = np.sqrt(np.square(wet).mean(dtype=np.float64) * 10.0 ** (-snr_db / 10.0))
        wet = wet + rng.standard_normal(wet.shape, dtype=np.float32) * np.float32(rms)
    scale = np.float32(PEAK * 32768.0 / np.abs(wet).max())
    return np.asarray(np.rint(wet * scale) / np.float32(32768.0), dtype=np.float32)


def _errors(source_m: FloatArray, estimate_m: FloatArray, centre_m: FloatArray) -> Row:
    """Return the error of an estimate: total, and along the distance, azimuth and elevation seen from a centre."""
    azimuth, elevation, distance = direction_deg(centre_m, source_m)
    found_azimuth, found_elevation, found_distance = direction_deg(centre_m, estimate_m)
    return {
        "found_x_m": estimate_m[0],
        "found_y_m": estimate_m[1],
        "found_z_m": estimate_m[2],
        "error_m": float(np.linalg.norm(estimate_m - source_m)),
        "radial_m": found_distance - distance,
        "azimuth_deg": (found_azimuth - azimuth + 180.0) % 360.0 - 180.0,
        "elevation_deg": found_elevation - elevation,
    }
