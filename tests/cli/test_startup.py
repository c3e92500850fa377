"""Modules that a command imports: a node runs on small machines, and a server starts within a second and a half."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from cli.command_runs import COMMANDS
from small_site import write_site

PAPER = Path(__file__).parents[2] / "config" / "paper.yaml"
RUN = """
import json, sys
from livessl.cli.main import main
code = main(sys.argv[1:])
print(json.dumps([code, sorted(sys.modules)]))
"""
OTHER_COMMANDS = {
    "livessl.lab.bench",
    "livessl.lab.demo",
    "livessl.lab.evaluate",
    "livessl.lab.plan",
    "livessl.offline",
}
LOCALIZES = {
    "livessl.core.kernels",
    "livessl.core.locate.estimator",
    "livessl.core.locate.peak_search",
    "livessl.core.locate.srp",
    "livessl.core.stream.fusion",
}
NEVER_LIVE = {
    "matplotlib",
    "opentelemetry.sdk",
    "pyarrow",
    "scipy.signal",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.stats",
    "tqdm",
}

LOADED_BY_THE_FUSION_THREAD = {"numba", "scipy.fft", "scipy.special"}
"""What takes longest to load; a server listens before."""


def loaded(*arguments: str, code: int) -> set[str]:
    """Run a command that ends with `code`; return the names of all modules that it has imported."""
    done = subprocess.run([sys.executable, "-c", RUN, *arguments], capture_output=True, text=True, check=True)
    got, names = json.loads(done.stdout.splitlines()[-1])
    assert got == code, done.stderr
    return set(names)


def test_capture_imports_nothing_that_localizes() -> None:
    names = loaded("capture", "--site", str(PAPER), "--node", "nobody", code=2)
    assert {"livessl.capture.node", "livessl.capture.link", "livessl.site.models"} <= names
    heavy = {"livessl.server", "livessl.simulation", "fastapi", "uvicorn"} | LOADED_BY_THE_FUSION_THREAD
    assert names & (LOCALIZES | heavy | OTHER_COMMANDS | NEVER_LIVE) == set()


def test_a_command_that_loads_blas_itself_lets_it_have_one_thread() -> None:
    """A second thread would wait in a loop and take CPU time."""
    script = (
        "import json, sys; from livessl.cli.main import main; early = 'numpy' in sys.modules; "
        "main(['check', sys.argv[1]]); import numpy, scipy.linalg; from threadpoolctl import threadpool_info; "
        "print(json.dumps([early, [pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas']]))"
    )
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    done = subprocess.run([sys.executable, "-c", script, str(PAPER)], capture_output=True, check=True, env=environment)
    early, threads = json.loads(done.stdout.splitlines()[-1])
    assert not early  # otherwise it would be limited anyway
    assert threads
    assert set(threads) == {1}


def test_serve_imports_nothing_of_other_commands(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        text = PAPER.read_text(encoding="utf-8")
        text = text.replace(":5570", f":{taken.getsockname()[1]}").replace("port: 8000", "port: 0")
        site = tmp_path / "site.yaml"
        site.write_text(text, encoding="utf-8")
        names = loaded("serve", "--site", str(site), code=1)  # the port is opened last
    assert {"livessl.server.api.app", "livessl.core.locate.peak_search", "fastapi"} <= names
    assert names & (OTHER_COMMANDS | NEVER_LIVE | {"livessl.recordings.recording", "livessl.simulation"}) == set()
    assert names & LOADED_BY_THE_FUSION_THREAD == set()


IDLE = """
import json, sys, time
from urllib.request import urlopen
from pathlib import Path
from threading import Thread
from livessl.clock import SystemClock
from livessl.server.app import Server
from livessl.site.load import load_site
server = Server(load_site(Path(sys.argv[1])), SystemClock())
before = server.parts.refiner.refinement
running = Thread(target=server.run)
running.start()
while server.parts.refiner.refinement is before and running.is_alive():
    time.sleep(0.1)
with urlopen(server.url + "/api/v1/health") as answer:
    assert answer.status == 200
names = sorted(sys.modules)
server.stop()
running.join()
print(json.dumps(names))
"""


def test_a_server_without_sounds_loads_nothing_that_examines_them(tmp_path: Path) -> None:
    """The optimizer takes 50 MB. Without compiled kernels a server needs `scipy.sparse` as well."""
    text = PAPER.read_text(encoding="utf-8").replace(":5570", ":0").replace("port: 8000", "port: 0")
    site = tmp_path / "site.yaml"
    site.write_text(text, encoding="utf-8")
    done = subprocess.run([sys.executable, "-c", IDLE, str(site)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    names = set(json.loads(done.stdout.splitlines()[-1]))
    assert {"livessl.core.locate.peak_search", "livessl.server.pose_refiner"} <= names
    assert names & (NEVER_LIVE | {"scipy.optimize", "PIL", "apprise", "nats"}) - {"scipy.sparse"} == set()


EVALUATION = {"livessl.cli.evaluate", "livessl.lab.evaluate", "livessl.lab.evaluate.paper"}


@pytest.mark.parametrize(
    "arguments", [("check", "evaluate"), ("replay", "evaluate"), ("--verbose", "check", "evaluate")], ids=" ".join
)
def test_file_called_evaluate_imports_nothing_of_the_evaluation(arguments: tuple[str, ...]) -> None:
    assert loaded(*arguments, code=2) & EVALUATION == set()


def test_evaluate_imports_the_evaluation() -> None:
    assert loaded("evaluate", "report", "--out", "unused", code=2) >= EVALUATION


def test_check_of_a_method_of_ones_own_imports_neither_the_method_nor_the_fusion(tmp_path: Path) -> None:
    """The module of the method does not exist, and the check does not look for it."""
    site = write_site(tmp_path, {"fusion.method": "nowhere:Method"})
    names = loaded("check", str(site), code=0)
    assert "livessl.lab.plan.prediction" in names, "the expected error"
    live = {"livessl.core.stream.fusion", "livessl.core.locate.peak_search", "livessl.server", "fastapi", "matplotlib"}
    assert names & (live | {"numba"}) == set()


SLOW_HELP = {"replay", "evaluate", "devices"}
"""Commands whose help still imports what they compute with."""


def test_help_imports_no_numerics() -> None:
    """All in one process: the help of any command would leave its modules behind."""
    commands = [name for name in COMMANDS if name not in SLOW_HELP]
    script = f"""
import sys
from livessl.cli.main import main
for command in ([], *([name] for name in {commands})):
    try:
        main([*command, "--help"])
    except SystemExit as end:
        assert end.code == 0, command
print(sorted(sys.modules), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    names = {name.strip("'") for name in done.stderr.strip("[]\n").split(", ")}
    assert "livessl.cli.init" in names
    assert names & {"numpy", "pydantic", "scipy", "threadpoolctl", "tqdm", "yaml", "zmq"} == set()
