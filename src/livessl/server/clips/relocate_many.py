"""Locates many events again from a folder of clips, on several cores."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path

from threadpoolctl import threadpool_limits

from livessl import __version__
from livessl.core.types import ArraySpec
from livessl.errors import ConfigError
from livessl.server.api.encode import JsonObject, answer
from livessl.server.clips.folder import ClipReader
from livessl.server.clips.relocate import SetUp, distance_m, relocate
from livessl.server.clips.stored_sound import RelocationError, stored_sound
from livessl.site.models import Site


@dataclass(frozen=True, slots=True)
class Task:
    """What all events are located again with.

    Parameters
    ----------
    site : Site
        With the poses of now.
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

    @property
    def digest(self) -> str:
        """Digest of everything but the clips that decides the answers.

        These are the release, the method and the set-up, and of the site the processed arrays (poses, bands, accuracy,
        joints), the speed of sound, the search grid, the activity detection and the fusion. The code of a method that
        is named by MODULE:NAME is not part of it.
        """
        site = self.site
        decisive = {
            "version": __version__,
            "method": self.method,
            "set_up": self.set_up,
            "arrays": [_decisive(spec) for spec in site.processed],
            "c_m_s": site.c_m_s,
            "settings": site.model_dump(mode="json", include={"site", "room", "grid", "activity", "fusion"}),
        }
        return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:16]


def _decisive(spec: ArraySpec) -> JsonObject:
    return {**asdict(spec), "microphones_m": spec.microphones_m.round(9).tolist()}


def relocate_one(task: Task, event_id: str) -> JsonObject:
    """Locate an event again; return both answers, or the first one and why there is no second."""
    folder = ClipReader(task.folder)
    about = folder.about(event_id) or {}
    found: JsonObject = {
        "kind": "relocation",
        "event_id": event_id,
        "time_utc": about.get("time_utc"),
        "method": task.method,
        "set_up": task.set_up,
        "digest": task.digest,
        "moved_arrays": [],
        "stored": about.get("answer"),
        "again": None,
        "other_sources": [],
        "distance_m": None,
        "error": None,
    }
    try:
        stored = stored_sound(folder, event_id).answer
        again = relocate(task.site, folder, event_id, task.method or stored["method"], task.set_up)
    except (RelocationError, ConfigError) as error:
        return found | {"error": str(error)}
    return found | {
        "moved_arrays": list(again.moved),
        "again": answer(again.event),
        "other_sources": [answer(other) for other in again.others],
        "distance_m": distance_m(stored["position_m"], again.event),
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
    others = set(active_children())
    pool = ProcessPoolExecutor(
        min(jobs, len(event_ids)), mp_context=get_context("spawn"), initializer=_begin, initargs=(task,)
    )
    try:  # a `with` would wait, on Ctrl-C, for every event not yet located
        for future in as_completed([pool.submit(_relocate_sent, event_id) for event_id in event_ids]):
            yield future.result()
    except BaseException:
        for worker in set(active_children()) - others:
            worker.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_sent: list[Task] = []


def _begin(task: Task) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    _sent[:] = [task]
    threadpool_limits(limits=1)
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)  # a killed parent cannot stop its workers

    threading.Thread(target=end_with_parent, daemon=True).start()


def _relocate_sent(event_id: str) -> JsonObject:
    return relocate_one(_sent[0], event_id)
