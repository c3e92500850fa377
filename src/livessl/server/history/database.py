"""Connects to the history's database (SQLite or PostgreSQL): time-outs, migrations (upgrades), words of its errors.

`records` has the statements.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Engine, create_engine, event, inspect, make_url, text
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.pool import QueuePool

from livessl.clock import SystemClock
from livessl.errors import ConfigError, Fault, RunError
from livessl.server.history import records
from livessl.server.history.tables import metadata
from livessl.server.history.turns import Turns

HEAD: Final = "0004"
"""The newest revision in `migrations/`; a database that has it needs no Alembic."""

BUSY_S: Final = 0.2
"""Longest wait, in seconds, for an SQLite file that another program has locked."""

CONNECT_S: Final = 3
"""Longest wait, in seconds, for a connection to PostgreSQL."""

STATEMENT_S: Final = 30
"""Longest time, in seconds, of a search, and of any statement in PostgreSQL."""

READER_S: Final = 3
"""Longest wait, in seconds, of a reader while all connections for reading are taken."""

DEAD_CLIENT: Final = (
    "-c tcp_keepalives_idle=5 -c tcp_keepalives_interval=2 -c tcp_keepalives_count=3 -c tcp_user_timeout=10000"
)
"""Settings by which PostgreSQL ends a session, and frees its locks, about 11 s after its client's machine vanished; by
default it does so after two hours."""

STEPS: Final = 100_000
"""SQLite looks at the time of a search whenever it has done so many steps: every few milliseconds."""

QUERY_CANCELED: Final = "57014"
"""PostgreSQL's code of a statement that has taken too long."""

MIGRATION_LOCK: Final = 0x11_7E_55_1
"""Number of the PostgreSQL lock that is held during migrations, so that of two servers one waits."""

READERS: Final = 4
"""Connections for reading that are kept open."""

UNLOCK: Final = "close the program that locks the file"
CURE: Final = f"free space on its disk, or {UNLOCK}"
"""Cures of an SQLite file that cannot be written."""

NARROW: Final = "narrow the span of time that is searched"
"""Cure of searches that take too long."""

CURE_OF_SERVER: Final = "see that PostgreSQL runs, has space, and admits this user"
"""Cure of a PostgreSQL database that cannot be used."""

_log = logging.getLogger(__name__)


class StoreError(RunError):
    """The database cannot be read or written."""


class RejectedError(StoreError):
    """The database refuses what it was given, and would refuse it again."""


class Database:
    """A connection for writing and some for reading, so that no slow search delays an event; every thread may use it.

    Parameters
    ----------
    place : Path, str or None
        An SQLite file, the URL of a PostgreSQL database, or None for SQLite in memory.
    further : sequence of callable
        Each makes or migrates other tables that belong into this database, in the transaction of `prepare`.

    Raises
    ------
    StoreError
        If the file cannot be used. A PostgreSQL server may come later: see `prepare`.
    ConfigError
        If the driver of PostgreSQL is not installed.
    """

    def __init__(self, place: Path | str | None, further: Sequence[Callable[[Connection], None]] = ()) -> None:
        self._further = further
        self.is_remote = isinstance(place, str)
        self.cure = CURE_OF_SERVER if self.is_remote else CURE
        """The cure of a database that cannot be written."""
        self._preparing = threading.Lock()
        self._turns = Turns()
        self._is_prepared = False
        self._problem = ""
        if isinstance(place, str):
            self.name = make_url(place).render_as_string(hide_password=True)
            self._writing: Engine = _postgresql(place, readers=0)
            self._reading = _postgresql(place, readers=READERS)
            self._sessions: Engine = _postgresql(place, readers=0, further=DEAD_CLIENT).execution_options(
                isolation_level="AUTOCOMMIT"
            )
        elif place is None:
            self.name = "memory"
            self._writing = self._reading = self._sessions = _sqlite(":memory:", 1, writes=True)
        else:
            self.name = str(place)
            self._writing = _sqlite(str(place), 1, writes=True)
            self._reading = _sqlite(f"{place.resolve().as_uri()}?mode=ro", READERS, writes=False)
            self._sessions = self._reading
        self._in_memory = place is None

    @property
    def is_prepared(self) -> bool:
        """True once the tables are known to be there."""
        return self._is_prepared

    @property
    def problem(self) -> str | None:
        """Reason why the tables could not be prepared yet; None if they are."""
        return None if self._is_prepared else self._problem

    def prepare(self) -> bool:
        """Make or migrate the tables, once, before anything else; return True if this call has done it.

        Raises
        ------
        StoreError
            If the database cannot be reached or used.
        """
        if self._is_prepared:
            return False
        with self._preparing:
            if self._is_prepared:
                return False
            try:
                with self._writing.begin() as connection:
                    if self._in_memory:
                        metadata.create_all(connection)
                    else:
                        _migrate(connection)
                    records.begin_life(connection)
                    for prepare in self._further:
                        prepare(connection)
            except StoreError as error:
                self._problem = str(error)
                raise
            except (SQLAlchemyError, KeyError, TypeError, ValueError) as error:  # the last ones: of a damaged old event
                cure = CURE_OF_SERVER if self.is_remote else "name a file in a writable folder"
                self._problem = f"server.events_db: cannot use {self.name}: {message_of(error)}; {cure}"
                raise StoreError(self._problem) from error
            self._is_prepared = True
        return True

    @contextmanager
    def writing(self, what: str) -> Iterator[Connection]:
        """A transaction that is kept if its block ends, and else undone.

        Parameters
        ----------
        what : str
            What is done, for the error: "cannot WHAT".

        Raises
        ------
        StoreError
            If it cannot be done.
        """
        self._check()
        try:
            with self._turns, self._writing.begin() as connection:
                yield connection
        except (DataError, IntegrityError) as error:
            raise RejectedError(f"server.events_db: cannot {what}: {message_of(error)}") from error
        except SQLAlchemyError as error:
            raise StoreError(f"server.events_db: cannot {what}: {message_of(error)}; {self.cure}") from error

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees one state of the database, and cannot change it.

        Raises
        ------
        StoreError
            If the database cannot be read.
        """
        self._check()
        try:
            with (
                self._reading.connect() as connection,
                nullcontext() if self.is_remote else _ending_in_time(connection),
            ):
                yield connection
        except PoolTimeoutError as error:
            what = f"server.events_db: all {READERS} connections for reading are taken by other searches"
            raise StoreError(f"{what}; wait for them, or {NARROW}") from error
        except SQLAlchemyError as error:
            if _took_too_long(error):
                what = f"server.events_db: a search was ended after {STATEMENT_S:g} s"
                raise StoreError(f"{what}; {NARROW}") from error
            cure = CURE_OF_SERVER if self.is_remote else UNLOCK
            raise StoreError(f"server.events_db: cannot read: {message_of(error)}; {cure}") from error

    @contextmanager
    def session(self) -> Iterator[Connection]:
        """A connection of its own that keeps no transaction open, for locks that last as long as it does.

        Raises
        ------
        StoreError
            If the database cannot be reached.
        """
        self._check()
        try:
            with self._sessions.connect() as connection:
                yield connection
        except SQLAlchemyError as error:
            raise StoreError(f"server.events_db: cannot use {self.name}: {message_of(error)}; {self.cure}") from error

    def erase(self) -> None:
        """Remove deleted rows from an SQLite file's journal; PostgreSQL's own vacuum does it there.

        Raises
        ------
        StoreError
            If the file is locked.
        """
        if self.is_remote or self._in_memory:
            return
        try:
            with self._writing.connect() as connection:
                driver: Any = connection.connection.dbapi_connection  # outside of any transaction
                busy, *_ = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        except (SQLAlchemyError, sqlite3.Error) as error:
            raise StoreError(f"server.events_db: old events were not erased: {message_of(error)}; {UNLOCK}") from error
        if busy:
            raise StoreError(f"server.events_db: its journal was not emptied of old events; {UNLOCK}")

    def _check(self) -> None:
        """Raise the error of the last `prepare`, so that no caller waits for a server that is known to be away."""
        if not self._is_prepared:
            raise StoreError(self._problem)

    def close(self) -> None:
        """Release the database."""
        self._reading.dispose()
        self._writing.dispose()
        self._sessions.dispose()


def message_of(error: Exception) -> str:
    """Return the message of the driver in one line, without the statement."""
    cause = error.orig if isinstance(error, DBAPIError) else error
    return " ".join(str(cause).split())


def _took_too_long(error: SQLAlchemyError) -> bool:
    cause = error.orig if isinstance(error, DBAPIError) else None
    return (
        getattr(cause, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT
        or getattr(cause, "sqlstate", None) == QUERY_CANCELED
    )


def upgrade(connection: Connection, migrations: Path = Path(__file__).parent / "migrations") -> None:
    """Apply all migrations of a folder that the database lacks, in the transaction of the connection.

    Raises
    ------
    StoreError
        If the database has a revision that no livessl has made.
    """
    from alembic import command  # most starts do not need it, and it takes a while to load
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config()
    config.set_main_option("script_location", str(migrations))
    config.attributes["connection"] = connection
    try:
        command.upgrade(config, "head")
    except CommandError as error:
        what = f"server.events_db: cannot migrate the database: {message_of(error)}"
        raise StoreError(f"{what}; update livessl, or name another database") from error


def _migrate(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": MIGRATION_LOCK})
        connection.execute(text("SET LOCAL statement_timeout = 0"))
    if inspect(connection).has_table("alembic_version"):
        revision = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
        if revision == HEAD:
            return
        if revision is not None and revision > HEAD:
            raise StoreError(
                f"server.events_db: expected a database of revision {HEAD} or before, got {revision} of a newer "
                "livessl; update livessl, or name another database"
            )
        _log.info("server.events_db: migrating the database from revision %s to %s", revision, HEAD)
    upgrade(connection)


def _sqlite(name: str, connections: int, *, writes: bool) -> Engine:
    """Return an engine for an SQLite file or URI, or for one in memory, whose only connection is never closed."""

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(
            name, timeout=BUSY_S, isolation_level=None, check_same_thread=False, uri=name.startswith("file:")
        )

    engine = create_engine(
        "sqlite://",
        creator=connect,
        poolclass=QueuePool,
        pool_size=connections,
        max_overflow=0,
        pool_timeout=30 if writes else READER_S,
        pool_reset_on_return="rollback",
    )
    _on_connect(engine, _set_up_for_writing if writes else _set_up_for_reading)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


@contextmanager
def _ending_in_time(connection: Connection) -> Iterator[None]:
    """Have SQLite interrupt what the connection still does after `STATEMENT_S`.

    A history in memory has one connection for everything, so what is written afterwards has no such limit.
    """
    driver: Any = connection.connection.dbapi_connection
    clock = SystemClock()
    end_ns = clock.monotonic_ns() + round(1e9 * STATEMENT_S)
    driver.set_progress_handler(lambda: clock.monotonic_ns() > end_ns, STEPS)
    try:
        yield
    finally:
        driver.set_progress_handler(None, STEPS)


def _on_connect(engine: Engine, set_up: Callable[[Any], None]) -> None:
    @event.listens_for(engine, "connect")
    def _connected(driver: Any, _record: Any) -> None:
        set_up(driver)


def _set_up_for_writing(driver: Any) -> None:
    driver.execute("PRAGMA journal_mode=WAL")
    driver.execute("PRAGMA secure_delete=ON")  # deleted rows are overwritten


def _set_up_for_reading(driver: Any) -> None:
    driver.execute("PRAGMA query_only=ON")


def _postgresql(url: str, *, readers: int, further: str = "") -> Engine:
    if find_spec("psycopg") is None:
        what = "PostgreSQL needs the package psycopg; pip install 'livessl[postgres]'"
        raise ConfigError([Fault("server.events_db", what)])
    made = make_url(url).set(drivername="postgresql+psycopg")
    of_readers: dict[str, Any] = {}
    options = f"-c statement_timeout={STATEMENT_S * 1000} -c idle_in_transaction_session_timeout={STATEMENT_S * 1000}"
    if readers:
        options += " -c default_transaction_read_only=on"
        # without it each statement of a reader would see another state
        of_readers = {"isolation_level": "REPEATABLE READ", "pool_timeout": READER_S}
    arguments: dict[str, Any] = {
        "connect_timeout": CONNECT_S,
        "application_name": "livessl",
        "tcp_user_timeout": 1000 * CONNECT_S,
        "keepalives_idle": 10,
    }
    given = {name: arguments[name] for name in arguments if name not in made.query}
    return create_engine(
        made,
        pool_size=readers or 1,
        max_overflow=0,
        pool_pre_ping=True,
        **of_readers,
        connect_args={**given, "options": f"{options} {further} {made.query.get('options', '')}".strip()},
    )
