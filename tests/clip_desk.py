"""Desks for tests of recordings: clips without a server, a server that stores them, and the content of a clip."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal, cast

import httpx

from livessl.clock import utc_text
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.load_policy import NOTHING_SHED
from livessl.core.types import Event
from livessl.server.app import Server
from livessl.server.clips.service import Clips
from livessl.site.tokens import add_token
from scene_server import capture_scene
from small_site import Changes, running_server, site_of, wait_until

ROLES: Final[tuple[Literal["viewer", "operator"], ...]] = ("viewer", "operator")


def head(start_ns: int, sizes: Mapping[str, int]) -> dict[str, Any]:
    """The head of a clip with recordings of these sizes in bytes; an enhanced one has that name."""
    shared = {"sample_rate_hz": 16000, "duration_s": 1.5, "time_utc": utc_text(start_ns), "beams": []}
    shared |= {"pre_roll_s": 1.0, "post_roll_s": 0.5, "gaps_s": [[0.1, 0.2]], "gain_db": 12.0}
    files = []
    for name, size in sizes.items():
        kind, array, channels = ("enhanced", None, 1) if name == "enhanced.flac" else ("array", "north", 4)
        files.append({"name": name, "kind": kind, "array": array, "channels": channels, "bytes": size, **shared})
    return {"start_ns": start_ns, "position_m": [2.0, 2.0, 1.0], "files": files}


def recordings(start_ns: int, contents: Mapping[str, bytes]) -> Any:
    """A function that writes these recordings into a folder, and says what every clip does."""

    def write(folder: Path) -> dict[str, Any]:
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        return head(start_ns, {name: len(content) for name, content in contents.items()})

    return write


class HandClock:
    """A clock that a test sets."""

    def __init__(self, ns: int) -> None:
        self.ns = ns

    def now_ns(self) -> int:
        return self.ns

    monotonic_ns = now_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        self.ns = max(self.ns, time_ns)
        return True


class Switches:
    """Stands in for site time and overload."""

    is_replay = False
    relief = NOTHING_SHED


class ClipDesk:
    """Clips without a server: a test hands in frames and events, and moves the clock."""

    def __init__(self, directory: Path, start_ns: int, changes: Changes | None = None, **clips: Any) -> None:
        settings = {"folder": "clips", "pre_s": 1.0, "post_s": 0.5, **clips}
        site = site_of({"server.clips": settings, **(changes or {})}, directory)
        assert site.server.clips is not None
        self.clock, self.switches = HandClock(start_ns), Switches()
        switches = cast(Any, self.switches)
        self.clips = Clips(site, site.server.clips, self.clock, switches, switches)
        self.offsets = ClockOffsets({"north": "a", "south": "b"}, site.c_m_s)

    def finish(self, *events: Event) -> None:
        for event in events:
            self.clips.take_final(event, self.offsets)

    def work(self) -> None:
        """Let the time come at which everything that waits is due, and do it."""
        self.clock.ns += 10_000_000_000
        while self.clips.work():
            pass

    def files(self, event: Event) -> dict[str, dict[str, Any]]:
        clip = self.clips.folder.read(event.id)
        return {} if clip is None else {file["name"]: file for file in clip.files}


class ServedClips:
    """A server that stores clips, and clients of it with the tokens of both roles."""

    def __init__(self, server: Server, folder: Path, tokens: dict[str, str]) -> None:
        self.server = server
        self.folder = folder
        self.tokens = tokens
        self.client = httpx.Client(base_url=f"{server.url}/api/v1/", timeout=100)  # making one takes long

    @property
    def clips(self) -> Clips:
        """The clips of the server."""
        clips = self.server.parts.clips
        assert clips is not None
        return clips

    def ask(self, path: str, method: str = "GET", role: str = "operator", **more: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.tokens[role]}", **more.pop("headers", {})}
        return self.client.request(method, path, headers=headers, **more)

    def get(self, path: str, role: str = "operator", **query: Any) -> dict[str, Any]:
        return self._answer(self.ask(path, role=role, params=query))

    def events(self) -> list[dict[str, Any]]:
        """All events, oldest first."""
        found: list[dict[str, Any]] = self.get("events")["events"]
        return found[::-1]

    def relocate(self, event_id: str, /, **wanted: Any) -> dict[str, Any]:
        return self._answer(self.ask(f"events/{event_id}/relocate", "POST", json=wanted))

    def refusal(self, status: int, event_id: str, /, **wanted: Any) -> str:
        """Why the server does not locate an event again."""
        answer = self.ask(f"events/{event_id}/relocate", "POST", json=wanted)
        assert answer.status_code == status, answer.text
        return json.dumps(answer.json()["detail"])

    @staticmethod
    def _answer(answer: httpx.Response) -> dict[str, Any]:
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found


@contextmanager
def served_clips(directory: Path, **clips: Any) -> Iterator[ServedClips]:
    """A server that has stored the clips of both events of the scene."""
    tokens: dict[str, str] = {role: add_token(directory / "tokens.yaml", role, role) for role in ROLES}
    changes: Changes = {"server.clips": {"folder": "clips", **clips}, "server.http.tokens": "tokens.yaml"}
    with running_server(site_of(changes, directory)) as server:
        served = ServedClips(server, directory / "clips", tokens)
        capture_scene(server)
        wait_until(lambda: served.clips.counts.written == 2, "both clips")
        with served.client:
            yield served
