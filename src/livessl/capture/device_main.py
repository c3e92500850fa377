"""The process that owns a node's audio device: opens it, copies blocks into the ring, tries again if it is missing.

Libraries of audio devices may loop endlessly, hang or flood the log when a device is unplugged. In a process of their
own they can be killed. The process imports as little as possible: neither numpy nor other packages of livessl. It ends
when its standard input is closed, so it never outlives the node. Its standard output and error belong to the native
libraries, and the node reads both.

Real-time contract: PortAudio calls `Receiver.receive` on its own thread. The method copies the block into the shared
memory, stamps it, publishes it and returns. It does not wait, takes no lock of livessl and does not log. Only that
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
"""Interval of the main loop, in seconds. Each pass of the loop leaves a sign of life in the ring."""

REOPEN_S: Final = 0.8
"""Time between two attempts to open a missing device, in seconds. A scan of all devices can take a few tenths of
a second."""

CLOSING_S: Final = 0.3
"""Longest time, in seconds, that the library may take to close the device when the node ends."""

MAX_BACKLOG_S: Final = 1.0
"""Largest plausible age of samples beyond the length of a block and of the driver's buffer, in seconds. A conversion
time that makes samples older is ignored."""


class Receiver:
    """Copies blocks from PortAudio into the ring.

    Parameters
    ----------
    ring : RingWriter
    clock : Clock
        Clock by which blocks are stamped.
    sample_rate_hz : float
    is_hardware : bool
        Whether the conversion times of the driver can be trusted.
    latency_s : float
        Length of the driver's buffer, in seconds. Samples in the buffer may be that old.
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
        """Take in a block. PortAudio calls this method; the contract is at the head of the module.

        A block that the driver flags is dropped whole, because in PortAudio 19.6 the gap lies inside it.

        The driver of a hardware device counts the samples in its buffer. Its conversion time therefore includes the
        time for which they waited for this call, even if two blocks of one period arrive at once. The conversion time
        of a sound server is a guess: that of PulseAudio drifts by 0.2 s in the first second while its blocks arrive
        evenly. For a sound server, and if the conversion time is not plausible, the last sample counts as having
        arrived now.
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
    """Writes changes of the device's state to the node."""

    def __init__(self, report_fd: int) -> None:
        self._fd = report_fd
        self._last: Report | None = None

    def report(self, report: Report) -> None:
        if report != self._last:
            self._last = report
            os.write(self._fd, f"{report.to_json()}\n".encode())


def run(wanted: Wanted, ring: RingWriter, reporter: _Reporter, ended: threading.Event) -> None:
    """Open the device as soon as possible, and watch its stream until the stream stops or the node ends."""
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
                not_realtime = request_realtime()  # the library has started its helper processes, but not its threads
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
    """Run the process. The function never returns, because the library's own clean-up may hang."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the node also receives Ctrl-C, and decides when this process ends
    sys.excepthook = _fail
    wanted = Wanted.from_json(sys.argv[1])
    memory_fd, published_fd, report_fd = map(int, sys.argv[2].split(","))
    ended = threading.Event()

    def watch() -> None:
        while os.read(0, 1):  # the node never writes to it; it is closed when the node ends, for whatever reason
            pass
        ended.set()
        threading.Event().wait(CLOSING_S)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
    run(wanted, RingWriter(memory_fd, published_fd, wanted.ring), _Reporter(report_fd), ended)
    os._exit(0)


if __name__ == "__main__":
    main()
