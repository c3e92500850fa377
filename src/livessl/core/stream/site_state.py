"""The state that all passes over one site's messages share."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

from livessl.core.locate.estimator import Estimator
from livessl.core.stream.channel_faults import ChannelFaults
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import CorrelationCache, ForEach
from livessl.core.stream.load_policy import NOTHING_SHED, Relief
from livessl.core.stream.outlier_votes import OutlierVotes
from livessl.core.stream.parameters import FusionParameters
from livessl.core.types import ArraySpec, Frame, Message

MOST_CORRELATED: Final = 32
"""Most arrays whose frames are correlated for an event: those to which it is clearest, twice as many as the default
method locates with. Correlating the others costs most of what an array costs, and does not move the position."""


class SiteState:
    """State of a site that does not depend on the pass.

    Parameters
    ----------
    site : str
        Name that event ids begin with.
    arrays : sequence of ArraySpec
    estimator : Estimator
    parameters : FusionParameters
    clock_offsets : ClockOffsets or None
        Offsets of the arrays' clocks, learned from events; None takes all clocks to agree.
    for_each : ForEach or None
        Correlates several arrays, perhaps in parallel; None does one after the other.
    free_axes : sequence of int
        Axes along which the search volume is not flat: those of a position's set-up error where an estimator returns no
        covariance.
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
        self.arrays = {spec.name: spec for spec in arrays}
        self.estimator = estimator
        self.parameters = parameters or FusionParameters()
        self.clock_offsets = clock_offsets
        self.cache = CorrelationCache(estimator, for_each)
        self.votes = OutlierVotes(self.arrays)
        self.channel_faults = ChannelFaults(self.arrays)
        self._answering: set[str] = set()
        self._excluded: Collection[str] = ()
        self.relief = NOTHING_SHED
        """The work that is shed while the server is overloaded."""

    def relieve(self, relief: Relief) -> None:
        """Shed this from now on."""
        self.relief = relief

    @property
    def most_arrays(self) -> int:
        """Most arrays that an event or a window is located from; never fewer than `min_arrays`."""
        shed = self.relief.arrays
        least = self.parameters.min_arrays
        return MOST_CORRELATED if shed is None else max(least, min(shed, MOST_CORRELATED))

    def exclude(self, arrays: Collection[str]) -> None:
        """Exclude these arrays from now on, and include all others again.

        No frame of an excluded array is active, awaited or requested.
        """
        self._excluded = arrays

    def is_excluded(self, array: str) -> bool:
        """Return whether an array is excluded."""
        return array in self._excluded

    def without_excluded(self, message: Message) -> Message:
        """Return a message as it is used: no frame of an excluded array is active."""
        if message.array in self._excluded and isinstance(message, Frame) and message.active:
            return replace(message, active=False)
        return message

    def set_answers(self, array: str, answers: bool) -> None:
        """Record whether the node of an array answers backfill requests; at first none does."""
        (self._answering.add if answers else self._answering.discard)(array)

    def stop_answers(self) -> None:
        """Record that no node answers backfill requests any more."""
        self._answering.clear()

    def answers(self, array: str) -> bool:
        """Return whether the node of an array answers backfill requests."""
        return array in self._answering

    def may_request(self, array: str) -> bool:
        """Return whether frames may be requested from an array: its node answers, and its sound would be used."""
        return self.answers(array) and not self.is_excluded(array) and self.channel_faults.of(array) is None

    def specs(self, arrays: Sequence[str]) -> list[ArraySpec]:
        """Return the specifications of the arrays named."""
        return [self.arrays[name] for name in arrays]
