"""Finds clocks that differ by so much that one sound is two events: sounds come again, later by one of the clocks.

Smaller differences are estimated and corrected while sounds are located (`livessl.core.stream.clock_offsets`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import FloatArray

LEAST_OFF_S: Final = 0.3
"""Difference of two clocks, in seconds, from which it is looked for here: sounds that far apart are two events."""

MOST_OFF_S: Final = 60.0
"""Greatest difference, in seconds, that is looked for."""

LEAST_MATCHES: Final = 4
"""Fewest sounds that must come again with one difference: by chance, pauses are not equal so often."""

SAME_S: Final = 0.15
"""Width, in seconds, within which differences are one; arrays detect a sound up to some frames apart."""

LEAST_SHARE: Final = 0.6
"""Share of the sounds of the clock with fewer of them that must come again. Where a pause is as long as the difference,
two sounds are one event, and the second seems to begin at once by both clocks."""

MOST_RIVAL: Final = 0.7
"""Most sounds that may come again with any other difference, as a share of these: sounds at equal intervals come again
with many differences."""


def find_clock_faults(starts_s: Mapping[str, Sequence[float]]) -> Iterator[Finding]:
    """Yield an error for every two clocks that differ by `LEAST_OFF_S` or more.

    Parameters
    ----------
    starts_s : mapping of clock to sequence of float
        When each sound began by that clock, in seconds.
    """
    for one, other in combinations(starts_s, 2):
        found = _difference(np.sort(starts_s[one]), np.sort(starts_s[other]))
        if found is not None:
            later_s, matches = found
            side = "ahead of" if later_s > 0.0 else "behind"
            message = (
                f"the clock of {other!r} is {abs(later_s):.1f} s {side} that of {one!r}: {matches} sounds come again "
                "with that difference"
            )
            cure = "set the clocks of both by NTP; what was recorded with them does not fit together"
            yield Finding("clock", None, None, Severity.ERROR, 1.0 - 0.5**matches, message, cure)


def _difference(one_s: FloatArray, other_s: FloatArray) -> tuple[float, int] | None:
    """Return by how much the other's sounds are later, and how many are; None if no difference stands out."""
    fewer = min(len(one_s), len(other_s))
    if fewer < LEAST_MATCHES:
        return None
    begin, end = (np.searchsorted(other_s, one_s + reach_s) for reach_s in (-MOST_OFF_S, MOST_OFF_S))
    later_s = np.sort(np.concatenate([other_s[i:k] - at_s for at_s, i, k in zip(one_s, begin, end, strict=True)]))
    counts = np.searchsorted(later_s, later_s + SAME_S, side="right") - np.arange(len(later_s))
    if not len(counts):
        return None
    first, most = int(counts.argmax()), int(counts.max())
    off_s = float(np.median(later_s[first : first + most]))
    matches = _matches(one_s, other_s - off_s)
    rivals = counts[np.abs(later_s - off_s) > 2.0 * SAME_S]
    if matches < max(LEAST_MATCHES, LEAST_SHARE * fewer) or abs(off_s) < LEAST_OFF_S:
        return None
    return None if rivals.max(initial=0) > MOST_RIVAL * most else (off_s, matches)


def _matches(one_s: FloatArray, other_s: FloatArray) -> int:
    """Return how many sounds have one of the other clock, at most as many as those have of this one."""

    def with_another(these_s: FloatArray, those_s: FloatArray) -> int:
        near = np.searchsorted(those_s, these_s + SAME_S / 2.0) - np.searchsorted(those_s, these_s - SAME_S / 2.0)
        return int(np.count_nonzero(near))

    return min(with_another(one_s, other_s), with_another(other_s, one_s))
