"""Makes results from localizations: id, status, reason, and the contribution of each array. It keeps no state.

`locate/confidence.py` decides whether a position is refused because of its confidence.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.commission.observe import receive
from livessl.core.geometry import direction_deg
from livessl.core.locate.confidence import NEAR_M
from livessl.core.locate.contributing import NO_EVIDENCE
from livessl.core.locate.estimator import Localization
from livessl.core.locate.map_estimator import MapEstimator
from livessl.core.locate.set_up_error import half_axis_m, probability_within, set_up_covariance_m2
from livessl.core.stream.excerpt import BackfilledSound, Excerpt
from livessl.core.stream.pending_event import PendingEvent
from livessl.core.stream.site_state import SiteState
from livessl.core.types import (
    FRAME_NS,
    FRAME_S,
    ArraySpec,
    Contribution,
    Estimate,
    Event,
    FloatArray,
    Received,
    Status,
    Update,
)

RANGE_UNKNOWN: Final = 0.25
"""Ratio of the position's standard deviation to its distance from the nearest array beyond which only the direction is
reported."""

RANGE_APERTURES: Final = 2.0
"""Ratio of distance to aperture beyond which one array gives no distance: reverberation shifts its delays, which
can move the position by metres along the line of sight. The covariance does not include this."""

NO_SOUND: Final = "the server was overloaded and kept none of its sound"
"""Reason for which an event is refused if no array's samples are left."""


def judged(found: Localization, specs: Sequence[ArraySpec]) -> tuple[Status, str | None]:
    """Decide whether a localization gives a position, only a direction, or neither, and why.

    Parameters
    ----------
    found : Localization
    specs : sequence of ArraySpec
        The arrays of the localization; empty if no array has evidence.

    Returns
    -------
    Status, str or None
        The status, and the reason for it; None without a reason.
    """
    if not specs:
        return Status.REFUSED, found.refused or NO_EVIDENCE
    spread_m = float(np.sqrt(max(0.0, np.linalg.eigvalsh(found.covariance_m2)[-1])))
    nearest_m = min(_distance_m(spec, found.position_m) for spec in specs)
    alone = len(specs) == 1 and nearest_m > RANGE_APERTURES * specs[0].aperture_m
    if spread_m <= RANGE_UNKNOWN * nearest_m and not alone:
        if found.refused is not None:
            return Status.REFUSED, found.refused
        return (Status.DIRECTION_ONLY, found.ambiguity) if found.candidates else (Status.LOCATED, _dissent(found))
    if found.features is not None and not found.features.has_direction:
        return Status.REFUSED, NO_EVIDENCE
    who = "one array" if len(specs) == 1 else "these arrays"
    unresolved = f"{who} cannot resolve the distance: ±{spread_m:.2f} m at {nearest_m:.2f} m"
    return Status.DIRECTION_ONLY, unresolved if found.ambiguity is None else f"{found.ambiguity}; {unresolved}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The events of a sound, one for each source, and their localization `found`; None if nothing was located."""

    events: list[Event]
    found: Localization | None


class Verdicts:
    """Locates excerpts, and judges the localizations.

    Parameters
    ----------
    state : SiteState
    """

    def __init__(self, state: SiteState) -> None:
        self._state = state

    def locate_event(
        self,
        event: PendingEvent,
        excerpt: Excerpt,
        now_ns: int,
        backfilled: Mapping[str, BackfilledSound] | None = None,
    ) -> Verdict:
        """Locate an event and return one event for each source.

        Parameters
        ----------
        event : PendingEvent
        excerpt : Excerpt
            Sound of the arrays that detected the event.
        now_ns : int
            Site time now.
        backfilled : mapping of array to BackfilledSound, optional
            Sounds of further arrays, which did not detect the event.
        """
        backfilled = backfilled or {}
        received, least = excerpt.with_backfill(backfilled), self._state.parameters.min_arrays
        faults = self._channel_faults(event, received)
        used = received.without(faults)
        count = "1 array" if len(received.sounds) == 1 else f"{len(received.sounds)} arrays"
        why = f"detected by {count}; fusion.min_arrays is {least}" if received.sounds else NO_SOUND
        few = why if len(received.sounds) < least else None
        first = self._refused(event, excerpt, now_ns, _joined(few, faults))
        if len(used.sounds) < least:
            return Verdict([replace(first, received=self._received(None, received, faults))], None)
        found = self._located(used)
        estimate = self._estimate(found, used)
        status, reason = self._judged(estimate, found)
        heard = self._received(found, received, faults)
        reason = _joined(reason, faults) or None
        power = first.power if found.power is None else found.power
        first = replace(first, status=status, reason=reason, power=power, received=heard)
        if status is not Status.REFUSED:
            contributions = self._contributions(used.powers, estimate, found, backfilled)
            first = replace(first, estimate=estimate, contributions=contributions)
        others = (
            replace(
                first,
                id=f"{first.id}-{source}",
                source=source,
                status=Status.LOCATED,
                reason=_joined(_limit_of_set_up(place), faults) or None,
                received=(),
                estimate=place,
                power=other.power,
                contributions=self._contributions(used.powers, place, found, backfilled),
            )
            for source, (other, place) in enumerate(self._others(found, used), 2)
        )
        return Verdict([first, *others], found)

    def _received(self, found: Localization | None, excerpt: Excerpt, faulty: Iterable[str]) -> tuple[Received, ...]:
        """Return the observations of all arrays, including those that were not used; none under overload."""
        estimator = self._state.estimator
        if self._state.relief.shed:
            return ()
        evidence = [] if found is None else list(found.evidence)
        known = {part.spec.name for part in evidence}
        missing = [name for name in (faulty if found is not None else excerpt.sounds) if name not in known]
        if missing and isinstance(estimator, MapEstimator):
            evidence += estimator.evidence({name: excerpt.sounds[name] for name in missing})
        return tuple(receive(part, excerpt.sounds[part.spec.name].segments) for part in evidence)

    def _channel_faults(self, event: PendingEvent, excerpt: Excerpt) -> dict[str, str]:
        """Return the faults, in words, of the arrays of an excerpt that have faulty channels."""
        examine, sounds = self._state.channel_faults.examine, excerpt.sounds
        faults = {name: examine(name, event.start, sound.onsets) for name, sound in sounds.items()}
        return {name: fault for name, fault in faults.items() if fault is not None}

    def _refused(self, event: PendingEvent, excerpt: Excerpt, now_ns: int, reason: str) -> Event:
        return Event(
            id=self._id(event.start),
            start_ns=excerpt.start_ns,
            end_ns=excerpt.end_ns,
            status=Status.REFUSED,
            reason=reason,
            estimate=None,
            power=excerpt.greatest_power,
            method=self._state.estimator.name,
            heard_by=tuple(excerpt.powers),
            late_frames=event.late_frames,
            latency_s=(now_ns - excerpt.end_ns) / 1e9,
            complete_ns=(event.closed + 1) * FRAME_NS,
        )

    def locate_window(self, event: PendingEvent, excerpt: Excerpt) -> tuple[Update, Localization]:
        """Locate a window of an event that continues; return the update and its localization."""
        found = self._located(excerpt)
        estimate = self._estimate(found, excerpt)
        status, _ = self._judged(estimate, found)
        return Update(
            event_id=self._id(event.start),
            status=status,
            estimate=estimate,
            power=excerpt.greatest_power,
            contributions=self._contributions(excerpt.powers, estimate, found),
            complete_ns=excerpt.end_ns,
            others=tuple(place for _, place in self._others(found, excerpt)),
        ), found

    def count_votes(self, event: PendingEvent, excerpt: Excerpt, verdict: Verdict) -> None:
        """Count which of the arrays that detected an event were outliers, unless the event was refused."""
        if verdict.found is not None and verdict.events[0].status is not Status.REFUSED:
            self._state.votes.count(event.start, verdict.found, excerpt.sounds)

    def _others(self, found: Localization, excerpt: Excerpt) -> list[tuple[Localization, Estimate]]:
        """Return the further sources of the sound that have a position, and their estimates."""
        others = [(other, self._estimate(other, excerpt)) for other in found.others]
        return [(other, place) for other, place in others if self._judged(place, other)[0] is Status.LOCATED]

    def _located(self, excerpt: Excerpt) -> Localization:
        """Locate an excerpt, and refuse results that contain NaN or infinity, which added methods may return."""
        estimator = self._state.estimator
        found = estimator.locate(excerpt.sounds)
        if np.isfinite(found.position_m).all() and np.isfinite(found.covariance_m2).all():
            return found
        return replace(
            found,
            position_m=np.where(np.isfinite(found.position_m), found.position_m, 0.0),
            covariance_m2=np.zeros((3, 3)),
            refused=f"method {estimator.name!r} answered with a position or covariance that is not finite",
            others=(),
            candidates=(),
            ambiguity=None,
        )

    def _estimate(self, found: Localization, excerpt: Excerpt) -> Estimate:
        arrays = _used(found, excerpt.sounds)
        of_set_up_m2 = np.zeros((3, 3))
        if arrays:
            axes = np.flatnonzero(np.diag(found.covariance_m2)).tolist() or self._state.free_axes
            of_set_up_m2 = set_up_covariance_m2(self._state.specs(arrays), found.position_m, axes)
        covariance_m2, confidence = found.covariance_m2 + of_set_up_m2, found.confidence
        if found.features is not None and of_set_up_m2.any():  # otherwise it is no probability, or that of the sound
            of_sound = probability_within(NEAR_M, found.covariance_m2)
            confidence *= min(1.0, probability_within(NEAR_M, covariance_m2) / max(of_sound, 1e-9))
        return Estimate(
            excerpt.middle_ns,
            found.position_m,
            covariance_m2,
            confidence,
            arrays,
            found.candidates,
            of_set_up_m2,
            found.confidence,
        )

    def _judged(self, estimate: Estimate, found: Localization) -> tuple[Status, str | None]:
        status, reason = judged(found, self._state.specs(estimate.arrays))
        least = self._state.parameters.min_arrays
        if status is Status.LOCATED:
            reason = "; ".join(filter(None, [reason, _limit_of_set_up(estimate)])) or None
        if status is Status.REFUSED or len(estimate.arrays) >= least:
            return status, reason
        names = " and ".join(map(repr, estimate.arrays))
        return Status.REFUSED, f"only {names} carried evidence of it; fusion.min_arrays is {least}"

    def _contributions(
        self,
        powers: Mapping[str, FloatArray],
        estimate: Estimate,
        found: Localization,
        backfilled: Collection[str] = (),
    ) -> tuple[Contribution, ...]:
        arrays = self._state.arrays
        return tuple(
            _contribution(arrays[name], power, estimate, found, backfilled=name in backfilled)
            for name, power in powers.items()
            if name not in backfilled or name not in found.unneeded
        )

    def _id(self, frame_index: int) -> str:
        """Return the id of an event that begins at a frame index: site and start, in milliseconds since the epoch.

        It is the same in every result of the event, after a restart, and in a replay at the same times.
        """
        return f"{self._state.site}-{frame_index * FRAME_NS // 1_000_000}"


def _used(found: Localization, arrays: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name in arrays if name not in (found.outliers or ()) and name not in found.unneeded)


def _distance_m(spec: ArraySpec, position_m: FloatArray) -> float:
    """Return the distance of a position from an array; at least half the aperture, because it may lie in the array."""
    return max(direction_deg(spec.centre_m, position_m)[2], spec.aperture_m / 2.0)


def _contribution(
    spec: ArraySpec, power: FloatArray, estimate: Estimate, found: Localization, *, backfilled: bool
) -> Contribution:
    azimuth_deg, elevation_deg, distance_m = direction_deg(spec.centre_m, estimate.position_m)
    agrees: bool | None = None
    is_used = spec.name not in found.unneeded and any(part.spec.name == spec.name for part in found.evidence)
    if found.outliers is not None and len(found.evidence) > 1 and is_used:
        agrees = spec.name not in found.outliers
    return Contribution(
        array=spec.name,
        active_s=len(power) * FRAME_S,
        power=float(power.mean()),
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        distance_m=distance_m,
        agrees=agrees,
        off_deg=(found.outliers or {}).get(spec.name),
        asked=backfilled,
    )


def _joined(reason: str | None, faults: Mapping[str, str]) -> str:
    """Return a reason followed by the faults of the arrays that were not used."""
    unused = [f"{name!r} is not used: {fault}" for name, fault in sorted(faults.items())]
    return "; ".join([*([] if reason is None else [reason]), *unused])


def _dissent(found: Localization) -> str | None:
    """Return a reason that names the outliers; None if there are none."""
    if not found.outliers:
        return None
    each = " and ".join(f"{name!r} ({off_deg:.0f}° off)" for name, off_deg in sorted(found.outliers.items()))
    return f"located without the {'outlier' if len(found.outliers) == 1 else 'outliers'} {each}"


def _limit_of_set_up(estimate: Estimate) -> str | None:
    """Return a reason that names the error of the set-up; None if positions can be right to `NEAR_M` despite it."""
    off_m = half_axis_m(estimate.set_up_covariance_m2)
    if off_m <= NEAR_M:
        return None
    names = " and ".join(map(repr, estimate.arrays))
    return (
        f"the set-up alone allows an error of {off_m:.1f} m here (90 %); measure the poses of {names}, "
        "and enter how well they are known (arrays.NAME.uncertainty)"
    )
