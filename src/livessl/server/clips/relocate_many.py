"""Locates many events again from a folder of clips, on several cores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from threadpoolctl import threadpool_limits

from livessl.errors import ConfigError
from livessl.schema.relocation import unanswered
from livessl.server.api.encode import JsonObject, answer
from livessl.server.clips.reader import ClipReader
from livessl.server.clips.relocate import SetUp, digest_of, distance_m, relocate_sound
from livessl.server.clips.stored_sound import RelocationError, stored_clip, stored_sound
from livessl.site.models import Site
from livessl.workers import on_cores


@dataclass(frozen=True)
class Task:
    """The settings with which all events are located again.

    Parameters
    ----------
    site : Site
        Has the poses that are in force now.
    folder : Path
        The clips.
    method : str or None
        None takes the one by which each event was located.
    set_up : "then" or "now"
    """

    site: Site
    folder: Path
    method: str | None
    set_up: SetUp

    @cached_property
    def digest(self) -> str:
        """Digest of everything but the clips that decides the answers: see `digest_of`."""
        return digest_of(self.site, self.method, self.set_up)


def relocate_one(task: Task, event_id: str) -> JsonObject:
    """Locate an event again; return both answers, or the first one and why there is no second."""
    found = unanswered(event_id, task.method, task.set_up, task.digest)
    try:
        clip = stored_clip(ClipReader(task.folder), event_id)
        found |= {"time_utc": clip.content.get("time_utc"), "stored": clip.content.get("answer")}
        sound = stored_sound(clip)
        again = relocate_sound(task.site, sound, task.method or sound.answer["method"], task.set_up)
    except (RelocationError, ConfigError) as error:
        return found | {"error": str(error)}
    return found | {
        "moved_arrays": list(again.moved),
        "again": answer(again.event),
        "other_sources": [answer(other) for other in again.others],
        "distance_m": distance_m(sound.answer["position_m"], again.event),
    }


def relocate_many(task: Task, event_ids: Sequence[str], jobs: int) -> Iterator[JsonObject]:
    """Yield the answers for some events as they come: see `relocate_one`.

    Parameters
    ----------
    task : Task
    event_ids : sequence of str
    jobs : int
        Processes, one core each; 1 computes in this process.
    """
    if jobs == 1 or len(event_ids) < 2:
        yield from (relocate_one(task, event_id) for event_id in event_ids)
        return
    yield from on_cores(_relocate_on_one_core, task, event_ids, jobs)


def _relocate_on_one_core(task: Task, event_id: str) -> JsonObject:
    with threadpool_limits(limits=1):
        return relocate_one(task, event_id)
