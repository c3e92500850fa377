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
    later_s = np.sort((other_s[None, :] - one_s[:, None]).ravel())
    later_s = later_s[np.abs(later_s) <= MOST_OFF_S]
    counts = np.searchsorted(later_s, later_s + SAME_S, side="right") - np.arange(len(later_s))
    if not len(counts) or (matches := int(counts.max())) < max(LEAST_MATCHES, LEAST_SHARE * fewer):
        return None
    first = int(counts.argmax())
    off_s = float(np.median(later_s[first : first + matches]))
    rivals = counts[np.abs(later_s - off_s) > 2.0 * SAME_S]
    if abs(off_s) < LEAST_OFF_S or rivals.max(initial=0) > MOST_RIVAL * matches:
        return None
    return off_s, matches
