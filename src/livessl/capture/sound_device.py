"""An audio interface through PortAudio, as an iterator of blocks. The only module that meets `sounddevice`.

The library is imported where it is used, so that a machine without PortAudio can do everything else.

Real-time contract. PortAudio calls `SoundDevice._receive` on a thread of its own. It copies, stamps, enqueues and
returns: it waits for nothing, takes no lock of ours, logs nothing and allocates nothing but the copy and the tuple
that carries it. While a stream is open that thread alone writes `_next_index` and `_lost`; the iterating thread
touches them only when no stream is.
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
"""Longest silence of the iterator: the caller serves its network link at least so often."""

REOPEN_S: Final = 2.0
"""Between two attempts to open a missing device. A scan of all devices may itself take some tenths of a second."""

STALLED_S: Final = 5.0
"""An open stream that delivers nothing for so long is as good as gone: some drivers hang instead of failing. A sound
server may well take 2 s to deliver its first block."""

QUEUE_S: Final = 2.0
"""Sound that may wait for the iterator, seconds: far more than any pause of a caller that is well."""

LATENCY_S: Final = 0.1
"""Asked of the driver, seconds. It sizes the driver's buffer, hence how long the callback may be kept from running
before samples are lost; blocks still arrive once a period."""

MAX_BACKLOG_S: Final = 1.0
"""A time of conversion that says the driver held more than this is not believed."""

_INVALID_CHANNEL_COUNT: Final = -9998
_INVALID_SAMPLE_RATE: Final = -9997


@dataclass(frozen=True, slots=True)
class InputDevice:
    """A device that can record.

    Parameters
    ----------
    name : str
        As the driver calls it.
    host_api : str
        PortAudio's name of the driver family, such as ALSA.
    channels : int
        Input channels it offers.
    default_sample_rate_hz : float
        Rate it runs at unless told otherwise.
    """

    name: str
    host_api: str
    channels: int
    default_sample_rate_hz: float

    @property
    def label(self) -> str:
        """The name that tells it from its namesakes under other drivers: `HOSTAPI: name`."""
        return f"{self.host_api}: {self.name}"

    @property
    def is_hardware(self) -> bool:
        """Whether samples come from the device itself (ALSA's `hw:`), not from a sound server or through a plug-in."""
        return "(hw:" in self.name

    def answers_to(self, wanted: str) -> bool:
        """Whether `wanted` is part of the name, case apart, or `HOSTAPI: part of the name`."""
        folded, name = wanted.casefold(), self.name.casefold()
        host_api, _, part = folded.partition(": ")
        return folded in name or (part != "" and host_api == self.host_api.casefold() and part in name)


class SoundDevice:
    """An audio interface, found by name; a context manager that opens it and an iterator of its blocks.

    Each step waits at most 0.25 s (longer only while a missing device is looked for) and then yields a block of no
    samples. A device that is absent or vanishes is waited for: empty blocks, `problem` set, an attempt to open it
    about every 2 s. The first block after that has `overflow` set, and indices go on from where they were.

    PortAudio sees new devices only when all of it is started anew, which closes every stream of the process: have
    one `SoundDevice` in a process.

    Parameters
    ----------
    config : SoundDeviceConfig
        Name, rate and block length.
    channels : int
        How many channels to record: the highest that any array uses.
    clock : Clock
        Stamps the blocks.

    Attributes
    ----------
    name : str
        As configured.
    sample_rate_hz : float
        Nominal rate.
    channels : int
        Channels of each block.
    problem : str or None
        What is wrong now, in words.
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
        """Open the device, or begin to wait for it.

        Raises
        ------
        DeviceError
            Where waiting would not help: PortAudio is not installed, the name fits several devices, the device has
            too few channels or not the sampling rate.
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
        """Next block, or one of no samples after 0.25 s.

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
        """PortAudio's callback: see the contract at the head of the module.

        The time of conversion that the driver of a hardware device gives rests on a count of the samples in its buffer,
        and so knows how long they waited for this call, and that two blocks of one period came at once. A sound
        server's is a guess: PulseAudio's drifts by 0.2 s in the first second, while its blocks arrive evenly. There,
        and where the time is not sane, the last sample is taken to have come just now.

        A copy is asked for by name, because one channel transposed is already contiguous, and the memory is
        PortAudio's.
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
        """After a wait in vain: give up a dead stream, or look for the missing device when it is time."""
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
            except DeviceError as error:  # no reason to stop: whoever plugged that in may take it out again
                self.problem = str(error)

    def _give_up(self, problem: str) -> None:
        self._close()
        self._idle_s = 0.0
        self._lost = True
        self.problem = problem

    def _open(self, sd: Any) -> str | None:
        """Open the device if it is there; what is wrong otherwise.

        Raises
        ------
        DeviceError
            Where waiting would not help.
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
    """Every device that can record, in PortAudio's order.

    Raises
    ------
    DeviceError
        Where PortAudio is not installed or cannot list the devices.
    """
    sd = _portaudio()
    try:
        return [device for _, device in _inputs(sd)]
    except sd.PortAudioError as error:
        raise DeviceError(f"PortAudio cannot list the devices: {_reason(error)}; is a sound driver running?") from error


def _portaudio() -> Any:
    """The `sounddevice` module; importing it starts PortAudio."""
    try:
        import sounddevice
    except OSError as error:
        raise DeviceError(
            "sound devices need the PortAudio library, which is not on this machine; "
            "install PortAudio: apt install libportaudio2"
        ) from error
    return sounddevice


def _inputs(sd: Any) -> list[tuple[int, InputDevice]]:
    """PortAudio's index and description of each device that can record."""
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
    """PortAudio's index and description of the one device that answers to a name; None if there is none.

    A name given in full wins over names that merely hold it, so that every device can be named.

    Raises
    ------
    DeviceError
        Where several answer, or the one has too few channels.
    """
    found = [(index, device) for index, device in devices if device.answers_to(wanted)]
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
            f"device {wanted!r}: expected a name that fits one input device, got {len(found)}: {candidates}; "
            "give more of the name in device.name"
        )
    index, device = found[0]
    if device.channels < channels:
        raise DeviceError(
            f"device {wanted!r} has {device.channels} input channels, arrays use channel {channels}; "
            "correct the channels under arrays of this node, or use an interface with more inputs"
        )
    return index, device


def _rescan(sd: Any) -> None:
    """Start PortAudio anew, the only way it sees a device that came after it began."""
    with suppress(sd.PortAudioError):  # not running, because the start before this one failed
        sd._terminate()
    sd._initialize()


def _is_active(sd: Any, stream: Any) -> bool:
    try:
        return bool(stream.active)
    except sd.PortAudioError:
        return False


def _reason(error: Exception) -> str:
    return str(error.args[0]) if error.args else type(error).__name__
