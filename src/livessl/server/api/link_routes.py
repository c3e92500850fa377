"""REST route that signs a link to one picture, recording or map, for people without a token."""

from __future__ import annotations

import logging
from typing import Final

from fastapi import APIRouter, HTTPException, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from livessl.clock import utc_text
from livessl.schema.answers import errors
from livessl.schema.values import UtcTime, Version
from livessl.server.api.auth import Access
from livessl.server.api.encode import API_VERSION
from livessl.server.api.routes import as_json
from livessl.server.signed_links import LINKABLE, LIVE_PATH
from livessl.site.alert_models import LIFETIME_S, LinkLifetimeS

LIVE_LIFETIME_S: Final = 600.0
"""Longest lifetime, in seconds, of a link to the map: a person who loses access cannot go on watching through an old
link for longer."""

_NO_TOKENS: Final = "The server uses no tokens, so no address needs a signature."
_log = logging.getLogger(__name__)


class LinkRequest(BaseModel):
    """Request for a link."""

    model_config = ConfigDict(extra="forbid", strict=True)

    path: str = Field(
        max_length=1000,
        pattern=f"^{LINKABLE}$",
        description="Path of a picture of an alert, a recording of an event, or the power map; nothing else.",
        examples=["/api/v1/events/lab-1/clips/best"],
    )
    lifetime_s: LinkLifetimeS = Field(
        default=LIFETIME_S,
        description="Seconds after which the link expires. A link to the map, which shows what happens now, expires "
        "after 600 at the latest.",
    )


class Link(BaseModel):
    """A link that opens one path without a token until it expires."""

    v: Version
    link: str = Field(
        description="The path with its signature; put the server's address before it.",
        examples=["/api/v1/events/lab-1/clips/best?expires=1767225600&signature=MA6a…"],
    )
    until_utc: UtcTime = Field(description="When it expires.")


def link_routes(access: Access) -> APIRouter:
    """Links for people without a token."""
    router = APIRouter(tags=["state"])

    @router.post("/api/v1/links", response_model=Link, responses=errors(400, 409, 411, 413, texts={409: _NO_TOKENS}))
    def post_link(wanted: LinkRequest, request: Request) -> Response:
        """Sign a link that opens one picture, recording or map without a token until it expires; for operators."""
        if access.links is None:
            raise HTTPException(409, "this server uses no tokens: the address works without a signature")
        lifetime_s = min(wanted.lifetime_s, LIVE_LIFETIME_S) if wanted.path == LIVE_PATH else wanted.lifetime_s
        link, expires_ns = access.links.sign(wanted.path, lifetime_s)
        until_utc = utc_text(expires_ns)
        _log.info("%r has signed a link to %r until %s", request.scope["client_name"], wanted.path, until_utc)
        return as_json({"v": API_VERSION, "link": link, "until_utc": until_utc})

    return router
