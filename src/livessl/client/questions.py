"""Single questions of both clients to a server: search for events, health."""

from __future__ import annotations

from datetime import datetime
from functools import cache
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from livessl.client.options import rfc3339
from livessl.client.reading import unreadable
from livessl.schema.answers import Health, HealthStatus

PAGE: Final = 500
"""Events that are asked for at once."""


def event_query(
    since: datetime | str | None,
    until: datetime | str | None,
    zone: str | None = None,
    min_confidence: float | None = None,
) -> dict[str, str]:
    """Return the query of a search for events."""
    given = {
        "since": rfc3339(since, "since"),
        "until": rfc3339(until, "until"),
        "zone": zone,
        "min_confidence": min_confidence,
        "limit": PAGE,
    }
    return {name: str(value) for name, value in given.items() if value is not None}


def health_of(body: bytes) -> Health | HealthStatus:
    """Return the condition of a server, of which it says less without a token.

    Raises
    ------
    NewerServerError, ForeignAnswerError
        See `read_answer`.
    """
    try:
        found: Health | HealthStatus = _health().validate_json(body)
    except ValidationError as error:
        raise unreadable(error, "health") from error
    return found


@cache
def _health() -> TypeAdapter[Any]:
    return TypeAdapter(Health | HealthStatus)
