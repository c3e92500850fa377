"""Proposes better poses of arrays by itself, from the sounds that the server locates anyway."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.server.heard_sounds import HeardSounds
from livessl.server.overload import Overload
from livessl.server.proposals import Proposal, Proposals, shared_sounds
from livessl.server.set_up_in_force import SetUpInForce
from livessl.server.spare_time import SpareTimeThread
from livessl.site.models import Site

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredPose

WAIT_S: Final = 2.0
"""Interval, in seconds, at which the thread looks for new sounds."""

SHARE: Final = 0.01
"""Greatest share of one core's time that refinements take. Poses that are off are no matter of seconds."""

REFINED_SOUNDS: Final = 20
"""Fewest sounds from which the thread refines: fewer leave poses unsure."""

NEW_SOUNDS: Final = 10
"""Number of further sounds after which the thread refines again."""

SIGNIFICANT: Final = 3.0
"""Standard deviations by which a pose has to be off before the thread proposes another one."""

LEAST_SHIFT_M: Final = 0.02
LEAST_TURN_DEG: Final = 0.7
"""Least shift in metres and turn in degrees that the thread proposes; smaller ones improve no position."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Refinement:
    """Agreement of the poses in force with the sounds so far.

    Parameters
    ----------
    sounds : int
        Number of kept sounds that two arrays received.
    proposal : Proposal or None
        Refined poses, if they differ from those in force by more than their uncertainty.
    agrees : bool or None
        Whether the sounds agree with the poses in force; None before there are enough, and where they leave it open.
    """

    sounds: int = 0
    proposal: Proposal | None = None
    agrees: bool | None = None


class PoseRefiner:
    """Refines the poses whenever there are enough new sounds; every thread may read what it found.

    Parameters
    ----------
    proposals : Proposals
        Makes and keeps what the refiner proposes.
    set_up : SetUpInForce
    heard : HeardSounds
        The last sounds.
    overload : Overload
        Nothing is refined while sound arrives faster than it is located.
    """

    def __init__(self, proposals: Proposals, set_up: SetUpInForce, heard: HeardSounds, overload: Overload) -> None:
        self._proposals = proposals
        self._set_up = set_up
        self._heard = heard
        self._refined: tuple[Site, int] | None = None  # the site and the last sound of the last refinement
        self.refinement = Refinement()
        """The latest refinement. Read it once for values that belong together."""
        self.thread = SpareTimeThread(
            "refine", self.refine_if_new, overload, wait_s=WAIT_S, share=SHARE, what="the refinement of the poses"
        )
        """Calls `refine_if_new`."""

    def prepare(self, _site: Site) -> Callable[[], None]:
        """Return what makes the thread refine soon, with the poses that are in force then; any thread."""
        return self.thread.wake

    def refine_if_new(self) -> None:
        """Refine if there are enough new sounds or other poses; the thread calls it, and a test may."""
        site, kept = self._set_up.site, self._heard.after(0)
        sounds = shared_sounds(kept)
        if len(sounds) < REFINED_SOUNDS or len(site.processed) < 2:
            self.refinement = Refinement(len(sounds))
            return
        before = self._refined
        new = len(sounds) if before is None else sum(sound.number > before[1] for sound in sounds)
        if before is not None and before[0] is site and new < NEW_SOUNDS:
            return
        try:
            proposal = self._proposals.refine(site, sounds, [_best_known(site)], is_of_thread=True)
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


def _best_known(site: Site) -> str:
    """Return the array whose position is known best; of equals, the first."""
    return min(site.processed, key=lambda spec: spec.uncertainty.position_m).name


def _is_significant(proposal: Proposal) -> bool:
    """Return whether a proposal moves an array by more than its uncertainty, and by so much that it matters."""
    assert proposal.measured is not None
    return any(map(_is_off, proposal.measured.poses.values()))


def _is_off(pose: MeasuredPose) -> bool:
    shift_m, turn_deg = float(np.linalg.norm(pose.shift_m)), float(np.degrees(pose.turn.magnitude()))
    return shift_m > max(LEAST_SHIFT_M, SIGNIFICANT * pose.position_std_m) or turn_deg > max(
        LEAST_TURN_DEG, SIGNIFICANT * pose.orientation_std_deg
    )
