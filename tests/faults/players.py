"""Recorded sounds that the nodes of a soak play again and again."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from world import Microphones
from world_parts import START

from livessl.clock import UnpacedClock
from livessl.core.types import FRAME_NS, Frame, Message
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import make_scene, render
from livessl.site.models import Site
from small_site import RATE_HZ, hiss

SECOND = 20
HOUR = 3600 * SECOND
SLOT = 60 * SECOND
"""One sound in each, but for every eighth hour, which is quiet."""

CLIP = 5 * SECOND
"""Longer than a sound's recording is, with the quiet at its end."""

SOUNDS = 8
"""Different ones, each at a place of its own."""

PLACES = {
    "a": ("north", [1.9, 1.0, 1.4]),
    "b": ("south", [2.2, 4.1, 1.5]),
    "c": ("east", [3.3, 2.6, 1.6]),
    "d": ("west", [0.7, 2.3, 1.5]),
}
"""Nodes, each with an array and its place."""

Heard = Mapping[int, Sequence[Frame]]
"""What an array's node sends of a sound, by frame index since the sound's recording began."""


def rendered_sounds(site: Site) -> list[dict[str, Heard]]:
    """Each of the sounds as every array's node sends it."""
    sounds: list[dict[str, Heard]] = []
    for k in range(SOUNDS):
        scene = make_scene(
            site.room.size_m,
            rt60_s=0.2,
            sounds=[("burst", hiss(0.2 + 0.1 * k, 1, seed=k)[0])],
            count=1,
            sample_rate_hz=RATE_HZ,
            c_m_s=site.c_m_s,
            keep_away_m=[spec.centre_m for spec in site.specs],
            seed=k,
            lead_s=1.0,
        )
        heard: dict[str, Heard] = {}
        for spec in site.specs:
            samples = render(scene, spec.microphones_m, seed=k)
            part = AssignedRecording(spec.name, MemoryRecording(spec.name, float(RATE_HZ), samples), 0, (1, 2, 3, 4))
            heard[spec.name] = _by_interval(site, part)
        sounds.append(heard)
    return sounds


def _by_interval(site: Site, part: AssignedRecording) -> dict[int, list[Frame]]:
    found: dict[int, list[Frame]] = {}
    run_up: list[Frame] = []
    for _, batch in paced_messages(*make_pipelines(site, [part]), UnpacedClock()):
        for message in batch:
            if isinstance(message, Frame):
                run_up.append(message)
                if message.active or message.frame_index - 1 in found:
                    found[message.frame_index], run_up = run_up, []
    return found


@dataclass
class Player(Microphones):
    """An array in a room where the rendered sounds come again and again."""

    sounds: Sequence[Mapping[str, Heard]] = ()
    sent: Counter[str] = field(default_factory=Counter)

    def messages_at(self, frame_index: int) -> list[Message]:
        messages = self._heard(frame_index)
        self.sent.update(type(message).__name__ for message in messages)
        return messages

    def _heard(self, frame_index: int) -> list[Message]:
        slot, since = divmod(frame_index - START, SLOT)
        played = sound_of(slot, len(self.sounds))
        if played is None:
            return super().messages_at(frame_index)
        began = frame_index - since + played[0]
        frames = self.sounds[played[1]][self.array].get(frame_index - began, ())
        if not frames:
            return super().messages_at(frame_index)
        messages: list[Message] = []
        for frame in frames:
            self.sequence += 1
            at = frame.frame_index + began
            messages.append(
                replace(frame, sequence=self.sequence, frame_index=at, time_ns=frame.time_ns + began * FRAME_NS)
            )
        return messages


@lru_cache(maxsize=8)
def sound_of(slot: int, count: int) -> tuple[int, int] | None:
    """When in its slot a sound's recording begins, in intervals, and which it is."""
    if slot * SLOT // HOUR % 8 == 7:
        return None
    rng = random.Random(slot)
    return rng.randrange(SLOT // 2), rng.randrange(count)
