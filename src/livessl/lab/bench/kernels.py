"""Times correlation, search and maps on this machine (`livessl bench`), relative to bare table look-ups.

Two or more arrays of four microphones stand in the paper's room of 8 x 10 x 4 m with a reverberation time of 0.7 s; a
block has 4096 samples. Every round times each case twice: in turn, when the other cases have filled the caches, and
again right after, with the next block. The rounds spread other load on the machine evenly over all cases. Medians are
reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from livessl.clock import Clock
from livessl.core.correlate.gcc_phat import GCCPhat, correlated
from livessl.core.geometry import Grid, posed, tetrahedron
from livessl.core.kernels import kernels
from livessl.core.locate.estimator import Sound
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPMapper
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.types import ArraySpec, Evidence, Float32Array, FloatArray
from livessl.simulation.room import impulse_responses
from livessl.simulation.sounds import voice

ROOM_M: Final = (8.0, 10.0, 4.0)
RATE_HZ: Final = 44_100.0
C_M_S: Final = 343.0
BAND_HZ: Final = (100.0, 6000.0)
RT60_S: Final = 0.7
BLOCK: Final = 4096
"""Length, in samples, of the block that is located at once: 93 ms."""

SEGMENT: Final = 44_100
SNR_DB: Final = 20.0

PLACES_M: Final = (
    (4.0, 2.5, 2.0), (4.0, 7.5, 2.0), (1.0, 5.0, 2.0), (7.0, 5.0, 2.0),
    (1.0, 1.0, 1.5), (7.0, 9.0, 1.5), (7.0, 1.0, 2.5), (1.0, 9.0, 2.5),
)  # fmt: skip
"""Centres of the arrays, in the order in which they are used."""

KINDS: Final = ("voice", "two voices", "noise")
"""Kinds of sound; noise alone is the slow case, because no peak stands out."""

LOOKED_UP: Final = 1 << 20
"""Look-ups of the reference case."""


@dataclass(frozen=True, slots=True)
class Timing:
    """The times of one case.

    Parameters
    ----------
    name : str
    median_ms, p99_ms, least_ms : float
        Times of the first run in a round, after the other cases have filled the caches.
    again_median_ms, again_p99_ms : float
        Times of the second run, right after the first, with the next block.
    ratio : float or None
        Ratio of the median to the time of as many bare look-ups on this machine.
    least_ratio : float or None
        The same ratio of the least times, which is steadier on a busy machine.
    """

    name: str
    median_ms: float
    p99_ms: float
    least_ms: float
    again_median_ms: float
    again_p99_ms: float
    ratio: float | None = None
    least_ratio: float | None = None


@dataclass(frozen=True, slots=True)
class KernelReport:
    """The measurement: name of the kernels, nanoseconds per bare look-up, and the cases."""

    kernels: str
    lookup_ns: float
    timings: tuple[Timing, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the report for `--json`."""
        return asdict(self)

    def of(self, name: str) -> Timing:
        """Return one case by its name."""
        return next(timing for timing in self.timings if timing.name == name)


@dataclass(frozen=True, slots=True)
class Case:
    """A case to time: its name, the function to call with the round's number, and its number of look-ups."""

    name: str
    run: Callable[[int], object]
    look_ups: int | None = None


def table(report: KernelReport) -> str:
    """Return the report as a table."""
    lines = [
        f"kernels {report.kernels}; a bare look-up takes {report.lookup_ns:.2f} ns",
        f"{'':48}{'median ms':>10}{'p99 ms':>10}{'again':>10}{'p99 ms':>10}{'/ look-ups':>12}",
    ]
    for timing in report.timings:
        ratio = "" if timing.ratio is None else f"{timing.ratio:12.2f}"
        times = (timing.median_ms, timing.p99_ms, timing.again_median_ms, timing.again_p99_ms)
        lines.append(f"{timing.name:<48}{''.join(f'{ms:10.3f}' for ms in times)}{ratio}")
    return "\n".join(lines)


def array_specs(count: int) -> list[ArraySpec]:
    """Return the first `count` arrays."""
    shape = tetrahedron(0.5)
    return [ArraySpec(f"array{k + 1}", posed(shape, place), BAND_HZ) for k, place in enumerate(PLACES_M[:count])]


class Blocks:
    """Blocks (K, `BLOCK`) of each kind of sound at each array, the same on every machine.

    Parameters
    ----------
    arrays : sequence of ArraySpec
    sources : int
        Number of positions of the voice; each gives several blocks.
    seed : int
    """

    def __init__(self, arrays: Sequence[ArraySpec], sources: int = 3, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self._arrays = arrays
        self._voices = [_voice_at(arrays, rng) for _ in range(sources)]
        self._noise = rng.standard_normal((len(arrays), 4, SEGMENT), dtype=np.float32)
        power = float(np.mean([np.square(one).mean() for one in self._voices]))
        self._noise *= np.float32(np.sqrt(power) * 10 ** (-SNR_DB / 20))

    def sound(self, kind: str, number: int, samples: int = BLOCK) -> list[Float32Array]:
        """Return block `number` of a kind, (K, samples) for each array; after the last block the first follows."""
        first = (number * BLOCK) % (SEGMENT - samples + 1)
        cut = slice(first, first + samples)
        one = self._voices[number % len(self._voices)]
        two = self._voices[(number + 1) % len(self._voices)]
        clean = {"voice": one, "two voices": one + two, "noise": np.float32(0.0) * one}[kind]
        return [np.ascontiguousarray(clean[a, :, cut] + self._noise[a, :, cut]) for a in range(len(self._arrays))]


def _voice_at(arrays: Sequence[ArraySpec], rng: np.random.Generator) -> Float32Array:
    """Return a second of a voice at a random position in the room: (A, 4, `SEGMENT`)."""
    source_m = rng.uniform([0.5, 0.5, 0.5], np.array(ROOM_M) - 0.5)
    microphones_m = np.concatenate([spec.microphones_m for spec in arrays])
    (responses,) = impulse_responses(ROOM_M, source_m, microphones_m, [RT60_S], sample_rate_hz=RATE_HZ, c_m_s=C_M_S)
    sound = np.resize(voice(rng, RATE_HZ), SEGMENT + responses.shape[1])
    n_fft = len(sound) + responses.shape[1]
    wet = np.fft.irfft(np.fft.rfft(responses, n_fft) * np.fft.rfft(sound, n_fft), n_fft)
    return wet[:, responses.shape[1] : responses.shape[1] + SEGMENT].astype(np.float32).reshape(len(arrays), 4, SEGMENT)


def measure(
    clock: Clock,
    rounds: int = 200,
    arrays: Sequence[int] = (2, 4, 8),
    spacings_m: Sequence[float] = (0.1, 0.05, 0.02),
    progress: Callable[[int, int], None] | None = None,
) -> KernelReport:
    """Time every case on one thread.

    Parameters
    ----------
    clock : Clock
    rounds : int
    arrays : sequence of int
        Numbers of arrays, each at most `len(PLACES_M)`.
    spacings_m : sequence of float
        Spacings of the grids that are searched.
    progress : callable or None
        Called with (rounds done, rounds).
    """
    with threadpool_limits(limits=1):
        cases = list(_cases(arrays, spacings_m))
        ms, again_ms = timed_ms(clock, cases, rounds, progress, in_a_row=2)
    floor_ms = ms[0] / LOOKED_UP
    timings = []
    for case, one, again in zip(cases[1:], ms[1:], again_ms[1:], strict=True):
        median, least = float(np.median(one)), float(one.min())
        ratio = least_ratio = None
        if case.look_ups is not None:
            ratio = median / (case.look_ups * float(np.median(floor_ms)))
            least_ratio = least / (case.look_ups * float(floor_ms.min()))
        p99, again_p99 = (float(np.percentile(each, 99)) for each in (one, again))
        timings.append(Timing(case.name, median, p99, least, float(np.median(again)), again_p99, ratio, least_ratio))
    return KernelReport(kernels.NAME, 1e6 * float(np.median(floor_ms)), tuple(timings))


def timed_ms(
    clock: Clock,
    cases: Sequence[Case],
    rounds: int,
    progress: Callable[[int, int], None] | None = None,
    in_a_row: int = 1,
) -> FloatArray:
    """Time every case in every round, in turn, after a warm-up: milliseconds (in_a_row, cases, rounds)."""
    taken_ns = np.empty((in_a_row, len(cases), rounds))
    for case in cases:
        case.run(0)
        case.run(1)
    for number in range(rounds):
        for index, case in enumerate(cases):
            for again in range(in_a_row):
                begun_ns = clock.monotonic_ns()
                case.run(number + again)
                taken_ns[again, index, number] = clock.monotonic_ns() - begun_ns
        if progress is not None:
            progress(number + 1, rounds)
    return taken_ns / 1e6


def bare_look_ups() -> Case:
    """Return the case of `LOOKED_UP` look-ups in tables of one array, the lower bound for the time of a map."""
    rng = np.random.default_rng(0)
    table, places = rng.standard_normal(6 * 1063, dtype=np.float32), rng.integers(0, 6 * 1063, LOOKED_UP, np.uint16)
    out = np.empty(LOOKED_UP, dtype=np.float32)
    return Case("look-ups", lambda _: kernels.look_up(table, places, out), LOOKED_UP)


def _cases(arrays: Sequence[int], spacings_m: Sequence[float]) -> Iterator[Case]:
    yield bare_look_ups()
    most = array_specs(max(arrays))
    blocks = Blocks(most)
    correlate = {spec.name: GCCPhat(spec, RATE_HZ, C_M_S) for spec in most}
    first = most[0]
    made = {(kind, n): blocks.sound(kind, n) for kind in KINDS for n in range(12)}
    segments = [blocks.sound("voice", n, SEGMENT)[0] for n in range(2)]

    def evidence(kind: str, number: int, count: int) -> list[Evidence]:
        sounds = made[kind, number % 12]
        gccs = correlated([(correlate[s.name], [x]) for s, x in zip(most[:count], sounds, strict=False)])
        return [Evidence(s, gcc) for s, gcc in zip(most, gccs, strict=False)]

    yield Case("GCC of a block, one array", lambda n: correlate[first.name]([made["voice", n % 12][0]]))
    yield Case("GCC of 1 s, one array", lambda n: correlate[first.name]([segments[n % 2]]))
    room = ((0.0, ROOM_M[0]), (0.0, ROOM_M[1]), (0.0, ROOM_M[2]))
    heard = {(kind, n): evidence(kind, n, len(most)) for kind in KINDS for n in range(12)}
    for spacing_m in spacings_m:
        grid = Grid(room, spacing_m)
        search = PeakSearch(most, grid, C_M_S)
        for spec in most:
            search.prepare(spec.name, correlate[spec.name].lags_s)
        for count in arrays:
            for kind in KINDS:
                yield Case(
                    f"peak, {count} arrays, {spacing_m:g} m, {kind}",
                    lambda n, kind=kind, count=count, search=search: search.among(heard[kind, n % 12][:count])(1),  # type: ignore[misc]
                )
        yield Case(
            f"samples to peak, {arrays[0]} arrays, {spacing_m:g} m, voice",
            lambda n, search=search: search.among(evidence("voice", n, arrays[0]))(1),  # type: ignore[misc]
        )
    specs = most[: arrays[0]]
    yield _drawn_map(specs, Grid(room, 0.1), correlate, [heard["voice", n] for n in range(12)])
    yield _located(specs, Grid(room, 0.05), [made["voice", n] for n in range(12)])


def _drawn_map(
    specs: Sequence[ArraySpec], grid: Grid, correlate: Mapping[str, GCCPhat], looks: Sequence[list[Evidence]]
) -> Case:
    """Return the case of the map that is drawn of a window, from the evidence of several windows in turns."""
    mappers = [SRPMapper(s, grid, correlate[s.name].pairs, correlate[s.name].lags_s, C_M_S) for s in specs]
    power = np.zeros(grid.size, dtype=np.float32)

    def draw(number: int) -> None:
        power[:] = 0.0
        for mapper, one in zip(mappers, looks[number % len(looks)], strict=False):
            mapper.add(power, one.gcc)

    pairs = sum(len(correlate[spec.name].pairs) for spec in specs)
    return Case(f"map, {len(specs)} arrays, {grid.spacing_m:g} m", draw, pairs * grid.size)


def _located(specs: Sequence[ArraySpec], grid: Grid, sounds: Sequence[Sequence[Float32Array]]) -> Case:
    """Return the case of an event that is located from its samples, of several events in turns."""
    estimator = SrpPhat(specs, grid, C_M_S)

    def locate(number: int) -> None:
        sound = sounds[number % len(sounds)]
        estimator.locate({s.name: Sound((x,), RATE_HZ) for s, x in zip(specs, sound, strict=False)})

    return Case(f"located, {len(specs)} arrays, with covariance and confidence", locate)
