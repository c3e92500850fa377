"""One array's frames become messages: frames around sound, marks in between. It knows no device and no socket."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import spectrum_power
from livessl.core.stream.activity import ActivityParameters, CausalActivity
from livessl.core.stream.steady_background import SteadyBackground
from livessl.core.stream.timeline import Cut, Framer
from livessl.core.types import FRAME_S, ArraySpec, Float32Array, FloatArray, Frame, IntArray, Mark, Message

RECENT_S: Final = 12.0
"""Length, in seconds, of the sound that a node remembers whether or not it was sent: longer than the longest usual
event, its pre-roll and the way of a backfill request together."""

WARM_UP_FRAMES: Final = 10
"""Number of frames held back at the start; the quietest of them is the first estimate of the background."""


class Segmenter:
    """Decides what is sound, and keeps what came just before it.

    Every frame index yields one message in order: a `Mark` while it is quiet, a `Frame` around sound. When sound
    begins, the pre-roll, whose frame indices were marked as quiet before, is sent as frames.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    channels : (K,) int64
        Device channels (from 0) of its microphones, in order.
    sample_rate_hz : float
        Nominal rate of the device.
    parameters : ActivityParameters
        Parameters of the activity rule.
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
        self._background = SteadyBackground(sample_rate_hz, spec.band_hz, parameters.floor_window_s, parameters.keep)
        self._hang_over = parameters.hang_over_frames
        self._warm_up: list[tuple[Cut, FloatArray, FloatArray]] | None = []
        self._pre_roll: deque[tuple[Cut, float]] = deque(maxlen=parameters.pre_roll_frames)
        self._recent: deque[tuple[Cut, float]] = deque(maxlen=round(RECENT_S / FRAME_S))
        self._quiet_frames = self._hang_over + 1
        self._sequence = 0
        self._frame_index: int | None = None

    @property
    def array(self) -> str:
        """Name of the array."""
        return self._spec.name

    def push(self, cut: Cut, framer: Framer) -> list[Message]:
        """Take in the next frame of the device; `framer` holds the counters and the clock state that marks carry."""
        if self._frame_index is not None and cut.frame_index != self._frame_index + 1:
            self._pre_roll.clear()  # frames before a gap are no pre-roll of a sound after it
            self._recent.clear()
            self._quiet_frames = self._hang_over + 1
        self._frame_index = cut.frame_index
        samples = self._selected(cut)
        plain = scipy.fft.rfft(samples, axis=1)
        power = spectrum_power(plain, samples.shape[1], self._rate_hz, self._spec.band_hz)
        spectrum, mean = self._background.spectrum(samples, plain), float(power.mean())
        found_hum = self._background.learn(spectrum)
        if self._warm_up is None:
            if found_hum:
                self._activity.restart(self._background.usual_power, self._background.changing_maximum)
            level = self._background.changing_power(spectrum, mean)
            return self._decide(cut, power, level, framer)
        self._warm_up.append((cut, power, spectrum))
        return self.flush(framer) if len(self._warm_up) >= WARM_UP_FRAMES else []

    def flush(self, framer: Framer) -> list[Message]:
        """End the warm-up, as the end of a short stream must."""
        held, self._warm_up = self._warm_up or [], None
        levels = [self._background.changing_power(spectrum, float(power.mean())) for _, power, spectrum in held]
        if held:
            self._activity.prime(min(levels))
        known = zip(held, levels, strict=True)
        return [message for (cut, power, _), level in known for message in self._decide(cut, power, level, framer)]

    def backfill(self, first: int, last: int) -> list[Message]:
        """Return the remembered frames from `first` to `last`, both included, whether or not they were sent."""
        return [self._requested_frame(cut, power) for cut, power in self._recent if first <= cut.frame_index <= last]

    def _selected(self, cut: Cut) -> Float32Array:
        return cut.samples[self._channels]

    def _decide(self, cut: Cut, channel_power: FloatArray, power: float, framer: Framer) -> list[Message]:
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
        samples, name = np.ascontiguousarray(self._selected(cut)), self._spec.name
        return Frame(name, self._sequence, cut.frame_index, cut.time_ns, self._rate_hz, samples, power, active)

    def _requested_frame(self, cut: Cut, power: float) -> Frame:
        samples, name = np.ascontiguousarray(self._selected(cut)), self._spec.name
        return Frame(name, 0, cut.frame_index, cut.time_ns, self._rate_hz, samples, power, active=False, requested=True)

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
