"""The state that the early and the final pass share: poses in force, disabled arrays, and the work that is shed."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Final, Self

from livessl.core.locate.estimator import Estimator
from livessl.core.stream.channel_faults import ChannelFaults
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import CorrelationCache, ForEach
from livessl.core.stream.load_policy import NOTHING_SHED, Relief
from livessl.core.stream.outlier_votes import OutlierVotes
from livessl.core.stream.parameters import FusionParameters
from livessl.core.types import ArraySpec, Frame, Message

MOST_CORRELATED: Final = 32
"""Largest number of arrays whose frames are correlated for an event: the clearest arrays, twice as many as the default
method uses. Correlation takes most of the time for an array, and further arrays do not move the position."""


@dataclass(frozen=True, slots=True)
class ArraySetUp:
    """The arrays with their poses, and the estimator and cache that belong to these poses.

    Parameters
    ----------
    arrays : mapping of array to ArraySpec
    estimator : Estimator
    cache : CorrelationCache
        Correlations by the estimator's front ends.
    """

    arrays: Mapping[str, ArraySpec]
    estimator: Estimator
    cache: CorrelationCache

    @classmethod
    def of(cls, arrays: Sequence[ArraySpec], estimator: Estimator, for_each: ForEach | None = None) -> Self:
        """Return the set-up of some arrays, with an empty cache."""
        return cls({spec.name: spec for spec in arrays}, estimator, CorrelationCache(estimator, for_each))


@dataclass(slots=True)
class _Conditions:
    """Conditions that change while a site runs, and that all passes share."""

    answering: set[str] = field(default_factory=set)
    excluded: Collection[str] = ()
    relief: Relief = NOTHING_SHED


class SiteState:
    """State of a site. All passes over its messages share the state, except the set-up of the arrays.

    Parameters
    ----------
    site : str
        Name of the site, with which event ids begin.
    arrays : sequence of ArraySpec
    estimator : Estimator
    parameters : FusionParameters
    clock_offsets : ClockOffsets or None
        Offsets of the arrays' clocks, learned from events; with None, all clocks count as equal.
    for_each : ForEach or None
        Correlates several arrays, perhaps in parallel; with None, one after the other.
    free_axes : sequence of int
        Axes along which the search volume is not flat. If an estimator returns no covariance, the error of the set-up
        has these axes.
    """

    def __init__(
        self,
        site: str,
        arrays: Sequence[ArraySpec],
        estimator: Estimator,
        parameters: FusionParameters | None = None,
        *,
        clock_offsets: ClockOffsets | None = None,
        for_each: ForEach | None = None,
        free_axes: Sequence[int] = (0, 1, 2),
    ) -> None:
        self.site = site
        self.free_axes = free_axes
        self.parameters = parameters or FusionParameters()
        self.clock_offsets = clock_offsets
        self._set_up = ArraySetUp.of(arrays, estimator, for_each)
        self._following: deque[tuple[int, ArraySetUp]] = deque()  # and the frame indices from which they apply
        self.votes = OutlierVotes(self.arrays)
        self.channel_faults = ChannelFaults(self.arrays)
        self._conditions = _Conditions()

    # --- the set-up of the arrays, which each pass follows by itself

    def for_another_pass(self) -> SiteState:
        """Return the state for another pass over the same messages; that pass follows the set-up by itself."""
        other = copy(self)
        other._following = deque(self._following)
        return other

    @property
    def arrays(self) -> Mapping[str, ArraySpec]:
        """The arrays by name."""
        return self._set_up.arrays

    @property
    def estimator(self) -> Estimator:
        """The estimator in use."""
        return self._set_up.estimator

    @property
    def cache(self) -> CorrelationCache:
        """The correlations of the arrays' frames."""
        return self._set_up.cache

    def follow(self, set_up: ArraySetUp, first: int | None) -> None:
        """Use another set-up of the same arrays from the frame index `first` on, or at once if that is None."""
        if first is None:
            self._set_up = set_up
            self._following.clear()
        else:
            self._following.append((first, set_up))

    def advance(self, frame_index: int) -> bool:
        """Use the set-up that applies at a frame index before which all events are reported.

        Return whether the set-up has changed.
        """
        before = self._set_up
        while self._following and self._following[0][0] <= frame_index:
            self._set_up = self._following.popleft()[1]
        return self._set_up is not before

    def use_newest(self) -> None:
        """Use the newest set-up at once, even if it was to apply from a later frame index."""
        if self._following:
            self._set_up = self._following[-1][1]
            self._following.clear()

    def start_over(self) -> None:
        """Forget all facts learned about the arrays, because the server's clock was set back."""
        self.use_newest()
        self.cache.clear()
        self.votes.clear()
        self.channel_faults.clear()

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute the tables for an array's sound in advance, for the set-up in use and the ones that follow."""
        for set_up in (self._set_up, *(following for _, following in self._following)):
            set_up.estimator.prepare(array, sample_rate_hz)

    # --- conditions

    @property
    def relief(self) -> Relief:
        """The work that is shed while the server is overloaded."""
        return self._conditions.relief

    def relieve(self, relief: Relief) -> None:
        """Shed the work that `relief` names from now on."""
        self._conditions.relief = relief

    @property
    def most_arrays(self) -> int:
        """Most arrays from which an event or a window is located; while work is shed, at least `min_arrays`."""
        shed = self.relief.arrays
        least = self.parameters.min_arrays
        return MOST_CORRELATED if shed is None else max(least, min(shed, MOST_CORRELATED))

    def exclude(self, arrays: Collection[str]) -> None:
        """Exclude these arrays from now on, and include all others again.

        No frame of an excluded array is active, awaited or requested.
        """
        self._conditions.excluded = arrays

    def is_excluded(self, array: str) -> bool:
        """Return whether an array is excluded."""
        return array in self._conditions.excluded

    def without_excluded(self, message: Message) -> Message:
        """Return a message, with a frame of an excluded array marked as not active."""
        if message.array in self._conditions.excluded and isinstance(message, Frame) and message.active:
            return replace(message, active=False)
        return message

    def set_answers(self, array: str, answers: bool) -> None:
        """Record whether the node of an array answers backfill requests; initially no node does."""
        answering = self._conditions.answering
        (answering.add if answers else answering.discard)(array)

    def stop_answers(self) -> None:
        """Record that no node answers backfill requests any more."""
        self._conditions.answering.clear()

    def answers(self, array: str) -> bool:
        """Return whether the node of an array answers backfill requests."""
        return array in self._conditions.answering

    def may_request(self, array: str) -> bool:
        """Return whether frames may be requested from an array: its node answers, and its sound would be used."""
        return self.answers(array) and not self.is_excluded(array) and self.channel_faults.of(array) is None

    def specs(self, arrays: Sequence[str]) -> list[ArraySpec]:
        """Return the specifications of the arrays named."""
        return [self.arrays[name] for name in arrays]
