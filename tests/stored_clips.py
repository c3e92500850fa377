"""Clips of the small site's scene as a server stores them, without a server, and its events."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from livessl.clock import UnpacedClock
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.load_policy import NOTHING_SHED
from livessl.core.types import Event, Message
from livessl.recordings.assign import make_pipelines
from livessl.recordings.play import paced_messages
from livessl.server.clips.service import Clips
from livessl.site.build.fusion import make_fusion
from small_site import Changes, scene_recordings, site_of

CLIPS: dict[str, Any] = {"folder": "clips", "pre_s": 1.0, "post_s": 0.5, "enhanced": False}
START_NS = 1_767_225_600_000_000_000


@cache
def messages() -> list[Message]:
    """What the nodes send of the scene."""
    pipelines, inputs = make_pipelines(site_of(), scene_recordings(START_NS))
    return [message for _, some in paced_messages(pipelines, inputs, UnpacedClock()) for message in some]


@cache
def events(method: str = "onset") -> list[Event]:
    """The events of the scene, as they are located first."""
    fusion = make_fusion(site_of(), method, updates=False)
    now_ns = messages()[-1].frame_index * 50_000_000
    outputs = [*fusion.step(messages(), now_ns, complete_until=messages()[-1].frame_index), *fusion.flush(now_ns)]
    return [output for output in outputs if isinstance(output, Event)]


class Offsets(ClockOffsets):
    """Offsets of clocks that a test knows: by whole frames, and by a rest in seconds."""

    def __init__(self, frames: dict[str, int], rest_s: float) -> None:
        super().__init__({"north": "a", "south": "b"}, 343.0)
        self._frames, self._rest_s = frames, rest_s

    def frames_ahead(self, array: str) -> int:
        return self._frames.get(array, 0)

    def rest_s(self, array: str) -> float:
        return self._rest_s if array in self._frames else 0.0


def clipped(directory: Path, taken: list[Message], offsets: ClockOffsets, changes: Changes | None = None) -> Clips:
    """Clips of the scene's events, written."""
    site = site_of({"server.clips": CLIPS, **(changes or {})}, directory)
    assert site.server.clips is not None
    clock = SimpleNamespace(now_ns=lambda: START_NS, monotonic_ns=lambda: clock.ns, ns=0)
    idle = cast(Any, SimpleNamespace(is_replay=False, relief=NOTHING_SHED))
    clips = Clips(site, site.server.clips, cast(Any, clock), idle, idle)
    clips.take(taken, None)
    for event in events():
        clips.take_final(event, offsets)
    clock.ns = 60_000_000_000
    while clips.work():
        pass
    assert clips.counts.written == len(events()) == 2
    return clips
