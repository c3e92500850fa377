"""The server's working thread: steps the fusion with what the nodes sent, and hands on what there is to tell."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Final

from livessl import wire
from livessl.clock import Clock, utc_text
from livessl.config import Site
from livessl.core.fusion import ArrayStatus
from livessl.core.search import warm_up
from livessl.core.types import FRAME_NS, Event, Message, Output, Track, TrackState, Update
from livessl.messages import JsonObject, Messages, Stages, array_status
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.receiver import Joined, Left, Receiver
from livessl.server.refusals import Refusals
from livessl.server.store import Store, StoreError

WAIT_S: Final = 0.02
"""How long the thread waits for sound before it looks at the clock again."""

BATCH: Final = 200
"""Messages taken in before the fusion is stepped: a second of ten arrays."""

STATUS_NS: Final = 500_000_000
"""Between two reports on the arrays."""

SAY_S: Final = 2.0
"""A start that waits longer for the compiler says so."""

REPLAY_SILENT_NS: Final = 5_000_000_000
"""A replay that sends nothing for so long is over, unless its node still says that it is there."""

_log = logging.getLogger(__name__)


class Engine:
    """Everything between the nodes and the hub.

    Parameters
    ----------
    site : Site
    clock : Clock
    store : Store
    publish : callable
        Gets every message for subscribers; called on the engine's thread.
    method : str or None
        Estimator, instead of the site's.

    Raises
    ------
    BindError
        Where the address for the nodes is taken.
    """

    def __init__(
        self, site: Site, clock: Clock, store: Store, publish: Callable[[JsonObject], None], method: str | None = None
    ) -> None:
        self._site = site
        self._clock = clock
        self._store = store
        self._publish = publish
        self._method = method
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._tracks: dict[int, JsonObject] = {}  # replaced, never changed: other threads read it
        self._states: dict[str, str] = {}
        self._replay_now_ns: int | None = None
        self._replay_heard_ns = 0
        self._replaying = False
        self._status_ns = 0
        self._failure: BaseException | None = None
        self._started_ns, self._began_ns = clock.now_ns(), clock.monotonic_ns()
        self.events = 0
        self.unkept = 0
        self.maps = Maps(clock)
        self.latency = Latency()
        _warm_up()
        self._begin()
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

    def arrays(self) -> list[JsonObject]:
        """How every array is doing; from any thread, and without waiting for a localization that is going on."""
        return [self._array(status) for status in self._fusion.status(self.now_ns())]

    def tracks(self) -> list[JsonObject]:
        """The tracks that live now."""
        return list(self._tracks.values())

    def _array(self, status: ArrayStatus) -> JsonObject:
        ingest = self._receiver.ingest
        described = array_status(status, self._site.node_of(status.name))
        described["counters"]["duplicates"] = ingest.duplicates[status.name]
        described["counters"]["sequence_gaps"] = ingest.sequence_gaps[status.name]
        problem = ingest.problem_of(status.name)
        if problem is not None:
            described["reason"] = problem
            if described["state"] == "healthy":
                described["state"] = "degraded"
        return described

    def _begin(self) -> None:
        """A clean slate: nothing of another time may leak into this one."""
        self._fusion = self._site.make_fusion(self._method)
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
            if isinstance(item, Joined | Left):
                self._step(batch)
                batch = []
                self._join(item.hello) if isinstance(item, Joined) else self._leave(item.hello)
            else:
                batch.append(item)
        self._step(batch)
        now_ns = self._clock.monotonic_ns()
        if batch:
            self._replay_heard_ns = now_ns
        elif self._replaying and now_ns - self._replay_heard_ns > REPLAY_SILENT_NS:
            if any(hello.replay for hello in self._receiver.ingest.live_nodes(now_ns)):
                self._replay_heard_ns = now_ns  # a gap in the recording
            else:
                self._end_replay()
        if now_ns - self._status_ns >= STATUS_NS:
            self._status_ns = now_ns
            self._tell_arrays()

    def _tell_arrays(self) -> None:
        arrays = self.arrays()
        for array in arrays:
            before = self._states.get(array["name"])
            if before not in (None, array["state"]):
                why = f": {array['reason']}" if array["reason"] else ""
                _log.info("array %r is %s%s", array["name"], array["state"], why)
            self._states[array["name"]] = array["state"]
        self._publish({"kind": "arrays", "now_utc": utc_text(self.now_ns()), "mode": self.mode, "arrays": arrays})

    def _join(self, hello: wire.Hello) -> None:
        if hello.replay or self._replay_now_ns is not None:
            self._begin()
            self._replay_now_ns = 0 if hello.replay else None
            self._replaying = hello.replay
            self._replay_heard_ns = self._clock.monotonic_ns()
        for array, rate_hz in hello.arrays.items():
            self._fusion.prepare(array, rate_hz)

    def _leave(self, hello: wire.Hello) -> None:
        _log.info("node %r has ended", hello.node)
        if hello.replay:
            self._end_replay()
            return
        for array in hello.arrays:
            self._fusion.leave(array)

    def _end_replay(self) -> None:
        """Tell what is still open. Map, arrays and time stay as they were at the end, to be looked at."""
        self._tell(self._fusion.flush(self.now_ns()))
        ended, self._tracks = list(self._tracks.values()), {}
        for track in ended:
            self._publish({**track, "state": str(TrackState.END)})
        self._replaying = False

    def _step(self, batch: Sequence[Message]) -> None:
        if self._messages is None:
            if not batch:
                return
            recorded_ns = min(message.raster for message in batch) * FRAME_NS
            origin_ns = self._started_ns if self._replay_now_ns is None else recorded_ns
            self._messages = Messages(self._site, origin_ns, utc=True)
        if self._replay_now_ns is not None and batch:
            newest_ns = (max(message.raster for message in batch) + 1) * FRAME_NS
            self._replay_now_ns = max(self._replay_now_ns, newest_ns)
        self._tell(self._fusion.step(batch, self.now_ns()))

    def _tell(self, outputs: Sequence[Output]) -> None:
        if self._messages is None:
            return
        for output in outputs:
            if isinstance(output, Event):
                event = self._messages.event(output, self._stages(output, "event"))
                try:
                    self._store.add(event, output.start_ns)
                except StoreError as error:  # better to lose the history than the present
                    self.unkept += 1
                    _log.error("%s", error)
                self.events += 1
                self._publish(event)
            elif isinstance(output, Update):
                self._publish(self._messages.update(output, self._stages(output, "update")))
            elif isinstance(output, Track):
                self._keep_track(self._messages.track(output), output)
            else:
                self.maps.show(output, self._fusion.power_maps)

    def _stages(self, answer: Update | Event, kind: str) -> Stages | None:
        """Where an answer's time went; a recording's was long ago."""
        if self._replay_now_ns is not None:
            return None
        stages = self._receiver.arrivals.stages(answer, self._clock.now_ns())
        if stages is not None:
            self.latency.located(kind, stages)
        return stages

    def _keep_track(self, message: JsonObject, track: Track) -> None:
        others = {number: other for number, other in self._tracks.items() if number != track.id}
        self._tracks = others if track.state is TrackState.END else {**others, track.id: message}
        self._publish(message)


def _warm_up() -> None:
    """Have compiled what localizes, before anybody waits for it; read from numba's cache it takes a moment only."""
    told = threading.Timer(SAY_S, _log.info, ["compiling the search, some seconds at the first start on this machine"])
    told.start()
    try:
        warm_up()
    finally:
        told.cancel()
