"""Sessions through the whole fusion: many seconds of sound, cut into frames by each array's clock, as live.

They measure the effect of clocks that disagree, of two sources at once, and of a talker who walks. A session is one
position of a campaign; its rows are the truths and the outputs of the fusion.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.types import Event, FloatArray, Output, Track, TrackState
from livessl.lab.evaluate.localizer import METHODS, half_of
from livessl.lab.evaluate.moments import SPEECH, Moment, MomentSimulator, row_of
from livessl.lab.evaluate.paper import C_M_S, ROOM_M
from livessl.lab.evaluate.parquet import NAME
from livessl.lab.evaluate.playback import START_NS, Recorded, play
from livessl.lab.evaluate.scenarios import ARRAYS, HALVES, SESSIONS, TWO, SessionCase
from livessl.lab.evaluate.unit import PEAK, Clips, Row
from livessl.site.load import parse_site

POSITIONS: Final = 100
"""Number of sessions by default."""

COVARIANCE: Final = ("xx", "yy", "zz", "xy", "xz", "yz")
"""Elements of the covariance that are kept, by their axes."""

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        *((name, NAME) for name in ("case", "method", "kind")),
        *((name, pa.float32()) for name in ("rt60_s", "snr_db")),
        *((name, pa.int32()) for name in ("moment", "number")),
        ("time_s", pa.float64()),
        *((name, NAME) for name in ("sound", "clip", "status")),
        ("confidence", pa.float32()),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"c{axes}_m2", pa.float32()) for axes in COVARIANCE),
    ]
)
"""One row for each truth, event and state of a track: its `kind`. A moment is one sound, or two at once; `number`
counts its sources, or is the track's id."""

LEAD_S: Final = 2.0
"""Noise, in seconds, before the first sound, in which the pipelines estimate the noise floor."""

PAUSE_S: Final = 1.2
"""Noise, in seconds, after the reverberation of each sound."""

BEFORE_S: Final = 0.5
"""Longest time, in seconds, by which an event may begin before the moment that it is counted for."""


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """All settings that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Number of sessions.
    scenario : str
        One of `SESSIONS`.
    rt60s_s : tuple of float
    snrs_db : tuple of float
        Level of each moment's mean power at the microphones above the white sensor noise, over its whole recording.
    seed : int
    sample_rate_hz : float
    half : str
        Half of the clips to use: one of `HALVES`.
    """

    positions: int
    scenario: str
    rt60s_s: tuple[float, ...]
    snrs_db: tuple[float, ...]
    seed: int = 0
    sample_rate_hz: float = 16000.0
    half: str = HALVES[1]

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name."""
        return asdict(self)


class SessionPosition:
    """Turns the number of a session into its rows. Made once in each worker.

    Parameters
    ----------
    settings : SessionSettings
    clips : Clips
        All clips; the settings choose the half that is used.

    Raises
    ------
    ValueError
        If a class is missing that the scenario needs.
    """

    def __init__(self, settings: SessionSettings, clips: Clips) -> None:
        self._settings = settings
        if any(case.walks is not None for case in SESSIONS[settings.scenario].cases) and SPEECH not in clips:
            raise ValueError(
                f"--classes: the walking talker needs speech, expected {SPEECH} among them, got {', '.join(clips)}"
            )
        microphones_m = np.vstack([ARRAYS[name].microphones_m for name in TWO.arrays])
        self._simulator = MomentSimulator(half_of(clips, settings.half), microphones_m, settings.sample_rate_hz)
        self._site = parse_site(_site_text())

    def rows(self, number: int) -> list[Row]:
        """Simulate session `number` and return its truths and the outputs of every method."""
        settings = self._settings
        rows: list[Row] = []
        for rt60_s in settings.rt60s_s:
            for case in SESSIONS[settings.scenario].cases:
                # every case gets the same random draws, so that only the case itself makes a difference
                rng = np.random.default_rng([settings.seed, number])
                moments = self._simulator.moments(case, rt60_s, rng)
                for snr_db in settings.snrs_db:
                    head = {"position": number, "case": case.name, "rt60_s": rt60_s, "snr_db": snr_db}
                    rows += [head | row for row in self._played(case, moments, snr_db, number)]
        return rows

    def _played(self, case: SessionCase, moments: Sequence[Moment], snr_db: float, number: int) -> Iterator[Row]:
        """Yield the truths of a session and the outputs of each method."""
        starts_s, duration_s = _schedule(moments, self._settings.sample_rate_hz)
        for moment, (start_s, each) in enumerate(zip(starts_s, moments, strict=True)):
            for truth in each.truths:
                yield truth | {"moment": moment, "method": "truth", "time_s": start_s + truth["time_s"]}
        recorded = self._recorded(case, moments, starts_s, duration_s, snr_db, number)
        for method in METHODS:
            outputs = play(self._site, recorded, self._settings.sample_rate_hz, method, updates=case.walks is not None)
            for output in outputs:
                row = _output_row(output)
                if row is not None:
                    moment = np.searchsorted(starts_s, row.pop("begin_s") + BEFORE_S, side="right") - 1
                    yield row | {"moment": max(0, int(moment)), "method": method}

    def _recorded(
        self,
        case: SessionCase,
        moments: Sequence[Moment],
        starts_s: FloatArray,
        duration_s: float,
        snr_db: float,
        number: int,
    ) -> dict[str, Recorded]:
        """Make the recording of each array's device; the case's clock fault is applied to the second array."""
        rate_hz = self._settings.sample_rate_hz
        recorded: dict[str, Recorded] = {}
        for index, name in enumerate(TWO.arrays):
            spoilt = index == 1
            late_s, drift_ppm = (case.late_s, case.drift_ppm) if spoilt else (0.0, 0.0)
            own_rate_hz = rate_hz * (1.0 + 1e-6 * drift_ppm)
            key = zlib.crc32(f"{name} {snr_db:g}".encode())
            noise = np.random.default_rng([self._settings.seed, number, key])
            channels = slice(4 * index, 4 * index + 4)
            samples = noise.standard_normal((4, round(duration_s * own_rate_hz)), dtype=np.float32)
            samples *= np.float32(10.0 ** (-snr_db / 20.0))
            for start_s, moment in zip(starts_s, moments, strict=True):
                first = round(start_s * own_rate_hz)
                samples[:, first : first + moment.wet.shape[1]] += moment.wet[channels]
            samples *= np.float32(PEAK / np.abs(samples).max())
            recorded[name] = Recorded(samples, own_rate_hz, round(1e9 * late_s))
        return recorded


def _schedule(moments: Sequence[Moment], sample_rate_hz: float) -> tuple[FloatArray, float]:
    """Return when each moment begins and how long all of them take, in seconds."""
    lengths_s = np.array([moment.wet.shape[1] / sample_rate_hz for moment in moments])
    ends_s = LEAD_S + np.cumsum(lengths_s + PAUSE_S)
    return ends_s - lengths_s - PAUSE_S, float(ends_s[-1])


def _output_row(output: Output) -> Row | None:
    """Return the row of an event or of a track's state; `begin_s` is the time at which the sound began."""
    match output:
        case Event(estimate=estimate):
            begin_s, end_s = ((time_ns - START_NS) / 1e9 for time_ns in (output.start_ns, output.end_ns))
            place_m = [np.nan] * 3 if estimate is None else estimate.position_m
            row = row_of("event", 0, (begin_s + end_s) / 2.0, place_m) | {
                "begin_s": begin_s,
                "status": str(output.status),
            }
            if estimate is None:
                return row
            c = estimate.sound_covariance_m2  # the set-up is exact here
            spread = dict(zip(COVARIANCE, (c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2]), strict=True))
            return row | {
                "confidence": estimate.sound_confidence,
                **{f"c{axes}_m2": value for axes, value in spread.items()},
            }
        case Track(state=state) if state is not TrackState.END:
            time_s = (output.time_ns - START_NS) / 1e9
            return row_of("track", output.id, time_s, output.position_m) | {"begin_s": time_s}
        case _:
            return None


def _site_text() -> str:
    """Return a site file of the paper's room with two arrays 5 m apart, each on its own node."""
    room = ", ".join(f"{length_m:g}" for length_m in ROOM_M)
    lines = ["site: evaluation", f"room: {{size_m: [{room}]}}", f"speed_of_sound_m_s: {C_M_S:g}", "arrays:"]
    for name in TWO.arrays:
        low_hz, high_hz = ARRAYS[name].band_hz
        lines += [f"  {name}:", f"    band_hz: [{low_hz:g}, {high_hz:g}]"]
        lines.append(f"    microphones_m: {ARRAYS[name].microphones_m.tolist()}")
    lines.append("nodes:")
    for name in TWO.arrays:
        lines += [
            f"  pc-{name}:",
            "    device: {name: any, sample_rate_hz: 16000}",
            f"    arrays: {{{name}: [1, 2, 3, 4]}}",
        ]
    return "\n".join(lines) + "\n"
