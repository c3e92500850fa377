"""Turns the blocks of one device into the messages of the arrays on its channels. It never waits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.level_reports import LevelReports
from livessl.core.stream.segmenter import Measured, Segmenter
from livessl.core.stream.timeline import Cut, Framer, FramerState
from livessl.core.types import ArraySpec, BackfillRequest, Block, IntArray, Mark, Message


@dataclass(frozen=True, slots=True)
class Wiring:
    """One array on a device: its geometry, and the device channel of each microphone.

    Parameters
    ----------
    spec : ArraySpec
    channels : (K,) int64
        Device channels, counted from 0, in the order of the array's microphones.
    """

    spec: ArraySpec
    channels: IntArray


class Pipeline:
    """Cuts the blocks of one device into frames, for every array that shares its clock.

    Parameters
    ----------
    wirings : sequence of Wiring
        The arrays on the device.
    sample_rate_hz : float
        Nominal rate of the device.
    parameters : ActivityParameters
        Parameters of the activity rule, which separates sound from the background.
    reports_levels : bool
        Whether marks carry the levels of the channels once a second, which a node's do.
    """

    def __init__(
        self,
        wirings: Sequence[Wiring],
        sample_rate_hz: float,
        parameters: ActivityParameters,
        *,
        reports_levels: bool = False,
    ) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.framer = Framer(sample_rate_hz)
        self._segmenters = [Segmenter(wiring.spec, wiring.channels, sample_rate_hz, parameters) for wiring in wirings]
        channels = {wiring.spec.name: wiring.channels for wiring in wirings}
        self._levels = LevelReports(channels, sample_rate_hz) if reports_levels else None

    @property
    def arrays(self) -> list[str]:
        """Names of the arrays on it."""
        return [segmenter.array for segmenter in self._segmenters]

    def push(self, block: Block) -> list[Message]:
        """Return the messages that a block completes."""
        (messages,) = self.push_several([block])
        return messages

    def push_several(self, blocks: Sequence[Block]) -> list[list[Message]]:
        """Return the messages that each of some blocks completes; their frames are measured together, which is faster.

        Marks with levels report the drift of the clock after the last block.
        """
        cut = [(self.framer.push(block), self.framer.state) for block in blocks]
        frames = [frame for some, _ in cut for frame in some]
        measured = [iter(segmenter.measure(frames)) for segmenter in self._segmenters]
        return [[message for frame in some for message in self._taken(frame, measured, state)] for some, state in cut]

    def _taken(self, cut: Cut, measured: Sequence[Iterator[Measured]], state: FramerState) -> Iterator[Message]:
        """Yield the messages that a frame completes; each iterator yields what an array's segmenter measured of it."""
        if self._levels is not None:
            self._levels.push(cut.samples)
        for segmenter, known in zip(self._segmenters, measured, strict=True):
            yield from map(self._with_levels, segmenter.take(cut, next(known), state))

    def backfill(self, request: BackfillRequest) -> list[Message]:
        """Return the remembered frames that a request names; none where the array is on another device."""
        return [
            message
            for segmenter in self._segmenters
            if segmenter.array == request.array
            for message in segmenter.backfill(request.first, request.last)
        ]

    def _with_levels(self, message: Message) -> Message:
        """Add the levels that wait to a mark of their array."""
        if self._levels is None or not isinstance(message, Mark):
            return message
        levels = self._levels.take(message.array)
        if not levels:
            return message
        return replace(message, levels=levels, drift_error_ppm=self.framer.timeline.drift_error_ppm)

    def flush(self) -> list[Message]:
        """Return the messages held back, at the end of the sound."""
        return [message for segmenter in self._segmenters for message in segmenter.flush(self.framer.state)]
