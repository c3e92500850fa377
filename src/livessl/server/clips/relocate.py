"""Locates a stored event again from its clip: by another method, or with the poses that are in force now.

The clip has the frames that the fusion had, and so the same fusion locates them: with the same method and poses the
answer is the same.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Final, Literal

import numpy as np

from livessl import __version__
from livessl.clock import Clock
from livessl.core.methods import METHODS
from livessl.core.types import (
    FRAME_NS,
    ArraySpec,
    BackfillRequest,
    Event,
    Frame,
    Output,
    Status,
)
from livessl.server.clips.reader import ClipReader
from livessl.server.clips.stored_sound import (
    MOST_BYTES,
    RelocationError,
    StoredSound,
    check_memory,
    stored_clip,
    stored_frames,
    stored_sound,
)
from livessl.server.overload import Overload
from livessl.site.models import Site

NICENESS: Final = 10
"""Niceness of the thread that locates again: live sound comes first."""

STRIDE: Final = 40
"""Number of frame indices that are handed to the fusion at a time, as many as its final pass takes."""

SAME_M: Final = 1e-4
"""Distance, in metres, up to which a microphone counts as being at the same place: positions are stored so exactly."""

GiveWay = Callable[[], None]
"""Is called between two steps of a long computation; raises `BusyError` to end it."""

SetUp = Literal["then", "now"]
"""The poses of the arrays, and the speed of sound: those by which the event was located, or those now in force."""


class BusyError(RelocationError):
    """Another event is being located again, or the server has no time for it."""


@dataclass(frozen=True, slots=True)
class Relocation:
    """An event as it is located again.

    Parameters
    ----------
    event : Event
        The same source of the same sound.
    others : tuple of Event
        Further sources that sounded at the same time.
    moved : tuple of str
        Arrays that are elsewhere, or turned, since the event was located first.
    """

    event: Event
    others: tuple[Event, ...]
    moved: tuple[str, ...]


def _go_on() -> None:
    """Never end a computation."""


def digest_of(site: Site, method: str | None, set_up: SetUp) -> str:
    """Return a digest of everything but the clips that decides the answers.

    These are the release, the method and the set-up, and of the site the processed arrays (poses, bands, accuracy,
    joints), the speed of sound, the search grid, the activity detection and the fusion. The code of a method that is
    named by MODULE:NAME is not part of it.

    Parameters
    ----------
    site : Site
        With the poses of now.
    method : str or None
        None takes the one by which each event was located.
    set_up : "then" or "now"
    """
    decisive = {
        "version": __version__,
        "method": method,
        "set_up": set_up,
        "arrays": [{**asdict(spec), "microphones_m": spec.microphones_m.round(9).tolist()} for spec in site.processed],
        "c_m_s": site.c_m_s,
        "settings": site.model_dump(mode="json", include={"site", "room", "grid", "activity", "fusion"}),
    }
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:16]


def known_methods(site: Site) -> tuple[str, ...]:
    """Return the methods by which an event may be located again: those that are registered, and the site's own.

    A client cannot name others, for naming one by MODULE:NAME runs code.
    """
    return tuple(dict.fromkeys((*METHODS, site.fusion.method)))


def relocate(
    site: Site,
    folder: ClipReader,
    event_id: str,
    method: str,
    set_up: SetUp,
    give_way: GiveWay = _go_on,
    most_bytes: int | None = None,
) -> Relocation:
    """Locate an event again from its clip.

    Parameters
    ----------
    site : Site
        With the poses that are in force now.
    folder : ClipReader
    event_id : str
    method : str
        One of `known_methods`.
    set_up : "then" or "now"
    give_way : callable
        Is called before each array is read and before each step of the fusion; ends it by an error.
    most_bytes : int or None
        Most bytes of decoded samples; None for no limit.

    Raises
    ------
    NoClipError
        If the event has no recordings.
    RelocationError
        If the clip does not fit: another release has made it, it is damaged, an array is no longer there, a file cannot
        be read, it takes more than `most_bytes`, or no sound of the event is in it.
    """
    return relocate_sound(site, stored_sound(stored_clip(folder, event_id)), method, set_up, give_way, most_bytes)


def relocate_sound(
    site: Site,
    sound: StoredSound,
    method: str,
    set_up: SetUp,
    give_way: GiveWay = _go_on,
    most_bytes: int | None = None,
) -> Relocation:
    """Locate an event again from its sound, as `relocate` does."""
    event_id = sound.event_id
    if most_bytes is not None:
        check_memory(sound, most_bytes)
    specs = _specs(site, sound)
    moved = tuple(name for name, spec in specs.items() if _is_moved(spec, site.array(name)))
    if set_up == "then":
        processed = tuple(specs.get(spec.name, spec) for spec in site.processed)
        site = site.model_copy(update={"processed": processed, "c_m_s": sound.c_m_s})
    frames: list[Frame] = []
    for array in sound.arrays:
        give_way()
        frames += stored_frames(sound, array)
    sources = _sources(site, frames, method, sound, give_way)
    if not sources:
        raise RelocationError(
            f"the recordings of {event_id!r} have no active frame of it: frames are missing; see its gaps_s"
        )
    wanted = next((event for event in sources if event.id == event_id), sources[0])
    return Relocation(wanted, tuple(event for event in sources if event is not wanted), moved)


def _sources(site: Site, frames: Sequence[Frame], method: str, sound: StoredSound, give_way: GiveWay) -> list[Event]:
    """Return the events, one for each source, of the sound of a clip; none if it has no active frame of it."""
    event_id, start_ns = sound.event_id, sound.start_ns
    sources = [
        event
        for event in events_of(site, frames, method, give_way=give_way)
        if event_id == event.id or event_id.startswith(f"{event.id}-") or event.id.startswith(f"{event_id}-")
    ]
    if sources:
        return sources
    # a part of a longer sound, which was split: what the clip has of the part before is no event of its own
    start = round(start_ns / FRAME_NS)
    quiet = [replace(frame, active=frame.active and frame.frame_index >= start) for frame in frames]
    found = events_of(site, quiet, method, reported_until=start, give_way=give_way)
    end_ns = start_ns + round(1e9 * sound.duration_s)
    overlaps = {event.start_ns: min(event.end_ns, end_ns) - max(event.start_ns, start_ns) for event in found}
    longest = max(overlaps, key=lambda at_ns: overlaps[at_ns], default=None)
    return [event for event in found if event.start_ns == longest and overlaps[event.start_ns] > 0]


def events_of(
    site: Site, frames: Sequence[Frame], method: str, reported_until: int | None = None, give_way: GiveWay = _go_on
) -> list[Event]:
    """Locate the events in frames of a site's arrays, on joint frame indices, by the fusion that locates live sound.

    Requested frames are given only if the fusion requests them. Frames before `reported_until` are in no pre-roll.

    Raises
    ------
    ConfigError
        If there is no such method.
    """
    from livessl.site.build.fusion import make_fusion  # what computes is loaded when it is needed first

    fusion = make_fusion(site, method, updates=False, corrects_clocks=False)
    if reported_until is not None:
        fusion.begin(reported_until)
    sent = sorted((frame for frame in frames if not frame.requested), key=lambda frame: frame.frame_index)
    kept: dict[str, list[Frame]] = {}
    for frame in frames:
        if frame.requested:
            kept.setdefault(frame.array, []).append(frame)
    for array in kept:
        fusion.set_answers(array, True)
    outputs: list[Output] = []
    while sent:
        give_way()
        end, end_ns = sent[0].frame_index + STRIDE, (sent[0].frame_index + STRIDE + 1) * FRAME_NS
        taken = [frame for frame in sent if frame.frame_index <= end]
        sent = sent[len(taken) :]
        fresh = fusion.step(taken, end_ns, complete_until=end)
        while requests := [output for output in fresh if isinstance(output, BackfillRequest)]:
            give_way()
            outputs += fresh
            for request in requests:  # what is not in the clip does not come any more
                fusion.set_answers(request.array, False)
            answers = [
                frame for one in requests for frame in kept[one.array] if one.first <= frame.frame_index <= one.last
            ]
            fresh = fusion.step(answers, end_ns)
            for request in requests:
                fusion.set_answers(request.array, True)
        outputs += fresh
        if not sent:
            give_way()
            outputs += fusion.flush(end_ns)
    return [output for output in outputs if isinstance(output, Event)]


def _specs(site: Site, sound: StoredSound) -> dict[str, ArraySpec]:
    """Return the arrays of a clip as they were then, in the bands of now.

    Raises
    ------
    RelocationError
        If one of them is no longer there, or has another number of microphones now.
    """
    now = {spec.name: spec for spec in site.processed}
    specs = {}
    for array in sound.arrays:
        name, microphones_m = array.name, array.microphones_m
        count = len(now[name].microphones_m) if name in now else 0
        if count != len(microphones_m):
            there = f"{count} microphones" if count else "no such array"
            raise RelocationError(
                f"array {name!r}: its recording has {len(microphones_m)} channels, and the site file has {there} now; "
                "locate the recordings with the former site file by `livessl locate`"
            )
        specs[name] = replace(now[name], microphones_m=microphones_m, uncertainty=array.uncertainty)
    return specs


def _is_moved(then: ArraySpec, now: ArraySpec) -> bool:
    return float(np.abs(then.microphones_m - now.microphones_m).max()) > SAME_M


class Relocator:
    """Locates events of a running server again, one at a time, by a thread of low priority. Every thread may call it.

    Parameters
    ----------
    folder : ClipReader
    clock : Clock
    site : callable
        Returns the site with the poses that are in force.
    overload : Overload
        Nothing is located again while the server is overloaded; a computation that runs when an overload begins ends at
        its next step.
    """

    def __init__(self, folder: ClipReader, clock: Clock, site: Callable[[], Site], overload: Overload) -> None:
        self._folder = folder
        self._clock = clock
        self._site = site
        self._overload = overload
        self._one_at_a_time = threading.Lock()
        self._stopping = threading.Event()
        self._ended: threading.Event | None = None  # of the computation that runs, or ran last

    def stop(self) -> None:
        """Refuse the request that waits, and all further ones; wait for nothing.

        The computation that runs ends at its next step.
        """
        self._stopping.set()
        ended = self._ended
        if ended is not None:
            ended.set()

    @property
    def site(self) -> Site:
        """The site with the poses that are in force."""
        return self._site()

    def relocate(self, event_id: str, method: str, set_up: SetUp) -> tuple[Relocation, Site, float]:
        """Locate an event again, and wait for it, as the function does.

        Return also the site by which it was located, whose poses may change meanwhile, and how long it took, in
        seconds.

        Raises
        ------
        BusyError
            If another event is being located again, the server is stopping, or it is or becomes overloaded.
        NoClipError, RelocationError
            As the function.
        """
        self._give_way()
        if not self._one_at_a_time.acquire(blocking=False):  # a thread that waited would be missing for other requests
            raise BusyError("another event is being located again; try again in some seconds")
        try:
            begun_ns, site = self._clock.monotonic_ns(), self.site
            made = self._at_leisure(
                lambda: relocate(site, self._folder, event_id, method, set_up, self._give_way, MOST_BYTES)
            )
            return made, site, (self._clock.monotonic_ns() - begun_ns) / 1e9
        finally:
            self._one_at_a_time.release()

    def _give_way(self) -> None:
        if self._stopping.is_set():
            raise BusyError("the server is stopping; try again when it has started again")
        if self._overload.message is not None:
            raise BusyError("the server is overloaded, and live sound comes first; try again when it is not")

    def _at_leisure(self, work: Callable[[], Relocation]) -> Relocation:
        """Do some work on a thread of low priority of its own, and wait for it or for `stop`; raise what it raises."""
        made: list[Relocation] = []
        failed: list[BaseException] = []
        self._ended = ended = threading.Event()

        def run() -> None:
            with suppress(OSError):  # a system that does not know priorities of threads
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
            try:
                made.append(work())
            except BaseException as error:  # noqa: BLE001 - it is raised by the thread that waits
                failed.append(error)
            ended.set()

        threading.Thread(target=run, name="relocate", daemon=True).start()
        if not self._stopping.is_set():  # `stop` may have missed the new event
            ended.wait()
        if made:
            return made[0]
        if failed:
            raise failed[0]
        self._give_way()
        raise AssertionError("a computation has ended without a result")


def distance_m(stored_m: Sequence[float] | None, again: Event) -> float | None:
    """Return the distance between the stored position and the one found again, metres; None without one of them."""
    if stored_m is None or again.estimate is None or again.status is Status.REFUSED:
        return None
    return float(np.linalg.norm(again.estimate.position_m - np.array(stored_m)))
