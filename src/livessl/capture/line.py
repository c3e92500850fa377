"""One line of sound: a device's blocks in, the messages of the arrays on its channels out. It waits for nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from livessl.capture.devices import DeviceError, Placed, Recording, played
from livessl.clock import Clock
from livessl.config import Site
from livessl.core.segmenter import Segmenter
from livessl.core.timeline import Framer
from livessl.core.types import Ask, Block, Message


class Line:
    """The arrays that share one device's clock.

    Parameters
    ----------
    site : Site
    channels : mapping of array name to channels
        Device channels counted from 1, in the order of the array's microphones. Arrays that the site joins are
        processed as one.
    sample_rate_hz : float
        Nominal rate of the device.
    """

    def __init__(self, site: Site, channels: Mapping[str, Sequence[int]], sample_rate_hz: float) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.framer = Framer(sample_rate_hz)
        self._segmenters = [
            Segmenter(site.array(name), np.array(numbers) - 1, sample_rate_hz, site.activity_parameters())
            for name, numbers in site.joined_channels(channels).items()
        ]

    @property
    def arrays(self) -> list[str]:
        """Names of the arrays on it."""
        return [segmenter.array for segmenter in self._segmenters]

    def push(self, block: Block) -> list[Message]:
        """Messages that a block completes."""
        return [
            message
            for cut in self.framer.push(block)
            for segmenter in self._segmenters
            for message in segmenter.push(cut, self.framer)
        ]

    def ask(self, ask: Ask) -> list[Message]:
        """What is remembered of an array's sound; nothing of an array that is on another line."""
        return [
            message
            for segmenter in self._segmenters
            if segmenter.array == ask.array
            for message in segmenter.ask(ask.first, ask.last)
        ]

    def flush(self) -> list[Message]:
        """Messages held back, at the end of the sound."""
        return [message for segmenter in self._segmenters for message in segmenter.flush(self.framer)]


def played_messages(
    lines: Sequence[Line], placed: Sequence[Placed], clock: Clock
) -> Iterator[tuple[int, list[Message]]]:
    """What lines make of their recordings, block by block: the site time at which it is known, and the messages."""
    end_ns = 0
    for end_ns, index, block in played(placed, clock):
        yield end_ns, lines[index].push(block)
    yield end_ns, [message for line in lines for message in line.flush()]


def recording_channels(site: Site, array: str, recording: Recording, wanted: Sequence[int] | None = None) -> list[int]:
    """Which channels (from 1) of a recording are an array's microphones.

    As wanted; else as many channels as microphones, in order; else the channels that the site file gives the array on
    its node's device; else the first ones.

    Raises
    ------
    DeviceError
        Where channels or sampling rate do not fit the site.
    """
    expected = len(site.array(array).microphones_m)
    node = site.node_of(array)
    rate = site.nodes[node].device.sample_rate_hz if node else None
    if rate is not None and rate != recording.sample_rate_hz:
        raise DeviceError(
            f"{recording.name}: expected {rate:g} Hz for array {array!r}, got {recording.sample_rate_hz:g} Hz; "
            f"resample the file or correct nodes.{node}.device.sample_rate_hz"
        )
    high = site.array(array).band_hz[1]
    if high >= recording.sample_rate_hz / 2:
        raise DeviceError(
            f"{recording.name}: array {array!r} uses up to {high:g} Hz and needs more than {2 * high:g} Hz, got "
            f"{recording.sample_rate_hz:g} Hz; lower band_hz or use a recording with a higher rate"
        )
    if wanted is not None:
        if not len(wanted) == len(set(wanted)) == expected or min(wanted) < 1 or max(wanted) > recording.channels:
            raise DeviceError(
                f"{recording.name}: expected {expected} different channel numbers from 1 to {recording.channels} "
                f"for array {array!r}, got {list(wanted)}"
            )
        return list(wanted)
    if recording.channels < expected:
        raise DeviceError(
            f"{recording.name}: expected {expected} channels, one for each microphone of array {array!r}, "
            f"got {recording.channels}"
        )
    if recording.channels > expected and node:
        captured = site.nodes[node].arrays
        numbers = [number for member in site.members(array) for number in captured[member]]
        if max(numbers) <= recording.channels:
            return numbers
    return list(range(1, expected + 1))
