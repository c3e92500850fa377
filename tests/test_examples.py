"""Each example runs unchanged, and its output is right."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import deque
from pathlib import Path
from queue import Queue
from threading import Thread

import pytest

from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from small_site import running_server, scene_recordings, site_of, wait_until

EXAMPLES = Path(__file__).parents[1] / "examples"
START_NS = 1_767_225_600_000_000_000
HANGS_AFTER_S = 110.0


def run(name: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        capture_output=True,
        text=True,
        timeout=HANGS_AFTER_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def positions(text: str, first_word: str) -> list[list[float]]:
    lines = [line for line in text.splitlines() if line.startswith(first_word)]
    return [[float(x) for x in re.search(r"\((.*?)\)", line)[1].split(",")] for line in lines]  # type: ignore[index]


@pytest.mark.processes
def test_recordings_are_located_where_the_sounds_were() -> None:
    text = run("locate_recordings.py")
    true, found = positions(text, "true"), positions(text, "found")
    assert len(true) == len(found) == 2
    for there, here in zip(true, found, strict=True):
        assert here == pytest.approx(there, abs=0.1)


@pytest.mark.processes
def test_power_map_is_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "map.png"
    assert "grid points" in run("power_map.py", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.processes
def test_tour_finds_all_four_sounds() -> None:
    text = run("tour.py")
    errors_m = [float(error) for error in re.findall(r"error ([0-9.]+) m, expected", text)]
    assert len(errors_m) == 4
    assert max(errors_m) < 0.1


@pytest.mark.processes
def test_own_estimator_is_as_near_as_the_standard() -> None:
    text = run("own_estimator.py")
    half_cell_diagonal_m = 0.5 * 3**0.5 * 0.1
    for name in ("product", "srp-phat"):
        errors_m = [float(error) for error in re.findall(rf"^{name} .* error ([0-9.]+) m$", text, re.MULTILINE)]
        assert len(errors_m) == 3
        assert max(errors_m) < 2 * half_cell_diagonal_m


@pytest.mark.processes
def test_subscriber_prints_the_events_of_a_server() -> None:
    with running_server(site_of()) as server:
        command = [sys.executable, str(EXAMPLES / "subscribe.py"), server.url]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as subscriber:
            assert subscriber.stdout is not None
            lines: Queue[str] = Queue()
            reader = Thread(target=lambda output: deque(map(lines.put, output)), args=(subscriber.stdout,))
            reader.start()
            try:
                wait_until(lambda: server.parts.fanout.clients == 1, "the subscriber", HANGS_AFTER_S)
                parts = scene_recordings(START_NS)
                pace = UnpacedClock(START_NS)
                send_session(site_of(), server.endpoint, parts, pace, SystemClock(), "run", lambda: False)
                printed = [lines.get(timeout=HANGS_AFTER_S) for _ in range(2)]
            finally:
                subscriber.kill()
                reader.join()
    assert [line.split()[1] for line in printed] == ["located", "located"]


def test_every_example_is_tested() -> None:
    mine = Path(__file__).read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES.glob("*.py") if f'"{path.name}"' not in mine] == []
