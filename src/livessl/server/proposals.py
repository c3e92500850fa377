"""Makes and keeps proposals for poses: measured by claps, refined by sounds, or typed. None applies by itself.

A person accepts a proposal (`Proposals.accept`); then it is written into the calibration file and comes into force.
`pose_refiner` makes proposals on its own, and `proposal_checks` decides what keeps one from being accepted.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.clock import Clock
from livessl.core.commission.observe import LEAST_SHARPNESS
from livessl.core.types import ArraySpec, FloatArray, Observation
from livessl.errors import RunError
from livessl.server.heard_sounds import HeardSound, HeardSounds
from livessl.server.proposal_checks import ClapFit, contradiction, is_enough, misfit_with_site, refusal_of
from livessl.server.set_up_in_force import SetUpInForce
from livessl.site.build.calibrated import measured_arrays, typed_arrays
from livessl.site.models import CalibratedArray, Site

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredSetUp

KEPT: Final = 16
"""Number of proposals that are kept and can still be accepted: so many that people requested, and as many of
`pose_refiner`. The oldest are dropped."""

MOST_SOUNDS: Final = 40
"""Most sounds, the newest ones, from which poses are refined: older ones may be from before an array was moved."""

TAPE_STD_M: Final = 0.1
"""Default standard deviation, in metres, of the arrays' positions in the site file before they are refined: as measured
by tape."""


class ProposalRefusedError(RunError):
    """A proposal cannot come into force: the sounds do not determine its poses, or these do not fit the site."""


class BusyError(RunError):
    """Another measurement is running."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """Poses that an operator may accept.

    Parameters
    ----------
    id : str
    method : str
        `poses`, `refine` or `typed`.
    made_ns : int
        When it was made, UTC.
    site : Site
        The site with the poses that were in force when the proposal was made.
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
        Whether the poses of all arrays are known as well as is useful.
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


class Proposals:
    """Makes and keeps proposals; every thread may call it.

    Parameters
    ----------
    set_up : SetUpInForce
    heard : HeardSounds
        The last sounds.
    clock : Clock
    """

    def __init__(self, set_up: SetUpInForce, heard: HeardSounds, clock: Clock) -> None:
        self._set_up = set_up
        self._heard = heard
        self._clock = clock
        self._busy = threading.Lock()
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, Proposal] = OrderedDict()
        # kept apart: new ones come often, and must not push out those of people
        self._kept_of_thread: OrderedDict[str, Proposal] = OrderedDict()
        self._made = 0

    # --- making proposals

    def by_claps(self, numbers: Sequence[int], places_m: FloatArray, place_std_m: float) -> Proposal:
        """Measure the poses of the arrays by the sounds of these numbers, at measured places (S, 3), metres.

        Raises
        ------
        LookupError
            With the number of a sound that is not kept any more.
        ValueError
            If no array received enough of the sounds.
        PlaceOutsideError
            If a place is far outside the room.
        BusyError
            If another measurement is running.
        """
        from livessl.site.build.set_up import measure_set_up, next_clap_place, place_sounds

        site, sounds = self._set_up.site, self._heard.numbered(list(numbers))
        observed = [sound.observations for sound in sounds]
        with self.measuring():
            measured = measure_set_up(site, observed, places_m, place_std_m)
            stored = measured_arrays(site, measured)
            refusal = refusal_of(site, measured, stored)
            before_m = np.linalg.norm(place_sounds(site, observed) - places_m, axis=1)
            moved = _moved(site, measured)
            after_m = np.linalg.norm(place_sounds(moved, observed) - places_m, axis=1)
            next_m = next_clap_place(moved, places_m, place_std_m)
        claps = tuple(
            ClapFit(number, place_m, _or_none(before), _or_none(after))
            for number, place_m, before, after in zip(numbers, places_m, before_m, after_m, strict=True)
        )
        made_ns = self._clock.now_ns()
        proposal = Proposal(
            self._new_id("poses", made_ns), "poses", made_ns, site, _microphones(measured), stored, measured,
            claps=claps, next_place_m=next_m, is_enough=is_enough(site, measured),
            refusal=contradiction(claps) if refusal is None else refusal,
        )  # fmt: skip
        return self._keep(proposal)

    def by_sounds(self, known: Collection[str], position_std_m: float = TAPE_STD_M) -> Proposal:
        """Refine the poses of all arrays but the known ones by the last sounds, wherever these were.

        Raises
        ------
        ValueError
            If there are too few sounds, or no array to refine.
        BusyError
            If another measurement is running.
        """
        with self.measuring():
            return self.refine(self._set_up.site, shared_sounds(self._heard.after(0)), known, position_std_m)

    def refine(
        self,
        site: Site,
        sounds: Sequence[HeardSound],
        known: Collection[str],
        position_std_m: float = TAPE_STD_M,
        *,
        is_of_thread: bool = False,
    ) -> Proposal:
        """Refine the poses of all arrays but the known ones by some sounds.

        Raises
        ------
        ValueError
            If there are too few sounds, or no array to refine.
        """
        from livessl.site.build.set_up import refine_set_up

        measured = refine_set_up(site, [sound.observations for sound in sounds], known, position_std_m)
        stored, made_ns = measured_arrays(site, measured), self._clock.now_ns()
        proposal = Proposal(
            self._new_id("refine", made_ns), "refine", made_ns, site, _microphones(measured), stored, measured,
            known=tuple(known), refusal=refusal_of(site, measured, stored),
        )  # fmt: skip
        return self._keep(proposal, is_of_thread=is_of_thread)

    def typed(self, poses: Mapping[str, tuple[FloatArray, FloatArray]]) -> Proposal:
        """Propose poses that were typed or dragged.

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
        stored, made_ns = typed_arrays(site, microphones), self._clock.now_ns()
        proposal = Proposal(
            self._new_id("typed", made_ns), "typed", made_ns, site, microphones, stored,
            refusal=misfit_with_site(site, stored),
        )  # fmt: skip
        return self._keep(proposal)

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Allow one requested measurement at a time; each takes some seconds of processor time.

        Raises
        ------
        BusyError
            If another one is running. Waiting for it would block a thread that serves requests.
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

    def _new_id(self, method: str, made_ns: int) -> str:
        with self._lock:
            self._made += 1
            return f"{method}-{made_ns // 1_000_000}-{self._made}"

    def _keep(self, proposal: Proposal, *, is_of_thread: bool = False) -> Proposal:
        with self._lock:
            kept = self._kept_of_thread if is_of_thread else self._kept
            kept[proposal.id] = proposal
            while len(kept) > KEPT:
                kept.popitem(last=False)
        return proposal


def shared_sounds(sounds: Sequence[HeardSound]) -> list[HeardSound]:
    """Return the sounds that two arrays or more received clearly; at most the newest `MOST_SOUNDS`."""

    def is_clear(one: Observation) -> bool:
        return one.sharpness >= LEAST_SHARPNESS and int(np.isfinite(one.delays_s).sum()) > 1

    shared = [sound for sound in sounds if sum(map(is_clear, sound.observations)) > 1]
    return shared[-MOST_SOUNDS:]


def _microphones(measured: MeasuredSetUp) -> dict[str, FloatArray]:
    """Return where the microphones of the measured arrays are, metres."""
    return {name: pose.microphones_m for name, pose in measured.poses.items()}


def _moved(site: Site, measured: MeasuredSetUp) -> Site:
    """Return a site with measured arrays, which may lie outside the room.

    Its speed of sound is that of the site, because the measured one does not come into force.
    """
    at_m = _microphones(measured)
    processed = tuple(
        ArraySpec(spec.name, at_m.get(spec.name, spec.microphones_m), spec.band_hz, spec.uncertainty, spec.parts)
        for spec in site.processed
    )
    return site.model_copy(update={"processed": processed})


def _or_none(distance_m: float) -> float | None:
    return float(distance_m) if np.isfinite(distance_m) else None
