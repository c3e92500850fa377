"""REST route that locates a stored event again, by another method or with the poses in force now."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Final

from fastapi import APIRouter, HTTPException, Query, Request, Response

from livessl.errors import ConfigError
from livessl.schema import relocation
from livessl.schema.answers import errors
from livessl.server.api.clip_routes import no_clip
from livessl.server.api.encode import API_VERSION, JsonObject, answer, std_m
from livessl.server.api.queries import unprocessable
from livessl.server.api.routes import as_json
from livessl.server.clips.relocate import BusyError, SetUp, digest_of, distance_m, known_methods
from livessl.server.clips.stored_sound import NoClipError, RelocationError
from livessl.server.parts import Parts

Method = Annotated[
    str | None, Query(min_length=1, max_length=200, description="As in the request; absent for that of each event.")
]
SetUpWanted = Annotated[SetUp, Query(description="As in the request.")]

_TEXTS: Final = {
    404: "There is no event of that id, or it has no recordings.",
    409: "Its recordings are still being made, damaged, too large or of another release; an array has changed or gone.",
    503: "Another event is being located again, the server is overloaded or stopping, or the database cannot be used.",
}
_log = logging.getLogger(__name__)


def relocate_route(parts: Parts) -> APIRouter:
    """Both answers beside each other."""
    router = APIRouter(prefix="/api/v1", tags=["clips"])
    _add_settings(router, parts)
    _add_relocation(router, parts)
    return router


def _add_settings(router: APIRouter, parts: Parts) -> None:
    relocator = parts.relocator

    @router.get("/relocation-settings", response_model=relocation.RelocationSettings)
    def get_relocation_settings(method: Method = None, set_up: SetUpWanted = "then") -> Response:
        """Digest that answers of `POST events/{id}/relocate` with this method and set-up would have now."""
        site = parts.site if relocator is None else relocator.site
        return as_json({"v": API_VERSION, "digest": digest_of(site, method, set_up)})


def _add_relocation(router: APIRouter, parts: Parts) -> None:
    clips, relocator = parts.clips, parts.relocator

    @router.post(
        "/events/{event_id}/relocate",
        response_model=relocation.Relocated,
        responses=errors(400, 404, 409, 411, 413, 503, texts=_TEXTS),
    )
    def post_relocate(event_id: str, wanted: relocation.RelocateRequest, request: Request) -> Response:
        """Locate an event again from its recordings, and return both answers; stores nothing. For operators.

        A thread of low priority does it, one event at a time, and none while live sound needs the whole machine.
        """
        stored = parts.store.get(event_id)
        if stored is None:
            raise HTTPException(404, f"no event {event_id!r}")
        method = stored["method"] if wanted.method is None else wanted.method
        known = known_methods(parts.site)
        if method not in known:
            raise unprocessable("method", f"method: expected one of {', '.join(known)}, got {method!r}", "body")
        if clips is None or relocator is None:
            raise HTTPException(404, f"event {event_id!r} has no recordings: {_why_none(parts)}")
        if clips.is_waiting(event_id):
            raise HTTPException(409, f"the recordings of {event_id!r} are being made; try again in some seconds")
        if not clips.folder.has(event_id) and clips.why_missing(event_id, None) is not None:
            raise no_clip(event_id, clips)
        with _refusals():
            found, site, took_s = relocator.relocate(event_id, method, wanted.set_up)
        _log.info("%r has located %r again by %r", request.scope["client_name"], event_id, method)
        return as_json(
            {
                "v": API_VERSION,
                "event_id": event_id,
                "set_up": wanted.set_up,
                "moved_arrays": list(found.moved),
                "stored": _stored(stored),
                "again": answer(found.event),
                "other_sources": [answer(other) for other in found.others],
                "distance_m": distance_m(stored["position_m"], found.event),
                "took_s": round(took_s, 3),
                "digest": digest_of(site, wanted.method, wanted.set_up),
            }
        )


@contextmanager
def _refusals() -> Iterator[None]:
    """Answer with the status of what keeps an event from being located again."""
    try:
        yield
    except NoClipError as error:
        raise HTTPException(404, str(error)) from error
    except BusyError as error:
        raise HTTPException(503, str(error)) from error
    except RelocationError as error:
        raise HTTPException(409, str(error)) from error
    except ConfigError as error:  # a method of the site's own that cannot be imported any more
        raise HTTPException(409, "; ".join(map(str, error.faults))) from error


def _why_none(parts: Parts) -> str:
    if parts.site.privacy == "positions-only":
        return "with privacy: positions-only the server stores no sound"
    return "the site file has no server.clips; name a folder there, and later events can be located again"


def _stored(event: JsonObject) -> JsonObject:
    """Return the answer in the history; an earlier release may have stored it without candidates."""
    names = ("method", "status", "reason", "position_m", "covariance_m2", "confidence", "arrays")
    known = {name: event[name] for name in names}
    return {**known, "std_m": std_m(event["covariance_m2"]), "candidates": event.get("candidates", [])}
