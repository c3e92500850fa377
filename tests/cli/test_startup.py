"""What a command loads: a node starts on small machines, and a server within a second and a half."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

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
NEVER_LIVE = {"matplotlib", "pyarrow", "scipy.signal", "scipy.sparse", "scipy.spatial", "scipy.stats", "tqdm"}


def loaded(*arguments: str, code: int) -> set[str]:
    """Modules, and the packages that they are in, that a command has loaded when it ends with that code."""
    done = subprocess.run([sys.executable, "-c", RUN, *arguments], capture_output=True, text=True, check=True)
    got, names = json.loads(done.stdout)
    assert got == code, done.stderr
    return set(names)


def test_a_node_loads_nothing_that_localizes() -> None:
    names = loaded("capture", "--site", str(PAPER), "--node", "nobody", code=2)
    assert {"livessl.capture.node", "livessl.capture.link", "livessl.site.models"} <= names
    heavy = {
        "livessl.core.locate.estimator",
        "livessl.core.stream.fusion",
        "livessl.core.kernels",
        "livessl.core.locate.peak_search",
    }
    heavy |= {"livessl.core.locate.srp", "livessl.server", "livessl.simulation", "fastapi", "numba", "uvicorn"}
    assert names & (heavy | OTHER_COMMANDS | NEVER_LIVE) == set()


def test_a_server_loads_nothing_of_other_commands(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        text = PAPER.read_text(encoding="utf-8")
        text = text.replace(":5570", f":{taken.getsockname()[1]}").replace("port: 8000", "port: 0")
        site = tmp_path / "site.yaml"
        site.write_text(text, encoding="utf-8")
        names = loaded("serve", "--site", str(site), code=1)  # once all else is ready
    assert {"livessl.server.api.app", "livessl.core.locate.peak_search", "fastapi", "numba"} <= names
    assert names & (OTHER_COMMANDS | NEVER_LIVE | {"livessl.recordings.recording", "livessl.simulation"}) == set()
