"""Estimates the offsets of the nodes' clocks from each other by located events. It reads no clock.

Clocks are compared with the server's in `server/node_clocks.py`; the drift of a device is measured in `timeline`.

A sound at a known position arrives at each array after its travel time; any other difference of its arrival times is a
difference of the clocks. Arrival times are compared by the rises of the power, correlated between arrays, so that
reverberation, level and the kind of sound matter little. Each event gives one difference. A robust line fit
to the differences of the last events gives the offset and drift of each clock relative to one of the clocks, because it
is unknown which clock is right.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any, Final

import numpy as np
import scipy

from livessl.core.types import FRAME_S, ArraySpec, FloatArray, Frame

MOST_OFF_S: Final = 0.6
"""Greatest offset, in seconds, that is searched for. With a greater offset, a sound is not one event of both arrays."""

INTERVAL_S: Final = 0.005
"""Length, in seconds, of the intervals whose power is computed; the peak is interpolated to a tenth of this."""

MOST_USED_S: Final = 3.0
"""Longest part of a sound, in seconds from its pre-roll on, that is used; the rest of a longer sound adds little."""

LEAST_SOUNDS: Final = 3
"""Least number of sounds from which an offset is used."""

KNOWN_S: Final = 0.01
"""Greatest standard deviation, in seconds, of an offset that is used."""

MOST_SOUNDS: Final = 32
"""Number of latest sounds from which an offset is estimated."""

SMALL_S: Final = 0.01
"""Offset, in seconds, below which a clock is not corrected; frames are 50 ms long."""

_HYSTERESIS: Final = 0.7
"""Rest of an offset, as a share of a frame, from which the correction by whole frames changes. It is above 0.5, so that
a correction does not alternate."""

_DECAY_DB_S: Final = 40.0
"""Decay of reverberation, in dB per second. Power below such a decay of earlier power is no rise."""

_STANDS_OUT: Final = 0.3
"""Least normalized height of the correlation's peak."""

_RIVAL: Final = 0.8
"""Greatest height of another peak, as a share of the first. The lag of a sound that repeats itself is ambiguous."""

_MICROPHONES: Final = 2
"""Number of microphones of each array that are used: two, because one may be dead."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Least power, full scale squared: the power of rounding to 16 bits."""

_ABOVE_NOISE: Final = 4.0
"""Ratio of power to that of the pre-roll above which the power belongs to a sound."""

_APART_S: Final = 0.03
"""Distance from the peak, in seconds, beyond which another maximum counts as a separate peak."""

_DRIFT: Final = 50e-6
"""Standard deviation of the rates of crystals, in seconds per second: the prior of the drift."""

_LEAST_SCATTER_S: Final = 1e-3
"""Least standard deviation, in seconds, of one sound's difference; positions are not more exact."""

_TUKEY: Final = 4.7
"""Number of standard deviations beyond which a sound has no weight: the usual constant of Tukey's biweight."""

_ITERATIONS: Final = 6
"""Number of iterations of the weights; further ones change the line by less than the scatter of one sound."""

_STEP_S: Final = 0.05
"""Least deviation, in seconds, of the last `LEAST_SOUNDS` sounds from the earlier line at which the clock counts as
having been set, if these sounds agree with one another."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Offset of a clock from the reference clock.

    Parameters
    ----------
    offset_s, std_s : float
        The offset and its standard deviation. With a positive offset the clock is ahead: it shows later times than
        the reference.
    sounds : int
        Number of sounds from which the offset was estimated.
    reference : str
        Name of the reference clock.
    """

    offset_s: float
    std_s: float
    sounds: int
    reference: str


class ClockOffsets:
    """A running estimate of the offsets of all clocks.

    Parameters
    ----------
    clocks : mapping of array to clock
        The clock of each array; arrays of one node have the same clock. With two clocks, the first one is the
        reference.
    c_m_s : float
        Speed of sound.
    """

    def __init__(self, clocks: Mapping[str, str], c_m_s: float) -> None:
        self._clock_of = dict(clocks)
        self._c_m_s = c_m_s
        self._late: dict[str, deque[tuple[int, float]]] = {
            clock: deque(maxlen=MOST_SOUNDS) for clock in self._clock_of.values()
        }
        self._known: dict[str, ClockOffset] = {}
        self._lines: dict[str, _Line] = {}  # cached; removed when the sounds of a clock change
        self._frames: dict[str, int] = dict.fromkeys(self._late, 0)

    def of(self, array: str) -> ClockOffset | None:
        """Return the offset of an array's clock at the last sound; None if it is not known yet."""
        return self._known.get(self._clock_of[array])

    def frames_ahead(self, array: str) -> int:
        """Return the correction of an array's frame indices, in whole frames and with hysteresis."""
        return self._frames[self._clock_of[array]]

    def rest_s(self, array: str) -> float:
        """Return the rest of an array's offset, in seconds; 0 if the offset is too small to be corrected."""
        offset, frames = self.of(array), self.frames_ahead(array)
        if offset is None or (frames == 0 and abs(offset.offset_s) < SMALL_S):
            return 0.0
        return offset.offset_s - frames * FRAME_S

    def differ(self, arrays: Iterable[str]) -> bool:
        """Return whether the arrays have more than one clock."""
        return len({self._clock_of[array] for array in arrays}) > 1

    def learn_from(
        self, time_ns: int, position_m: FloatArray, sounds: Sequence[tuple[ArraySpec, Sequence[Frame]]]
    ) -> None:
        """Learn from a sound at a known position.

        Parameters
        ----------
        time_ns : int
            Site time of the sound.
        position_m : (3,) float64
        sounds : sequence of (ArraySpec, frames)
            Each array's frames of the sound, without gaps, the pre-roll first.
        """
        travel_s = {s.name: float(np.linalg.norm(s.centre_m - position_m)) / self._c_m_s for s, _ in sounds}
        late_s = lateness_s({spec.name: frames for spec, frames in sounds}, travel_s)
        if self.differ(late_s):
            self.learn(time_ns, late_s)

    def learn(self, time_ns: int, late_s: Mapping[str, float]) -> None:
        """Learn from the arrival times of a sound.

        Parameters
        ----------
        time_ns : int
            Site time of the sound.
        late_s : mapping of array to float
            Arrival time by each array's own clock minus the travel time, in seconds after any common time.
        """
        each: dict[str, list[float]] = {}
        for array, late in late_s.items():
            each.setdefault(self._clock_of[array], []).append(late)
        now = {clock: float(np.median(values)) for clock, values in each.items()}
        expected = {clock: self._line(clock).at(time_ns)[0] for clock in now if self._late[clock]}
        moment = float(np.median([now[clock] - expected.get(clock, 0.0) for clock in expected or now]))
        for clock, late in now.items():
            self._forget_before_step(clock, time_ns, late - moment)
            self._late[clock].append((time_ns, late - moment))
            self._lines.pop(clock, None)
        self._know(time_ns)

    def state(self) -> dict[str, Any]:
        """Return the state of all clocks, as values of types that JSON has."""
        return {
            "heard": {clock: list(map(list, late)) for clock, late in self._late.items()},
            "frames": dict(self._frames),
            "known": {clock: astuple(offset) for clock, offset in self._known.items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from an earlier `state`; clocks that no longer exist are ignored."""
        for clock, late in self._late.items():
            late.extend((int(time_ns), float(late_s)) for time_ns, late_s in state["heard"].get(clock, ()))
            self._frames[clock] = int(state["frames"].get(clock, 0))
            if clock in state["known"]:
                self._known[clock] = ClockOffset(*state["known"][clock])

    def _line(self, clock: str) -> _Line:
        if clock not in self._lines:
            self._lines[clock] = _line(*zip(*self._late[clock], strict=True))
        return self._lines[clock]

    def _forget_before_step(self, clock: str, time_ns: int, late_s: float) -> None:
        """Forget all but the last sounds if these and the new one show that the clock was set: see `_STEP_S`."""
        kept = self._late[clock]
        if len(kept) < 2 * LEAST_SOUNDS:
            return
        line = self._line(clock)
        last = [*list(kept)[1 - LEAST_SOUNDS :], (time_ns, late_s)]
        off_s = np.array([late - line.at(at_ns)[0] for at_ns, late in last])
        if np.abs(off_s).min() > _STEP_S and np.ptp(off_s) < _STEP_S / 2.0:
            while len(kept) >= LEAST_SOUNDS:
                kept.popleft()

    def _know(self, time_ns: int) -> None:
        found = {c: self._line(c).at(time_ns) for c, late in self._late.items() if len(late) >= LEAST_SOUNDS}
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
                len(self._late[clock]),
                reference,
            )
            for clock, (offset_s, std_s) in known.items()
        }
        for clock, offset in self._known.items():
            if abs(offset.offset_s - self._frames[clock] * FRAME_S) > _HYSTERESIS * FRAME_S:
                self._frames[clock] = round(offset.offset_s / FRAME_S)


def clock_is_off(offset: ClockOffset) -> str:
    """Return the reason why an array with this offset, which exceeds a frame, is degraded."""
    side = "ahead of" if offset.offset_s > 0 else "behind"
    return (
        f"its clock is {1e3 * abs(offset.offset_s):.0f} ms (±{1e3 * offset.std_s:.0f}) {side} that of "
        f"{offset.reference!r}, estimated from {offset.sounds} sounds and corrected; set both by NTP"
    )


@dataclass(frozen=True, slots=True)
class _Line:
    origin_ns: int
    offset_s: float
    drift: float
    covariance: FloatArray  # (2, 2) of offset and drift

    def at(self, time_ns: int) -> tuple[float, float]:
        """Return the offset at a time and its standard deviation, seconds."""
        since_s = (time_ns - self.origin_ns) / 1e9
        terms = np.array([1.0, since_s])
        return self.offset_s + self.drift * since_s, float(np.sqrt(terms @ self.covariance @ terms))


def _line(times_ns: Sequence[int], offsets_s: Sequence[float]) -> _Line:
    """Fit a line to offsets by iterated weights (Tukey's biweight); with few offsets the prior keeps it flat."""
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
    """Compare the arrival times of a sound at several arrays, less the travel times.

    Parameters
    ----------
    frames : mapping of array to its frames
        Frames of the sound without gaps, the pre-roll first.
    travel_s : mapping of array to float
        Travel time from the sound's position to each array, in seconds.

    Returns
    -------
    dict of array to float
        Seconds by which the sound is later than at the array with the clearest rises, which has 0. Arrays without a
        clear answer are missing; without any it is empty.
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
    """Return how far the log power of each interval exceeds the decay of all earlier ones, (n,)."""
    frames = frames[: round(MOST_USED_S / FRAME_S)]
    samples = np.concatenate([frame.samples[:_MICROPHONES] for frame in frames], axis=1)
    steps = np.diff(samples, axis=1, prepend=samples[:, :1])  # no rumble
    intervals = round(FRAME_S / INTERVAL_S)
    lengths = [frame.samples.shape[1] for frame in frames]
    begins = np.cumsum([0, *lengths[:-1]])
    edges = np.concatenate(
        [first + np.arange(intervals) * n // intervals for first, n in zip(begins, lengths, strict=True)]
    )
    energy = np.add.reduceat(np.square(steps).sum(axis=0, dtype=np.float64), edges)
    power = energy / (len(samples) * np.maximum(1, np.diff(edges, append=samples.shape[1])))
    floor = max(float(np.median(power[: 2 * intervals])), _LEAST_POWER)
    level = np.log(np.maximum(power, _ABOVE_NOISE * floor))
    decay = np.log(10.0) / 10.0 * _DECAY_DB_S * INTERVAL_S * np.arange(len(level))
    past = np.maximum.accumulate(level + decay) - decay
    return np.asarray(np.maximum(0.0, level[1:] - past[:-1]))


def _lag_s(first: FloatArray, other: FloatArray) -> float | None:
    """Return by how much the rises of the other are later, in seconds; None if they do not match, or match twice."""
    norm = float(np.sqrt(np.square(first).sum() * np.square(other).sum()))
    if norm == 0.0:
        return None
    size = scipy.fft.next_fast_len(len(first) + len(other), real=True)
    smooth = np.array([0.25, 0.5, 0.25])
    spectra = [scipy.fft.rfft(np.convolve(rises, smooth), size) for rises in (first, other)]
    fits = scipy.fft.irfft(np.conj(spectra[0]) * spectra[1], size) / norm
    reach = min(round(MOST_OFF_S / INTERVAL_S), size // 2 - 1)
    lags = np.arange(-reach, reach + 1)
    fits = fits[lags]
    top = int(fits.argmax())
    apart = np.abs(lags - lags[top]) > _APART_S / INTERVAL_S
    if not 0 < top < len(lags) - 1 or fits[top] < _STANDS_OUT or fits[apart].max() > _RIVAL * fits[top]:
        return None
    before, at, after = fits[top - 1 : top + 2]
    return float(lags[top] + 0.5 * (before - after) / (before - 2.0 * at + after)) * INTERVAL_S
