"""Proposals for the poses of arrays: measured by claps, refined by unknown sounds, or typed. None applies by itself.

A person accepts a proposal (`Proposals.accept`); then it is written into the calibration file and comes into force.
A thread refines the poses with the sounds that the server locates anyway, and keeps what it proposes for people to see.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.clock import Clock
from livessl.core.types import ArraySpec, FloatArray, Observation
from livessl.errors import ConfigError, RunError
from livessl.server.heard_sounds import HeardSound, HeardSounds
from livessl.server.overload import Overload
from livessl.server.set_up_in_force import SetUpInForce
from livessl.site.build.calibrated import measured_arrays, typed_arrays, with_calibration
from livessl.site.models import CalibratedArray, CalibrationFile, Site

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredPose, MeasuredSetUp

KEPT: Final = 16
"""Number of proposals of people that can still be accepted, and of those of the thread; the oldest ones are dropped."""

WAIT_S: Final = 2.0
"""Interval, in seconds, at which the thread looks for new sounds, and at which it can be stopped."""

JOIN_S: Final = 1.0
"""Longest wait, in seconds, for a refinement that is under way when the server stops; it is of no use any more."""

REFINED_SOUNDS: Final = 20
"""Fewest sounds from which the thread refines: fewer leave poses unsure."""

MOST_SOUNDS: Final = 40
"""Most sounds, the newest ones, from which poses are refined: older ones may be from before an array was moved."""

NEW_SOUNDS: Final = 10
"""Number of further sounds after which the thread refines again."""

POSITION_STD_M: Final = 0.1
"""Standard deviation of positions that are refined, metres: as measured by tape."""

SIGNIFICANT: Final = 3.0
"""Standard deviations by which a pose has to be off before the thread proposes another one."""

LEAST_SHIFT_M: Final = 0.02
LEAST_TURN_DEG: Final = 0.7
"""Least shift in metres and turn in degrees that the thread proposes; smaller ones improve no position."""

AGREES_M: Final = 0.3
"""Distance, in metres, between a clap and its place up to which the two agree with the measured poses."""

_log = logging.getLogger(__name__)


class ProposalRefusedError(RunError):
    """A proposal cannot come into force: it is not determined, or does not fit."""


class BusyError(RunError):
    """Another measurement is running."""


@dataclass(frozen=True, slots=True)
class ClapFit:
    """How well a sound at a measured place fits the poses before and after.

    Parameters
    ----------
    number : int
        Number of the sound.
    place_m : (3,) float64
        Where it was made, metres.
    before_m, after_m : float or None
        Distance from there to where its delays place it, metres; None if two arrays did not receive it.
    """

    number: int
    place_m: FloatArray
    before_m: float | None
    after_m: float | None

    @property
    def agrees(self) -> bool | None:
        """True if it agrees with the proposed poses; None where that cannot be said."""
        return None if self.after_m is None else self.after_m <= AGREES_M


@dataclass(frozen=True, slots=True)
class Proposal:
    """Poses that somebody may accept.

    Parameters
    ----------
    id : str
    method : str
        `poses`, `refine` or `typed`.
    made_ns : int
        When it was made, UTC.
    site : Site
        The site with the poses before.
    microphones : mapping of array to (K, 3) float64
        The arrays that it moves, with their proposed places, metres.
    stored : mapping of array to CalibratedArray
        What is written into the calibration file.
    measured : MeasuredSetUp or None
        What the poses were measured with; None if they were typed.
    known : tuple of str
        Arrays that were taken to be right.
    claps : tuple of ClapFit
    next_place_m : (3,) float64 or None
        Place at which another clap would improve the poses most, metres.
    is_enough : bool
        Whether another clap would hardly improve the poses.
    refusal : str or None
        Why it cannot be accepted; None if it can.
    """

    id: str
    method: str
    made_ns: int
    site: Site
    microphones: Mapping[str, FloatArray]
    stored: Mapping[str, CalibratedArray]
    measured: MeasuredSetUp | None = None
    known: tuple[str, ...] = ()
    claps: tuple[ClapFit, ...] = ()
    next_place_m: FloatArray | None = None
    is_enough: bool = False
    refusal: str | None = None


@dataclass(frozen=True, slots=True)
class Refinement:
    """What the sounds so far say of the poses.

    Parameters
    ----------
    sounds : int
        Number of kept sounds that two arrays received.
    proposal : Proposal or None
        The poses that the sounds say, if they differ from those in force by more than their uncertainty.
    agrees : bool or None
        Whether the sounds agree with the poses in force; None before there are enough, and where they leave it open.
    """

    sounds: int = 0
    proposal: Proposal | None = None
    agrees: bool | None = None


class Proposals:
    """Makes and keeps proposals; every thread may call it.

    Parameters
    ----------
    set_up : SetUpInForce
    heard : HeardSounds
        The last sounds.
    clock : Clock
    overload : Overload
        Nothing is refined while sound arrives faster than it is located.
    """

    def __init__(self, set_up: SetUpInForce, heard: HeardSounds, clock: Clock, overload: Overload) -> None:
        self._set_up = set_up
        self._heard = heard
        self._clock = clock
        self._overload = overload
        self._busy = threading.Lock()
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, Proposal] = OrderedDict()
        self._kept_of_thread: OrderedDict[str, Proposal] = (
            OrderedDict()
        )  # they come all the time, and push no other out
        self._made = 0
        self._refined: tuple[Site, int] | None = None  # the site and the last sound of the last refinement
        self.refinement = Refinement()
        """The latest refinement by the thread. Read it once for values that belong together."""
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    # --- making proposals

    def by_claps(self, numbers: Sequence[int], places_m: FloatArray, place_std_m: float) -> Proposal:
        """Measure the poses of the arrays by sounds (S,) at measured places (S, 3), metres.

        Raises
        ------
        LookupError
            With the number of a sound that is not kept any more.
        ValueError
            If no array received enough of the sounds.
        BusyError
            If another measurement is running.
        """
        from livessl.site.build.set_up import measure_set_up, next_clap_place, place_sounds

        site, sounds = self._set_up.site, self._heard.numbered(list(numbers))
        observed = [sound.observations for sound in sounds]
        with self.measuring():
            measured = measure_set_up(site, observed, places_m, place_std_m)
            stored = measured_arrays(site, measured)
            refusal = _undetermined(measured) or _misfit_with_site(site, stored)
            before_m = np.linalg.norm(place_sounds(site, observed) - places_m, axis=1)
            moved = _moved(site, measured)
            after_m = np.linalg.norm(place_sounds(moved, observed) - places_m, axis=1)
            next_m = next_clap_place(moved, places_m, place_std_m)
        claps = tuple(
            ClapFit(number, place_m, _or_none(before), _or_none(after))
            for number, place_m, before, after in zip(numbers, places_m, before_m, after_m, strict=True)
        )
        if refusal is None and sum(clap.agrees is not False for clap in claps) < _least_agreeing(len(claps)):
            off = ", ".join(str(index) for index, clap in enumerate(claps, 1) if clap.agrees is False)
            refusal = f"claps {off} contradict the others by more than {AGREES_M:g} m; measure their places again"
        return self._keep(
            "poses", site, measured, stored, claps=claps, next_place_m=next_m, refusal=refusal,
            is_enough=_is_enough(site, measured),
        )  # fmt: skip

    def by_sounds(self, known: Collection[str], position_std_m: float = POSITION_STD_M) -> Proposal:
        """Refine the poses of all arrays but the known ones by the last sounds, wherever these were.

        Raises
        ------
        ValueError
            If there are too few sounds, or no array to refine.
        BusyError
            If another measurement is running.
        """
        site, sounds = self._set_up.site, _shared(self._heard.after(0))[-MOST_SOUNDS:]
        with self.measuring():
            return self._refine(site, sounds, known, position_std_m)

    def typed(self, poses: Mapping[str, tuple[FloatArray, FloatArray]]) -> Proposal:
        """Propose poses that somebody typed or dragged.

        Parameters
        ----------
        poses : mapping of array to ((3,) float64, (3,) float64)
            The position of its centre, metres, and the turn from its present orientation: angles about x, then y, then
            z, degrees.
        """
        from scipy.spatial.transform import Rotation

        site = self._set_up.site
        microphones = {}
        for name, (position_m, turn_deg) in poses.items():
            at_m = site.array(name).microphones_m
            arms_m = Rotation.from_euler("xyz", turn_deg, degrees=True).apply(at_m - at_m.mean(axis=0))
            microphones[name] = np.asarray(arms_m + position_m)
        stored = typed_arrays(site, microphones)
        return self._keep("typed", site, None, stored, microphones=microphones, refusal=_misfit_with_site(site, stored))

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Hold the only place for a measurement that somebody waits for: each takes seconds of a core.

        Raises
        ------
        BusyError
            If another one is running: a thread that waited would be missing for other requests.
        """
        if not self._busy.acquire(blocking=False):
            raise BusyError("another measurement is running; try again in some seconds")
        try:
            yield
        finally:
            self._busy.release()

    # --- accepting one

    def accept(self, proposal_id: str) -> list[str]:
        """Write a proposal into the calibration file and bring it into force; return the arrays that changed.

        Raises
        ------
        LookupError
            If there is no such proposal any more.
        ProposalRefusedError
            If it cannot come into force.
        OutOfDateError, ConfigError, CalibrationFileError, SetUpChangedError
            See `SetUpInForce.accept`.
        """
        with self._lock:
            proposal = self._kept.get(proposal_id) or self._kept_of_thread.get(proposal_id)
        if proposal is None:
            raise LookupError(f"no proposal {proposal_id!r}; measure again")
        if proposal.refusal is not None:
            raise ProposalRefusedError(proposal.refusal)
        measured = proposal.measured
        sounds, c_m_s = (0, 0.0) if measured is None else (measured.sounds, measured.c_m_s)
        return self._set_up.accept(proposal.stored, proposal.method, sounds, c_m_s, proposal.site)

    # --- the thread that refines

    def start(self) -> None:
        """Begin to refine."""
        self._thread = threading.Thread(target=self._work, name="refine", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and wait a little for the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=JOIN_S)

    def refine_if_new(self) -> None:
        """Refine if there are enough new sounds or other poses; the thread calls it, and a test may."""
        site, kept = self._set_up.site, self._heard.after(0)
        sounds = _shared(kept)[-MOST_SOUNDS:]
        if len(sounds) < REFINED_SOUNDS or len(site.processed) < 2:
            self.refinement = Refinement(len(sounds))
            return
        before = self._refined
        new = len(sounds) if before is None else sum(sound.number > before[1] for sound in sounds)
        if before is not None and before[0] is site and new < NEW_SOUNDS:
            return
        try:
            proposal = self._refine(site, sounds, [_best_known(site)], POSITION_STD_M, is_of_thread=True)
        except (ValueError, np.linalg.LinAlgError) as error:
            _log.debug("the sounds so far do not refine the poses: %s", error)
            self._refined, self.refinement = (site, sounds[-1].number), Refinement(len(sounds))
            return
        self._refined = site, sounds[-1].number
        if proposal.refusal is not None:
            self.refinement = Refinement(len(sounds))
        elif _is_significant(proposal):
            self.refinement = Refinement(len(sounds), proposal, agrees=False)
        else:
            self.refinement = Refinement(len(sounds), None, agrees=True)

    def _work(self) -> None:
        try:
            while not self._stop.wait(WAIT_S):
                if self._overload.message is None:
                    self.refine_if_new()
        except BaseException as error:
            self.failure = error
            _log.exception("the refinement of the poses has failed; the server ends")
            raise

    def _refine(
        self,
        site: Site,
        sounds: Sequence[HeardSound],
        known: Collection[str],
        position_std_m: float,
        *,
        is_of_thread: bool = False,
    ) -> Proposal:
        from livessl.site.build.set_up import refine_set_up

        measured = refine_set_up(site, [sound.observations for sound in sounds], known, position_std_m)
        stored = measured_arrays(site, measured)
        refusal = _undetermined(measured) or _misfit_with_site(site, stored)
        return self._keep(
            "refine", site, measured, stored, known=tuple(known), refusal=refusal, is_of_thread=is_of_thread
        )

    def _keep(
        self,
        method: str,
        site: Site,
        measured: MeasuredSetUp | None,
        stored: Mapping[str, CalibratedArray],
        *,
        microphones: Mapping[str, FloatArray] | None = None,
        known: tuple[str, ...] = (),
        claps: tuple[ClapFit, ...] = (),
        next_place_m: FloatArray | None = None,
        is_enough: bool = False,
        refusal: str | None = None,
        is_of_thread: bool = False,
    ) -> Proposal:
        if microphones is None:
            microphones = {} if measured is None else {n: pose.microphones_m for n, pose in measured.poses.items()}
        now_ns = self._clock.now_ns()
        with self._lock:
            self._made += 1
            proposal = Proposal(
                f"{method}-{now_ns // 1_000_000}-{self._made}",
                method, now_ns, site, microphones, stored, measured, known, claps, next_place_m, is_enough, refusal,
            )  # fmt: skip
            kept = self._kept_of_thread if is_of_thread else self._kept
            kept[proposal.id] = proposal
            while len(kept) > KEPT:
                kept.popitem(last=False)
        return proposal


def _shared(sounds: Sequence[HeardSound]) -> list[HeardSound]:
    """Return the sounds that two arrays or more received clearly."""
    from livessl.core.commission.findings import LEAST_SHARPNESS

    def is_clear(one: Observation) -> bool:
        return one.sharpness >= LEAST_SHARPNESS and int(np.isfinite(one.delays_s).sum()) > 1

    return [sound for sound in sounds if sum(map(is_clear, sound.observations)) > 1]


def _best_known(site: Site) -> str:
    """Return the array whose position is known best; of equals, the first."""
    return min(site.processed, key=lambda spec: spec.uncertainty.position_m).name


def _moved(site: Site, measured: MeasuredSetUp) -> Site:
    """Return a site with measured arrays, which need not fit the room.

    Its speed of sound is that of the site, because the measured one does not come into force.
    """
    at_m = {name: pose.microphones_m for name, pose in measured.poses.items()}
    processed = tuple(
        ArraySpec(spec.name, at_m.get(spec.name, spec.microphones_m), spec.band_hz, spec.uncertainty, spec.parts)
        for spec in site.processed
    )
    return site.model_copy(update={"processed": processed})


def _undetermined(measured: MeasuredSetUp) -> str | None:
    """Return in words which poses are not determined; None if all are."""
    from livessl.core.commission.resection import MOST_STD_DEG, MOST_STD_M

    doubtful = [
        f"{name!r} is known to {pose.position_std_m:.2f} m and {pose.orientation_std_deg:.1f} degrees"
        for name, pose in measured.poses.items()
        if not pose.is_determined
    ]
    return (
        f"{', '.join(doubtful)}; at most {MOST_STD_M:g} m and {MOST_STD_DEG:g} degrees are accepted"
        if doubtful
        else None
    )


def _misfit_with_site(site: Site, stored: Mapping[str, CalibratedArray]) -> str | None:
    """Return in words why a site with these arrays could not be loaded; None if it could."""
    try:
        with_calibration(site, CalibrationFile(arrays=dict(stored)))
    except ConfigError as error:
        return "; ".join(fault.what for fault in error.faults)
    return None


def _is_enough(site: Site, measured: MeasuredSetUp) -> bool:
    """Return whether the poses of all arrays are known as well as is useful."""
    from livessl.core.commission.next_place import AIM_DEG, AIM_M

    return len(measured.poses) == len(site.processed) and all(
        pose.position_std_m <= AIM_M and pose.orientation_std_deg <= AIM_DEG for pose in measured.poses.values()
    )


def _is_significant(proposal: Proposal) -> bool:
    """Return whether a proposal moves an array by more than its uncertainty, and by so much that it matters."""
    assert proposal.measured is not None
    return any(map(_is_off, proposal.measured.poses.values()))


def _is_off(pose: MeasuredPose) -> bool:
    shift_m, turn_deg = float(np.linalg.norm(pose.shift_m)), float(np.degrees(pose.turn.magnitude()))
    return shift_m > max(LEAST_SHIFT_M, SIGNIFICANT * pose.position_std_m) or turn_deg > max(
        LEAST_TURN_DEG, SIGNIFICANT * pose.orientation_std_deg
    )


def _least_agreeing(count: int) -> int:
    """Return how many of some claps have to agree: all but one in four, and four at least."""
    return max(4, count - count // 4)


def _or_none(distance_m: float) -> float | None:
    return float(distance_m) if np.isfinite(distance_m) else None
