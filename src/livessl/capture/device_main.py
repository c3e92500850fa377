"""The process that owns a node's audio device: `python -m livessl.capture.device_main WANTED FDS`.

Libraries of audio devices loop for ever, hang and flood when a device is unplugged. Here they can be killed. The
process loads as little as possible: no numpy, no other room of livessl. It ends when its standard input does, so it
never outlives the node. The node reads its standard output and error, which belong to the native libraries.

Real-time contract: PortAudio calls `Receiver.receive` on a thread of its own. The method copies the block into the
shared memory, stamps it, publishes it and returns. It does not wait, takes no lock of ours and does not log. Only that
thread writes the attributes of `Receiver`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import TracebackType
from typing import Any, Final

from livessl.capture.device_report import DeviceState, OpeningError, Report, Wanted
from livessl.capture.portaudio import is_active, library, open_stream, rescan
from livessl.capture.realtime import request_realtime
from livessl.capture.ring import RingWriter
from livessl.clock import Clock, SystemClock

BEAT_S: Final = 0.1
"""Interval of the main loop, in seconds. Each turn is a sign of life in the ring."""

REOPEN_S: Final = 0.8
"""Time between two attempts to open a missing device, in seconds. A scan of all devices can take some tenths of a
second."""

CLOSING_S: Final = 0.3
"""Longest time, in seconds, in which the library may close the device when the node ends."""

MAX_BACKLOG_S: Final = 1.0
"""Largest plausible age of samples beyond the length of a block and of the driver's buffer, in seconds. A conversion
time beyond it is ignored."""


class Receiver:
    """Copies blocks from PortAudio into the ring.

    Parameters
    ----------
    ring : RingWriter
    clock : Clock
        Stamps the blocks.
    sample_rate_hz : float
    is_hardware : bool
        Whether conversion times of the driver are to be trusted.
    latency_s : float
        Length of the driver's buffer, in seconds: samples in it may be that old.
    """

    def __init__(
        self, ring: RingWriter, clock: Clock, sample_rate_hz: float, *, is_hardware: bool, latency_s: float = 0.0
    ) -> None:
        self._ring = ring
        self._clock = clock
        self._rate_hz = sample_rate_hz
        self._is_hardware = is_hardware
        self._most_waited_s = latency_s + MAX_BACKLOG_S
        self._next_index = 0
        self._lost = False

    def receive(self, samples: Any, count: int, time: Any, status: Any) -> None:
        """Take in a block: PortAudio's callback, see the contract at the head of the module.

        A block that the driver flags is dropped whole, because in PortAudio 19.6 the gap lies inside it.

        The driver of a hardware device counts the samples in its buffer, so its conversion time includes how long they
        waited for this call, also when two blocks of one period come at once. The conversion time of a sound server is
        a guess: PulseAudio's drifts by 0.2 s in the first second while its blocks arrive evenly. For a sound server,
        and if the time is not plausible, the last sample is taken to have arrived now.
        """
        first_index = self._next_index
        self._next_index = first_index + count
        if status.input_overflow:
            self._lost = True
            self._ring.count_flagged()
            return
        length_s = count / self._rate_hz
        age_s = time.currentTime - time.inputBufferAdcTime if self._is_hardware else length_s
        if not length_s <= age_s <= length_s + self._most_waited_s:
            age_s = length_s
        time_ns = self._clock.now_ns() - round(age_s * 1e9)
        self._lost = not self._ring.write(first_index, samples, count, time_ns, lost=self._lost)


class _Reporter:
    """Writes changes of the state for the node."""

    def __init__(self, report_fd: int) -> None:
        self._fd = report_fd
        self._last: Report | None = None

    def report(self, report: Report) -> None:
        if report != self._last:
            self._last = report
            os.write(self._fd, f"{report.to_json()}\n".encode())


def run(wanted: Wanted, ring: RingWriter, reporter: _Reporter, ended: threading.Event) -> None:
    """Open the device as soon as that is possible, and watch its stream until it stops or the node ends."""
    clock = SystemClock()

    def callback(device: Any) -> Any:
        receiver = Receiver(
            ring, clock, wanted.sample_rate_hz, is_hardware=device.is_hardware, latency_s=wanted.latency_s
        )
        return receiver.receive

    sd: Any = None
    stream: Any = None
    not_realtime = ""
    while stream is None:
        ring.beat()
        try:
            if sd is None:
                sd = library()
                not_realtime = request_realtime()  # the library has started its helpers, and not yet its threads
            else:
                rescan(sd)
            stream, is_hardware = open_stream(sd, wanted, callback)
        except OpeningError as trouble:
            reporter.report(Report(trouble.state, str(trouble)))
            for _ in range(round(REOPEN_S / BEAT_S)):
                if ended.wait(BEAT_S):
                    return
                ring.beat()
    reporter.report(Report(DeviceState.OPEN, hardware=is_hardware, not_realtime=not_realtime))
    while not ended.wait(BEAT_S):
        ring.beat()
        if not is_active(sd, stream):
            reporter.report(Report(DeviceState.STOPPED))
            return
    stream.abort()
    stream.close()


def _fail(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an unexpected error, which the node logs, and end without the library's clean-up."""
    sys.__excepthook__(kind, error, trace)
    sys.stderr.flush()
    os._exit(1)


def main() -> None:
    """Run the process; it never returns, because the library's own clean-up may hang."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the node decides, and it also receives Ctrl-C
    sys.excepthook = _fail
    wanted = Wanted.from_json(sys.argv[1])
    memory_fd, published_fd, report_fd = map(int, sys.argv[2].split(","))
    ended = threading.Event()

    def watch() -> None:
        while os.read(0, 1):  # nothing is ever written to it; it ends when the node does, however that happens
            pass
        ended.set()
        threading.Event().wait(CLOSING_S)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
    run(wanted, RingWriter(memory_fd, published_fd, wanted.ring), _Reporter(report_fd), ended)
    os._exit(0)


if __name__ == "__main__":
    main()
