"""Loads the compiled kernels; at the first start on a machine, compiles them in a process of its own meanwhile.

python -m livessl.server.compiling      # compile now, for example while installing
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Final

from livessl.core import kernels as package
from livessl.core.kernels import kernels, with_numpy
from livessl.core.locate.peak_search import warm_up

COMPILE: Final = (sys.executable, "-m", "livessl.server.compiling")
"""The command that compiles the kernels and exits."""

UNTIL_STDIN_ENDS: Final = "--until-stdin-ends"
"""Argument that makes the command end when its standard input is closed: a killed server cannot stop it."""

NICENESS: Final = 10
"""Niceness of a compiler that a server has started, as of nice(1), so that the server comes first."""

_log = logging.getLogger(__name__)


class KernelLoader:
    """Loads the compiled kernels, or has them compiled while those on NumPy do their work.

    Parameters
    ----------
    command : sequence of str
        Compiles the kernels and exits with 0.
    """

    def __init__(self, command: Sequence[str] = COMPILE) -> None:
        self._command = command
        self._lock = threading.Lock()  # of the two below
        self._compiler: subprocess.Popen[bytes] | None = None
        self._is_stopped = False

    def load(self) -> None:
        """Load the compiled kernels; where there are none, begin to compile them and use those on NumPy until then.

        This takes most of a second, so a server listens before. Where numba is not installed, or may keep its machine
        code nowhere, no process is begun: then there is nothing to compile, or it is compiled here before this returns.
        """
        compiled = kernels.in_use
        stamp = _stamp(compiled)
        if stamp is None or stamp.exists():
            warm_up()
            return
        with self._lock:
            if self._is_stopped:
                return
            command = (*self._command, UNTIL_STDIN_ENDS)
            self._compiler = subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603 - this package
        _log.info(
            "First start: compiling kernels in the background, a minute or so; "
            "until then NumPy does their work, slower."
        )
        kernels.use(with_numpy)
        wait = threading.Thread(target=self._wait, args=(self._compiler, compiled), name="compiling", daemon=True)
        wait.start()

    def stop(self) -> None:
        """End the compiler if it still runs; the next start begins anew."""
        with self._lock:
            self._is_stopped = True
        if self._compiler is not None:
            self._compiler.terminate()
            self._compiler.wait()

    def _wait(self, compiler: subprocess.Popen[bytes], compiled: ModuleType) -> None:
        with compiler:  # which closes its standard input at the end
            code = compiler.wait()
        if self._is_stopped:
            return
        if code:
            _log.warning("compiling kernels failed with exit code %d: NumPy goes on, more slowly", code)
            return
        kernels.use(compiled)
        warm_up()
        _log.info("The kernels are compiled and in use.")


def machine_code_folder(compiled: ModuleType) -> Path | None:
    """Return the folder of numba's machine code for a module of kernels; None if numba keeps none."""
    statistics = getattr(compiled.highest, "stats", None)  # a function on NumPy, or with NUMBA_DISABLE_JIT, has none
    folder: str | None = getattr(statistics, "cache_path", None)
    return None if folder is None else Path(folder)


def _stamp(compiled: ModuleType) -> Path | None:
    """Return the file that says that these kernels are compiled, whether it is there or not; None if none is kept."""
    folder = machine_code_folder(compiled)
    if folder is None:
        return None
    sources = sorted(Path(package.__path__[0]).glob("*.py"))
    about = [(path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in sources]
    digest = hashlib.sha256(repr((version("numba"), version("numpy"), about)).encode()).hexdigest()
    return folder / f"compiled-{digest[:16]}"


def main() -> None:
    """Compile the kernels and note that it was done; what another process compiles already is waited for."""
    if UNTIL_STDIN_ENDS in sys.argv[1:]:
        threading.Thread(target=_end_with_stdin, name="parent", daemon=True).start()
        os.nice(NICENESS)
    stamp = _stamp(kernels.in_use)
    if stamp is None:
        warm_up()
        return
    stamp.parent.mkdir(parents=True, exist_ok=True)
    # several servers may start at once, each with a compiler
    with (stamp.parent / "compiling.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not stamp.exists():
            warm_up()
            stamp.touch()


def _end_with_stdin() -> None:
    while os.read(sys.stdin.fileno(), 1):  # a read by sys.stdin that waits at the end of the process would abort it
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
