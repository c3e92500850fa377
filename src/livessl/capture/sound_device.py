"""An audio interface as an iterator of blocks, through PortAudio. Only this module imports `sounddevice`.

The library is imported where it is used, so that everything else works on a machine without PortAudio.

Real-time contract: PortAudio calls `SoundDevice._receive` on a thread of its own. The method copies, stamps, enqueues
and returns. It does not wait, takes no lock of ours, does not log, and allocates only the copy and the tuple that
carries it. While a stream is open, only that thread writes `_next_index` and `_lost`; the iterating thread accesses
them only while no stream is open.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Final

import numpy as np

from livessl.clock import Clock
from livessl.core.types import Block, Float32Array
from livessl.errors import DeviceError
from livessl.site.node_models import SoundDeviceConfig

WAIT_S: Final = 0.25
"""Longest wait of the iterator, in seconds, so that the caller can serve its network link in between."""

REOPEN_S: Final = 2.0
"""Time between two attempts to open a missing device, in seconds. A scan of all devices can take some tenths of a
second."""

STALLED_S: Final = 5.0
"""Time without a block, in seconds, after which an open stream is given up: some drivers hang instead of failing. A
sound server may take 2 s to deliver its first block."""

QUEUE_S: Final = 2.0
"""Most sound that waits for the iterator, in seconds: far more than any pause of a healthy caller."""

LATENCY_S: Final = 0.1
"""Latency requested from the driver, in seconds. It sets the size of the driver's buffer, and so how long the callback
may be delayed before samples are lost; blocks still arrive once a period."""

MAX_BACKLOG_S: Final = 1.0
"""Largest plausible age of samples in the driver's buffer, in seconds; a conversion time beyond it is ignored."""

_INVALID_CHANNEL_COUNT: Final = -9998
_INVALID_SAMPLE_RATE: Final = -9997
"""PortAudio's error codes."""


@dataclass(frozen=True, slots=True)
class InputDevice:
    """An input device.

    Parameters
    ----------
    name : str
        Name by the driver.
    host_api : str
        PortAudio's name of the driver family, such as ALSA.
    channels : int
        Number of input channels.
    default_sample_rate_hz : float
        The driver's default sampling rate, Hz.
    """

    name: str
    host_api: str
    channels: int
    default_sample_rate_hz: float

    @property
    def label(self) -> str:
        """`HOSTAPI: name`, unique among the entries of one device under several drivers."""
        return f"{self.host_api}: {self.name}"

    @property
    def is_hardware(self) -> bool:
        """True if samples come directly from the device (ALSA's `hw:`), not through a sound server or a plug-in."""
        return "(hw:" in self.name

    def matches(self, wanted: str) -> bool:
        """Return True if `wanted` is a part of the name, or `HOSTAPI: part of the name`, in upper or lower case."""
        folded, name = wanted.casefold(), self.name.casefold()
        host_api, _, part = folded.partition(": ")
        return folded in name or (part != "" and host_api == self.host_api.casefold() and part in name)


class SoundDevice:
    """An audio interface, found by name; a context manager that opens it and an iterator of its blocks.

    Each step waits at most 0.25 s (longer only during a scan for a missing device) and then yields a block without
    samples. If the device is absent or disappears, the iterator yields empty blocks, sets `problem`, and tries to open
    the device about every 2 s. The first block after that has `overflow` set, and sample indices continue.

    PortAudio detects new devices only after a restart, which closes every stream of the process: use one `SoundDevice`
    in a process.

    Parameters
    ----------
    config : SoundDeviceConfig
        Name, rate and block length.
    channels : int
        Number of channels to record: the highest channel that any array uses.
    clock : Clock
        Stamps the blocks.

    Attributes
    ----------
    name : str
        Name in the site file.
    sample_rate_hz : float
        Nominal sampling rate, Hz.
    channels : int
        Channels of each block.
    problem : str or None
        The present problem in words; None if there is none.
    """

    def __init__(self, config: SoundDeviceConfig, channels: int, clock: Clock) -> None:
        self.name = config.name
        self.sample_rate_hz = config.sample_rate_hz
        self.channels = channels
        self.problem: str | None = None
        self._clock = clock
        self._block_samples = max(1, round(config.block_s * config.sample_rate_hz))
        self._capacity = max(2, math.ceil(QUEUE_S * config.sample_rate_hz / self._block_samples))
        self._queue: SimpleQueue[tuple[int, Float32Array, int, bool]] = SimpleQueue()
        self._entered = False
        self._stream: Any = None
        self._is_hardware = False
        self._idle_s = 0.0
        self._next_index = 0
        self._lost = False
        self._handed_index = 0

    def __enter__(self) -> SoundDevice:
        """Open the device, or start waiting for it.

        Raises
        ------
        DeviceError
            If waiting would not help: PortAudio is not installed, the name matches several devices, or the device
            has too few channels or does not offer the sampling rate.
        """
        self.problem = self._open(_portaudio())
        self._entered = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entered = False
        self._close()

    def __iter__(self) -> Iterator[Block]:
        return self

    def __next__(self) -> Block:
        """Return the next block, or one without samples after 0.25 s.

        Raises
        ------
        StopIteration
            Outside the `with` block.
        """
        if not self._entered:
            raise StopIteration
        try:
            first_index, samples, stamp_ns, overflow = self._queue.get(timeout=WAIT_S)
        except Empty:
            self._look_after()
            nothing = np.empty((self.channels, 0), dtype=np.float32)
            return Block(self._handed_index, nothing, self._clock.now_ns())
        self._idle_s = 0.0
        self._handed_index = first_index + samples.shape[1]
        return Block(first_index, samples, stamp_ns, overflow)

    def _receive(self, samples: Float32Array, count: int, time: Any, status: Any) -> None:
        """Enqueue a block; this is PortAudio's callback, see the contract at the head of the module.

        The driver of a hardware device counts the samples in its buffer, so its conversion time includes how long they
        waited for this call, also when two blocks of one period come at once. The conversion time of a sound server is
        a guess: PulseAudio's drifts by 0.2 s in the first second while its blocks arrive evenly. For a sound server,
        and if the time is not plausible, the last sample is taken to have arrived now.

        The copy is explicit because a single channel is contiguous even after transposition, and the memory belongs to
        PortAudio.
        """
        first_index = self._next_index
        self._next_index = first_index + count
        if status.input_overflow:
            self._lost = True
        if self._queue.qsize() >= self._capacity:  # only this thread adds, so the queue cannot have grown since
            self._lost = True
            return
        length_s = count / self.sample_rate_hz
        age_s = time.currentTime - time.inputBufferAdcTime if self._is_hardware else length_s
        if not length_s <= age_s <= length_s + MAX_BACKLOG_S:
            age_s = length_s
        stamp_ns = self._clock.now_ns() - round(age_s * 1e9)
        self._queue.put((first_index, samples.T.copy(order="C"), stamp_ns, self._lost))
        self._lost = False

    def _look_after(self) -> None:
        """Give up a dead stream, or look for a missing device; called when no block has come within `WAIT_S`."""
        self._idle_s += WAIT_S
        sd = _portaudio()
        if self._stream is not None:
            if not _is_active(sd, self._stream):
                self._give_up(f"device {self.name!r} has stopped; was it unplugged? Waiting for it")
            elif self._idle_s >= STALLED_S:
                self._give_up(f"device {self.name!r} has delivered nothing for {STALLED_S:g} s; opening it again")
        elif self._idle_s >= REOPEN_S:
            self._idle_s = 0.0
            try:
                _rescan(sd)
                self.problem = self._open(sd)
            except sd.PortAudioError as error:
                self.problem = f"PortAudio cannot be started: {_reason(error)}; trying again"
            except DeviceError as error:  # not fatal while running: the right device may be plugged in later
                self.problem = str(error)

    def _give_up(self, problem: str) -> None:
        self._close()
        self._idle_s = 0.0
        self._lost = True
        self.problem = problem

    def _open(self, sd: Any) -> str | None:
        """Open the device; return the problem if that fails for now, else None.

        Raises
        ------
        DeviceError
            If waiting would not help.
        """
        stream: Any = None
        try:
            found = _find(_inputs(sd), self.name, self.channels)
            if found is None:
                return f"device {self.name!r} is not connected, or another program holds it; waiting for it"
            index, device = found
            self._is_hardware = device.is_hardware
            stream = sd.InputStream(
                device=index,
                channels=self.channels,
                samplerate=self.sample_rate_hz,
                blocksize=self._block_samples,
                dtype="float32",
                latency=LATENCY_S,
                callback=self._receive,
            )
            stream.start()
        except sd.PortAudioError as error:
            if stream is not None:
                stream.close()
            code = error.args[1] if len(error.args) > 1 else None
            if code in (_INVALID_SAMPLE_RATE, _INVALID_CHANNEL_COUNT):
                raise DeviceError(
                    f"device {self.name!r} does not offer {self.channels} channels at {self.sample_rate_hz:g} Hz; "
                    "set device.sample_rate_hz to a rate that it has (`livessl devices` shows its default)"
                ) from error
            return f"device {self.name!r} cannot be opened: {_reason(error)}; trying again"
        self._stream = stream
        return None

    def _close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.abort()
            stream.close()


def input_devices() -> list[InputDevice]:
    """Return all input devices, in PortAudio's order.

    Raises
    ------
    DeviceError
        If PortAudio is not installed or cannot list the devices.
    """
    sd = _portaudio()
    try:
        return [device for _, device in _inputs(sd)]
    except sd.PortAudioError as error:
        raise DeviceError(f"PortAudio cannot list the devices: {_reason(error)}; is a sound driver running?") from error


def _portaudio() -> Any:
    """Return the `sounddevice` module; its import starts PortAudio."""
    try:
        import sounddevice
    except OSError as error:
        raise DeviceError(
            "sound devices need the PortAudio library, which is not on this machine; "
            "install PortAudio: apt install libportaudio2"
        ) from error
    return sounddevice


def _inputs(sd: Any) -> list[tuple[int, InputDevice]]:
    """Return PortAudio's index and a description of each input device."""
    host_apis = [str(host_api["name"]) for host_api in sd.query_hostapis()]
    return [
        (
            int(found["index"]),
            InputDevice(
                name=str(found["name"]),
                host_api=host_apis[found["hostapi"]],
                channels=int(found["max_input_channels"]),
                default_sample_rate_hz=float(found["default_samplerate"]),
            ),
        )
        for found in sd.query_devices()
        if found["max_input_channels"] > 0
    ]


def _find(devices: Sequence[tuple[int, InputDevice]], wanted: str, channels: int) -> tuple[int, InputDevice] | None:
    """Return PortAudio's index and a description of the device that matches a name; None if there is none.

    A full name takes precedence over names that contain it, so that every device can be named.

    Raises
    ------
    DeviceError
        If several devices match, or the device has too few channels.
    """
    found = [(index, device) for index, device in devices if device.matches(wanted)]
    in_full = [
        (index, device)
        for index, device in found
        if wanted.casefold() in (device.name.casefold(), device.label.casefold())
    ]
    if len(in_full) == 1:
        found = in_full
    if not found:
        return None
    if len(found) > 1:
        candidates = "; ".join(device.label for _, device in found)
        raise DeviceError(
            f"device {wanted!r}: expected a name that matches one input device, got {len(found)}: {candidates}; "
            "give more of the name in device.name"
        )
    index, device = found[0]
    if device.channels < channels:
        raise DeviceError(
            f"device {wanted!r}: expected at least {channels} input channels, got {device.channels}; "
            "correct the channels under arrays of this node, or use an interface with more inputs"
        )
    return index, device


def _rescan(sd: Any) -> None:
    """Restart PortAudio: only then does it detect devices that were connected after its start."""
    with suppress(sd.PortAudioError):  # PortAudio is not running if the last start failed
        sd._terminate()
    sd._initialize()


def _is_active(sd: Any, stream: Any) -> bool:
    try:
        return bool(stream.active)
    except sd.PortAudioError:
        return False


def _reason(error: Exception) -> str:
    return str(error.args[0]) if error.args else type(error).__name__
