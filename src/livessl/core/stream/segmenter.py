"""Decides which frames a node sends (those around a sound) and when a mark stands for silence.

It also decides what digital silence is, and remembers the last seconds for backfill requests. `activity` decides from
which level on a frame is active.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import spectrum_power
from livessl.core.stream.activity import ActivityParameters, CausalActivity
from livessl.core.stream.steady_background import SteadyBackground
from livessl.core.stream.timeline import Cut, FramerState
from livessl.core.types import FRAME_S, ArraySpec, Float32Array, FloatArray, Frame, IntArray, Mark, Message

RECENT_S: Final = 12.0
"""Length, in seconds, of the sound that a node remembers whether or not it was sent: longer than the longest usual
event, its pre-roll and the way of a backfill request together."""

WARM_UP_FRAMES: Final = 10
"""Number of frames held back where the background is unknown: at the start, and after digital silence that is not the
background. The quietest of them is the first estimate of the background, without the first frame if the device fades in
there."""

DIGITAL_SILENCE: Final = 1e-14
"""In-band power, full scale squared, below which a frame is digital silence: -140 dBFS. The noise of the best
converters is 15 dB above it; zeros and other constants are below it."""

FADE_IN: Final = 4.0
"""Ratio of the powers of the first frame's halves at and above which a device fades in: a sound must be as much louder
than the background to be found."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of one frame of an array, which do not depend on the frames before it.

    Parameters
    ----------
    channel_power : (K,) float64
        In-band mean power of each channel, full scale squared.
    power : float
        Their mean.
    spectrum : (F,) float64
        Power in each bin: see `SteadyBackground.spectra`.
    """

    channel_power: FloatArray
    power: float
    spectrum: FloatArray


class Segmenter:
    """Decides what is sound, and keeps what came just before it.

    Every frame index yields one message in order: a `Mark` while it is quiet, a `Frame` around sound. When sound
    begins, the pre-roll, whose frame indices were marked as quiet before, is sent as frames.

    Drivers deliver zeros until a device runs. This digital silence is no measure of the background. The warm-up follows
    it, unless the background is known from less than its window before. Digital silence that returns within this
    window, as that of a noise gate or of a simulation without noise, is the background, until there is a gap.

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
        self._parameters = parameters
        self._hang_over = parameters.hang_over_frames
        self._warm_up: list[tuple[Cut, Measured]] | None = []
        self._pre_roll: deque[tuple[Cut, float]] = deque(maxlen=parameters.pre_roll_frames)
        self._recent: deque[tuple[Cut, float]] = deque(maxlen=round(RECENT_S / FRAME_S))
        self._quiet_frames = self._hang_over + 1
        self._sequence = 0
        self._frame_index: int | None = None
        self._floor_frames = round(parameters.floor_window_s / FRAME_S)
        self._silent_frames = 0
        self._frames_since_silence: int | None = None  # None before the first since the start or a gap
        self._is_silence_background = False

    @property
    def array(self) -> str:
        """Name of the array."""
        return self._spec.name

    def measure(self, cuts: Sequence[Cut]) -> list[Measured]:
        """Measure some frames. Those that follow each other and are equally long are transformed together."""
        measured: list[Measured] = []
        for _, alike in groupby(cuts, key=lambda cut: cut.samples.shape[1]):
            samples = np.stack([self._selected(cut) for cut in alike])
            count, channels, length = samples.shape
            plain = scipy.fft.rfft(samples.reshape(count * channels, length), axis=1)
            power = spectrum_power(plain, length, self._rate_hz, self._spec.band_hz).reshape(count, channels)
            spectra = self._background.spectra(samples, plain.reshape(count, channels, -1))
            measured += map(Measured, power, power.mean(axis=1).tolist(), spectra)
        return measured

    def push(self, cut: Cut, state: FramerState) -> list[Message]:
        """Take in the next frame of the device; `state` is that of its framer, which marks report."""
        (measured,) = self.measure([cut])
        return self.take(cut, measured, state)

    def take(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        """Take in the next frame of the device, which has been measured: see `push`."""
        if self._frame_index is not None and cut.frame_index != self._frame_index + 1:
            self._pre_roll.clear()  # frames before a gap are no pre-roll of a sound after it
            self._recent.clear()
            self._quiet_frames = self._hang_over + 1
            self._frames_since_silence, self._is_silence_background = None, False
        self._frame_index = cut.frame_index
        if measured.power < DIGITAL_SILENCE:
            return self._take_silence(cut, measured, state)
        if self._frames_since_silence is not None:
            self._frames_since_silence += 1
        return self._take_sound(cut, measured, state)

    def _take_sound(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        found_hum = self._background.learn(measured.spectrum)
        if self._warm_up is None:
            if found_hum:
                self._activity.restart(self._background.usual_power, self._background.changing_maximum)
            level = self._background.changing_power(measured.spectrum, measured.power)
            return self._decide(cut, measured, level, state, active=self._activity.push(level))
        self._warm_up.append((cut, measured))
        return self.flush(state) if len(self._warm_up) >= WARM_UP_FRAMES else []

    def _take_silence(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        """Take in a frame of digital silence, which is the background once it has returned soon."""
        if self._frames_since_silence is not None and 0 < self._frames_since_silence <= self._floor_frames:
            self._is_silence_background = True
        self._silent_frames = 1 if self._frames_since_silence != 0 else self._silent_frames + 1
        self._frames_since_silence = 0
        messages = self._end_warm_up(state, 0.0) if self._warm_up else []
        if self._is_silence_background:
            self._warm_up = None
            return messages + self._take_sound(cut, measured, state)
        if messages or self._silent_frames == self._floor_frames:
            self._activity, self._warm_up = CausalActivity(self._parameters), []
        return messages + self._decide(cut, measured, measured.power, state, active=False)

    def flush(self, state: FramerState) -> list[Message]:
        """End the warm-up, as the end of a short stream must."""
        return self._end_warm_up(state)

    def _end_warm_up(self, state: FramerState, floor_power: float | None = None) -> list[Message]:
        """Decide about the frames that are held back, over a known background or over that of the quietest of them."""
        held, self._warm_up = self._warm_up or [], None
        levels = [self._background.changing_power(known.spectrum, known.power) for _, known in held]
        if held:
            fades_in = len(held) > 1 and _fades_in(self._selected(held[0][0]))
            quietest = min(levels[1:] if fades_in else levels)
            self._activity.prime(quietest if floor_power is None else floor_power)
        return [
            message
            for (cut, known), level in zip(held, levels, strict=True)
            for message in self._decide(cut, known, level, state, active=self._activity.push(level))
        ]

    def backfill(self, first: int, last: int) -> list[Message]:
        """Return the remembered frames from `first` to `last`, both included, whether or not they were sent."""
        return [self._requested_frame(cut, power) for cut, power in self._recent if first <= cut.frame_index <= last]

    def _selected(self, cut: Cut) -> Float32Array:
        return cut.samples[self._channels]

    def _decide(self, cut: Cut, measured: Measured, power: float, state: FramerState, *, active: bool) -> list[Message]:
        self._recent.append((cut, power))
        self._quiet_frames = 0 if active else self._quiet_frames + 1
        if self._quiet_frames > self._hang_over:
            self._pre_roll.append((cut, power))
            return [self._mark(cut, measured, state)]
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

    def _mark(self, cut: Cut, measured: Measured, state: FramerState) -> Mark:
        return Mark(
            array=self._spec.name,
            sequence=self._sequence,
            frame_index=cut.frame_index,
            power=measured.power,
            noise_power=self._activity.floor_power,
            channel_power=tuple(measured.channel_power.tolist()),
            overflows=state.overflows,
            lost_frames=state.lost_frames,
            drift_ppm=state.drift_ppm,
            clock=state.clock,
        )


def _fades_in(samples: Float32Array) -> bool:
    """Return whether the second half of a first frame (channels, n) is much louder than the first, or all is constant.

    The mean of the first half plays no part: a driver may deliver another constant than zero.
    """
    half = samples.shape[1] // 2
    power = np.square(samples - samples[:, :half].mean(axis=1, keepdims=True))
    return bool(FADE_IN * power[:, :half].sum() <= power[:, half : 2 * half].sum())
