"""REST route `GET log` of the server's last log lines."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, Field

from livessl.clock import utc_text
from livessl.schema.values import UtcTime, Version
from livessl.server.api.auth import LOG
from livessl.server.api.encode import API_VERSION
from livessl.server.api.routes import as_json
from livessl.server.parts import Parts
from livessl.server.recent_log import KEPT_LINES


class LogLine(BaseModel):
    """One line of the server's log."""

    time_utc: UtcTime
    level: str = Field(description="`info`, `warning`, `error` or `critical`.", examples=["warning"])
    logger: str = Field(description="Part of the program that wrote it.", examples=["livessl.server.engine"])
    message: str = Field(
        description="The text, with a traceback if there is one.", examples=["node 'lab-pc' has ended"]
    )


class LogLines(BaseModel):
    """The last lines of the server's log, the oldest first."""

    v: Version
    lines: list[LogLine]


def log_route(parts: Parts) -> APIRouter:
    """`GET /api/v1/log`."""
    router = APIRouter(tags=["state"])

    @router.get(LOG, response_model=LogLines)
    def get_log(
        limit: Annotated[int, Query(ge=1, le=KEPT_LINES, description="most lines, the newest ones")] = 200,
    ) -> Response:
        """The last lines of the server's log, which names clients and addresses; for admins."""
        lines = [
            {"time_utc": utc_text(line.time_ns), "level": line.level, "logger": line.logger, "message": line.message}
            for line in parts.recent_log.lines(limit)
        ]
        return as_json({"v": API_VERSION, "lines": lines})

    return router
