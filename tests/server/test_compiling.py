"""A server listens before it loads the kernels, and works on NumPy at the first start until they are compiled."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from livessl.core.kernels import with_numba
from livessl.server.compiling import machine_code_folder
from small_site import started, wait_until

SCRIPT = """
import logging, shutil, sys, threading
from pathlib import Path
import numpy as np
from livessl.core.geometry import Grid, posed, tetrahedron
from livessl.core.kernels import kernels, with_numba
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.types import ArraySpec
from livessl.server.compiling import KernelLoader, machine_code_folder

logging.basicConfig(level="INFO", stream=sys.stdout, format="%(message)s")
folder = machine_code_folder(with_numba)
folder.mkdir(parents=True, exist_ok=True)
loader = KernelLoader([sys.executable, "-c", sys.argv[1]])
loader.load()
assert kernels.NAME == "NumPy"
spec = ArraySpec("a", posed(tetrahedron(0.5), (1.0, 1.0, 1.0)), (100.0, 6000.0))
PeakSearch([spec], Grid(((0.0, 2.0), (0.0, 2.0), (0.0, 2.0)), 0.5), 343.0).prepare("a", np.arange(-700, 701) / 4e5)
if len(sys.argv) > 2:  # what the compiler would have made
    for path in Path(sys.argv[2]).glob("*.nb?"):
        shutil.copy2(path, folder)
if "sleep" not in sys.argv[1]:
    next(thread for thread in threading.enumerate() if thread.name == "compiling").join()
loader.stop()
print("kernels of", kernels.NAME, "now")
"""

AGAIN = """
import logging, shutil, subprocess, sys, threading
from pathlib import Path
from livessl.core.kernels import kernels, with_numba
from livessl.server.compiling import COMPILE, KernelLoader, machine_code_folder

logging.basicConfig(level="INFO", stream=sys.stdout, format="%(message)s")
folder = machine_code_folder(with_numba)
folder.mkdir(parents=True, exist_ok=True)
for path in Path(sys.argv[1]).glob("*.nb?"):
    shutil.copy2(path, folder)
subprocess.run(COMPILE, check=True)
KernelLoader([sys.executable, "-c", "raise SystemExit('nothing is left to compile')"]).load()
assert not [thread for thread in threading.enumerate() if thread.name == "compiling"]
print("kernels of", kernels.NAME, "at once")
"""

COMPILER = """
from livessl.server import compiling
compiling.warm_up = lambda: print("compiled" if input() == "done" else "interrupted")
compiling.main()
"""


def compiler(tmp_path: Path) -> AbstractContextManager[subprocess.Popen[str]]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return started(sys.executable, "-c", COMPILER, env=environment, **pipes)


def test_compiler_of_a_server_that_is_killed_ends_with_it(tmp_path: Path) -> None:
    """Otherwise each start of a server that crashes would leave one that computes for a minute."""
    server = (
        "import os, signal, sys\n"
        "from livessl.server.compiling import KernelLoader\n"
        "loader = KernelLoader()\n"
        "loader.load()\n"
        "print(loader._compiler.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", server],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    compiler = Path("/proc") / done.stdout.strip()
    wait_until(lambda: not compiler.exists() or ") Z " in (compiler / "stat").read_text(), "the end of the compiler")
    assert list(tmp_path.rglob("compiled-*")) == []


def run(script: str, tmp_path: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def first_start(tmp_path: Path, *arguments: str) -> str:
    said = run(SCRIPT, tmp_path, *arguments)
    assert "First start: compiling kernels in the background" in said
    return said


def test_compiled_kernels_are_used_once_they_are_there(tmp_path: Path) -> None:
    compile_nothing = "from livessl.server import compiling; compiling.warm_up = lambda: None; compiling.main()"
    said = first_start(tmp_path, compile_nothing, str(machine_code_folder(with_numba)))
    assert "The kernels are compiled and in use." in said
    assert "kernels of numba now" in said


def test_failed_compiler_leaves_numpy_in_use_and_is_told(tmp_path: Path) -> None:
    said = first_start(tmp_path, "raise SystemExit(3)")
    assert "compiling kernels failed with exit code 3: NumPy goes on" in said
    assert "kernels of NumPy now" in said


def test_server_that_stops_ends_its_compiler(tmp_path: Path) -> None:
    assert "kernels of NumPy now" in first_start(tmp_path, "import time; time.sleep(3600)")


def test_kernels_that_were_compiled_before_are_loaded_at_once(tmp_path: Path) -> None:
    said = run(AGAIN, tmp_path, str(machine_code_folder(with_numba)))
    assert "compiling" not in said
    assert "kernels of numba at once" in said


def test_two_compilers_do_the_work_once(tmp_path: Path) -> None:
    """As when a server was killed while its compiler ran, and is started again."""

    def begun() -> bool:
        return any(f" {first.pid} " in line for line in locks())

    def locks() -> list[str]:
        return Path("/proc/locks").read_text(encoding="ascii").splitlines()

    with compiler(tmp_path) as first:
        wait_until(begun, "the first compiler")
        with compiler(tmp_path) as second:
            wait_until(lambda: any("->" in line and f" {second.pid} " in line for line in locks()), "the second one")
            assert first.communicate("done\n")[0] == "compiled\n"
            assert second.communicate()[0] == ""
            assert (first.returncode, second.returncode) == (0, 0)
