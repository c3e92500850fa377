"""Finds clocks so far apart that one sound becomes two events, from when recordings rise (a finding of doctor).

Smaller differences are estimated and corrected while sounds are located (`livessl.core.stream.clock_offsets`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
import scipy

from livessl.core.commission.envelopes import INTERVAL_S
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import FloatArray

LEAST_OFF_S: Final = 0.3
"""Difference of two clocks, in seconds, from which it is reported as an error, because one sound then becomes two
events."""

MOST_OFF_S: Final = 60.0
"""Greatest difference of two clocks, in seconds, that can be found."""

LEAST_FIT: Final = 0.3
"""Least normalized correlation of the rises at which the recordings of two clocks count as recordings of the same
sounds."""

MOST_RIVAL: Final = 0.7
"""Highest correlation at any other difference, as a share of the correlation at the best one. Sounds at equal intervals
correlate at several differences."""

LEAST_SOUNDS: Final = 4
"""Fewest separate rises that both recordings must have in common. Two or three sounds can have the same intervals by
chance."""

APART_S: Final = 0.15
"""Least distance, in seconds, of two differences, or of two rises, that count as separate."""

_SMOOTH: Final = np.array([0.25, 0.5, 0.25])
_BLOCK: Final = 60_000
"""Number of values of `Rises` that are correlated at one time: ten minutes."""

_LARGE: Final = 0.2
"""Least product of rises that counts as a sound, as a share of the largest product."""


@dataclass(frozen=True, slots=True)
class Rises:
    """Times at which the sound in a recording rises.

    Parameters
    ----------
    start_s : float
        Time at which the recording begins, by its own clock, seconds.
    values : (n,) float64
        `EnvelopeMeter.rises` of the recording.
    """

    start_s: float
    values: FloatArray


@dataclass(frozen=True, slots=True)
class _Difference:
    later_s: float
    sounds: int
    fit: float


def find_clock_faults(recordings: Mapping[str, Rises]) -> Iterator[Finding]:
    """Yield an error for every clock that differs by `LEAST_OFF_S` or more from the majority of the others.

    Parameters
    ----------
    recordings : mapping of clock to Rises
        The rises in the recording of one array for each clock.
    """
    found = {
        (one, other): difference
        for one, other in combinations(recordings, 2)
        if (difference := _difference(recordings[one], recordings[other])) is not None
    }
    reported: set[str] = set()
    agreeing = {
        clock: sum(abs(one.later_s) < LEAST_OFF_S for pair, one in found.items() if clock in pair)
        for clock in recordings
    }
    for (one, other), difference in sorted(found.items(), key=lambda pair: -pair[1].fit):
        if abs(difference.later_s) < LEAST_OFF_S:
            continue
        # the clock that agrees with fewer others is wrong; if both agree with as many, the later one in the site file
        is_first = agreeing[one] < agreeing[other]
        off, right = (one, other) if is_first else (other, one)
        if off in reported:
            continue
        reported.add(off)
        later_s = -difference.later_s if is_first else difference.later_s
        side = "ahead of" if later_s > 0.0 else "behind"
        message = (
            f"the clock of {off!r} is {abs(later_s):.1f} s {side} that of {right!r}: {difference.sounds} sounds "
            "are in both recordings with that difference"
        )
        cure = "set the clocks of both by NTP; recordings made with these clocks cannot be combined"
        yield Finding("clock", None, None, Severity.ERROR, min(0.99, 0.5 + difference.fit / 2.0), message, cure)


def _difference(one: Rises, other: Rises) -> _Difference | None:
    """Return by how much the sounds of the other recording are later; None if no difference stands out."""
    values = [np.convolve(rises.values, _SMOOTH, mode="same") for rises in (one, other) if rises.values.any()]
    if len(values) < 2:
        return None
    began_s = other.start_s - one.start_s
    middle, reach = round(-began_s / INTERVAL_S), round(MOST_OFF_S / INTERVAL_S)
    lags = np.arange(max(middle - reach, 1 - len(values[0])), min(middle + reach, len(values[1]) - 1) + 1)
    if not len(lags):
        return None
    norm = float(np.sqrt((values[0] ** 2).sum() * (values[1] ** 2).sum()))
    fits = _correlation(values[0], values[1], int(lags[0]), len(lags)) / norm
    top = int(fits.argmax())
    apart = np.abs(lags - lags[top]) > APART_S / INTERVAL_S
    if fits[top] < LEAST_FIT or fits[apart].max(initial=0.0) > MOST_RIVAL * fits[top]:
        return None
    sounds = _sounds(values[0], values[1], int(lags[top]))
    if sounds < LEAST_SOUNDS:
        return None
    return _Difference(began_s + float(lags[top]) * INTERVAL_S, sounds, float(fits[top]))


def _correlation(one: FloatArray, other: FloatArray, first: int, count: int) -> FloatArray:
    """Sum of `one[n] other[n + lag]` over n for `count` lags from `first` on, in blocks, because sessions are long."""
    total = np.zeros(count)
    size = scipy.fft.next_fast_len(_BLOCK + count, real=True)
    for begin in range(0, len(one), _BLOCK):
        block = one[begin : begin + _BLOCK]
        low, high = begin + first, begin + first + len(block) + count - 1
        beside = other[max(low, 0) : max(high, 0)]
        if not len(beside) or not block.any():
            continue
        beside = np.concatenate([np.zeros(max(0, -low)), beside])
        spectrum = np.conj(scipy.fft.rfft(block, size)) * scipy.fft.rfft(beside, size)
        total += scipy.fft.irfft(spectrum, size)[:count]
    return total


def _sounds(one: FloatArray, other: FloatArray, lag: int) -> int:
    """Count the separate rises that two recordings have in common at a lag."""
    first, second = (one[-lag:], other) if lag < 0 else (one, other[lag:])
    length = min(len(first), len(second))
    product = first[:length] * second[:length]
    at = np.flatnonzero(product > _LARGE * product.max(initial=0.0))
    return 0 if not len(at) else 1 + int(np.count_nonzero(np.diff(at) > APART_S / INTERVAL_S))
