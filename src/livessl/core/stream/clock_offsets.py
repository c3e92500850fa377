"""How far the nodes' clocks differ, told by the sounds that their arrays hear. It reads no clock.

A sound of known place should be heard at each array after its travel time; what is over is the clocks' difference. When
it is heard is told by the rises of the power, correlated between arrays, so that reverberation, levels and what the
sound is matter little. Each event gives one difference; a robust line through those of the last sounds gives each
clock's offset and drift, relative to one of the clocks: nobody here knows which one is right.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any, Final

import numpy as np
import scipy.fft

from livessl.core.types import FRAME_S, ArraySpec, FloatArray, Frame

MOST_OFF_S: Final = 0.6
"""Offsets beyond it are not looked for: such arrays' sounds do not meet in one event."""

HOP_S: Final = 0.005
"""Pieces that the power is taken of; the peak of the correlation is interpolated to a tenth of it."""

LISTENED_S: Final = 3.0
"""From the run-up of a sound on: more of a long one tells little more."""

LEAST_SOUNDS: Final = 3
"""Before an offset is believed."""

KNOWN_S: Final = 0.01
"""Standard deviation from which on it is."""

MOST_SOUNDS: Final = 32
"""That an offset is made of: the last ones."""

SMALL_S: Final = 0.01
"""An offset below this is nothing to correct: events are told to 50 ms."""

_MUCH: Final = 0.7
"""Of a frame: what is left of an offset after its correction may grow so far, lest corrections come and go."""

_DECAY_DB_S: Final = 40.0
"""Power that falls slower than this is reverberation: what comes up under it is no rise."""

_STANDS_OUT: Final = 0.3
"""Least height of the correlation's peak."""

_RIVAL: Final = 0.8
"""Highest other peak, of the first: a sound that repeats itself does not tell by how many periods it is late."""

_MICROPHONES: Final = 2
"""Listened to of each array: one may be dead."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Rounding to 16 bits, full scale squared: below it nothing is heard."""

_ABOVE_NOISE: Final = 4.0
"""Power above so many times that of the run-up is no noise."""

_APART_S: Final = 0.03
"""Further from the peak is another one."""

_DRIFT: Final = 50e-6
"""Standard deviation of crystals' rates, before sounds tell."""

_LEAST_SCATTER_S: Final = 1e-3
"""Of a sound's difference: positions are not known better than this."""

_TUKEY: Final = 4.7
"""Scatters beyond which a sound does not count."""

_ITERATIONS: Final = 6
"""Of the weights; more change less than a sound's own scatter."""

_STEP_S: Final = 0.05
"""So many last sounds as are needed to believe an offset, this far off and at one: the clock was set."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How far ahead of the reference a clock is.

    Parameters
    ----------
    offset_s, std_s : float
        Positive is ahead: its times are later than the reference's for the same moment.
    sounds : int
        It was made of.
    reference : str
        Name of the clock that it is relative to.
    """

    offset_s: float
    std_s: float
    sounds: int
    reference: str


class ClockOffsets:
    """Running estimate of every clock's offset.

    Parameters
    ----------
    clocks : mapping of array to clock
        Arrays of one node have one clock. The first one is the reference while there are two.
    c_m_s : float
        Speed of sound.
    """

    def __init__(self, clocks: Mapping[str, str], c_m_s: float) -> None:
        self._clock_of = dict(clocks)
        self._c_m_s = c_m_s
        self._heard: dict[str, deque[tuple[int, float]]] = {
            clock: deque(maxlen=MOST_SOUNDS) for clock in self._clock_of.values()
        }
        self._known: dict[str, ClockOffset] = {}
        self._lines: dict[str, _Line] = {}  # of the clocks that have not been heard since
        self._frames: dict[str, int] = dict.fromkeys(self._heard, 0)

    def of(self, array: str) -> ClockOffset | None:
        """How far off an array's clock was at the last sound; None where nobody knows yet."""
        return self._known.get(self._clock_of[array])

    def frames_ahead(self, array: str) -> int:
        """By how many whole frames an array's times are to be put back: it changes only with much, lest it flicker."""
        return self._frames[self._clock_of[array]]

    def rest_s(self, array: str) -> float:
        """What is left of an array's offset then, seconds; 0 for what is too small to tell."""
        offset, frames = self.of(array), self.frames_ahead(array)
        if offset is None or (frames == 0 and abs(offset.offset_s) < SMALL_S):
            return 0.0
        return offset.offset_s - frames * FRAME_S

    def tell_apart(self, arrays: Iterable[str]) -> bool:
        """Whether the arrays have different clocks."""
        return len({self._clock_of[array] for array in arrays}) > 1

    def learn_from(
        self, time_ns: int, position_m: FloatArray, heard: Sequence[tuple[ArraySpec, Sequence[Frame]]]
    ) -> None:
        """Learn from a sound of known place: of each array the frames of it, without gaps, its run-up first."""
        travel_s = {s.name: float(np.linalg.norm(s.centre_m - position_m)) / self._c_m_s for s, _ in heard}
        late_s = lateness_s({spec.name: frames for spec, frames in heard}, travel_s)
        if self.tell_apart(late_s):
            self.learn(time_ns, late_s)

    def learn(self, time_ns: int, late_s: Mapping[str, float]) -> None:
        """Take in how late each array heard a sound, by its own clock and but for the travel time.

        Parameters
        ----------
        time_ns : int
            When that was.
        late_s : mapping of array to float
            Seconds against one moment, whichever.
        """
        each: dict[str, list[float]] = {}
        for array, late in late_s.items():
            each.setdefault(self._clock_of[array], []).append(late)
        now = {clock: float(np.median(values)) for clock, values in each.items()}
        expected = {clock: self._line(clock).at(time_ns)[0] for clock in now if self._heard[clock]}
        moment = float(np.median([now[clock] - expected.get(clock, 0.0) for clock in expected or now]))
        for clock, late in now.items():
            self._forget_before_step(clock, time_ns, late - moment)
            self._heard[clock].append((time_ns, late - moment))
            self._lines.pop(clock, None)
        self._know(time_ns)

    def state(self) -> dict[str, Any]:
        """All that is known, as JSON can hold it."""
        return {
            "heard": {clock: list(map(list, heard)) for clock, heard in self._heard.items()},
            "frames": dict(self._frames),
            "known": {clock: astuple(offset) for clock, offset in self._known.items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state`, as far as it is of clocks that there are."""
        for clock, heard in self._heard.items():
            heard.extend((int(time_ns), float(late_s)) for time_ns, late_s in state["heard"].get(clock, ()))
            self._frames[clock] = int(state["frames"].get(clock, 0))
            if clock in state["known"]:
                self._known[clock] = ClockOffset(*state["known"][clock])

    def _line(self, clock: str) -> _Line:
        if clock not in self._lines:
            self._lines[clock] = _line(*zip(*self._heard[clock], strict=True))
        return self._lines[clock]

    def _forget_before_step(self, clock: str, time_ns: int, late_s: float) -> None:
        """Forget all but the last sounds where these and the new one agree, and are far off what was before."""
        heard = self._heard[clock]
        if len(heard) < 2 * LEAST_SOUNDS:
            return
        line = self._line(clock)
        last = [*list(heard)[1 - LEAST_SOUNDS :], (time_ns, late_s)]
        off_s = np.array([late - line.at(at_ns)[0] for at_ns, late in last])
        if np.abs(off_s).min() > _STEP_S and np.ptp(off_s) < _STEP_S / 2.0:
            while len(heard) >= LEAST_SOUNDS:
                heard.popleft()

    def _know(self, time_ns: int) -> None:
        found = {c: self._line(c).at(time_ns) for c, heard in self._heard.items() if len(heard) >= LEAST_SOUNDS}
        known = {clock: (offset_s, std_s) for clock, (offset_s, std_s) in found.items() if std_s < KNOWN_S}
        if len(known) < 2:
            return
        ordered = sorted(known, key=lambda clock: known[clock][0])
        middle = ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]
        reference = next(clock for clock in known if clock in middle)
        zero_s, zero_std_s = known[reference]
        self._known = {
            clock: ClockOffset(
                offset_s - zero_s,
                0.0 if clock == reference else std_s + zero_std_s,
                len(self._heard[clock]),
                reference,
            )
            for clock, (offset_s, std_s) in known.items()
        }
        for clock, offset in self._known.items():
            if abs(offset.offset_s - self._frames[clock] * FRAME_S) > _MUCH * FRAME_S:
                self._frames[clock] = round(offset.offset_s / FRAME_S)


def clock_is_off(offset: ClockOffset) -> str:
    """What to say of a clock that is off by more than a frame."""
    side = "ahead of" if offset.offset_s > 0 else "behind"
    return (
        f"its clock is {1e3 * abs(offset.offset_s):.0f} ms (±{1e3 * offset.std_s:.0f}) {side} that of "
        f"{offset.reference!r}, by {offset.sounds} sounds; this is corrected for: set both by NTP"
    )


@dataclass(frozen=True, slots=True)
class _Line:
    origin_ns: int
    offset_s: float
    drift: float
    covariance: FloatArray  # (2, 2) of offset and drift

    def at(self, time_ns: int) -> tuple[float, float]:
        """Offset at a time and its standard deviation, seconds."""
        since_s = (time_ns - self.origin_ns) / 1e9
        terms = np.array([1.0, since_s])
        return self.offset_s + self.drift * since_s, float(np.sqrt(terms @ self.covariance @ terms))


def _line(times_ns: Sequence[int], offsets_s: Sequence[float]) -> _Line:
    """Line through the offsets at some times by iterated weights (Tukey's); flat where too few tell its slope."""
    origin_ns, late_s = times_ns[-1], np.array(offsets_s)
    terms = np.stack([np.ones_like(late_s), (np.array(times_ns) - origin_ns) / 1e9], axis=1)
    found = np.array([np.median(late_s), 0.0])
    for _ in range(_ITERATIONS):
        off_s = late_s - terms @ found
        scatter_s = max(_LEAST_SCATTER_S, 1.4826 * float(np.median(np.abs(off_s))))
        weights = np.square(np.maximum(0.0, 1.0 - np.square(off_s / (_TUKEY * scatter_s))))
        normal = (terms.T * weights) @ terms + np.diag([0.0, (scatter_s / _DRIFT) ** 2])
        found = np.linalg.solve(normal, (terms.T * weights) @ late_s)
    return _Line(origin_ns, float(found[0]), float(found[1]), scatter_s**2 * np.linalg.inv(normal))


def lateness_s(frames: Mapping[str, Sequence[Frame]], travel_s: Mapping[str, float]) -> dict[str, float]:
    """How late each array heard a sound against one that did well, but for the travel time; none where it is not sure.

    Parameters
    ----------
    frames : mapping of array to its frames
        Without gaps, from the run-up on.
    travel_s : mapping of array to float
        From the sound's place to the array.
    """
    rises = {array: _rises(some) for array, some in frames.items() if len(some) > 1}
    if len(rises) < 2:
        return {}
    first = max(rises, key=lambda array: float(np.square(rises[array]).sum()))
    late = {first: 0.0}
    for other in (array for array in rises if array != first):
        lag_s = _lag_s(rises[first], rises[other])
        if lag_s is not None:
            began_s = (frames[other][0].time_ns - frames[first][0].time_ns) / 1e9
            late[other] = lag_s + began_s - (travel_s[other] - travel_s[first])
    return late if len(late) > 1 else {}


def _rises(frames: Sequence[Frame]) -> FloatArray:
    """By how much the power of each piece of `HOP_S` exceeds all before it, less the decay; log, (n,)."""
    frames = frames[: round(LISTENED_S / FRAME_S)]
    samples = np.concatenate([frame.samples[:_MICROPHONES] for frame in frames], axis=1)
    steps = np.diff(samples, axis=1, prepend=samples[:, :1])  # no rumble
    pieces = round(FRAME_S / HOP_S)
    lengths = [frame.samples.shape[1] for frame in frames]
    begins = np.cumsum([0, *lengths[:-1]])
    edges = np.concatenate([first + np.arange(pieces) * n // pieces for first, n in zip(begins, lengths, strict=True)])
    energy = np.add.reduceat(np.square(steps).sum(axis=0, dtype=np.float64), edges)
    power = energy / (len(samples) * np.maximum(1, np.diff(edges, append=samples.shape[1])))
    floor = max(float(np.median(power[: 2 * pieces])), _LEAST_POWER)
    level = np.log(np.maximum(power, _ABOVE_NOISE * floor))
    decay = np.log(10.0) / 10.0 * _DECAY_DB_S * HOP_S * np.arange(len(level))
    past = np.maximum.accumulate(level + decay) - decay
    return np.asarray(np.maximum(0.0, level[1:] - past[:-1]))


def _lag_s(first: FloatArray, other: FloatArray) -> float | None:
    """By how much later the other's rises come, seconds; None where they do not fit, or as well at another lag."""
    norm = float(np.sqrt(np.square(first).sum() * np.square(other).sum()))
    if norm == 0.0:
        return None
    size = scipy.fft.next_fast_len(len(first) + len(other), real=True)
    smooth = np.array([0.25, 0.5, 0.25])
    spectra = [scipy.fft.rfft(np.convolve(rises, smooth), size) for rises in (first, other)]
    fits = scipy.fft.irfft(np.conj(spectra[0]) * spectra[1], size) / norm
    reach = min(round(MOST_OFF_S / HOP_S), size // 2 - 1)
    lags = np.arange(-reach, reach + 1)
    fits = fits[lags]
    top = int(fits.argmax())
    apart = np.abs(lags - lags[top]) > _APART_S / HOP_S
    if not 0 < top < len(lags) - 1 or fits[top] < _STANDS_OUT or fits[apart].max() > _RIVAL * fits[top]:
        return None
    before, at, after = fits[top - 1 : top + 2]
    return float(lags[top] + 0.5 * (before - after) / (before - 2.0 * at + after)) * HOP_S
