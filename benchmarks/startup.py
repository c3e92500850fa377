"""The start-up time of `livessl serve`, with two arrays in the room of the other benchmarks and a grid of 0.05 m.

    python benchmarks/startup.py --out docs/performance

The kernels are compiled before, and the first start is not counted; the others are.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final, NamedTuple
from urllib.request import urlopen

import machine
from livessl.clock import Clock, SystemClock
from livessl.lab.processes import free_port
from livessl.server.compiling import COMPILE

STARTS: Final = 15
SITE: Final = """\
site: startup
room: {{size_m: [8, 10, 4]}}
grid: {{spacing_m: 0.05}}
arrays:
  north: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4, 7.5, 1.5]}}
  south: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [4, 2.5, 1.5]}}
nodes:
  pc:
    server: tcp://127.0.0.1:{frames}
    device: {{name: any, sample_rate_hz: 44100}}
    arrays: {{north: [1, 2, 3, 4], south: [5, 6, 7, 8]}}
server:
  bind: tcp://127.0.0.1:{frames}
  http: {{host: 127.0.0.1, port: {http}}}
  events_db: {folder}/events.db
"""


class Start(NamedTuple):
    """One start of a server.

    Parameters
    ----------
    took_s : float
        Time until the server logged that it was listening, in seconds.
    processor_s : float
        Processor time until then, in seconds.
    answered_s : float
        Time until a request that was sent then was answered, counted from the start, in seconds: meanwhile the fusion
        thread loads what it computes with.
    """

    took_s: float
    processor_s: float
    answered_s: float


def start(site: Path, clock: Clock) -> Start:
    """Start a server, wait until it logs that it is listening and until it answers, and stop it.

    Raises
    ------
    RuntimeError
        If the server ends without that log line.
    """
    began_ns = clock.monotonic_ns()
    command = [sys.executable, "-m", "livessl", "serve", "--site", str(site)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:  # noqa: S603 - ours
        assert server.stderr is not None
        lines = []
        for line in server.stderr:
            lines.append(line)
            if "listening" in line:
                took_s = (clock.monotonic_ns() - began_ns) / 1e9
                ticks = Path(f"/proc/{server.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[11:13]
                with urlopen(f"{line.split()[-1]}/api/v1/health") as answer:  # noqa: S310 - ours
                    answer.read()
                answered_s = (clock.monotonic_ns() - began_ns) / 1e9
                server.send_signal(signal.SIGTERM)
                server.communicate()
                return Start(took_s, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK"), answered_s)
    raise RuntimeError(f"livessl serve: expected a line with 'listening', got {''.join(lines)!r}")


def main() -> int:
    """Measure the start-up time and write `startup.json`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--starts", type=int, default=STARTS)
    arguments = parser.parse_args()
    about, clock = machine.describe(), SystemClock()
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder, "site.yaml")
        site.write_text(SITE.format(frames=free_port(), http=free_port(), folder=folder), encoding="utf-8")
        subprocess.run(COMPILE, check=True)  # noqa: S603 - ours
        start(site, clock)
        starts = [start(site, clock) for _ in range(arguments.starts)]
    report = {"machine": about} | {name: [getattr(each, name) for each in starts] for name in Start._fields}
    (arguments.out / "startup.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
