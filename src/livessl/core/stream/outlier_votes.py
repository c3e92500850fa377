"""Decides which arrays are suspect: those that were outliers in many of the last events."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from livessl.core.locate.estimator import Localization

VOTES: Final = 10
"""Number of latest events for which the votes of an array are kept."""

LEAST_VOTES: Final = 3
"""Number of outlier votes from which an array is suspect, if they are also more than half of its last `VOTES` votes.
The same number of consecutive agreements clears the array. It is also the least number of arrays in a counted
consensus."""

Votes = tuple[tuple[int, float | None], ...]
"""One entry for each of the last events: the frame index at which it began, and the error of the array's
direction in degrees; None if the array agreed with the others."""


class OutlierVotes:
    """The votes of all arrays. Any thread may read the votes of an array, which are replaced and never changed.

    Parameters
    ----------
    arrays : iterable of str
        Names of the arrays.
    """

    def __init__(self, arrays: Iterable[str]) -> None:
        self._votes: dict[str, Votes] = dict.fromkeys(arrays, ())

    def of(self, array: str) -> Votes:
        """Return an array's votes, the oldest first."""
        return self._votes[array]

    def is_suspect(self, array: str) -> bool:
        """Return whether an array is suspect: see `LEAST_VOTES`."""
        return is_suspect(self._votes[array])

    def suspects(self) -> set[str]:
        """Return the names of the suspect arrays."""
        return {array for array, votes in self._votes.items() if is_suspect(votes)}

    def count(self, start: int, found: Localization, detected_by: Iterable[str]) -> None:
        """Add the votes of an event; they replace earlier votes of the same event.

        Parameters
        ----------
        start : int
            Frame index at which the event began.
        found : Localization
            Localization of the event. It is counted only if at least `LEAST_VOTES` arrays are in the consensus.
        detected_by : iterable of str
            Arrays that detected the event by themselves.
        """
        if found.outliers is None or len(found.evidence) < LEAST_VOTES:
            return
        for array in detected_by:
            if array not in found.unneeded:
                others = [vote for vote in self._votes[array] if vote[0] != start]
                self._votes[array] = (*others, (start, found.outliers.get(array)))[-VOTES:]

    def clear(self) -> None:
        """Remove all votes."""
        self._votes.update(dict.fromkeys(self._votes, ()))


def is_suspect(votes: Votes) -> bool:
    """Return whether an array with these votes is suspect: see `LEAST_VOTES`."""
    outlying = [vote for vote in votes if vote[1] is not None]
    lately = any(vote[1] is not None for vote in votes[-LEAST_VOTES:])
    return len(outlying) >= LEAST_VOTES and 2 * len(outlying) > len(votes) and lately
