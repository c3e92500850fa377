"""The server's working thread: steps the fusion with what the nodes sent, and hands on what there is to tell."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from livessl import wire
from livessl.clock import Clock, utc_ns, utc_text
from livessl.core.locate.peak_search import warm_up
from livessl.core.stream.array_health import ArrayState, ArrayStatus
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, BackfillRequest, Event, Frame, Message, Output, Track, TrackState, Update
from livessl.server.api.encode import JsonObject, Messages, Stages, array_status
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.parallel import Helper
from livessl.server.receiver import Greeted, Joined, Left, Receiver
from livessl.server.refusals import Refusals
from livessl.server.resident import unmap_unused
from livessl.server.store import Store, StoreError
from livessl.site.build.fusion import make_clock_offsets, make_two_pass_fusion
from livessl.site.models import Site

WAIT_S: Final = 0.02
"""How long the thread waits for sound before it looks at the clock again."""

BATCH: Final = 200
"""Messages taken in before the fusion is stepped: a second of ten arrays."""

STATUS_NS: Final = 500_000_000
"""Between two reports on the arrays."""

COMPILER: Final = "libllvmlite.so"
"""What compiles our kernels, and links those that are cached; once all of them are there, nothing calls it."""

SAY_S: Final = 2.0
"""A start that waits longer than this for the compiler says so."""

WATCH_NS: Final = 100_000_000
"""Between two looks whether an array's state has changed; then it is reported at once."""

RETRY_NS: Final = 1_000_000_000
"""Events that the store did not take are offered to it again this often."""

MAX_UNSAVED: Final = 10_000
"""Events that wait for the store, about 10 MB; beyond it the oldest are given up, and counted."""

REPLAY_SILENT_NS: Final = 5_000_000_000
"""A replay that sends nothing for so long is over, unless its node still says that it is there."""

DISABLED: Final = "disabled"
"""The state of an array that an operator has disabled, however it is doing."""

_ANSWER: Final = ("time_utc", "duration_s", "position_m", "covariance_m2", "confidence", "arrays", "status")
"""Where these are the same, an event is no news."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Unsaved:
    """Events and their start times, the ids they take the place of, and the frame index they settle all before.

    `clocks` is what was known of the arrays' clocks then: without it, a frame index is another one to each.
    """

    events: Sequence[tuple[JsonObject, int]]
    replaced: Sequence[str]
    until: int
    clocks: JsonObject


class Engine:
    """Everything between the nodes and the hub.

    Parameters
    ----------
    site : Site
    clock : Clock
    store : Store
    publish : callable
        Gets every message for subscribers; called on the engine's thread.

    Raises
    ------
    BindError
        Where the address for the nodes is taken.
    """

    def __init__(self, site: Site, clock: Clock, store: Store, publish: Callable[[JsonObject], None]) -> None:
        self._site = site
        self._clock = clock
        self._store = store
        self._publish = publish
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._tracks: dict[int, JsonObject] = {}  # replaced, never changed: other threads read it
        self._states: dict[str, str] = {}
        self._replay_now_ns: int | None = None
        self._replay_heard_ns = 0
        self._replaying = False
        self._status_ns = self._watch_ns = self._retry_ns = 0
        self._unsaved: deque[_Unsaved] = deque()
        self._failure: BaseException | None = None
        self._started_ns, self._began_ns = clock.now_ns(), clock.monotonic_ns()
        self.events = 0
        self.unkept = 0
        self.unsaved = 0
        """Events that wait for the store to take them."""
        self._disabled = store.disabled(site.site)  # replaced, never changed: other threads read it
        self._switching = threading.Lock()
        self.maps = Maps(clock)
        self._helper = Helper()
        self.latency = Latency()
        _warm_up()
        self._begin_live()
        self._receiver = Receiver(site, clock)

    @property
    def endpoint(self) -> str:
        """Where nodes connect to."""
        return self._receiver.endpoint

    @property
    def refusals(self) -> Refusals:
        """Who was turned away, by nodes' and clients' doors."""
        return self._receiver.refusals

    @property
    def enrolled(self) -> list[str]:
        """Nodes whose keys are let in; empty where the site uses none."""
        return self._receiver.enrolled

    @property
    def failure(self) -> BaseException | None:
        """What ended one of the threads, if anything did."""
        return self._failure or self._receiver.failure or self.maps.failure

    @property
    def mode(self) -> str:
        """Live; or replay from a recorded session's first sound on, until a live node comes."""
        return "live" if self._replay_now_ns is None else "replay"

    @property
    def updates_left_out(self) -> int:
        """Windows that were not localized, for newer ones were due."""
        return self._settling.updates_left_out

    @property
    def malformed(self) -> int:
        """Messages refused since the start."""
        return self._receiver.ingest.malformed

    def start(self) -> None:
        """Begin to work."""
        self._receiver.start()
        self.maps.start()
        self._thread.start()

    def stop(self) -> None:
        """End, and give the address back."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=3.0)
        self._helper.stop()
        self.maps.stop()
        self._receiver.stop()

    def wait_idle(self) -> None:
        """Return when the replay that is going on has ended and its last event is told."""
        while self._replaying and self.failure is None and self._thread.is_alive():
            self._stop.wait(WAIT_S)

    def now_ns(self) -> int:
        """Site time: the clock's, or in a replay the recording's."""
        replayed = self._replay_now_ns
        return self._clock.now_ns() if replayed is None else replayed

    def uptime_s(self) -> float:
        """Seconds since the start."""
        return (self._clock.monotonic_ns() - self._began_ns) / 1e9

    def arrays(self, *, levels: bool = True) -> list[JsonObject]:
        """How every array is doing; from any thread, and without waiting for a localization that is going on."""
        return [self._array(status) for status in self._settling.status(self.now_ns(), levels=levels)]

    def enable(self, array: str, enabled: bool) -> None:
        """Use an array's sound from now on, or do not; from any thread.

        A disabled array is heard as ever, its sound acknowledged and its levels shown, but no event is made of it and
        nobody waits for it. The store remembers it.

        Raises
        ------
        StoreError
            Where the store does not take it; all stays as it was.
        """
        with self._switching:
            self._store.enable(self._site.site, array, enabled)
            self._disabled = self._disabled - {array} if enabled else self._disabled | {array}

    def tracks(self) -> list[JsonObject]:
        """The tracks that live now."""
        return list(self._tracks.values())

    def _array(self, status: ArrayStatus) -> JsonObject:
        ingest, settling = self._receiver.ingest, self._settling
        described = array_status(status, self._site.node_of(status.name))
        counters: dict[str, int] = described["counters"]
        counters["duplicates"] = ingest.duplicates[status.name] + settling.duplicates.get(status.name, 0)
        counters["sequence_gaps"] = ingest.sequence_gaps[status.name]
        counters["backfilled"] = settling.backfilled.get(status.name, 0)
        counters["asked"] = settling.asked.get(status.name, 0)
        counters["helped"] = settling.helped.get(status.name, 0)
        counters["too_late"] = settling.too_late.get(status.name, 0)
        problem = ingest.problem_of(status.name)
        if problem is not None:
            described["reason"] = problem
            if described["state"] == ArrayState.HEALTHY:
                described["state"] = str(ArrayState.DEGRADED)
        if described["state"] == ArrayState.LOST and ingest.is_live(status.name, self._clock.monotonic_ns()):
            described["state"] = str(ArrayState.QUIET)
            described["reason"] = problem or "its node is there, but no sound comes from its device"
        described["enabled"] = status.name not in self._disabled
        if not described["enabled"]:
            otherwise = f"{described['state']}: {described['reason']}" if described["reason"] else described["state"]
            described["reason"] = f"an operator has disabled it, and its sound is not used; otherwise {otherwise}"
            described["state"] = DISABLED
        return described

    def _begin_live(self) -> None:
        arrays = [spec.name for spec in self._site.processed]
        self._begin(arrays, *self._store.settled(self._site.site), live=True)

    def _begin(
        self, arrays: Iterable[str], settled: int | None, clocks: JsonObject | None = None, *, live: bool = False
    ) -> None:
        """A clean slate: nothing of another time may leak into this one."""
        self._clocks = make_clock_offsets(self._site)
        if clocks is not None:
            self._clocks.restore(clocks)
        self._settling = make_two_pass_fusion(
            self._site, arrays, settled, live=live, clock_offsets=self._clocks, for_each=self._helper.each
        )
        self._messages: Messages | None = None
        self.maps.clear()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except BaseException as error:
            self._failure = error
            _log.exception("the fusion thread has failed; the server ends")
            raise

    def _turn(self) -> None:
        batch: list[Message] = []
        for item in self._receiver.take(BATCH, WAIT_S):
            if isinstance(item, Joined | Greeted | Left):
                self._step(batch)
                batch = []
                self._meet(item)
            else:
                batch.append(self._used(item))
        self._step(batch)
        now_ns = self._clock.monotonic_ns()
        if batch:
            self._replay_heard_ns = now_ns
        elif self._replaying and now_ns - self._replay_heard_ns > REPLAY_SILENT_NS:
            if any(hello.replay for hello in self._receiver.ingest.live_nodes(now_ns)):
                self._replay_heard_ns = now_ns  # a gap in the recording
            else:
                self._end_replay()
        if self._unsaved and now_ns - self._retry_ns >= RETRY_NS:
            self._save()
        if now_ns - self._watch_ns >= WATCH_NS:
            self._watch_ns = now_ns
            self._watch_arrays(now_ns)

    def _used(self, message: Message) -> Message:
        """The message as the fusion shall have it: nothing in a disabled array's sound is active."""
        if message.array in self._disabled and isinstance(message, Frame) and message.active:
            return replace(message, active=False)
        return message

    def _meet(self, item: Joined | Greeted | Left) -> None:
        if isinstance(item, Left):
            self._leave(item.hello)
            return
        if isinstance(item, Joined):
            self._join(item.hello)
        for array in item.hello.arrays:
            self._settling.greet(array, item.hello.backlog.get(array), self.now_ns(), answers=item.hello.answers)

    def _watch_arrays(self, now_ns: int) -> None:
        if now_ns - self._status_ns < STATUS_NS:
            states = {array["name"]: array["state"] for array in self.arrays(levels=False)}
            if all(state == self._states.get(name) for name, state in states.items()):
                return
        arrays = self.arrays()
        self._status_ns = now_ns
        for array in arrays:
            before = self._states.get(array["name"])
            if before not in (None, array["state"]):
                why = f": {array['reason']}" if array["reason"] else ""
                _log.info("array %r is %s%s", array["name"], array["state"], why)
            self._states[array["name"]] = array["state"]
        self._publish({"kind": "arrays", "now_utc": utc_text(self.now_ns()), "mode": self.mode, "arrays": arrays})

    def _join(self, hello: wire.Hello) -> None:
        if hello.replay or self._replay_now_ns is not None:
            if hello.replay:
                self._begin(hello.arrays, None)
            else:
                self._begin_live()
            self._receiver.ingest.settled = self._settling.settled_of  # not what was settled of another time
            self._replay_now_ns = 0 if hello.replay else None
            self._replaying = hello.replay
            self._replay_heard_ns = self._clock.monotonic_ns()
        for array, rate_hz in hello.arrays.items():
            self._settling.prepare(array, rate_hz)

    def _leave(self, hello: wire.Hello) -> None:
        _log.info("node %r has ended", hello.node)
        if hello.replay:
            self._end_replay()
            return
        for array in hello.arrays:
            self._settling.leave(array)

    def _end_replay(self) -> None:
        """Tell what is still open. Map, arrays and time stay as they were at the end, to be looked at."""
        self._tell(self._settling.flush(self.now_ns()))
        ended, self._tracks = list(self._tracks.values()), {}
        for track in ended:
            self._publish({**track, "state": str(TrackState.END)})
        self._replaying = False

    def _step(self, batch: Sequence[Message]) -> None:
        if self._messages is None:
            if not batch:
                return
            recorded_ns = min(message.frame_index for message in batch) * FRAME_NS
            origin_ns = self._started_ns if self._replay_now_ns is None else recorded_ns
            self._messages = Messages(self._site, origin_ns, utc=True)
        if self._replay_now_ns is not None and batch:
            newest_ns = (max(message.frame_index for message in batch) + 1) * FRAME_NS
            self._replay_now_ns = max(self._replay_now_ns, newest_ns)
        self._settling.exclude(self._disabled)
        self._tell(self._settling.step(batch, self.now_ns()))
        if not self._unsaved:
            self._receiver.ingest.settled = self._settling.settled_of

    def _tell(self, outputs: Sequence[Output | FinalResults]) -> None:
        if self._messages is None:
            return
        for output in outputs:
            if isinstance(output, FinalResults):
                self._tell_settled(output, self._messages)
            elif isinstance(output, Event):
                self._tell_provisional(output, self._messages)
            elif isinstance(output, Update):
                self._publish(self._messages.update(output, self._stages(output, "update")))
            elif isinstance(output, BackfillRequest):
                self._receiver.ask(output)
            elif isinstance(output, Track):
                self._keep_track(self._messages.track(output), output)
            else:
                self.maps.show(output, self._settling.power_maps)

    def _stages(self, answer: Update | Event, kind: str) -> Stages | None:
        """Where an answer's time went; a recording's was long ago."""
        if self._replay_now_ns is not None:
            return None
        stages = self._receiver.arrivals.stages(answer, self._clock.now_ns())
        if stages is not None:
            self.latency.located(kind, stages)
        return stages

    def _tell_provisional(self, output: Event, messages: Messages) -> None:
        """An event that cannot wait for an array that is late or away."""
        event = messages.event(output, self._stages(output, "event"))
        try:
            self._store.add(event, output.start_ns, provisional=True)
        except StoreError as error:  # it will be settled, and is then kept until the store takes it
            _log.error("%s", error)
        self._publish_event(event)

    def _provisional(self, until: int) -> list[JsonObject]:
        try:
            return self._store.provisional(until)
        except StoreError as error:  # what was told without an array is then told again, not replaced
            _log.error("%s", error)
            return []

    def _tell_settled(self, settled: FinalResults, messages: Messages) -> None:
        """Events that stay: those that are news are told, once they are stored."""
        before = [] if self._replay_now_ns is not None else self._provisional(settled.until)
        events = []
        for output in settled.events:
            stages = None if output.late or before else self._stages(output, "event")
            events.append((messages.event(output, stages), output.start_ns))
        if self._replay_now_ns is not None:
            self._keep_replayed(events)
            return
        replaced = {old["id"]: _overlapped(old, [event for event, _ in events]) for old in before}
        known = {old["id"]: old for old in before}
        news = []
        for k, (event, start_ns) in enumerate(events):
            event["replaces"] = [old for old, by in replaced.items() if by is event and old != event["id"]]
            same = known.get(event["id"])
            if same is not None and not event["replaces"] and all(same[key] == event[key] for key in _ANSWER):
                events[k] = (same, start_ns)
            else:
                news.append(event)
        gone = [old for old, by in replaced.items() if by is not None]
        self._unsaved.append(_Unsaved(events, gone, settled.until, self._clocks.state()))
        self._save()
        for event in news:
            self._publish_event(event)

    def _keep_replayed(self, events: Sequence[tuple[JsonObject, int]]) -> None:
        for event, start_ns in events:
            try:
                self._store.add(event, start_ns)
            except StoreError as error:  # better to lose the history than the present
                self.unkept += 1
                _log.error("%s", error)
            self._publish_event(event)

    def _save(self) -> None:
        """Offer the store what it has not taken yet; until it has, no node forgets the sound of it."""
        self._retry_ns = self._clock.monotonic_ns()
        while self._unsaved:
            first = self._unsaved[0]
            try:
                self._store.settle(self._site.site, first.events, first.replaced, first.until, first.clocks)
            except StoreError as error:
                _log.error("%s", error)
                break
            self._unsaved.popleft()
        waiting = sum(len(unsaved.events) for unsaved in self._unsaved)
        while waiting > MAX_UNSAVED:
            lost = len(self._unsaved.popleft().events)
            self.unkept, waiting = self.unkept + lost, waiting - lost
        self.unsaved = waiting

    def _publish_event(self, event: JsonObject) -> None:
        self.events += 1
        self._publish(event)

    def _keep_track(self, message: JsonObject, track: Track) -> None:
        others = {number: other for number, other in self._tracks.items() if number != track.id}
        self._tracks = others if track.state is TrackState.END else {**others, track.id: message}
        self._publish(message)


def _warm_up() -> None:
    """Have compiled what localizes, before anybody waits for it; read from numba's cache it takes a moment only."""
    what = "preparing the search: the first start on a machine compiles it, which takes some seconds"
    told = threading.Timer(SAY_S, _log.info, [what])
    told.start()
    try:
        warm_up()
    finally:
        told.cancel()
    unmap_unused(COMPILER)


def _overlapped(old: JsonObject, events: Sequence[JsonObject]) -> JsonObject | None:
    """The event that shares some of its time with an old one; of two sources of one sound, the one of its number."""
    begin_ns = utc_ns(old["time_utc"])
    end_ns = begin_ns + old["duration_s"] * 1e9
    sharing = []
    for event in events:
        start_ns = utc_ns(event["time_utc"])
        if start_ns < end_ns and begin_ns < start_ns + event["duration_s"] * 1e9:
            sharing.append(event)
    same = (event for event in sharing if event["source"] == old.get("source", 1))
    return next(same, sharing[0] if sharing else None)
