"""Clips of a real server process: they outlive a kill, nothing unfinished does, and speech is not stored."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pytest

from livessl.capture.node import capture_recordings
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.lab.processes import free_port, wait_until_ready
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.clips.missing import FILE
from small_site import (
    HANG_S,
    RATE_HZ,
    heard,
    hiss,
    scene_recordings,
    site_of,
    started,
    wait_until,
    write_site,
)
from voice_scene import voiced

CLOCK = SystemClock()


def made(figures: dict[str, Any]) -> int:
    """The number of events whose clips are no longer waited for."""
    return sum(int(figures[name]) for name in ("written", "shed", "failed", "without_sound", "with_speech"))


pytestmark = pytest.mark.processes


class ClipServer:
    """A server's process with clips, which can be started again, and a node that plays recordings to it."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        port, endpoint = free_port(), f"tcp://127.0.0.1:{free_port()}"
        self._changes = changes | {
            "server": {
                "bind": endpoint,
                "http": {"port": port},
                "events_db": "events.sqlite",
                "clips": {"folder": "clips", "post_s": 0.1},
            },
            "nodes.lab-pc.server": endpoint,
        }
        self._command = (sys.executable, "-m", "livessl", "serve", "--site", write_site(folder, self._changes))
        self.url = f"http://127.0.0.1:{port}"

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[str]]:
        """Run it until the end of the context."""
        with started(*self._command) as process:
            wait_until_ready(self.url, [process], CLOCK)  # type: ignore[list-item]
            yield process

    def get(self, path: str) -> dict[str, Any]:
        answer = httpx.get(f"{self.url}/api/v1/{path}", timeout=HANG_S)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    def play(self, make: Callable[[int], list[AssignedRecording]], run: str) -> None:
        """Play recordings that begin one second from now."""
        start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS
        capture_recordings(site_of(self._changes), "lab-pc", make(start_ns), CLOCK, run, lambda: False)


def test_clips_of_a_killed_server_are_there_after_its_restart(tmp_path: Path) -> None:
    server = ClipServer(tmp_path)
    get, url = server.get, server.url
    with server.running() as process:
        for attempt in count(1):  # a busy machine can shed a clip
            server.play(scene_recordings, f"run-{attempt}")
            wait_until(lambda n=2 * attempt: made(get("clips")) >= n, "what becomes of both events")  # type: ignore[misc]
            if get("clips")["written"] >= 2:
                break
        written = get("clips")["written"]
        process.kill()
        process.wait()
    unfinished = tmp_path / "clips" / ".partial-small-1"
    unfinished.mkdir()
    (unfinished / "array-north.flac").write_bytes(b"half")
    with server.running() as process:
        wait_until(lambda: get("clips")["clips"] == written, "the clips of before")
        wait_until(lambda: not unfinished.exists(), "the end of what was not finished")
        events = [event["id"] for event in get("events")["events"]]
        for event in (each for each in events if get(f"events/{each}/clips")["state"] == "stored"):
            files = get(f"events/{event}/clips")["files"]
            assert [file["kind"] for file in files] == ["enhanced", "array", "array"]
            sound = httpx.get(f"{url}/api/v1/events/{event}/clips/enhanced.flac", timeout=HANG_S)
            assert sound.content[:4] == b"fLaC"
            assert httpx.delete(f"{url}/api/v1/events/{event}/clips", timeout=HANG_S).status_code == 200
        assert recordings_in(tmp_path / "clips") == []


def recordings_in(folder: Path) -> list[Path]:
    """The files and folders of recordings; the file that says why events have no clip is none of them."""
    return [path for path in folder.rglob("*") if path.name != FILE]


def detectors_of(pid: int) -> list[int]:
    """The processes with a detector of speech that a server has started."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"speech_main" in (process / "cmdline").read_bytes():
                found.append(int(process.name))
    return found


def is_running(pid: int) -> bool:
    """Whether a process exists, and is more than an entry that nobody has collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def heard_by_one(start_ns: int) -> list[AssignedRecording]:
    """The scene at one array; the other one is as good as silent."""
    north, south = scene_recordings(start_ns)
    quiet = hiss(heard("south").shape[1] / RATE_HZ, 4, level=1e-6)
    return [north, replace(south, recording=MemoryRecording("south", float(RATE_HZ), quiet))]


def test_server_process_stores_no_speech_but_refused_events_and_says_why_after_a_restart(tmp_path: Path) -> None:
    server = ClipServer(tmp_path, **{"privacy": "no-speech", "fusion.min_arrays": 2})
    get, url = server.get, server.url

    def send(make: Callable[[int], list[AssignedRecording]], result: str) -> None:
        """Send recordings until one of their events has this result: a busy machine can shed clips."""
        for attempt in range(8):
            before = made(get("clips"))
            server.play(make, f"run-{result}-{attempt}")
            wait_until(lambda: made(get("clips")) > before and not get("clips")["waiting"], "what becomes of them")  # noqa: B023
            if get("clips")[result]:
                return
        raise AssertionError(f"no clip was {result}: {get('clips')}")

    def ids_with_speech() -> list[str]:
        ids = [event["id"] for event in get("events")["events"]]
        return [event_id for event_id in ids if get(f"events/{event_id}/clips")["missing"] == "speech"]

    with server.running() as process:
        send(voiced, "with_speech")
        wait_until(lambda: ids_with_speech(), "the event with speech")
        folders = recordings_in(tmp_path / "clips")  # a busy machine can store a part of the voice without speech
        assert not [path for path in folders for event_id in ids_with_speech() if event_id in path.parts]
        send(heard_by_one, "written")
        metrics = httpx.get(f"{url}/metrics", timeout=HANG_S).text
        assert 'livessl_clips_total{result="with_speech"} ' in metrics
        assert get("health")["privacy"]["mode"] == "no-speech"
        [detector] = detectors_of(process.pid)
        process.kill()
        process.wait()
        wait_until(lambda: not is_running(detector), "the end of the detector's process, whose server is gone")
    with server.running() as process:
        wait_until(lambda: get("clips")["clips"], "the clips of before")
        events = {event["id"]: event for event in get("events")["events"]}
        clips = {event_id: get(f"events/{event_id}/clips") for event_id in events}
        spoken = [each for each in clips.values() if each["missing"] == "speech"]
        stored = {
            event_id: each
            for event_id, each in clips.items()
            if each["state"] == "stored" and events[event_id]["status"] == "refused"
        }
        assert {each["state"] for each in spoken} == {"none"}
        assert "privacy: no-speech" in spoken[0]["problem"]
        assert "array-north.flac" in {file["name"] for found in stored.values() for file in found["files"]}
        for found in stored.values():
            assert "neither a place nor a direction" in found["no_enhanced"]
        again: list[httpx.Response] = []

        def is_located_again() -> bool:  # a busy server asks to try again
            path = f"{url}/api/v1/events/{next(iter(stored))}/relocate"
            again.append(httpx.post(path, json={"method": "onset"}, timeout=HANG_S))
            return again[-1].status_code != 503

        wait_until(is_located_again, "both answers of the refused event")
        answer = again[-1].json()
        assert (answer["stored"]["status"], answer["again"]["status"]) == ("refused", "refused")
        assert answer["stored"]["reason"] == answer["again"]["reason"]
