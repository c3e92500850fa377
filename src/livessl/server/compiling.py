"""The first start on a machine: a process of its own compiles the kernels, and NumPy does their work meanwhile.

python -m livessl.server.compiling      # compile now, for example while installing
"""

from __future__ import annotations

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

NICENESS: Final = 10
"""By how much the compiler gives way to the server, as of nice(1)."""

_log = logging.getLogger(__name__)


def load_kernels(command: Sequence[str] = COMPILE) -> Compiler | None:
    """Load the compiled kernels, or begin to compile them and use those on NumPy until that is done.

    Where numba is not installed, or may keep its machine code nowhere, nothing is begun: then there is nothing to
    compile, or it is compiled here before this returns.

    Parameters
    ----------
    command : sequence of str
        Compiles the kernels and exits with 0.

    Returns
    -------
    Compiler or None
        What compiles now, to be stopped with the server; None if the kernels are ready.
    """
    compiled = kernels.in_use
    stamp = _stamp(compiled)
    if stamp is None or stamp.exists():
        warm_up()
        return None
    _log.info(
        "First start: compiling kernels in the background, a minute or so; until then NumPy does their work, slower."
    )
    kernels.use(with_numpy)
    compiler = Compiler(compiled, command)
    compiler.start()
    return compiler


class Compiler:
    """A process that compiles, and the thread that waits for it to use what was compiled.

    Parameters
    ----------
    compiled : module
        The kernels to use afterwards.
    command : sequence of str
        See `load_kernels`.
    """

    def __init__(self, compiled: ModuleType, command: Sequence[str]) -> None:
        self._compiled = compiled
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)  # noqa: S603 - this package
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._wait, name="compiling", daemon=True)

    def start(self) -> None:
        """Wait for the process on a thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the process if it still runs; the next start begins anew."""
        self._stopped.set()
        self._process.terminate()
        self._thread.join()

    def _wait(self) -> None:
        code = self._process.wait()
        if self._stopped.is_set():
            return
        if code:
            _log.warning("compiling kernels failed with exit code %d: NumPy goes on, more slowly", code)
            return
        kernels.use(self._compiled)
        warm_up()
        _log.info("The kernels are compiled and in use.")


def machine_code_folder(compiled: ModuleType) -> Path | None:
    """Where numba keeps the machine code of a module of kernels; None if it keeps none."""
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
    """Compile the kernels and note that it was done."""
    os.nice(NICENESS)
    stamp = _stamp(kernels.in_use)
    warm_up()
    if stamp is not None:
        stamp.parent.mkdir(parents=True, exist_ok=True)
        stamp.touch()


if __name__ == "__main__":
    main()
