"""Finds clocks that differ by so much that one sound is two events, by what rises in the recordings of both.

Smaller differences are estimated and corrected while sounds are located (`livessl.core.stream.clock_offsets`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
import scipy

from livessl.core.commission.envelopes import HOP_S
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import FloatArray

LEAST_OFF_S: Final = 0.3
"""Difference of two clocks, in seconds, from which it is an error: sounds that far apart are two events."""

MOST_OFF_S: Final = 60.0
"""Greatest difference, in seconds, that is looked for."""

LEAST_FIT: Final = 0.3
"""Least normalized correlation of the rises by two clocks for which they are taken to show the same sounds."""

MOST_RIVAL: Final = 0.7
"""Highest correlation with any other difference, as a share of this one: sounds at equal intervals fit many."""

LEAST_SOUNDS: Final = 4
"""Fewest rises, apart from each other, that have to fit: two or three sounds may follow one another alike by chance."""

APART_S: Final = 0.15
"""Distance, in seconds, from which two differences, or two rises, are not the same one."""

_SMOOTH: Final = np.array([0.25, 0.5, 0.25])
_BLOCK: Final = 60_000
"""Pieces, ten minutes, that are correlated at one time."""

_LARGE: Final = 0.2
"""Share of the largest product of rises from which a product counts as a sound."""


@dataclass(frozen=True, slots=True)
class Rises:
    """Times at which the sound in a recording rises.

    Parameters
    ----------
    start_s : float
        When the recording begins by its clock, seconds.
    values : (n,) float64
        `EnvelopeMeter.rises` of it.
    """

    start_s: float
    values: FloatArray


@dataclass(frozen=True, slots=True)
class _Difference:
    later_s: float
    sounds: int
    fit: float


def find_clock_faults(recordings: Mapping[str, Rises]) -> Iterator[Finding]:
    """Yield an error for every clock that differs by `LEAST_OFF_S` or more from the one that most others agree with.

    Parameters
    ----------
    recordings : mapping of clock to Rises
        What one array recorded by each clock.
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
        # the one with fewer friends is off; of two alike, the second one of the site file
        is_first = agreeing[one] < agreeing[other]
        off, right = (one, other) if is_first else (other, one)
        if off in reported:
            continue
        reported.add(off)
        later_s = -difference.later_s if is_first else difference.later_s
        side = "ahead of" if later_s > 0.0 else "behind"
        message = (
            f"the clock of {off!r} is {abs(later_s):.1f} s {side} that of {right!r}: {difference.sounds} sounds come "
            "again with that difference"
        )
        cure = "set the clocks of both by NTP; what was recorded with them does not fit together"
        yield Finding("clock", None, None, Severity.ERROR, min(0.99, 0.5 + difference.fit / 2.0), message, cure)


def _difference(one: Rises, other: Rises) -> _Difference | None:
    """Return by how much the other's sounds are later; None if no difference stands out."""
    values = [np.convolve(rises.values, _SMOOTH, mode="same") for rises in (one, other) if rises.values.any()]
    if len(values) < 2:
        return None
    began_s = other.start_s - one.start_s
    middle, reach = round(-began_s / HOP_S), round(MOST_OFF_S / HOP_S)
    lags = np.arange(max(middle - reach, 1 - len(values[0])), min(middle + reach, len(values[1]) - 1) + 1)
    if not len(lags):
        return None
    norm = float(np.sqrt((values[0] ** 2).sum() * (values[1] ** 2).sum()))
    fits = _correlation(values[0], values[1], int(lags[0]), len(lags)) / norm
    top = int(fits.argmax())
    apart = np.abs(lags - lags[top]) > APART_S / HOP_S
    if fits[top] < LEAST_FIT or fits[apart].max(initial=0.0) > MOST_RIVAL * fits[top]:
        return None
    sounds = _sounds(values[0], values[1], int(lags[top]))
    if sounds < LEAST_SOUNDS:
        return None
    return _Difference(began_s + float(lags[top]) * HOP_S, sounds, float(fits[top]))


def _correlation(one: FloatArray, other: FloatArray, first: int, count: int) -> FloatArray:
    """Sum of `one[n] other[n + lag]` over n for `count` lags from `first` on, block by block: sessions are long."""
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
    """Count the rises, apart from each other, that two recordings have in common at a lag."""
    first, second = (one[-lag:], other) if lag < 0 else (one, other[lag:])
    length = min(len(first), len(second))
    product = first[:length] * second[:length]
    at = np.flatnonzero(product > _LARGE * product.max(initial=0.0))
    return 0 if not len(at) else 1 + int(np.count_nonzero(np.diff(at) > APART_S / HOP_S))
