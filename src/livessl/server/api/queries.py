"""Checks query parameters of REST and WebSockets, and words what is wrong (422): unknown names, times, values."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from typing import Annotated, Final

import orjson
from fastapi import HTTPException, Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, Field, WithJsonSchema

from livessl.clock import utc_ns
from livessl.server.fanout import Filter
from livessl.server.maps import FUSED, VIEWS
from livessl.server.store import Cursor
from livessl.server.zones.zone_map import no_zone
from livessl.site.models import Site

Time = Annotated[str, WithJsonSchema({"type": "string", "format": "date-time"})]
"""A time in a query, for `instant`."""

KINDS: Final = frozenset({"update", "event", "track", "arrays", "alert", "poses", "zone", "zones"})
"""Message kinds that a subscriber can choose from; `hello` and `gap` are always sent."""


MAX_RATE_HZ: Final = 1000.0
"""Highest rate that a subscriber can ask for, in messages a second: more than there are of any subject."""


class LiveParameters(BaseModel):
    """Query parameters of the live messages, over a WebSocket or as server-sent events."""

    kinds: str | None = Field(
        default=None,
        description="Message kinds, separated by commas: alert, arrays, event, poses, track, update, zone, "
        "zones. All if absent.",
        examples=["event,track"],
    )
    min_confidence: float = Field(
        default=0.0, ge=0, le=1, description="Events and updates with a lower confidence are not sent.", examples=[0.8]
    )
    zone: str | None = Field(
        default=None,
        description="Only events, updates, tracks, changes and alerts inside this zone are sent.",
        examples=["door"],
    )
    track: int | None = Field(
        default=None,
        ge=0,
        description="Of tracks and their changes in zones, only those of the track of this number are sent.",
        examples=[7],
    )
    max_rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=MAX_RATE_HZ,
        description="Most updates of a sound, states of a track, and states of the arrays a second; those in between "
        "are left out. Events, alerts, changes in zones, and the first and last state of a track are always sent.",
        examples=[2.0],
    )
    since_seq: int | None = Field(
        default=None,
        ge=0,
        description="`seq` of the last message received: everything published since then is sent first.",
        examples=[1767225600123],
    )


class MapParameters(BaseModel):
    """Query parameters of the map WebSocket."""

    array: str = Field(default=FUSED, description="`fused`, or an array's name.", examples=["fused", "north"])
    views: str = Field(
        default="floor", description="Views, separated by commas: floor, side, front.", examples=["floor,side"]
    )


class ListenParameters(BaseModel):
    """Query parameters of the WebSocket of sound."""

    array: str = Field(description="Name of an array.", examples=["north"])
    channel: int = Field(default=1, ge=1, description="Microphone of the array, from 1.", examples=[1])


async def refuse_unknown_parameters(request: Request) -> None:
    """Answer 422 to a request with a query parameter that its route does not have.

    Raises
    ------
    HTTPException
        In FastAPI's form of a validation error.
    """
    if not request.query_params:
        return
    route: APIRoute = request.scope["route"]
    known = _query_parameters(route.dependant)
    faults = [
        {"type": "extra_forbidden", "loc": ["query", name], "msg": unknown_parameter(name, known), "input": value}
        for name, value in request.query_params.items()
        if name not in known
    ]
    if faults:
        raise HTTPException(422, faults)


def _query_parameters(dependant: Dependant) -> list[str]:
    """Names of the query parameters of a route and of what it depends on."""
    here = [parameter.alias for parameter in dependant.query_params]
    return here + [name for other in dependant.dependencies for name in _query_parameters(other)]


def unknown_parameter(name: str, known: Collection[str]) -> str:
    """Error text for a parameter that is not known, with the closest one that is."""
    close = get_close_matches(name, known, n=1)
    if close:
        cure = f"did you mean {close[0]!r}?"
    else:
        cure = f"expected one of {', '.join(known)}" if known else "this request takes no parameters"
    return f"unknown parameter {name!r}; {cure}"


def check_parameters(given: Iterable[str], model: type[BaseModel]) -> None:
    """Raise ValueError if a WebSocket was opened with a query parameter that its model does not have."""
    for name in given:
        if name not in model.model_fields:
            raise ValueError(unknown_parameter(name, list(model.model_fields)))


def unprocessable(name: str | None, what: str, part: str = "query") -> HTTPException:
    """A 422 in FastAPI's form, for a query parameter or a key of another part; None stands for the whole part."""
    loc = [part] if name is None else [part, name]
    return HTTPException(422, [{"type": "value_error", "loc": loc, "msg": what}])


async def refuse_request(_request: Request, error: Exception) -> Response:
    """Answer 422 with the faults of a request, without the values if JSON cannot hold them: deep nesting, odd bytes."""
    assert isinstance(error, RequestValidationError)
    faults = error.errors()
    try:
        body = orjson.dumps({"detail": jsonable_encoder(faults)})
    except (TypeError, ValueError, RecursionError):
        bare = [{name: fault[name] for name in ("type", "loc", "msg")} for fault in faults]
        body = orjson.dumps({"detail": jsonable_encoder(bare)})
    return Response(body, 422, media_type="application/json")


def instant(name: str, text: str | None) -> int | None:
    """Nanoseconds since the epoch of an RFC 3339 text, clipped to 64 bits.

    Raises
    ------
    HTTPException
        422 if the text is no time with an offset.
    """
    if text is None:
        return None
    text = text.replace(" ", "+")  # an unescaped + in a query arrives as a blank
    try:
        time_ns = utc_ns(re.sub(r"(?<=\d)[tz]", lambda letter: letter[0].upper(), text))  # RFC 3339 allows lower case
    except (ValueError, OverflowError) as error:
        raise unprocessable(name, f"{name}: {error}") from error
    return max(-(2**63), min(2**63 - 1, time_ns))


def require_no_nul(**texts: str | None) -> None:
    """Check that parameters have no NUL, which PostgreSQL cannot compare.

    Raises
    ------
    HTTPException
        422 if one has.
    """
    for name, text in texts.items():
        if text is not None and "\0" in text:
            raise unprocessable(name, f"{name}: expected a text without NUL")


def page_cursor(text: str | None, name: str = "cursor") -> Cursor | None:
    """Return the place in the list of events for a page's `next_cursor`, or its `previous_cursor` if `name` is `after`.

    Raises
    ------
    HTTPException
        422 if no page has such a cursor.
    """
    try:
        return None if text is None else Cursor.parse(text)
    except ValueError as error:
        wanted = "previous_cursor" if name == "after" else "next_cursor"
        raise unprocessable(name, f"{name}: expected the {wanted} of a page, got {text!r}") from error


def live_filter(
    zones: Collection[str],
    kinds: str | None,
    min_confidence: str,
    zone: str | None,
    track: str | None = None,
    max_rate_hz: str | None = None,
) -> Filter:
    """Filter of a live subscriber, on a site with these zones, from the texts of its query.

    Raises
    ------
    ValueError
        If a kind or the zone does not exist, or a number is out of range.
    """
    chosen = None if kinds is None else frozenset(kind.strip() for kind in kinds.split(","))
    if chosen is not None and not chosen <= KINDS:
        raise ValueError(f"kinds: expected some of {', '.join(sorted(KINDS))}, got {kinds!r}")
    least = _number(min_confidence)
    if not 0.0 <= least <= 1.0:
        raise ValueError(f"min_confidence: expected a number from 0 to 1, got {min_confidence!r}")
    rate_hz = None if max_rate_hz is None else _number(max_rate_hz)
    if rate_hz is not None and not 0.0 < rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"max_rate_hz: expected a number above 0, at most {MAX_RATE_HZ:g}, got {max_rate_hz!r}")
    if zone is not None and zone not in zones:
        raise ValueError(f"zone: {no_zone(zone, zones)}")
    return Filter(chosen, least, zone, whole_number("track", track, "the number of a track"), rate_hz)


def whole_number(name: str, text: str | None, what: str = "the seq of a message") -> int | None:
    """The number in a parameter, None if it is absent.

    Raises
    ------
    ValueError
        If the text is no decimal number of at most 19 digits.
    """
    if text is not None and not (text.isascii() and text.isdigit() and len(text) < 20):
        raise ValueError(f"{name}: expected {what}, got {text!r}")
    return None if text is None else int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def array_names(site: Site) -> list[str]:
    """Names of the arrays that are processed."""
    return [spec.name for spec in site.processed]


def map_names(site: Site) -> list[str]:
    """Names of the power maps: `fused`, and one for each array."""
    return [FUSED, *array_names(site)]


def chosen_microphone(site: Site, array: str, channel: str) -> int:
    """Channel that a listener has chosen, from 1.

    Raises
    ------
    ValueError
        If the site does not permit listening, or the array or the channel does not exist.
    """
    if not site.server.listen:
        raise ValueError("listen: the site file does not permit it; set server.listen: true")
    if array not in array_names(site):
        raise ValueError(f"array: no array {array!r}; there are {', '.join(array_names(site))}")
    count = len(site.array(array).microphones_m)
    if not channel.isascii() or not channel.isdigit() or not 1 <= int(channel) <= count:
        raise ValueError(f"channel: expected a number from 1 to {count}, got {channel!r}")
    return int(channel)


def chosen_views(site: Site, array: str, views: str) -> tuple[str, ...]:
    """Views that a watcher of maps has chosen, each once.

    Raises
    ------
    ValueError
        If the array or a view does not exist.
    """
    if array not in map_names(site):
        raise ValueError(f"array: no array {array!r}; there are {', '.join(map_names(site))}")
    chosen = tuple(dict.fromkeys(view.strip() for view in views.split(",")))
    if not set(chosen) <= VIEWS.keys():
        raise ValueError(f"views: expected some of {', '.join(VIEWS)}, got {views!r}")
    return chosen
