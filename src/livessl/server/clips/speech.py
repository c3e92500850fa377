"""Decides whether there is speech in a recording (voice activity, VAD), before `privacy: no-speech` stores anything.

The voice activity detector runs in a process of its own (`speech_main`): its library holds the interpreter for
milliseconds, which would delay the localization. Samples go there through a pipe, and never to a disk.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Final

import numpy as np

from livessl.core.enhance.align import resampled
from livessl.core.types import Float32Array, FloatArray
from livessl.errors import RunError
from livessl.server.clips.speech_main import CHUNK, HEADER, RATE_HZ, WITHOUT_DETECTOR, read_exactly

LEAST_PROBABILITY: Final = 0.3
"""Probability from which a chunk of 32 ms counts as speech. Half of the usual 0.5: a clip too few is the smaller
mistake."""

LEAST_CHUNKS: Final = 3
"""Chunks within `WINDOW` that make speech: 96 ms, half a syllable. A single one would drop many door slams."""

WINDOW: Final = 10
"""Consecutive chunks, 0.32 s, among which speech is looked for: syllables have pauses, and consonants between them."""

LEVELLED_S: Final = 0.25
"""Distance, in seconds, from which on a loud sound does not make the detector deaf to a quiet voice: each moment is
divided by the largest sample within it."""

SILENCE: Final = 1e-4
"""Level, relative to the recording's peak, below which it is not made louder: 80 dB down a voice cannot be heard."""

SPLIT_HZ: Final = 120.0
"""Frequency, in hertz, below which sound is limited before a channel is levelled: hum of the mains, rumble and a
constant offset would otherwise set the level. Most of a voice is above it."""

SPLIT_ORDER: Final = 4
"""Order of the high-pass filter that splits a channel; it runs forward and backward."""

MOST_LOW: Final = 2.0
"""Largest level of the low frequencies, relative to that of the others at the same moment. Without any, doors resemble
voices."""

_PADDING_S: Final = 0.2
"""Time, in seconds, by which the signal is mirrored at its ends, so that the filter has settled where it begins."""

PEAK: Final = 0.5
"""Level, of full scale, to which recordings are brought before the detector examines them."""

ANSWER_S: Final = 120.0
"""Longest time, in seconds, in which the process examines one channel; then it hangs, and is killed."""

PROGRAM: Final = (sys.executable, "-P", "-m", "livessl.server.clips.speech_main")
"""The program that has the detector."""


_log = logging.getLogger(__name__)


class SpeechError(RunError):
    """It cannot be known whether there is speech."""


def is_speech(probabilities: FloatArray) -> bool:
    """Return whether the probabilities (n,) of speech in consecutive chunks make speech."""
    if not len(probabilities):
        return False
    is_voice = np.asarray(probabilities) >= LEAST_PROBABILITY
    return bool(np.convolve(is_voice, np.ones(WINDOW)).max() >= LEAST_CHUNKS)


def levelled(samples: Float32Array, sample_rate_hz: float) -> Float32Array:
    """Return a channel as the detector needs it: at `RATE_HZ`, with limited low frequencies, and equally loud.

    Parameters
    ----------
    samples : (n,) float32
    sample_rate_hz : float
        In hertz.

    Returns
    -------
    (m,) float32
        Empty if the channel is silent; otherwise at least one chunk long.

    Raises
    ------
    SpeechError
        If a sample is not a finite number.
    """
    if not np.isfinite(samples).all():
        raise SpeechError("a channel has values that are not finite numbers; check the array's device and its driver")
    if not samples.any():
        return np.zeros(0, dtype=np.float32)
    signal = resampled(_limited(np.asarray(samples, dtype=np.float64), sample_rate_hz), sample_rate_hz, RATE_HZ)
    peak = float(np.abs(signal).max(initial=0.0))
    if peak == 0.0:
        return np.zeros(0, dtype=np.float32)
    signal = np.pad(signal, (0, -len(signal) % CHUNK))
    return np.asarray(PEAK * signal / np.maximum(_level(signal, RATE_HZ), SILENCE * peak), dtype=np.float32)


def _limited(signal: FloatArray, sample_rate_hz: float) -> FloatArray:
    """Return a signal (n,), n > 0, whose part below `SPLIT_HZ` is `MOST_LOW` times as loud as the rest at most."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(SPLIT_ORDER, SPLIT_HZ, "highpass", fs=sample_rate_hz, output="sos")
    padding = min(round(_PADDING_S * sample_rate_hz), len(signal) - 1)
    high = np.asarray(sosfiltfilt(sections, signal, padtype="even", padlen=padding), dtype=np.float64)
    low = signal - high  # the filter delays nothing
    most = MOST_LOW * _level(high, sample_rate_hz)
    return high + low * np.minimum(1.0, most / np.maximum(_level(low, sample_rate_hz), np.finfo(np.float64).tiny))


def _level(signal: FloatArray, sample_rate_hz: float) -> FloatArray:
    """Return the largest magnitude of a signal (n,) within `LEVELLED_S` of each sample, smoothed."""
    from scipy.ndimage import maximum_filter1d, uniform_filter1d  # most servers never need it

    reach = round(LEVELLED_S * sample_rate_hz)
    return np.asarray(uniform_filter1d(maximum_filter1d(np.abs(signal), 2 * reach + 1), reach), dtype=np.float64)


def _end_of(process: subprocess.Popen[bytes]) -> str:
    """Return a sentence about a process that has ended without an answer."""
    if process.returncode == WITHOUT_DETECTOR:
        return "the detector of speech cannot be imported; `pip install 'livessl[speech]'` installs it"
    return (
        f"the process that detects speech has ended with exit code {process.returncode}; its last line in the log says "
        "why, unless it was killed"
    )


class SpeechDetector:
    """The process with the voice activity detector: begun when it is needed, and again after it has died.

    One thread calls `has_speech`; any thread may call `close`.

    Parameters
    ----------
    program : sequence of str
        The program and its arguments.
    """

    def __init__(self, program: Sequence[str] = PROGRAM) -> None:
        self._program = program
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False

    def has_speech(self, recordings: Iterable[tuple[Float32Array, float]]) -> bool:
        """Return whether any channel of some recordings contains speech; ends at the first one that does.

        Parameters
        ----------
        recordings : iterable of ((K, n) float32, float)
            Samples, and their rate in hertz.

        Raises
        ------
        SpeechError
            If the process cannot be begun, or ends without an answer, or a sample is not a finite number.
        """
        return any(
            is_speech(self.probabilities(channel, rate_hz)) for samples, rate_hz in recordings for channel in samples
        )

    def probabilities(self, samples: Float32Array, sample_rate_hz: float) -> FloatArray:
        """Return the probability (m,) of speech in each chunk of 32 ms of a channel (n,); none if it is silent.

        Raises
        ------
        SpeechError
            As `has_speech`.
        """
        signal = levelled(samples, sample_rate_hz)
        if not len(signal):
            return np.zeros(0)
        process = self._running()
        hangs = threading.Timer(ANSWER_S, process.kill)
        hangs.daemon = True
        hangs.start()
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(HEADER.pack(len(signal)) + signal.tobytes())
            process.stdin.flush()
            answer = read_exactly(process.stdout, 4 * (len(signal) // CHUNK))
        except OSError:
            answer = None
        finally:
            hangs.cancel()
        if answer is None:
            self._end(process)
            raise SpeechError(_end_of(process))
        return np.frombuffer(answer, dtype="<f4").astype(np.float64)

    def close(self) -> None:
        """End the process, also while it examines something; no other one is begun."""
        with self._lock:
            self._closed = True
            process, self._process = self._process, None
        if process is not None:
            process.kill()
            self._reap(process)

    def _running(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._closed:
                raise SpeechError("the server is stopping")
            if self._process is not None and self._process.poll() is not None:
                _log.warning("%s; it is begun again", _end_of(self._process))
                self._reap(self._process)
                self._process = None
            if self._process is None:
                try:
                    self._process = subprocess.Popen(  # noqa: S603  # our own program
                        self._program, stdin=subprocess.PIPE, stdout=subprocess.PIPE
                    )
                except OSError as error:
                    raise SpeechError(
                        f"the process that detects speech cannot be begun: {error.strerror or error}; free memory or "
                        "raise the limit of processes"
                    ) from error
            return self._process

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        """Forget a process that does not answer, and end it."""
        with self._lock:
            if self._process is process:
                self._process = None
        process.kill()
        self._reap(process)

    @staticmethod
    def _reap(process: subprocess.Popen[bytes]) -> None:
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):  # what was not written yet is lost
                    pipe.close()
