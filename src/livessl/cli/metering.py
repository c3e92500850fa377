"""Meters an audio device or a recording for `livessl levels`, and waits for a device that is absent or busy."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from livessl.cli.exits import FAILED, OK, stop_on_signal
from livessl.cli.levels_view import Lines, Objects, Places, Screen, View
from livessl.cli.output import complain
from livessl.clock import Clock, SystemClock
from livessl.core.commission.levels import LevelMeter
from livessl.core.commission.taps import TapDetector
from livessl.core.types import Block
from livessl.errors import ConfigError, Fault

if TYPE_CHECKING:
    from livessl.capture.sound_device import SoundDevice
    from livessl.recordings.sound_file import SoundWriter
    from livessl.site.models import Site
    from livessl.site.node_models import NodeConfig, SoundDeviceConfig

SCREEN_S: Final = 0.2
"""Interval between two drawings on a terminal, in seconds."""

LINES_S: Final = 1.0
"""Interval between two tables or sets of JSON objects, in seconds."""

SEARCH_S: Final = 2.0
"""Interval between two searches for a device that is absent or busy, in seconds."""

MOST_OF_SERVER: Final = 8
"""Inputs that are metered of a sound server or plug-in unless --inputs says otherwise: these offer 32 or 128 whatever
the hardware has."""

USUAL_RATE_HZ: Final = 48000.0


@dataclass(frozen=True, slots=True)
class _Source:
    """The device or file that is metered, with the inputs and arrays that the site file names."""

    name: str
    sample_rate_hz: float
    inputs: int
    places: Places
    arrays: tuple[tuple[int, ...], ...] = ()


def meter_file(arguments: argparse.Namespace) -> int:
    """Meter a recording as fast as it can be read."""
    from livessl.recordings.recording import FileRecording

    recording = FileRecording(arguments.wav)
    if recording.note:
        complain(recording.note, kind="note")
    source = _Source(str(arguments.wav), recording.sample_rate_hz, recording.channels, {})
    view: View = Objects({}) if arguments.json else Lines({}, taps_only=True)
    with stop_on_signal() as stop:
        return _Session(arguments, source, view, LINES_S).run(recording.blocks(0), lambda _: stop.is_set())


def meter_device(arguments: argparse.Namespace, site: Site | None) -> int:
    """Meter a device until `--seconds` or Ctrl-C; wait for one that is absent or busy."""
    from livessl.capture.sound_device import SoundDevice

    clock = SystemClock()
    config, node = _device_config(arguments, site)
    places, arrays = _places(node)
    label = f"{config.name} ({arguments.node})" if arguments.node else config.name
    if arguments.json:
        view: View = Objects(places)
    elif sys.stdout.isatty():
        view = Screen(label, places)
    else:
        view = Lines(places, taps_only=arguments.tap)
    with stop_on_signal() as stop:
        limit = _Limit(clock, arguments.seconds, stop.is_set)
        known = _open_when_there(arguments, config, max(places, default=1), view, limit)
        if known is None:
            return _no_sound(config.name)
        config, inputs = known
        metered = tuple(tuple(index for index in array if index < inputs) for array in arrays)
        source = _Source(label, config.sample_rate_hz, inputs, places, metered)
        session = _Session(arguments, source, view, SCREEN_S if isinstance(view, Screen) else LINES_S)
        with SoundDevice(config, inputs, clock) as device:
            problem: str | None = None

            def over(block: Block) -> bool:
                nonlocal problem
                if device.problem != problem:
                    problem = device.problem
                    view.problem(problem)
                if (problem is not None and device.has_cause) or block.samples.shape[1]:
                    limit.begin(sounds=bool(block.samples.shape[1]))
                return limit.is_over

            code = session.run(device, over)
            _note_losses(device)
            return code


def _note_losses(device: SoundDevice) -> None:
    """Print how often sound was lost, and why: the machine was busy, or the device was not there."""
    if device.lost_blocks:
        complain(
            f"sound was lost {device.lost_blocks} times because this machine did not keep up; stop other programs",
            kind="note",
        )
    if device.interruptions:
        complain(
            f"the device was interrupted {device.interruptions} times: unplugged, switched off, or opened again after "
            "an error; the lines above say when",
            kind="note",
        )


class _Limit:
    """The end by `--seconds` or a signal. Seconds count from the first sound, or while there is none, a problem."""

    def __init__(self, clock: Clock, seconds: float | None, stopped: Callable[[], bool]) -> None:
        self._clock = clock
        self._seconds = seconds
        self._stopped = stopped
        self._begun_ns: int | None = None
        self._sounds = False

    def begin(self, *, sounds: bool) -> None:
        """Begin to count at a problem, and anew at the first sound."""
        if self._begun_ns is None or (sounds and not self._sounds):
            self._begun_ns, self._sounds = self._clock.monotonic_ns(), sounds

    @property
    def is_over(self) -> bool:
        """True from the end on."""
        if self._stopped() or self._seconds is None or self._begun_ns is None:
            return self._stopped()
        return self._clock.monotonic_ns() - self._begun_ns >= self._seconds * 1e9


def _device_config(arguments: argparse.Namespace, site: Site | None) -> tuple[SoundDeviceConfig, NodeConfig | None]:
    from livessl.cli.node_input import node_config
    from livessl.site.node_models import SoundDeviceConfig

    if site is None:
        rate_hz = arguments.sample_rate or USUAL_RATE_HZ
        return SoundDeviceConfig(name=arguments.device, sample_rate_hz=rate_hz), None
    node = node_config(site, arguments.node, arguments.site)
    if not isinstance(node.device, SoundDeviceConfig):
        where = f"{arguments.site}: nodes.{arguments.node}.device"
        what = f"expected an audio interface, got type {node.device.type}; give its files with --wav FILE"
        raise ConfigError([Fault(where, what)])
    return node.device, node


def _places(node: NodeConfig | None) -> tuple[Places, tuple[tuple[int, ...], ...]]:
    """Return the microphone at each input, and the inputs (from 0) of each array."""
    arrays = {} if node is None else node.arrays
    places = {
        number: (array, microphone) for array, numbers in arrays.items() for microphone, number in enumerate(numbers, 1)
    }
    return places, tuple(tuple(number - 1 for number in numbers) for numbers in arrays.values())


def _open_when_there(
    arguments: argparse.Namespace, config: SoundDeviceConfig, least: int, view: View, limit: _Limit
) -> tuple[SoundDeviceConfig, int] | None:
    """Wait for the device; return its configuration and its number of inputs, or None if that is over before.

    Parameters
    ----------
    arguments, config, view
        What is wanted, and what shows why it is not there.
    least : int
        Inputs that are needed: the highest of any array.
    limit : _Limit
        When to stop waiting.
    """
    from livessl.capture.input_search import search_input
    from livessl.capture.sound_device import SoundDevice, wanted_device

    clock = SystemClock()
    least = arguments.inputs or least
    shown: str | None = None
    delivers = False
    while not limit.is_over:
        found = search_input(wanted_device(config, least))
        if found is not None:
            usual = found.channels if found.is_hardware else max(least, min(found.channels, MOST_OF_SERVER))
            if arguments.site is None and arguments.sample_rate is None:
                config = config.model_copy(update={"sample_rate_hz": found.default_sample_rate_hz})
            if shown is not None:
                view.problem(None)
            return config, arguments.inputs or usual
        if delivers:  # it opens although no search finds it, such as with a library that lists it late
            return config, least
        # the attempt to open it says why it is not found
        end_ns = clock.monotonic_ns() + round(SEARCH_S * 1e9)
        with SoundDevice(config, least, clock) as device:
            for block in device:
                if device.problem is not None and device.problem != shown:
                    shown = device.problem
                    view.problem(shown)
                has_cause = device.problem is not None and device.has_cause
                if has_cause:
                    limit.begin(sounds=False)
                delivers = block.samples.shape[1] > 0
                if limit.is_over or delivers or (has_cause and clock.monotonic_ns() >= end_ns):
                    break
    return None


def _no_sound(name: str) -> int:
    complain(f"device {name!r} delivered no sound; check its connection with `livessl devices`")
    return FAILED


class _Session:
    """Meters the blocks of a source and shows them."""

    def __init__(self, arguments: argparse.Namespace, source: _Source, view: View, interval_s: float) -> None:
        if arguments.listen is not None and arguments.listen > source.inputs:
            what = f"expected an input from 1 to {source.inputs}, got {arguments.listen}"
            raise ConfigError([Fault("--listen", what)])
        self._source = source
        self._view = view
        self._taps = TapDetector(source.inputs, source.sample_rate_hz) if arguments.tap else None
        self._meter = LevelMeter(source.inputs, source.sample_rate_hz, source.arrays)
        self._listen: int | None = arguments.listen
        self._target: Path = arguments.out
        self._interval = max(1, round(interval_s * source.sample_rate_hz))
        self._seconds: float | None = arguments.seconds
        self._samples = 0
        self._is_live = arguments.wav is None

    def run(self, blocks: Iterable[Block], over: Callable[[Block], bool]) -> int:
        """Meter blocks to their end or until `over`; return the exit code."""
        with ExitStack() as stack:
            writer = self._writer(stack)
            for block in blocks:
                if block.samples.shape[1]:
                    self._take(block, writer)
                if over(block) or self._is_full():
                    break
        if self._samples == 0:
            return _no_sound(self._source.name)
        self._view.summary(self._time_s, self._meter.overall())
        if self._listen is not None:
            complain(f"input {self._listen} was written to {self._target}", kind="note")
        return OK

    @property
    def _time_s(self) -> float:
        return self._samples / self._source.sample_rate_hz

    def _is_full(self) -> bool:
        return self._seconds is not None and self._time_s >= self._seconds

    def _take(self, block: Block, writer: SoundWriter | None) -> None:
        before = self._samples
        self._samples += block.samples.shape[1]
        self._meter.push(block.samples)
        if writer is not None and self._listen is not None:
            writer.write(block.samples[self._listen - 1 : self._listen])
        for tap in self._taps.push(block.samples) if self._taps else ():
            self._view.tap(tap)
        if self._is_live and self._samples // self._interval > before // self._interval:
            self._view.levels(self._time_s, self._meter.recent())

    def _writer(self, stack: ExitStack) -> SoundWriter | None:
        if self._listen is None:
            return None
        from livessl.recordings.sound_file import SoundWriter

        writer = SoundWriter(self._target, round(self._source.sample_rate_hz), 1, "wav")
        stack.callback(writer.close)
        return writer
