"""Clips of a real server process: they outlive a kill, and nothing unfinished does."""

from __future__ import annotations

import sys
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pytest

from livessl.capture.node import capture_recordings
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.lab.processes import free_port, wait_until_ready
from small_site import HANG_S, scene_recordings, site_of, started, wait_until, write_site

CLOCK = SystemClock()


def made(figures: dict[str, Any]) -> int:
    """The number of events whose clips are no longer waited for."""
    return sum(int(figures[name]) for name in ("written", "shed", "failed", "without_sound"))


pytestmark = [pytest.mark.processes, pytest.mark.timeout(240)]


def test_clips_of_a_killed_server_are_there_after_its_restart(tmp_path: Path) -> None:
    port, endpoint = free_port(), f"tcp://127.0.0.1:{free_port()}"
    changes = {
        "server": {
            "bind": endpoint,
            "http": {"port": port},
            "events_db": "events.sqlite",
            "clips": {"folder": "clips", "post_s": 0.1},
        },
        "nodes.lab-pc.server": endpoint,
    }
    command = (sys.executable, "-m", "livessl", "serve", "--site", write_site(tmp_path, changes))
    url = f"http://127.0.0.1:{port}"

    def get(path: str) -> dict[str, Any]:
        answer = httpx.get(f"{url}/api/v1/{path}", timeout=HANG_S)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    with started(*command) as process:
        wait_until_ready(url, [process], CLOCK)  # type: ignore[list-item]
        for attempt in count(1):  # a busy machine can shed a clip
            start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS
            recordings = scene_recordings(start_ns)
            capture_recordings(site_of(changes), "lab-pc", recordings, CLOCK, f"run-{attempt}", lambda: False)
            wait_until(lambda n=2 * attempt: made(get("clips")) >= n, "what becomes of both events")  # type: ignore[misc]
            if get("clips")["written"] >= 2:
                break
        written = get("clips")["written"]
        process.kill()
        process.wait()
    unfinished = tmp_path / "clips" / ".partial-small-1"
    unfinished.mkdir()
    (unfinished / "array-north.flac").write_bytes(b"half")
    with started(*command) as process:
        wait_until_ready(url, [process], CLOCK)  # type: ignore[list-item]
        wait_until(lambda: get("clips")["clips"] == written, "the clips of before")
        wait_until(lambda: not unfinished.exists(), "the end of what was not finished")
        events = [event["id"] for event in get("events")["events"]]
        for event in (each for each in events if get(f"events/{each}/clips")["state"] == "stored"):
            files = get(f"events/{event}/clips")["files"]
            assert [file["kind"] for file in files] == ["enhanced", "array", "array"]
            sound = httpx.get(f"{url}/api/v1/events/{event}/clips/enhanced.flac", timeout=HANG_S)
            assert sound.content[:4] == b"fLaC"
            assert httpx.delete(f"{url}/api/v1/events/{event}/clips", timeout=HANG_S).status_code == 200
        assert list((tmp_path / "clips").iterdir()) == []
