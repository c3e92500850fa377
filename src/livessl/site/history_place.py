"""Decides whether `server.events_db` is an SQLite file or a PostgreSQL URL."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from livessl.site.models import Site


def is_url(name: str) -> bool:
    """Return whether `server.events_db` names a database by its URL, and not a file."""
    return "://" in name


def check_history_place(name: str | None) -> str | None:
    """Return the name if it is that of a file, or the URL of a PostgreSQL database.

    Raises
    ------
    ValueError
        If it is another URL.
    """
    if name is None or not is_url(name):
        return name
    try:
        parts = urlsplit(name)
        _ = parts.port
    except ValueError as error:
        raise ValueError(f"expected postgresql://USER@HOST:PORT/DATABASE, got a URL with {error}") from error
    if parts.scheme == "sqlite":
        raise ValueError("expected the name of a file for SQLite, such as events.sqlite, got a URL")
    if parts.scheme not in ("postgresql", "postgres"):
        raise ValueError(
            f"expected the name of a file, or postgresql://USER@HOST:PORT/DATABASE, got a URL of {parts.scheme!r}"
        )
    return "postgresql" + name[len(parts.scheme) :]


def history_place(site: Site) -> Path | str | None:
    """Return the SQLite file of a site's history, the URL of its PostgreSQL database, or None for memory."""
    name = site.server.events_db
    return name if name is None or is_url(name) else site.file(name)
