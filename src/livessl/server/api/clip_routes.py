"""REST routes of clips: what there is, the sound as FLAC or WAV, keeping, deleting, and why a clip is missing."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import soundfile
from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse

from livessl.schema.answers import errors
from livessl.schema.clips import MissingReason
from livessl.server.api import clip_schema
from livessl.server.api.encode import API_VERSION
from livessl.server.api.routes import as_json
from livessl.server.clips.reader import Clip, UnreadableClipError
from livessl.server.clips.relocate import known_methods
from livessl.server.clips.service import Clips, state_of
from livessl.server.clips.stored_sound import is_relocatable
from livessl.server.parts import Parts

MEDIA_TYPES: Final = {".flac": "audio/flac", ".wav": "audio/wav"}

_BINARY: Final[dict[str, Any]] = {"schema": {"type": "string", "format": "binary"}}
_TEXT: Final[dict[str, Any]] = {"text/plain; charset=utf-8": {"schema": {"type": "string"}}}
_SOUND: Final[dict[int | str, dict[str, Any]]] = {
    200: {"description": "The recording.", "content": dict.fromkeys(MEDIA_TYPES.values(), _BINARY)},
    206: {"description": "The part that `Range` asks for.", "content": {"audio/flac": _BINARY}},
    400: {"description": "`Range` is malformed.", "content": _TEXT},
    416: {"description": "`Range` lies beyond the end.", "content": _TEXT},
}
"""Answers with sound, by status."""

WHY_MISSING: Final[dict[MissingReason, str]] = {
    MissingReason.SPEECH: "speech was detected, and privacy: no-speech stores no recordings of it",
    MissingReason.STATUS: "server.clips.of does not name events of this status",
    MissingReason.WITHOUT_SOUND: "the server had no frame of its sound left",
    MissingReason.SHED: "the server was overloaded, or too many events waited for their recordings",
    MissingReason.FAILED: "an error prevented it; the server's log has it",
}
"""Why an event has no recordings, in words."""

_NO_CLIP: Final = "The event has no recordings."
_NO_FILE: Final = "The event has no recording of that name."
_UNREADABLE: Final = "What is stored about the recordings, or the recording itself, cannot be read."
_DISK: Final = "The folder of the clips cannot be written."
_log = logging.getLogger(__name__)


def clip_routes(parts: Parts) -> APIRouter:
    """Figures, lists, recordings, and what operators may do with them."""
    router = APIRouter(prefix="/api/v1", tags=["clips"])
    _add_recordings(router, parts.clips)
    _add_lists(router, parts)
    _add_changes(router, parts.clips)
    return router


def _add_lists(router: APIRouter, parts: Parts) -> None:
    """Add the routes that say what there is."""
    clips = parts.clips

    @router.get("/clips", response_model=clip_schema.ClipsState)
    def get_clips() -> Response:
        """Number and size of the recordings, and counts of what was left out since the start."""
        config = parts.site.server.clips
        limits = {
            "max_bytes": None if config is None else config.max_bytes,
            "max_age_days": None if config is None else config.max_age_days,
            "of": [] if config is None else list(config.of),
        }
        return as_json({"v": API_VERSION, **state_of(clips), **limits})

    @router.get(
        "/events/{event_id}/clips",
        response_model=clip_schema.EventClips,
        responses=errors(404, 503, texts={404: "There is no event of that id, and no recordings of one."}),
    )
    def get_event_clips(event_id: str) -> Response:
        """Recordings of an event. Where `state` is `unreadable` or `none`, `problem` says why.

        Recordings can outlive their event in the history.
        """
        clip: Clip | None = None
        problem = None
        try:
            clip = None if clips is None else clips.folder.read(event_id)
        except UnreadableClipError as error:
            problem = str(error)
        state = _state(clips, event_id, clip, problem)
        missing = None
        if state == "none":
            event = parts.store.get(event_id)
            if event is None:
                raise HTTPException(404, f"no event {event_id!r}")
            missing = None if clips is None else clips.why_missing(event_id, event["status"])
            problem = None if missing is None else WHY_MISSING[missing]
        found = {
            "v": API_VERSION,
            "event_id": event_id,
            "state": state,
            "problem": problem,
            "missing": missing,
            "keep": clip is not None and clip.keep,
            "position_m": None if clip is None else clip.content["position_m"],
            "files": [] if clip is None else clip.files,
            "no_enhanced": None if clip is None else clip.content.get("no_enhanced"),
            "methods": list(known_methods(parts.site)) if clip is not None and is_relocatable(clip) else [],
        }
        return as_json(found)


def _add_changes(router: APIRouter, clips: Clips | None) -> None:
    """Add the routes by which operators keep and delete recordings."""

    @router.put(
        "/events/{event_id}/clips/keep",
        response_model=clip_schema.Kept,
        responses=errors(400, 404, 409, 411, 413, 503, texts={404: _NO_CLIP, 409: _UNREADABLE, 503: _DISK}),
    )
    def put_keep(event_id: str, switch: clip_schema.KeepSwitch, request: Request) -> Response:
        """Keep an event's recordings for ever, or no longer; for operators."""
        with _disk_errors(), _unreadable():
            if clips is None or not clips.folder.keep(event_id, switch.keep):
                raise no_clip(event_id, clips)
        what = "keeps" if switch.keep else "no longer keeps"
        _log.info("%r %s the clips of %r", request.scope["client_name"], what, event_id)
        return as_json({"v": API_VERSION, "event_id": event_id, "keep": switch.keep})

    @router.delete(
        "/events/{event_id}/clips",
        response_model=clip_schema.ClipsDeleted,
        responses=errors(404, 411, 413, 503, texts={404: _NO_CLIP, 503: _DISK}),
    )
    def delete_clips(event_id: str, request: Request) -> Response:
        """Delete an event's recordings, also those that are kept for ever or unreadable; the event stays.

        For operators.
        """
        with _disk_errors():
            if clips is None or not clips.folder.delete(event_id):
                raise no_clip(event_id, clips)
        _log.info("%r has deleted the clips of %r", request.scope["client_name"], event_id)
        return as_json({"v": API_VERSION, "event_id": event_id})


def _add_recordings(router: APIRouter, clips: Clips | None) -> None:
    """Add the routes of the sound itself."""

    @router.get(
        "/events/{event_id}/clips/best",
        response_class=Response,
        responses=_SOUND | errors(404, 409, texts={404: "The event has no recordings, or none yet.", 409: _UNREADABLE}),
    )
    def get_best_clip(event_id: str) -> Response:
        """The recording that people listen to first, the enhanced one if there is one; for operators."""
        with _unreadable():
            path = None if clips is None else clips.best_file(event_id)
        if path is None:
            if clips is not None and clips.is_waiting(event_id):
                raise HTTPException(404, f"the recordings of event {event_id!r} are being made; try again in seconds")
            raise no_clip(event_id, clips)
        return _sound_file(path, f"{event_id}-{path.name}")

    @router.get(
        "/events/{event_id}/clips/{name}",
        response_class=Response,
        responses=_SOUND | errors(404, 409, texts={404: _NO_FILE, 409: _UNREADABLE}),
    )
    def get_clip(
        event_id: str,
        name: str,
        format: Annotated[  # noqa: A002 - the API's word
            Literal["stored", "wav"], Query(description="as it is stored, or decoded to 24-bit WAV, always whole")
        ] = "stored",
    ) -> Response:
        """A recording, for operators. `Range` gives parts of it as it is stored."""
        with _unreadable():
            clip = None if clips is None else clips.folder.read(event_id)
        path = None if clip is None else clip.file(name)
        if path is None:
            raise HTTPException(404, f"event {event_id!r} has no recording {name!r}; GET events/ID/clips lists them")
        if format == "wav" and path.suffix != ".wav":
            return Response(_as_wav(event_id, path), media_type=MEDIA_TYPES[".wav"])
        return _sound_file(path)


def _sound_file(path: Path, filename: str | None = None) -> Response:
    """Return a recording as it is stored; with a file name, under which people save it."""
    headers = {"Cache-Control": "private, no-cache"}
    media_type = MEDIA_TYPES[path.suffix]
    return FileResponse(
        path, media_type=media_type, headers=headers, filename=filename, content_disposition_type="inline"
    )


def _state(clips: Clips | None, event_id: str, clip: Clip | None, problem: str | None) -> str:
    if clip is not None:
        return "stored"
    if problem is not None:
        return "unreadable"
    return "waiting" if clips is not None and clips.is_waiting(event_id) else "none"


def no_clip(event_id: str, clips: Clips | None) -> HTTPException:
    """Return the answer that an event has no recordings, and why, if that is known."""
    missing = None if clips is None else clips.why_missing(event_id, None)
    why = "" if missing is None else f": {WHY_MISSING[missing]}"
    return HTTPException(404, f"event {event_id!r} has no recordings{why}")


@contextmanager
def _disk_errors() -> Iterator[None]:
    """Answer 503 where the disk does not do what it should."""
    try:
        yield
    except OSError as error:
        raise HTTPException(503, f"server.clips.folder: {error.strerror or error}; correct that") from error


@contextmanager
def _unreadable() -> Iterator[None]:
    """Answer 409 where what is stored about recordings cannot be read."""
    try:
        yield
    except UnreadableClipError as error:
        raise HTTPException(409, str(error)) from error


def _as_wav(event_id: str, path: Path) -> bytes:
    """Return a recording as a WAV file of 24 bits; answer 409 if it is damaged."""
    try:
        samples, rate_hz = soundfile.read(path, dtype="int32", always_2d=True)
    except (OSError, soundfile.SoundFileError) as error:
        cure = "restore the file from a copy; the other recordings of the event can be heard"
        raise HTTPException(409, f"event {event_id!r}: {path.name} cannot be read: {error}; {cure}") from error
    made = io.BytesIO()
    soundfile.write(made, samples, rate_hz, format="WAV", subtype="PCM_24")
    return made.getvalue()
