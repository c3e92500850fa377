"""A capture node from sound to server: its messages, its end, and its errors when the server does not take them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate, count
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Self

import numpy as np
import pytest

from livessl import wire
from livessl.capture.host_clock import HostClock
from livessl.capture.host_watch import HostWatch
from livessl.capture.link import Link
from livessl.capture.links import UndeliveredError
from livessl.capture.node import (
    AHEAD_NS,
    MAX_PENDING,
    STUCK_NS,
    capture_device,
    capture_recordings,
    send_session,
    with_host,
)
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import FRAME_NS, Block, ChannelLevel, Float32Array, Frame, Mark
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.inlet import QUEUE_MESSAGES
from livessl.server.receiver import Item, Joined, Left, Receiver
from livessl.service_manager import ServiceManager
from livessl.site.models import Site
from notify_socket import listening
from small_site import HANG_S, RATE_HZ, frame, hiss, mark, site_of, wait_until

START_NS = 1_767_225_600_000_000_000
FIRST = START_NS // FRAME_NS
ARRAYS = ("north", "south")
CLOCK = SystemClock()


class PatientClock(SystemClock):
    """A clock by which the server is never silent.

    With a real clock, a pause of the machine of two seconds makes the link reconnect and send frames again, as it
    should, but these tests count frames.
    """

    def monotonic_ns(self) -> int:
        """Return a constant time."""
        return 0


class HurriedClock(SystemClock):
    """A clock by which a second passes from each look to the next."""

    def __init__(self) -> None:
        self._seconds = count()

    def monotonic_ns(self) -> int:
        return 1_000_000_000 * next(self._seconds)


@dataclass
class There:
    """The real receiver, and all items that it has received."""

    receiver: Receiver
    items: list[Item] = field(default_factory=list)

    @property
    def site(self) -> Site:
        return site_of({"nodes.lab-pc.server": self.receiver.endpoint})

    def of(self, kind: type[Item]) -> list[Item]:
        """Return the received items of a kind."""
        self.items += self.receiver.take(1000, 0.001)
        return [item for item in self.items if isinstance(item, kind)]

    def messages(self, array: str) -> list[Frame | Mark]:
        return [item for item in self.items if isinstance(item, Frame | Mark) and item.array == array]


@contextmanager
def server() -> Iterator[There]:
    receiver = Receiver(site_of(), CLOCK)
    receiver.start()
    try:
        yield There(receiver)
    finally:
        receiver.stop()


def sound() -> Float32Array:
    """Return 1.5 s of quiet noise with a burst after the first second."""
    samples = hiss(1.5, level=1e-3)
    samples[:, RATE_HZ : RATE_HZ + RATE_HZ // 5] += hiss(0.2, seed=1, level=0.2)
    return samples


def recordings(start_ns: int = START_NS, samples: Float32Array | None = None) -> list[AssignedRecording]:
    heard = sound() if samples is None else samples
    burst = MemoryRecording("burst", float(RATE_HZ), heard)
    return [AssignedRecording(array, burst, start_ns, (1, 2, 3, 4)) for array in ARRAYS]


def never() -> bool:
    return False


def replay(there: There, played: list[AssignedRecording], progress: Callable[[int], None] | None = None) -> None:
    pace = UnpacedClock(START_NS)
    send_session(there.site, there.receiver.endpoint, played, pace, PatientClock(), "run-1", never, progress)


def assert_whole(there: There, first: int = FIRST) -> None:
    """Assert that every message of both arrays has arrived in order, and the burst as frames."""
    for array in ARRAYS:
        messages = there.messages(array)
        assert [m.sequence for m in messages] == list(accumulate(isinstance(m, Frame) for m in messages))
        assert [m.frame_index - first for m in messages if isinstance(m, Frame) and m.active] == [20, 21, 22, 23]
        assert messages[-1].frame_index == first + 29


def test_session_arrives_whole_and_ends_with_a_good_bye() -> None:
    with server() as there:
        progress: list[int] = []
        replay(there, recordings(), progress.append)
        wait_until(lambda: there.of(Left), "the good-bye")
        reports = [
            mark.levels for array in ARRAYS for mark in there.messages(array) if isinstance(mark, Mark) and mark.levels
        ]
        assert [len(levels) for levels in reports] == [4, 4]  # of the first second, of each array
        hello = wire.Hello("replay", "run-1", {"north": 16000.0, "south": 16000.0}, replay=True)
        assert there.items[0] == Joined(hello)
        assert there.items[-1] == Left(replace(hello, answers=True))  # because the server has announced requests
        assert_whole(there)
        assert progress == sorted(progress)
        assert progress[-1] == START_NS + 1_500_000_000


def test_session_waits_for_a_server_that_starts_later() -> None:
    with server() as there:
        site = site_of({"server.bind": there.receiver.endpoint})
    played = Thread(
        target=send_session,
        args=(site, site.server.bind, recordings(), UnpacedClock(START_NS), PatientClock(), "run-1", never),
    )
    played.start()
    receiver = Receiver(site, CLOCK)
    receiver.start()
    late = There(receiver)
    try:
        wait_until(lambda: late.of(Left), "the good-bye")
    finally:
        receiver.stop()
    played.join(timeout=HANG_S)
    assert_whole(late)


def knocking() -> Float32Array:
    """Return 40 s of noise that is loud every other half second, so that nearly every frame is sent."""
    samples = hiss(40.0, level=0.1)
    loud = np.arange(samples.shape[1]) // (RATE_HZ // 2) % 2 == 1
    return np.where(loud, samples, 1e-3 * samples).astype(np.float32)


def test_session_is_not_played_faster_than_the_server_takes_messages() -> None:
    with server() as there:
        played = Thread(target=replay, args=(there, recordings(samples=knocking())))
        played.start()
        wait_until(lambda: there.receiver.ingest.live_nodes(CLOCK.monotonic_ns()), "the node")
        wait_until(lambda: there.receiver.queued >= QUEUE_MESSAGES, "a full queue")  # no message is taken
        assert played.is_alive()
        wait_until(lambda: there.of(Left), "the end")
        played.join()
        assert len(there.of(Frame)) > 2 * MAX_PENDING
        for array in ARRAYS:
            messages = there.messages(array)
            assert [m.sequence for m in messages] == list(accumulate(isinstance(m, Frame) for m in messages))


class Stuck(SystemClock):
    """A clock that advances by a tenth of a second at each wait."""

    def __init__(self) -> None:
        self.waited_ns = 0

    def monotonic_ns(self) -> int:
        return self.waited_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        self.waited_ns += 100_000_000
        return super().sleep_until_ns(time_ns)


def test_session_is_not_played_far_ahead_of_the_settled_time() -> None:
    """The server can thus still request frames; but the replay continues if the server settles nothing."""
    clock, reached = Stuck(), dict[int, int]()
    with server() as there:
        there.receiver.ingest.note_final(dict.fromkeys(ARRAYS, FIRST + 20))

        def note(end_ns: int) -> None:
            reached[clock.waited_ns] = end_ns - START_NS
            there.of(Left)  # take the messages that have arrived

        played = recordings(samples=hiss(15.0, level=1e-3))
        pace = UnpacedClock(START_NS)
        send_session(there.site, there.receiver.endpoint, played, pace, clock, "run-1", never, note)
    before, *_, after = (reached[waited_ns] for waited_ns in sorted(reached))
    assert AHEAD_NS <= before - 20 * FRAME_NS < AHEAD_NS + FRAME_NS
    assert STUCK_NS <= clock.waited_ns < STUCK_NS + 500_000_000
    assert after == 15_000_000_000


def test_recordings_arrive_whole() -> None:
    """Recordings play at real speed; these began a little ago, so that the test need not wait."""
    with server() as there:
        first = CLOCK.now_ns() // FRAME_NS - 30
        capture_recordings(there.site, "lab-pc", recordings(first * FRAME_NS), PatientClock(), "run-1", never)
        wait_until(lambda: there.of(Left), "the good-bye")
        assert there.items[0] == Joined(wire.Hello("lab-pc", "run-1", {"north": 16000.0, "south": 16000.0}))
        for array in ARRAYS:
            frames = [m.frame_index - first for m in there.messages(array) if isinstance(m, Frame)]
            assert sorted(frames) == list(range(12, 30))  # live frames overtake those cut before the connection


def test_absent_server_is_reported_at_the_end() -> None:
    with server() as there:
        endpoint, site = there.receiver.endpoint, there.site
    with pytest.raises(UndeliveredError) as caught:
        capture_recordings(site, "lab-pc", recordings(), UnpacedClock(START_NS), "run-1", never)
    assert str(caught.value).endswith(f"were never acknowledged by the server at {endpoint}; is one running there?")
    assert int(str(caught.value).split()[0]) >= 36


def test_refusal_is_reported() -> None:
    with server() as there:
        first = Link(there.receiver.endpoint, wire.Hello("other-pc", "run-0", {"north": 16000.0}), CLOCK)
        first.wait_connected(never)
        sequence = count(1)

        def heard() -> bool:
            first.send([mark(next(sequence))])  # a node that is silent for 2 s loses its arrays
            return False

        start_ns = CLOCK.now_ns() - 2_000_000_000
        with pytest.raises(UndeliveredError, match="refused the sound: array 'north' is captured by node 'other-pc'"):
            capture_recordings(there.site, "lab-pc", recordings(start_ns), CLOCK, "run-1", heard)
        with pytest.raises(UndeliveredError, match="refused the sound: live nodes are connected"):
            send_session(there.site, first.endpoint, recordings()[1:], UnpacedClock(START_NS), CLOCK, "run-2", heard)
        first.close(bye=True)


def test_stopping_is_not_an_error() -> None:
    with server() as there:
        site = there.site
    asked = count()
    capture_recordings(site, "lab-pc", recordings(), UnpacedClock(START_NS), "run-1", lambda: next(asked) > 10)
    send_session(
        site, "tcp://127.0.0.1:1", recordings(), UnpacedClock(START_NS), CLOCK, "run-1", lambda: next(asked) > 15
    )


class Scripted:
    """A device that follows a script: for each 50 ms either None, or a problem in place of sound."""

    name = "UMC1820"
    sample_rate_hz = float(RATE_HZ)
    channels = 8

    def __init__(self, script: list[str | None], ready: Callable[[], object]) -> None:
        self._script = script
        self._ready = ready
        self.problem: str | None = None
        self.lost_blocks = 0
        self.through_sound_server = False
        self.entered = self.left = False

    def __enter__(self) -> Self:
        self.entered = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.left = True

    def __iter__(self) -> Iterator[Block]:
        while not self._ready():
            yield Block(0, np.zeros((8, 0), dtype=np.float32), START_NS)
        samples, index = np.vstack([knocking(), knocking()]), 0
        for problem in self._script:
            self.problem = problem
            stop = index if problem else index + RATE_HZ // 20
            yield Block(index, samples[:, index:stop].copy(), START_NS + round(index / RATE_HZ * 1e9))
            index = stop


def captured(script: list[str | None], stop: Callable[[Scripted], bool]) -> tuple[There, Scripted]:
    """Return what a connected server receives from such a device."""
    with server() as there:
        device = Scripted(script, lambda: there.of(Joined))
        capture_device(there.site, "lab-pc", device, CLOCK, "run-1", lambda: stop(device))
        wait_until(lambda: there.of(Left), "the good-bye")
        return there, device


def test_device_is_entered_captured_and_left() -> None:
    there, device = captured([None] * 30, lambda _: False)
    assert device.entered
    assert device.left
    for array in ARRAYS:
        frames = [m for m in there.messages(array) if isinstance(m, Frame)]
        assert [frame.frame_index - FIRST for frame in frames if frame.active] == [*range(10, 20)]
        assert there.messages(array)[-1].frame_index == FIRST + 29


def test_device_problem_and_its_end_reach_the_server_and_the_service_manager(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    unplugged = "input device 'UMC1820' is not connected"
    seen: set[str | None] = set()
    with server() as there, listening(tmp_path, reads=True) as manager:

        def ask() -> bool:
            seen.add(there.receiver.ingest.problem_of("south"))
            assert manager.said is not None  # read with each block, before the socket is full
            return False

        script = [None] * 15 + [unplugged] * 200 + [None] * 15
        device = Scripted(script, lambda: there.of(Joined))
        service = ServiceManager(HurriedClock(), manager.address, 1_000_000_000)
        capture_device(there.site, "lab-pc", device, CLOCK, "run-1", ask, service)
        wait_until(lambda: there.of(Left), "the good-bye")
        assert manager.said[0] == "READY=1"
        assert manager.count("WATCHDOG=1") >= len(script)
        states = [line.removeprefix("STATUS=") for line in manager.said if line.startswith("STATUS=")]
        assert f"connected to the server at {there.receiver.endpoint}" in states
        without, *_ = (number for number, state in enumerate(states) if state.startswith(f"{unplugged}; "))
        assert not states[without - 1].startswith(unplugged)
        assert not states[-2].startswith(unplugged)
        assert states[-1] == "stopping"
        [left] = there.of(Left)
        assert isinstance(left, Left)
        assert left.hello.problem is None
        assert len(there.of(Joined)) == 1
        assert there.messages("south")[-1].frame_index == FIRST + 29
    assert seen <= {None, unplugged}
    assert caplog.text.count("is not connected") == 1
    assert "device 'UMC1820' delivers sound" in caplog.text


def test_device_is_left_on_stop() -> None:
    heard: list[bool] = []

    def after_twenty(device: Scripted) -> bool:
        heard.append(device.left)
        return len(heard) > 20

    there, device = captured([None] * 100, after_twenty)
    assert device.left
    assert all(m.frame_index < FIRST + 20 for m in there.messages("north"))


def test_samples_beyond_full_scale_arrive_unchanged() -> None:
    samples = sound()
    samples[:, RATE_HZ] = 1.7
    with server() as there:
        replay(there, recordings(samples=samples))
        wait_until(lambda: there.of(Left), "the good-bye")
        frames = [item for item in there.items if isinstance(item, Frame)]
        assert max(float(frame.samples.max()) for frame in frames) == pytest.approx(1.7)


def test_state_of_the_machine_goes_with_the_levels() -> None:
    level = ChannelLevel(-40.0, -50.0, 0, None, None, None, None)
    report = replace(mark(3), levels=(level,) * 4)
    with HostWatch(lambda: HostClock(True, "chrony", "ntp.example", 0.002)) as host:
        assert with_host([mark(2)], host, 5) == [mark(2)]
        wait_until(lambda: host.state() is not None, "the first reading of the clock")
        plain, carries, sound = with_host([mark(2), report, frame(4)], host, 5)
    assert plain == mark(2)
    assert isinstance(sound, Frame)
    assert isinstance(carries, Mark)
    assert replace(carries, host=None) == report
    assert carries.host is not None
    assert (carries.host.synchronized, carries.host.reference, carries.host.lost_blocks) == (True, "ntp.example", 5)
