"""The localizer through the whole fusion: many seconds of sound, cut into frames by each array's clock, as live.

What clocks that disagree, two sources at once, and a talker who walks do to it. A session is one position of a
campaign: its rows are truths, and what was told.
"""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.types import Block, Event, Float32Array, FloatArray, Output, Track, TrackState
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.paper import C_M_S, ROOM_M
from livessl.lab.evaluate.scenarios import ARRAYS, HALVES, SESSIONS, TWO, SessionCase
from livessl.lab.evaluate.unit import PEAK, Clips, Row, convolved
from livessl.simulation.moving import place_on_way, render_moving
from livessl.simulation.room import impulse_responses
from livessl.site.build.fusion import make_fusion
from livessl.site.build.pipeline import make_pipeline
from livessl.site.load import parse_site
from livessl.site.models import Site

POSITIONS: Final = 100

NAME: Final = pa.dictionary(pa.int32(), pa.string())

COVARIANCE: Final = ("xx", "yy", "zz", "xy", "xz", "yz")

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

START_NS: Final = 1_800_000_000_000_000_000
"""Site time at which every session begins: any would do."""

LEAD_S: Final = 2.0
"""Noise before the first sound: a node warms up."""

PAUSE_S: Final = 1.2
"""Noise after each sound's reverberation."""

BEFORE_S: Final = 0.5
"""An event belongs to the moment that begins at most so long after it."""

TOGETHER_S: Final = 0.1
"""Two sources at once begin at most so far apart."""

APART_M: Final = 1.5
"""They are at least so far from one another."""

WALK_M_S: Final = 1.0
WALK_S: Final = 8.0
"""The talker begins no other clip after so long."""

WALKER_M: Final = 1.5
"""Height of a mouth."""

MARGIN_M: Final = 1.0
"""The talker keeps away from walls, and turns round there."""

TRUTH_S: Final = 0.05
"""Time between two truths of a talker."""

SPEECH: Final = "speech"
"""Class of what a talker says."""

BLOCK_S: Final = 0.04


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """All that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Sessions.
    scenario : str
        One of `SESSIONS`.
    rt60s_s : tuple of float
    snrs_db : tuple of float
        White sensor noise below each moment's mean power at the microphones, over its whole recording.
    seed : int
    sample_rate_hz : float
    half : str
        Of the sounds: one of `HALVES`.
    """

    positions: int
    scenario: str
    rt60s_s: tuple[float, ...]
    snrs_db: tuple[float, ...]
    seed: int = 0
    sample_rate_hz: float = 16000.0
    half: str = HALVES[1]

    def as_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Moment:
    """One sound, or several at once: what all microphones hear of it (K, n), its mean power 1, and the truth of it.

    `truths` are rows whose `time_s` counts from the first sample.
    """

    wet: Float32Array
    truths: tuple[Row, ...]


class SessionPosition:
    """Everything that turns the number of a session into its rows. Made once a worker.

    Parameters
    ----------
    settings : SessionSettings
    clips : Clips
        All; the settings say which half counts.

    Raises
    ------
    ValueError
        Where a class is missing that the scenario needs.
    """

    def __init__(self, settings: SessionSettings, clips: Clips) -> None:
        self._settings = settings
        first = HALVES.index(settings.half)
        self._clips = {name: ours[first :: len(HALVES)] for name, ours in clips.items()}
        if any(case.walks is not None for case in SESSIONS[settings.scenario].cases) and SPEECH not in clips:
            raise ValueError(f"--classes: who walks talks, so expected {SPEECH} among them, got {', '.join(clips)}")
        self._microphones_m = np.vstack([ARRAYS[name].microphones_m for name in TWO.arrays])
        self._site = parse_site(_site_text())

    def rows(self, number: int) -> list[Row]:
        """Simulate session `number` and what is told of it."""
        settings = self._settings
        rows: list[Row] = []
        for rt60_s in settings.rt60s_s:
            for case in SESSIONS[settings.scenario].cases:
                # the same draws for every case: they differ by what the case says alone
                moments = self._moments(case, rt60_s, np.random.default_rng([settings.seed, number]))
                for snr_db in settings.snrs_db:
                    head = {"position": number, "case": case.name, "rt60_s": rt60_s, "snr_db": snr_db}
                    rows += [head | row for row in self._played(case, moments, snr_db, number)]
        return rows

    def _moments(self, case: SessionCase, rt60_s: float, rng: np.random.Generator) -> list[Moment]:
        if case.walks is not None:
            return [self._talker(case.walks, rt60_s, rng)]
        names = [name for _ in range(case.rounds) for name in rng.permutation(list(self._clips))]
        sounds = [self._sounding(name, rt60_s, rng) for name in names]
        if not case.pairs:
            return [self._moment([sound]) for sound in sounds]
        moments = []
        for one, other in zip(sounds[::2], sounds[1::2], strict=True):
            while np.linalg.norm(one.place_m - other.place_m) < APART_M:
                other = self._sounding(other.name, rt60_s, rng)
            lag = round(rng.uniform(0.0, TOGETHER_S) * self._settings.sample_rate_hz)
            moments.append(self._moment([one] if case.alone else [one, other.later(lag)]))
        return moments

    def _sounding(self, name: str, rt60_s: float, rng: np.random.Generator) -> _Sounding:
        clips = self._clips[name]
        clip, sound = clips[int(rng.integers(len(clips)))]
        place_m = np.asarray(rng.uniform(0.0, 1.0, 3) * ROOM_M)
        wet = convolved(sound, self._responses(place_m, rt60_s))
        return _Sounding(name, clip, place_m, _at_unit_power(wet), len(sound))

    def _responses(self, place_m: FloatArray, rt60_s: float) -> Float32Array:
        responses = impulse_responses(
            ROOM_M,
            place_m,
            self._microphones_m,
            [rt60_s],
            sample_rate_hz=self._settings.sample_rate_hz,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        return np.asarray(responses[0])

    def _moment(self, sounds: Sequence[_Sounding]) -> Moment:
        wet = np.zeros((len(self._microphones_m), max(sound.wet.shape[1] for sound in sounds)), dtype=np.float32)
        truths: list[Row] = []
        for number, sound in enumerate(sounds):
            wet[:, : sound.wet.shape[1]] += sound.wet
            middle_s = (sound.begin + 0.5 * sound.length) / self._settings.sample_rate_hz
            truths.append(_row("truth", number, middle_s, sound.place_m) | {"sound": sound.name, "clip": sound.clip})
        return Moment(_at_unit_power(wet), tuple(truths))

    def _talker(self, walks: bool, rt60_s: float, rng: np.random.Generator) -> Moment:
        rate_hz = self._settings.sample_rate_hz
        clips = self._clips[SPEECH]
        parts: list[Float32Array] = []
        spoken: list[tuple[float, float]] = []
        length = 0
        while length < WALK_S * rate_hz:
            _, sound = clips[int(rng.integers(len(clips)))]
            pause = round(rng.uniform(0.1, 0.4) * rate_hz)
            parts += [sound / np.sqrt(np.square(sound).mean()), np.zeros(pause, dtype=np.float32)]
            spoken.append((length / rate_hz, (length + len(sound)) / rate_hz))
            length += len(sound) + pause
        times_s, way_m = _way(length / rate_hz, rng)
        if not walks:
            way_m = np.repeat(way_m[:1], len(way_m), axis=0)
        wet = render_moving(
            np.concatenate(parts),
            times_s,
            way_m,
            self._microphones_m,
            room_size_m=ROOM_M,
            rt60_s=rt60_s,
            sample_rate_hz=rate_hz,
            c_m_s=C_M_S,
            compiled=True,
        )
        at_s = np.concatenate([np.arange(start, stop, TRUTH_S) for start, stop in spoken])
        places_m = place_on_way(times_s, way_m, at_s)
        truths = tuple(_row("truth", 0, float(s), place_m) for s, place_m in zip(at_s, places_m, strict=True))
        return Moment(_at_unit_power(wet), truths)

    def _played(self, case: SessionCase, moments: Sequence[Moment], snr_db: float, number: int) -> Iterator[Row]:
        """Truths, and what either method tells of a session."""
        starts_s, duration_s = _schedule(moments, self._settings.sample_rate_hz)
        for moment, (start_s, each) in enumerate(zip(starts_s, moments, strict=True)):
            for truth in each.truths:
                yield truth | {"moment": moment, "method": "truth", "time_s": start_s + truth["time_s"]}
        recorded = self._recorded(case, moments, starts_s, duration_s, snr_db, number)
        for method in METHODS:
            outputs = play(self._site, recorded, self._settings.sample_rate_hz, method, updates=case.walks is not None)
            for output in outputs:
                row = _told(output)
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
        """What each array's device records, by its own clock; the second array's is the one that a case spoils."""
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


@dataclass(frozen=True, slots=True)
class Recorded:
    """What one device records: samples (K, n), its true rate, and how late its clock is, which stamps them."""

    samples: Float32Array
    true_rate_hz: float
    late_ns: int


def play(
    site: Site, recorded: Mapping[str, Recorded], nominal_rate_hz: float, method: str, *, updates: bool
) -> Iterator[Output]:
    """Let a site's fusion hear what its arrays' devices record, block by block; each has a line of its own.

    Parameters
    ----------
    site : Site
    recorded : mapping of array name to Recorded
        From `START_NS` on.
    nominal_rate_hz : float
        What the devices say their rate is.
    method : str
    updates : bool
        Whether windows are located, and tracks made, besides events.
    """
    fusion = make_fusion(site, method, updates=updates)
    lines = {
        name: make_pipeline(site, {name: range(1, len(each.samples) + 1)}, nominal_rate_hz)
        for name, each in recorded.items()
    }
    now_ns = START_NS
    for now_ns, name, block in heapq.merge(*(_blocks(name, each) for name, each in recorded.items()), key=_when):
        yield from fusion.step(lines[name].push(block), now_ns)
    yield from fusion.step([message for line in lines.values() for message in line.flush()], now_ns)
    yield from fusion.flush(now_ns)


def _blocks(name: str, recorded: Recorded) -> Iterator[tuple[int, str, Block]]:
    """Blocks of a device, with the true time at which each is complete."""
    size = round(BLOCK_S * recorded.true_rate_hz)
    for first in range(0, recorded.samples.shape[1], size):
        samples = recorded.samples[:, first : first + size].copy()
        begin_ns, end_ns = (
            START_NS + round(1e9 * index / recorded.true_rate_hz) for index in (first, first + samples.shape[1])
        )
        yield end_ns, name, Block(first, samples, begin_ns + recorded.late_ns)


def _when(entry: tuple[int, str, Block]) -> tuple[int, str]:
    return entry[:2]


@dataclass(frozen=True, slots=True)
class _Sounding:
    """A clip at a place: what microphones hear (K, n), where in it its emission begins, and how long that is."""

    name: str
    clip: str
    place_m: FloatArray
    wet: Float32Array
    length: int
    begin: int = 0

    def later(self, samples: int) -> _Sounding:
        wet = np.pad(self.wet, ((0, 0), (samples, 0)))
        return _Sounding(self.name, self.clip, self.place_m, wet, self.length, self.begin + samples)


def _at_unit_power(wet: Float32Array) -> Float32Array:
    return np.asarray(wet / np.sqrt(np.square(wet).mean(dtype=np.float64)), dtype=np.float32)


def _way(duration_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times and waypoints of a walk from somewhere to somewhere else, and so on, at an even pace."""
    low_m, high_m = np.full(2, MARGIN_M), np.array(ROOM_M[:2]) - MARGIN_M
    times_s, points_m = [0.0], [rng.uniform(low_m, high_m)]
    while times_s[-1] < duration_s:
        next_m = rng.uniform(low_m, high_m)
        length_m = float(np.linalg.norm(next_m - points_m[-1]))
        times_s.append(times_s[-1] + length_m / WALK_M_S)
        points_m.append(next_m)
    return np.array(times_s), np.column_stack([points_m, np.full(len(points_m), WALKER_M)])


def _schedule(moments: Sequence[Moment], sample_rate_hz: float) -> tuple[FloatArray, float]:
    """When each moment begins, and how long all take, seconds."""
    lengths_s = np.array([moment.wet.shape[1] / sample_rate_hz for moment in moments])
    ends_s = LEAD_S + np.cumsum(lengths_s + PAUSE_S)
    return ends_s - lengths_s - PAUSE_S, float(ends_s[-1])


def _row(kind: str, number: int, time_s: float, place_m: Iterable[float]) -> Row:
    return {
        "kind": kind,
        "number": number,
        "time_s": time_s,
        **{f"{a}_m": v for a, v in zip("xyz", place_m, strict=True)},
    }


def _told(output: Output) -> Row | None:
    """The row of an event or of a track's state; `begin_s` is when the sound began."""
    match output:
        case Event(estimate=estimate):
            begin_s, end_s = ((time_ns - START_NS) / 1e9 for time_ns in (output.start_ns, output.end_ns))
            place_m = [np.nan] * 3 if estimate is None else estimate.position_m
            row = _row("event", 0, (begin_s + end_s) / 2.0, place_m) | {
                "begin_s": begin_s,
                "status": str(output.status),
            }
            if estimate is None:
                return row
            c = estimate.covariance_m2
            spread = dict(zip(COVARIANCE, (c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2]), strict=True))
            return row | {"confidence": estimate.confidence, **{f"c{axes}_m2": value for axes, value in spread.items()}}
        case Track(state=state) if state is not TrackState.END:
            time_s = (output.time_ns - START_NS) / 1e9
            return _row("track", output.id, time_s, output.position_m) | {"begin_s": time_s}
        case _:
            return None


def _site_text() -> str:
    """The paper's room with the two arrays 5 m apart, each on a node of its own."""
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
