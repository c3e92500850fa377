"""A real PostgreSQL server on a free port, run by an unprivileged user in a temporary folder."""

from __future__ import annotations

import os
import pwd
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import psycopg

from conftest import require
from livessl.lab.processes import free_port
from small_site import HANG_S, wait_until

BINARIES: Final = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
"""Where Debian keeps the programs of each version, which are not on the path."""

SETTINGS: Final = {
    "listen_addresses": "127.0.0.1",
    "fsync": "off",
    "full_page_writes": "off",
    "shared_buffers": "16MB",
    "max_connections": "60",
    "log_min_messages": "fatal",
}


class PostgreSQL:
    """A server that can be stopped and started again.

    Parameters
    ----------
    folder : Path
        An empty folder that the user of the server may enter.
    settings : dict of str to str
        Settings of the server.
    """

    def __init__(self, folder: Path, settings: dict[str, str] = SETTINGS) -> None:
        self._data, self._binaries = folder / "data", _binaries()
        self._settings = settings
        self.port = free_port()
        self._user: dict[str, Any] = {}
        if os.getuid() == 0:  # PostgreSQL refuses to run as root
            account = pwd.getpwnam("nobody")
            os.chown(folder, account.pw_uid, account.pw_gid)
            self._user = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
        command = ("initdb", "--auth=trust", "--username=livessl", "--no-sync", "--encoding=UTF8", "--locale=C")
        self._run(*command, "--pgdata", str(self._data))
        self._process: subprocess.Popen[bytes] | None = None
        self._schemas = 0

    def url(self) -> str:
        """The URL of an empty schema."""
        self._schemas += 1
        name = f"test_{self._schemas}"
        with psycopg.connect(self.address, autocommit=True) as connection:
            connection.execute(f"CREATE SCHEMA {name}")
        return f"{self.address}?options=-csearch_path%3D{name}"

    @property
    def pid(self) -> int:
        """Process id of the server, of which the processes of its connections are children."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start the server, and wait until it answers."""
        settings = [f"-c{name}={value}" for name, value in self._settings.items()]
        command = [str(self._binaries / "postgres"), "-D", str(self._data), "-k", str(self._data), f"-p{self.port}"]
        self._process = subprocess.Popen(
            [*command, *settings], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/", **self._user
        )

        def answers() -> bool:
            assert self._process is not None
            assert self._process.poll() is None, "PostgreSQL has ended"
            try:
                psycopg.connect(self.address, connect_timeout=2).close()
            except psycopg.OperationalError:
                return False
            return True

        wait_until(answers, "PostgreSQL")

    def stop(self) -> None:
        """Stop the server at once; its clients lose their connections."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(timeout=HANG_S)
            self._process = None

    @property
    def address(self) -> str:
        """The URL of its one database."""
        return f"postgresql://livessl@127.0.0.1:{self.port}/postgres"

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._binaries / program), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, cwd="/", check=False, **self._user)
        assert done.returncode == 0, done.stderr


def _binaries() -> Path:
    require(bool(BINARIES), "PostgreSQL is not installed (Debian: apt install postgresql)")
    return BINARIES[-1]


@contextmanager
def running_postgresql(settings: dict[str, str] = SETTINGS) -> Iterator[PostgreSQL]:
    """Run a PostgreSQL server that ends with the context."""
    _binaries()
    with TemporaryDirectory(prefix="livessl-postgresql-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)
        server = PostgreSQL(Path(folder), settings)
        try:
            server.start()
            yield server
        finally:
            server.stop()
