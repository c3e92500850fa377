"""REST routes of poses: those in force, proposals, accept and undo."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np
from fastapi import APIRouter, HTTPException, Request, Response

from livessl.clock import utc_text
from livessl.core.types import FloatArray
from livessl.errors import ConfigError
from livessl.schema.answers import errors
from livessl.server.api import set_up_schema
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.queries import unprocessable
from livessl.server.api.routes import as_json
from livessl.server.api.set_up_routes import PLACE_STD_M
from livessl.server.parts import Parts
from livessl.server.pose_refiner import REFINED_SOUNDS, Refinement
from livessl.server.proposals import BusyError, Proposal, ProposalRefusedError
from livessl.server.set_up_in_force import CalibrationFileError, OutOfDateError, SetUpChangedError
from livessl.site.models import Site

_TEXTS: Final = {
    404: "The array, sound or proposal does not exist, or does not exist any more, or there is no former calibration.",
    409: "Another measurement is running, or the proposal cannot come into force; the detail says why.",
    503: "The calibration file cannot be written.",
}
_ERRORS: Final = errors(400, 404, 409, 411, 413, 503, texts=_TEXTS)
_log = logging.getLogger(__name__)


def proposal_routes(parts: Parts) -> APIRouter:
    """Routes of the set-up in force, of proposals for its poses, and of changes to it."""
    router = APIRouter(tags=["state"])
    _add_state(router, parts)
    _add_proposals(router, parts)
    _add_changes(router, parts)
    return router


def _add_state(router: APIRouter, parts: Parts) -> None:
    set_up, first = parts.set_up, _FirstPlace()

    @router.get("/api/v1/set-up", response_model=set_up_schema.SetUp)
    def get_set_up() -> Response:
        """Poses of the arrays, the calibration file, and whether the sounds so far agree with the poses."""
        return as_json(
            {
                "v": API_VERSION,
                "calibration": set_up.describe(),
                "arrays": _arrays(parts),
                "next_place_m": first.of(set_up.site),
                "refinement": _refinement(parts.refiner.refinement),
            }
        )


def _add_proposals(router: APIRouter, parts: Parts) -> None:
    proposals = parts.proposals

    @router.post("/api/v1/set-up/measure", response_model=set_up_schema.OneProposal, responses=_ERRORS)
    def post_measure(request: set_up_schema.MeasureRequest) -> Response:
        """Measure the poses of the arrays by at least four sounds at measured places; eight sounds are usual.

        The answer is a proposal, which changes nothing.
        """
        places_m = np.array([clap.place_m for clap in request.claps], dtype=np.float64)
        with _refusals():
            proposal = proposals.by_claps([clap.number for clap in request.claps], places_m, request.place_std_m)
        return _answer(proposal)

    @router.post("/api/v1/set-up/refine", response_model=set_up_schema.OneProposal, responses=_ERRORS)
    def post_refine(request: set_up_schema.RefineRequest) -> Response:
        """Refine the poses of the arrays by the last sounds, wherever these were made.

        The answer is a proposal, which changes nothing.
        """
        _require(parts, request.known)
        with _refusals():
            proposal = proposals.by_sounds(request.known, request.position_std_m)
        return _answer(proposal)

    @router.post("/api/v1/set-up/move", response_model=set_up_schema.OneProposal, responses=_ERRORS)
    def post_move(request: set_up_schema.MoveRequest) -> Response:
        """Propose poses that were typed or dragged. The proposal changes nothing."""
        _require(parts, request.arrays)
        poses = {name: (np.array(one.position_m), np.array(one.turn_deg)) for name, one in request.arrays.items()}
        with _refusals():
            proposal = proposals.typed(poses)
        return _answer(proposal)


def _add_changes(router: APIRouter, parts: Parts) -> None:
    set_up = parts.set_up

    @router.post("/api/v1/set-up/accept", response_model=set_up_schema.Changed, responses=_ERRORS)
    def post_accept(accept: set_up_schema.AcceptRequest, request: Request) -> Response:
        """Write a proposal into the calibration file and bring it into force, without a restart."""
        with _refusals():
            changed = parts.proposals.accept(accept.id)
        return _changed(parts, changed, f"has accepted {accept.id}", request)

    @router.post("/api/v1/set-up/undo", response_model=set_up_schema.Changed, responses=_ERRORS)
    def post_undo(request: Request) -> Response:
        """Put back the calibration before the last change, without a restart."""
        with _refusals():
            changed = set_up.undo()
        return _changed(parts, changed, "has undone the last calibration", request)

    @router.post("/api/v1/set-up/reload", response_model=set_up_schema.Changed, responses=_ERRORS)
    def post_reload(request: Request) -> Response:
        """Read the calibration file again and bring it into force, without a restart."""
        with _refusals():
            changed = set_up.reload()
        return _changed(parts, changed, "had the calibration file read again", request)


class _FirstPlace:
    """Computes the place that is proposed for the first clap, once for each set-up."""

    def __init__(self) -> None:
        self._known: tuple[Site, list[float] | None] | None = None

    def of(self, site: Site) -> list[float] | None:
        """Return the place [x, y, z] in metres; None if no place is free."""
        known = self._known
        if known is None or known[0] is not site:
            from livessl.site.build.set_up import next_clap_place  # scipy's optimizer takes memory

            known = self._known = site, _point(next_clap_place(site, np.zeros((0, 3)), PLACE_STD_M))
        return known[1]


def _require(parts: Parts, names: Iterable[str]) -> None:
    """Answer 404 if one of the names is not that of an array."""
    known = [spec.name for spec in parts.set_up.site.processed]
    stranger = next((name for name in names if name not in known), None)
    if stranger is not None:
        raise HTTPException(404, f"no array {stranger!r}; there are {', '.join(known)}")


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn the errors that keep poses from being measured or changed into answers with their status."""
    try:
        yield
    except LookupError as error:
        number = error.args[0]
        text = f"sound {number} is not kept any more; make it again" if isinstance(number, int) else str(number)
        raise HTTPException(404, text) from error
    except (BusyError, OutOfDateError, ProposalRefusedError, SetUpChangedError) as error:
        raise HTTPException(409, str(error)) from error
    except ConfigError as error:
        raise HTTPException(409, "; ".join(map(str, error.faults))) from error
    except CalibrationFileError as error:
        raise HTTPException(503, str(error)) from error
    except ValueError as error:
        raise unprocessable(None, str(error), "body") from error


def _answer(proposal: Proposal) -> Response:
    return as_json({"v": API_VERSION, **describe_proposal(proposal)})


def _changed(parts: Parts, changed: list[str], what: str, request: Request) -> Response:
    """Note who has done what to the poses, and answer with what is in force now."""
    who = request.scope["client_name"]
    text = f"{who!r} {what}: {', '.join(changed) or 'no pose'} changed"
    _log.info("%s", text)
    if changed:
        parts.journal.configuration("poses", who, text, {"changed": changed})
    described = {"changed": changed, "calibration": parts.set_up.describe(), "arrays": _arrays(parts)}
    return as_json({"v": API_VERSION, **described})


def _arrays(parts: Parts) -> JsonObject:
    return {spec.name: _placed(spec.microphones_m) for spec in parts.set_up.site.processed}


def _refinement(refinement: Refinement) -> JsonObject:
    proposal = refinement.proposal
    return {
        "sounds": refinement.sounds,
        "needed": REFINED_SOUNDS,
        "agrees": refinement.agrees,
        "proposal": None if proposal is None else describe_proposal(proposal),
    }


def describe_proposal(proposal: Proposal) -> JsonObject:
    """Encode a proposal."""
    measured = proposal.measured
    speed = None
    if measured is not None:
        speed = {
            "speed_of_sound_m_s": round(measured.c_m_s, 2),
            "std_m_s": round(measured.c_std_m_s, 2),
            "in_force_m_s": round(proposal.site.c_m_s, 2),
        }
    return {
        "id": proposal.id,
        "method": proposal.method,
        "made_utc": utc_text(proposal.made_ns),
        "sounds": 0 if measured is None else measured.sounds,
        "known": list(proposal.known),
        "arrays": [_pose(proposal, name) for name in proposal.microphones],
        "speed": speed,
        "claps": [
            {
                "number": clap.number,
                "place_m": clap.place_m.tolist(),
                "before_m": _rounded(clap.before_m),
                "after_m": _rounded(clap.after_m),
                "agrees": clap.agrees,
            }
            for clap in proposal.claps
        ],
        "next_place_m": _point(proposal.next_place_m),
        "enough": proposal.is_enough,
        "refusal": proposal.refusal,
    }


def _pose(proposal: Proposal, name: str) -> JsonObject:
    """Encode the pose of an array before and after a proposal."""
    from livessl.core.commission.resection import turn_between

    before_m, after_m = proposal.site.array(name).microphones_m, proposal.microphones[name]
    pose = None if proposal.measured is None else proposal.measured.poses[name]
    return {
        "array": name,
        "before": _placed(before_m),
        "after": _placed(after_m),
        "shift_m": (after_m.mean(axis=0) - before_m.mean(axis=0)).round(4).tolist(),
        "turn_deg": np.degrees(turn_between(before_m, after_m).as_rotvec()).round(2).tolist(),
        "position_std_m": None if pose is None else round(pose.position_std_m, 4),
        "orientation_std_deg": None if pose is None else round(pose.orientation_std_deg, 2),
        "misfit_us": None if pose is None else [round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
        "determined": None if pose is None else pose.is_determined,
    }


def _placed(microphones_m: FloatArray) -> JsonObject:
    return {
        "position_m": microphones_m.mean(axis=0).round(4).tolist(),
        "microphones_m": microphones_m.round(4).tolist(),
    }


def _point(place_m: FloatArray | None) -> list[float] | None:
    return None if place_m is None else place_m.round(3).tolist()


def _rounded(distance_m: float | None) -> float | None:
    return None if distance_m is None else round(distance_m, 4)
