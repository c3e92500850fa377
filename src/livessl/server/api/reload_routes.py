"""REST route `POST reload`: takes over a changed site file without a restart."""

from __future__ import annotations

import logging

from fastapi import APIRouter, HTTPException, Request, Response
from pydantic import BaseModel, Field

from livessl.errors import ConfigError, RunError
from livessl.schema.answers import errors
from livessl.schema.values import Version
from livessl.server.api.encode import API_VERSION
from livessl.server.api.routes import as_json
from livessl.server.parts import Parts

_TEXTS = {409: "The site file cannot be used: `detail` has its faults, one a line, and nothing has changed."}

_log = logging.getLogger(__name__)


class ReloadResult(BaseModel):
    """Result of a reload of the site file."""

    v: Version
    changed: list[str] = Field(description="Keys that took effect.", examples=[["zones.door.bounds_m"]])
    needs_restart: list[str] = Field(
        description="Keys that differ from what the server runs with, and take effect with its next start.",
        examples=[["server.http.port"]],
    )
    warnings: list[str] = Field(description="Settings that are valid but unlikely to work.", examples=[[]])


def reload_route(parts: Parts) -> APIRouter:
    """`POST /api/v1/reload`."""
    router = APIRouter(tags=["state"])

    @router.post("/api/v1/reload", response_model=ReloadResult, responses=errors(409, 411, 413, texts=_TEXTS))
    def post_reload(request: Request) -> Response:
        """Read the site file again and take over what has changed, as SIGHUP does; for operators."""
        _log.info("%r asks to read the site file again", request.scope["client_name"])
        try:
            result = parts.reloader.reload()
        except (ConfigError, RunError) as error:
            _log.error("the site file was not taken over, and the former settings stay in force: %s", error)
            raise HTTPException(409, str(error)) from error
        return as_json(
            {
                "v": API_VERSION,
                "changed": list(result.changed),
                "needs_restart": list(result.needs_restart),
                "warnings": list(result.warnings),
            }
        )

    return router
