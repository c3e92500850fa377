"""REST routes for setting up: last sounds with their delays, verification by claps at known places."""

from __future__ import annotations

import threading
from dataclasses import asdict
from typing import Annotated, Final

import numpy as np
from fastapi import APIRouter, HTTPException, Query, Response

from livessl.clock import utc_text
from livessl.core.commission.verification import set_up_verdict
from livessl.core.types import FloatArray, Observation
from livessl.schema.answers import errors
from livessl.server.api import set_up_schema
from livessl.server.api.encode import API_VERSION, JsonObject, where
from livessl.server.api.queries import unprocessable
from livessl.server.api.routes import as_json
from livessl.server.heard_sounds import HeardSound
from livessl.server.parts import Parts

PLACE_STD_M: Final = 0.03
"""Standard deviation of the places of claps, in metres, unless the request gives another one."""

_TEXTS = {
    404: "One of the sounds is not kept: the last 64 are.",
    409: "Another verification is running: it takes up to seconds of one core.",
}


def set_up_routes(parts: Parts) -> APIRouter:
    """Sounds with their delays, and the verification of the set-up."""
    router = APIRouter(tags=["state"])
    _add_sounds(router, parts)
    _add_verification(router, parts)
    return router


def _add_sounds(router: APIRouter, parts: Parts) -> None:
    heard = parts.set_up_watch.heard

    @router.get("/api/v1/sounds", response_model=set_up_schema.HeardSounds)
    def get_sounds(
        after: Annotated[int, Query(ge=0, le=2**53, description="only sounds of a higher number")] = 0,
    ) -> Response:
        """The last 64 sounds with the delays that each array observed, the oldest first: what calibration uses."""
        sounds, last = heard.read(after)
        now_utc = utc_text(parts.site_time.now_ns())
        found = [_sound(sound) for sound in sounds]
        return as_json({"v": API_VERSION, "now_utc": now_utc, "last": last, "sounds": found})


def _add_verification(router: APIRouter, parts: Parts) -> None:
    heard, one_at_a_time = parts.set_up_watch.heard, threading.Lock()

    @router.post(
        "/api/v1/set-up/verify",
        response_model=set_up_schema.Verified,
        responses=errors(400, 404, 409, 411, 413, texts=_TEXTS),
    )
    def post_verify(request: set_up_schema.VerifyRequest) -> Response:
        """Compare sounds with the places where they were made, and explain the errors; changes nothing. For operators.

        One sound shows that something is wrong; four usually show what.
        """
        from livessl.site.build.set_up import (
            PlaceOutsideError,
            next_clap_place,
            verify_set_up,
        )  # scipy's optimizer takes memory, and no event needs it

        try:
            sounds = heard.numbered([clap.number for clap in request.claps])
        except LookupError as error:
            raise HTTPException(404, f"sound {error} is not kept any more; make it again") from error
        places_m = np.array([clap.place_m for clap in request.claps], dtype=np.float64)
        if not one_at_a_time.acquire(blocking=False):  # a thread that waited would be missing for other requests
            raise HTTPException(409, "another verification is running; try again in some seconds")
        try:
            site = parts.set_up.site
            findings = verify_set_up(site, [sound.observations for sound in sounds], places_m)
            next_m = next_clap_place(site, places_m, PLACE_STD_M)
        except PlaceOutsideError as error:
            raise unprocessable("claps", str(error), "body") from error
        finally:
            one_at_a_time.release()
        claps = [_clap(sound, place_m) for sound, place_m in zip(sounds, places_m, strict=True)]
        return as_json(
            {
                "v": API_VERSION,
                "verdict": str(set_up_verdict(findings, [clap["error_m"] for clap in claps])),
                "claps": claps,
                "findings": [{"kind": "finding", **asdict(finding)} for finding in findings],
                "next_place_m": None if next_m is None else next_m.round(3).tolist(),
            }
        )


def _sound(sound: HeardSound) -> JsonObject:
    event = sound.event
    return {
        "number": sound.number,
        "id": event.id,
        "time_utc": utc_text(event.start_ns),
        "position_m": where(event.estimate)[0],
        "status": str(event.status),
        "reason": event.reason,
        "observations": [_observed(observation) for observation in sound.observations],
    }


def _observed(one: Observation) -> JsonObject:
    return {
        "array": one.array,
        "delays_us": [None if np.isnan(delay_s) else round(1e6 * delay_s, 3) for delay_s in one.delays_s.tolist()],
        "inverted": one.inverted.tolist(),
        "coherence": one.coherence.round(4).tolist(),
        "powers": one.powers.tolist(),
        "sharpness": round(one.sharpness, 3),
        "closure_us": round(1e6 * one.closure_s, 3),
    }


def _clap(sound: HeardSound, place_m: FloatArray) -> JsonObject:
    estimate = sound.event.estimate
    error_m = None if estimate is None else round(float(np.linalg.norm(estimate.position_m - place_m)), 4)
    return {
        "number": sound.number,
        "place_m": place_m.tolist(),
        "position_m": where(estimate)[0],
        "error_m": error_m,
        "status": str(sound.event.status),
        "reason": sound.event.reason,
    }
