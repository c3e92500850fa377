"""One array's frames become messages: frames around sound, marks in between. It knows no device and no socket."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from livessl.core.correlate.band import band_power
from livessl.core.stream.activity import ActivityParameters, CausalActivity
from livessl.core.stream.timeline import Cut, Framer
from livessl.core.types import FRAME_S, ArraySpec, Float32Array, FloatArray, Frame, IntArray, Mark, Message

RECENT_S: Final = 12.0
"""How long what was not sent is remembered: longer than the longest usual event, its run-up, and the asking."""

WARM_UP_FRAMES: Final = 10
"""Frames held back at the start: the quietest of them is the first guess of the background."""


class Segmenter:
    """Decides what is sound, and keeps what came just before it.

    Every frame index yields one message in order, a `Mark` while it is quiet and a `Frame` around sound; intervals
    of the pre-roll, already marked as quiet, are sent again as frames when sound begins.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    channels : (K,) int64
        Device channels (from 0) of its microphones, in order.
    sample_rate_hz : float
        Nominal rate of the device.
    parameters : ActivityParameters
        The activity rule's numbers.
    """

    def __init__(
        self, spec: ArraySpec, channels: IntArray, sample_rate_hz: float, parameters: ActivityParameters
    ) -> None:
        if len(channels) != len(spec.microphones_m):
            raise ValueError(
                f"array {spec.name!r}: has {len(spec.microphones_m)} microphones, given {len(channels)} channels"
            )
        self._spec = spec
        self._channels = channels
        self._rate_hz = sample_rate_hz
        self._activity = CausalActivity(parameters)
        self._hang_over = round(parameters.hang_over_s / FRAME_S)
        self._warm_up: list[tuple[Cut, FloatArray]] | None = []
        self._pre_roll: deque[tuple[Cut, float]] = deque(maxlen=round(parameters.pre_roll_s / FRAME_S))
        self._recent: deque[tuple[Cut, float]] = deque(maxlen=round(RECENT_S / FRAME_S))
        self._quiet_frames = self._hang_over + 1
        self._sequence = 0
        self._raster: int | None = None

    @property
    def array(self) -> str:
        """Name of the array."""
        return self._spec.name

    def push(self, cut: Cut, framer: Framer) -> list[Message]:
        """Take in the next frame index; `framer` tells how the device is doing."""
        if self._raster is not None and cut.frame_index != self._raster + 1:
            self._pre_roll.clear()  # what came before a gap is no run-up to what comes after it
            self._recent.clear()
            self._quiet_frames = self._hang_over + 1
        self._raster = cut.frame_index
        power = band_power(self._selected(cut), self._rate_hz, self._spec.band_hz)
        if self._warm_up is None:
            return self._decide(cut, power, framer)
        self._warm_up.append((cut, power))
        return self.flush(framer) if len(self._warm_up) >= WARM_UP_FRAMES else []

    def flush(self, framer: Framer) -> list[Message]:
        """End the warm-up, as the end of a short stream must."""
        held, self._warm_up = self._warm_up or [], None
        if held:
            self._activity.prime(min(float(power.mean()) for _, power in held))
        return [message for cut, power in held for message in self._decide(cut, power, framer)]

    def ask(self, first: int, last: int) -> list[Message]:
        """What is remembered of some frame indices, both ends included, whether or not it was sent."""
        return [self._frame(cut, power, 0) for cut, power in self._recent if first <= cut.frame_index <= last]

    def _selected(self, cut: Cut) -> Float32Array:
        return cut.samples[self._channels]

    def _decide(self, cut: Cut, channel_power: FloatArray, framer: Framer) -> list[Message]:
        power = float(channel_power.mean())
        self._recent.append((cut, power))
        active = self._activity.push(power)
        self._quiet_frames = 0 if active else self._quiet_frames + 1
        if self._quiet_frames > self._hang_over:
            self._pre_roll.append((cut, power))
            return [self._mark(cut, channel_power, framer)]
        messages: list[Message] = [self._next_frame(earlier, level, False) for earlier, level in self._pre_roll]
        self._pre_roll.clear()
        messages.append(self._next_frame(cut, power, active))
        return messages

    def _next_frame(self, cut: Cut, power: float, active: bool) -> Frame:
        self._sequence += 1
        return self._frame(cut, power, self._sequence, active)

    def _frame(self, cut: Cut, power: float, sequence: int, active: bool = False) -> Frame:
        samples = np.ascontiguousarray(self._selected(cut))
        return Frame(self._spec.name, sequence, cut.frame_index, cut.time_ns, self._rate_hz, samples, power, active)

    def _mark(self, cut: Cut, channel_power: FloatArray, framer: Framer) -> Mark:
        return Mark(
            array=self._spec.name,
            sequence=self._sequence,
            frame_index=cut.frame_index,
            power=float(channel_power.mean()),
            noise_power=self._activity.floor_power,
            channel_power=tuple(float(power) for power in channel_power),
            overflows=framer.overflows,
            lost_frames=framer.lost_frames,
            drift_ppm=framer.timeline.drift_ppm,
            clock=framer.timeline.state,
        )
