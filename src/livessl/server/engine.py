"""The fusion thread: steps the fusion with what nodes sent, and begins and ends live runs and replays."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final, Protocol

from livessl import wire
from livessl.core.stream.site_state import ArraySetUp
from livessl.core.types import FRAME_NS, Message
from livessl.server.array_states import ArrayStates
from livessl.server.event_log import EventLog
from livessl.server.event_traces import EventTraces
from livessl.server.parallel import Parallel
from livessl.server.publisher import Publisher
from livessl.server.receiver import Greeted, Inbox, Joined, Left
from livessl.server.run import Run, live_run, replay_run
from livessl.server.shared_state import SharedState
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.build.fusion import make_array_set_up
from livessl.site.models import Site

WAIT_S: Final = 0.02
"""Longest wait for messages, in seconds, before the thread looks at the clock again."""

BATCH: Final = 200
"""Most messages taken in before the fusion is stepped: one second of ten arrays."""

_log = logging.getLogger(__name__)


class SoundTaker(Protocol):
    """Takes in the sound of the arrays, on the fusion thread, which it must not hold up."""

    def take(self, messages: Iterable[Message], settled: int | None) -> None:
        """Take in messages, and the frame index before which all results are final."""
        ...


class Engine:
    """Everything between the receiver and the publisher, in one thread.

    Parameters
    ----------
    shared : SharedState
    receiver : Inbox
    array_states : ArrayStates
    event_log : EventLog
    publisher : Publisher
    zones : callable
        Returns the zones that are in force.
    sound_takers : sequence of SoundTaker
        Get every frame: for those who listen, and for what is kept of events.
    traces : EventTraces or None
        Times the steps of the fusion; None if nothing is traced.
    """

    def __init__(
        self,
        shared: SharedState,
        receiver: Inbox,
        array_states: ArrayStates,
        event_log: EventLog,
        publisher: Publisher,
        zones: Callable[[], ZoneMap],
        sound_takers: Sequence[SoundTaker] = (),
        traces: EventTraces | None = None,
    ) -> None:
        self._traces = traces
        self._site = shared.site
        self._clock = shared.clock
        self._receiver = receiver
        self._site_time = shared.site_time
        self._array_states = array_states
        self._event_log = event_log
        self._maps = shared.maps
        self._publisher = publisher
        self._overload = shared.overload
        self._zones = zones
        self._sound_takers = sound_takers
        self._rates_hz: dict[str, float] = {}  # of the arrays whose nodes have joined
        self._coming: deque[tuple[Site, ArraySetUp]] = deque()
        self._parallel = Parallel()
        self._stop = threading.Event()
        self._prepare: Callable[[], None] | None = None
        self.turns = 0
        """Number of turns, passes of the thread's loop, that have ended. If it stops growing, the thread hangs."""
        self._thread = threading.Thread(target=self._work, name="fusion", daemon=True)
        self.failure: BaseException | None = None
        """The error that has ended the thread, if it has ended."""
        self._begin(live_run(shared.site, event_log.begin_live(), self._parallel.for_each))

    @property
    def has_turned(self) -> bool:
        """True once the first turn of the thread has ended. The modules that compute are loaded by then."""
        return self.turns > 0

    @property
    def updates_left_out(self) -> int:
        """Number of windows of this run that were not located because newer ones were due."""
        return self._run.fusion.updates.left_out

    def start(self, prepare: Callable[[], None]) -> None:
        """Start the thread, which calls `prepare` before its first turn."""
        self._prepare = prepare
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=3.0)
        self._parallel.stop()

    def prepare(self, site: Site) -> Callable[[], None]:
        """Prepare to locate with the poses of a site; return a function that puts them into force at the next turn.

        Any thread may call both. Sounds that have begun are still located with the poses in force before. The tables of
        the estimator are computed here, so that the fusion thread does not wait for them.
        """
        set_up = make_array_set_up(site, self._parallel.for_each)
        for array, rate_hz in tuple(self._rates_hz.items()):
            set_up.estimator.prepare(array, rate_hz)
        return partial(self._coming.append, (site, set_up))

    def wait_idle(self) -> None:
        """Wait until the replay that was sent has ended and its last event is published.

        Before the first turn it is not known whether a replay was sent.
        """
        while self.failure is None and self._thread.is_alive():
            if self.has_turned and not self._site_time.replay_is_running:
                return
            self._stop.wait(WAIT_S)

    def turn(self) -> None:
        """Take one turn: process the messages that have arrived, step the fusion, and publish the results.

        A turn waits up to `WAIT_S` for its first message.

        The thread calls it until the server stops. If the thread is not started, any other caller may call it.
        """
        while self._coming:
            self._site, set_up = self._coming.popleft()
            self._run.fusion.take_over(set_up)
        batch: list[Message] = []
        began_ns = self._clock.monotonic_ns()
        items = self._receiver.take(BATCH, WAIT_S)
        self._adapt(len(items), self._clock.monotonic_ns() - began_ns)
        for item in items:
            if isinstance(item, Joined | Greeted | Left):
                self._step(batch)
                batch = []
                self._handle(item)
            else:
                batch.append(item)
        self._step(batch)
        if batch:
            self._site_time.note_sound()
        elif self._site_time.replay_is_silent():
            self._end_or_await_replay()
        self._event_log.retry()
        self._array_states.watch()

    def _adapt(self, items: int, waited_ns: int) -> None:
        """Set the work that is shed under the present load; in a replay nothing is shed, because the replay waits."""
        run, live = self._run, not self._site_time.is_replay
        relief = self._overload.note(self._receiver.delay_s, items, waited_ns, sheds=live)
        run.fusion.relieve(relief)
        self._overload.updates_shed = self._updates_shed + run.fusion.updates.shed
        self._receiver.ingest.keep_samples_of(run.fusion.located if relief.arrays is not None else None)

    def _work(self) -> None:
        try:
            if self._prepare is not None:
                self._prepare()
            while not self._stop.is_set():
                self.turn()
                self.turns += 1
        except BaseException as error:
            self.failure = error
            _log.exception("the fusion thread has failed; the server ends")
            raise

    def _begin(self, run: Run) -> None:
        self._updates_shed = self._overload.updates_shed
        self._run = run
        self._array_states.follow(run.fusion)
        self._maps.clear()

    def _switch(self, run: Run) -> None:
        """Begin another run, and replace the acknowledged final indices: those of the previous run do not apply.

        Its tracks end while the mode is still that of the previous run, which may have died without an end.
        """
        self._publisher.end_tracks()
        self._begin(run)
        self._receiver.ingest.note_final(run.fusion.settled_of)

    def _handle(self, item: Joined | Greeted | Left) -> None:
        """Take in that a node has joined, greeted again, or left."""
        if isinstance(item, Left):
            self._leave(item.hello)
            return
        if isinstance(item, Joined):
            self._join(item.hello)
        hello, now_ns = item.hello, self._site_time.now_ns()
        for array in hello.arrays:
            self._run.fusion.greet(array, hello.backlog.get(array), now_ns, answers=hello.answers)

    def _join(self, hello: wire.Hello) -> None:
        if hello.replay:
            self._event_log.begin_replay()
            self._switch(replay_run(self._site, hello.arrays, self._parallel.for_each))
            self._site_time.begin_replay()
        elif self._site_time.is_replay:
            self._switch(live_run(self._site, self._event_log.begin_live(), self._parallel.for_each))
            self._site_time.begin_live()
        else:
            self._array_states.join(hello)
        for array, rate_hz in hello.arrays.items():
            self._rates_hz[array] = rate_hz
            self._run.fusion.prepare(array, rate_hz)

    def _leave(self, hello: wire.Hello) -> None:
        _log.info("node %r has ended", hello.node)
        if hello.replay:
            self._end_replay()
            return
        for array in hello.arrays:
            self._run.fusion.leave(array)

    def _end_or_await_replay(self) -> None:
        """End a replay that sends nothing, unless its node still greets: then there is a gap in the recording."""
        nodes = self._receiver.ingest.live_nodes(self._clock.monotonic_ns())
        if any(hello.replay for hello in nodes):
            self._site_time.note_sound()
        else:
            self._end_replay()

    def _end_replay(self) -> None:
        """Publish what is still open. Map, arrays and site time stay as they were at the end, for people to look at."""
        self._publisher.publish(self._run.fusion.flush(self._site_time.now_ns()), self._run)
        self._publisher.end_tracks()
        self._site_time.end_replay()

    def _step(self, batch: Sequence[Message]) -> None:
        run = self._run
        if run.messages is None:
            if not batch:
                return
            recorded_ns = min(message.frame_index for message in batch) * FRAME_NS
            origin_ns = recorded_ns if self._site_time.is_replay else self._site_time.started_ns
            run.begin(origin_ns, self._zones)
        self._site_time.advance(batch)
        run.fusion.exclude(self._array_states.disabled)
        for taker in self._sound_takers:
            taker.take(batch, run.fusion.settled)
        if self._traces is not None:
            self._traces.begin_step(self._clock.now_ns())
        self._publisher.publish(run.fusion.step(batch, self._site_time.now_ns()), run)
        if self._event_log.is_saved:
            self._receiver.ingest.note_final(run.fusion.settled_of)
