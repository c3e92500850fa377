"""The databases that the tests of the history run on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # what only these tests need is loaded by these tests only
    from livessl.server.store import Store
    from postgresql import PostgreSQL

Place = Path | str | None


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgreSQL]:
    """A PostgreSQL server."""
    from postgresql import running_postgresql

    with running_postgresql() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """An empty database that outlives its store."""
    if request.param == "sqlite":
        return tmp_path / "events.db"
    server: PostgreSQL = request.getfixturevalue("postgresql")
    return server.url()


@pytest.fixture
def opened(place: Place) -> Iterator[Callable[[], Store]]:
    """Opens the same database, as often as wanted."""
    from livessl.server.store import Store

    stores: list[Store] = []

    def open_store() -> Store:
        stores.append(Store(place))
        return stores[-1]

    yield open_store
    for store in stores:
        store.close()


@pytest.fixture(params=["memory", "sqlite", "postgresql"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """An empty store."""
    from livessl.server.store import Store

    place: Place = None
    if request.param == "sqlite":
        place = tmp_path / "events.db"
    elif request.param == "postgresql":
        server: PostgreSQL = request.getfixturevalue("postgresql")
        place = server.url()
    made = Store(place)
    yield made
    made.close()
