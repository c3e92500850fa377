"""Clips of the small site's scene as a server stores them, without a server, and its events."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Final

from clip_desk import ClipDesk
from livessl.clock import UnpacedClock
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.types import FRAME_NS, Event, Message
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.server.clips.service import Clips
from livessl.site.build.fusion import make_fusion
from livessl.site.models import Site
from small_site import scene_recordings, site_of

CLIPS: Final[dict[str, Any]] = {"folder": "clips", "pre_s": 1.0, "post_s": 0.5, "enhanced": False}
START_NS = 1_767_225_600_000_000_000


def sent(recordings: list[AssignedRecording]) -> list[Message]:
    """What the small site's nodes send of recordings."""
    pipelines, inputs = make_pipelines(site_of(), recordings)
    return [message for _, some in paced_messages(pipelines, inputs, UnpacedClock()) for message in some]


def located(site: Site, taken: list[Message], method: str | None = None) -> list[Event]:
    """The events in messages, as they are located first."""
    last = taken[-1].frame_index
    fusion = make_fusion(site, method, updates=False)
    outputs = [*fusion.step(taken, last * FRAME_NS, complete_until=last), *fusion.flush(last * FRAME_NS)]
    return [output for output in outputs if isinstance(output, Event)]


@cache
def messages() -> list[Message]:
    """What the nodes send of the scene."""
    return sent(scene_recordings(START_NS))


@cache
def events(method: str = "onset") -> list[Event]:
    """The events of the scene."""
    return located(site_of(), messages(), method)


class Offsets(ClockOffsets):
    """Offsets of clocks that a test knows: by whole frames, and by a rest in seconds."""

    def __init__(self, frames: dict[str, int], rest_s: float) -> None:
        super().__init__({"north": "a", "south": "b"}, 343.0)
        self._frames, self._rest_s = frames, rest_s

    def frames_ahead(self, array: str) -> int:
        return self._frames.get(array, 0)

    def rest_s(self, array: str) -> float:
        return self._rest_s if array in self._frames else 0.0


def clipped(
    directory: Path, taken: list[Message], offsets: ClockOffsets | None = None, found: list[Event] | None = None
) -> Clips:
    """Clips of the scene's events, or of others that were found in the messages, written."""
    desk = ClipDesk(directory, START_NS, **CLIPS)
    desk.offsets = Offsets({}, 0.0) if offsets is None else offsets
    desk.clips.take(taken, None)
    found = events() if found is None else found
    desk.finish(*found)
    desk.clock.ns += 60_000_000_000
    desk.work()
    clips = desk.clips
    assert clips.counts.written == len(found) > 0
    return clips
