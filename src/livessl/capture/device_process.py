"""Starts, reads and kills the process that owns a node's device; `device_watch` decides when it has to be killed."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Final

import numpy as np

from livessl.capture.device_report import Report, Wanted
from livessl.capture.ring import RingReader, beyond_standard
from livessl.core.types import Block

OUTPUT_BYTES: Final = 65536
"""Most output of native libraries, in bytes, that is read at one time. It is the size of a pipe, so a library that
prints more waits until the node has read it."""

ENDING_S: Final = 0.5
"""Time, in seconds, that the process may take to end before it is killed."""

PROGRAM: Final = (sys.executable, "-P", "-m", "livessl.capture.device_main")
"""The program that owns the device."""


class DamageError(Exception):
    """The process has written invalid data into the ring or its reports, because its memory is damaged."""


class DeviceProcess:
    """One run of the process that owns the device. The process starts when the object is created.

    Parameters
    ----------
    wanted : Wanted
        The device.
    program : sequence of str
        The program and its arguments. The device and its file descriptors are added as two further arguments.
    environment : mapping or None
        Environment variables of the process; None for those of this process.
    """

    def __init__(
        self, wanted: Wanted, program: Sequence[str] = PROGRAM, environment: Mapping[str, str] | None = None
    ) -> None:
        self._wanted = wanted
        self._ring = RingReader(wanted.ring)
        try:
            self._reports_fd, report_fd = map(beyond_standard, os.pipe())
        except OSError:
            self._ring.close()
            raise
        self._rest = b""
        fds = (self._ring.memory_fd, self._ring.published_fd, report_fd)
        try:
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                [*program, wanted.to_json(), ",".join(map(str, fds))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=fds,
                env=environment,
            )
        except OSError:
            self._ring.close()
            os.close(self._reports_fd)
            raise
        finally:
            os.close(report_fd)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._output_fd = self._process.stdin, self._process.stdout.fileno()
        for fd in (self._reports_fd, self._output_fd):
            os.set_blocking(fd, False)
        self._poll = select.poll()
        self._poll.register(self._ring.published_fd, select.POLLIN)
        self._poll.register(self._reports_fd, select.POLLIN)
        self._closed = False

    @property
    def waiting(self) -> int:
        """Number of blocks that `block` returns without waiting."""
        return self._ring.waiting

    @property
    def overruns(self) -> int:
        """Number of blocks lost because the node did not read them in time."""
        return self._ring.overruns

    @property
    def flagged(self) -> int:
        """Number of blocks dropped because the driver flagged a loss in them."""
        return self._ring.flagged

    @property
    def beats(self) -> int:
        """Number of passes of the process's main loop."""
        return self._ring.beats

    @property
    def exit_code(self) -> int | None:
        """Exit code of the process, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def pid(self) -> int:
        """Process ID."""
        return self._process.pid

    def wait(self, seconds: float) -> None:
        """Wait until the process has published a block or a report, or has ended, or until some seconds have passed."""
        if not self._ring.waiting:
            for fd, events in self._poll.poll(seconds * 1e3):
                if fd == self._reports_fd and events & select.POLLHUP and not events & select.POLLIN:
                    # The process is ending, which lasts while the kernel holds it in a driver. Without this, each wait
                    # until then would return at once.
                    self._poll.unregister(fd)
            self._ring.receive()

    def block(self) -> Block | None:
        """Return the next block, with its own copy of the samples (channels, n); None if there is no block.

        Raises
        ------
        DamageError
            If the process has damaged the ring.
        """
        if not self._ring.waiting:
            return None
        try:
            slot = self._ring.first()
        except ValueError as error:
            raise DamageError(str(error)) from error
        with slot.samples:
            samples = np.frombuffer(slot.samples, dtype=np.float32).reshape(slot.count, self._wanted.channels)
            own = samples.T.copy(order="C")
            del samples
        self._ring.release()
        return Block(slot.first_index, own, slot.time_ns, slot.lost)

    def reports(self) -> list[Report]:
        """Return the reports that have arrived since the last call.

        Raises
        ------
        DamageError
            If they cannot be read.
        """
        *lines, self._rest = (self._rest + self._read(self._reports_fd)).split(b"\n")
        try:
            return [Report.from_json(line.decode()) for line in lines]
        except (ValueError, TypeError, KeyError) as error:
            raise DamageError(f"report: {error}") from error

    def output(self) -> bytes:
        """Return the output of native libraries since the last call, at most `OUTPUT_BYTES`."""
        return self._read(self._output_fd)

    def end(self, *, kill: bool) -> bytes:
        """End the process, by force with `kill` or if it takes long; return its last output."""
        if self._closed:
            return b""
        self._closed = True
        with suppress(BrokenPipeError):
            self._stdin.close()
        if not kill:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDING_S)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # the kernel may hold it in a driver; it ends when that returns
            self._process.wait(ENDING_S)
        last = self.output()
        self._ring.close()
        os.close(self._reports_fd)
        assert self._process.stdout is not None
        self._process.stdout.close()
        return last

    @staticmethod
    def _read(fd: int) -> bytes:
        try:
            return os.read(fd, OUTPUT_BYTES)
        except BlockingIOError:
            return b""
