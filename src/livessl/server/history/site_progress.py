"""Stores what a restarted server needs besides events: progress of the final pass, clocks, disabled arrays."""

from __future__ import annotations

from typing import NamedTuple

import orjson
from sqlalchemy import Connection, delete, insert, select

from livessl.server.history.query import JsonObject
from livessl.server.history.tables import disabled, progress


class Finalized(NamedTuple):
    """Progress of the final pass.

    Parameters
    ----------
    until : int or None
        Frame index before which all events are final; None if there are none yet.
    clocks : JsonObject or None
        What was known of the arrays' clocks then.
    """

    until: int | None
    clocks: JsonObject | None


def finalized(connection: Connection, site: str) -> Finalized:
    """Return how far the final pass of a site has come."""
    query = select(progress.c.frame_index, progress.c.clocks).where(progress.c.site == site)
    row = connection.execute(query).one_or_none()
    if row is None:
        return Finalized(None, None)
    return Finalized(int(row.frame_index), None if row.clocks is None else orjson.loads(row.clocks))


def put_progress(connection: Connection, site: str, frame_index: int, clocks: JsonObject) -> None:
    """Note how far the final pass of a site has come, and what was known of its clocks."""
    connection.execute(delete(progress).where(progress.c.site == site))
    text = orjson.dumps(clocks).decode()
    connection.execute(insert(progress), {"site": site, "frame_index": frame_index, "clocks": text})


def disabled_arrays(connection: Connection, site: str) -> frozenset[str]:
    """Return the names of a site's disabled arrays."""
    return frozenset(connection.execute(select(disabled.c.array).where(disabled.c.site == site)).scalars())


def put_disabled(connection: Connection, site: str, array: str, *, is_disabled: bool) -> None:
    """Note whether an array is disabled."""
    connection.execute(delete(disabled).where(disabled.c.site == site, disabled.c.array == array))
    if is_disabled:
        connection.execute(insert(disabled), {"site": site, "array": array})
