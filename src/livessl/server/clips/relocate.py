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
"""Number of frame indices that are passed to the fusion at a time, as many as the final pass of a server closes."""

SAME_M: Final = 1e-4
"""Largest distance, in metres, between two positions of a microphone that count as the same: stored positions are
rounded."""

GiveWay = Callable[[], None]
"""A function that is called between two steps of a long computation; it raises `BusyError` to end the computation."""

SetUp = Literal["then", "now"]
"""Poses of the arrays, and speed of sound: with `then`, those with which the event was located; with `now`, those that
are in force."""


class BusyError(RelocationError):
    """Another event is being located again, or the server has no time for it."""


@dataclass(frozen=True, slots=True)
class Relocation:
    """The result of locating an event again.

    Parameters
    ----------
    event : Event
        The same source of the same sound.
    others : tuple of Event
        Further sources that sounded at the same time.
    moved : tuple of str
        Arrays that were moved or turned after the event was located first.
    """

    event: Event
    others: tuple[Event, ...]
    moved: tuple[str, ...]


def _go_on() -> None:
    """Never end a computation."""


def digest_of(site: Site, method: str | None, set_up: SetUp) -> str:
    """Return a digest of everything except the clips on which the answers depend.

    The digest covers the release, the method and the set-up, and from the site the processed arrays (poses, bands,
    accuracy, joints), the speed of sound, the search grid, the activity detection and the fusion. It does not cover
    the code of a method that is named by MODULE:NAME.

    Parameters
    ----------
    site : Site
        The site with the poses that are in force.
    method : str or None
        Method by which all events are located again; None locates each event by its own.
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

    A client cannot name another one by MODULE:NAME, because that would run code.
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
        The site with the poses that are in force.
    folder : ClipReader
    event_id : str
    method : str
        One of `known_methods`.
    set_up : "then" or "now"
    give_way : callable
        Function that is called before each array is read and before each step of the fusion; an error that it raises
        ends the computation.
    most_bytes : int or None
        Most bytes of decoded samples; None for no limit.

    Raises
    ------
    NoClipError, BusyError, ConfigError
        If the event has no recordings, if `give_way` raises it, or if there is no such method.
    RelocationError
        If the clip cannot be used: another release wrote it, it is damaged, the site file no longer has one of its
        arrays, a file cannot be read, its samples take more than `most_bytes`, or it has no sound of the event.
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
    """Locate an event again from its sound, as `relocate` does, with the same errors but `NoClipError`."""
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
    """Return the events in the sound of a clip, one for each source; none if no frame of the event is active."""
    event_id, start_ns = sound.event_id, sound.start_ns
    sources = [
        event
        for event in events_of(site, frames, method, give_way=give_way)
        if event_id == event.id or event_id.startswith(f"{event.id}-") or event.id.startswith(f"{event_id}-")
    ]
    if sources:
        return sources
    # The event is a part of a longer sound that was split. The end of the part before, which the clip has as well, must
    # not become an event.
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

    Frames that the clip has because they were requested are passed to the fusion only if it requests them again. Frames
    before `reported_until` belong to no event's pre-roll.

    Raises
    ------
    BusyError, ConfigError
        If `give_way` raises it, or if there is no such method.
    """
    from livessl.site.build.fusion import (
        make_fusion,  # the estimators are imported at the first use, because that takes time
    )

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
        end = sent[0].frame_index + STRIDE - 1
        end_ns = (end + 1) * FRAME_NS
        taken = [frame for frame in sent if frame.frame_index <= end]
        sent = sent[len(taken) :]
        fresh = fusion.step(taken, end_ns, complete_until=end)
        while requests := [output for output in fresh if isinstance(output, BackfillRequest)]:
            give_way()
            outputs += fresh
            for request in requests:  # frames that the clip does not have never arrive
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
    """Return the arrays of a clip with their poses at that time and their present bands.

    Raises
    ------
    RelocationError
        If the site file no longer has one of them, or has it with another number of microphones.
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
    """Locates events of a running server again, one at a time, on a thread of low priority. Every thread may call it.

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
        self._ended: threading.Event | None = None  # set at the end of the latest computation

    def stop(self) -> None:
        """Refuse the waiting request and all later ones, and return at once.

        A running computation ends at its next step.
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
        """Locate an event again as the function `relocate` does, and wait for the result.

        Returns
        -------
        Relocation
        Site
            The site by which it was located; the poses in force may have changed since.
        float
            Time that it took, in seconds.

        Raises
        ------
        BusyError
            If another event is being located again, the server is stopping, or it is or becomes overloaded.
        NoClipError, ConfigError, RelocationError
            As `relocate` raises them.
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
        """Call `work` on a new thread of low priority, wait for its end or for `stop`, and raise its error."""
        made: list[Relocation] = []
        failed: list[BaseException] = []
        self._ended = ended = threading.Event()

        def run() -> None:
            with suppress(OSError):  # the system has no priorities of threads
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
            try:
                made.append(work())
            except BaseException as error:  # noqa: BLE001 - the waiting thread raises it
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
    """Return the distance, in metres, between the stored position and the new one.

    It is None if there is no stored position, if there is no new one, or if the event is now refused.
    """
    if stored_m is None or again.estimate is None or again.status is Status.REFUSED:
        return None
    return float(np.linalg.norm(again.estimate.position_m - np.array(stored_m)))
