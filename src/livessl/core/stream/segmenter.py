"""Decides which frames a node sends (those around a sound) and when a mark stands for silence.

It also decides what digital silence is, and remembers the last seconds for backfill requests. `activity` decides from
which level on a frame is active.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import spectrum_power
from livessl.core.stream.activity import ActivityParameters, CausalActivity
from livessl.core.stream.digital_silence import (
    DIGITAL_SILENCE,
    LEAST_SILENT_FRAMES,
    LEAST_SOUND,
    SilenceEdges,
    sound_shares,
)
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

HELD_FRAMES: Final = 8
"""Number of frames that are still compared after a warm-up that follows digital silence and was steady. A frame is sent
0.35 s late then; at 0.5 s, others no longer wait for it."""

HELD_S: Final = 5.0
"""Time after digital silence, in seconds, for which they are. Most steady sounds, such as rings of telephones, have
ended by then."""

FALLEN: Final = 4.0
"""Ratio of the mean level of the oldest held frames to that of the newest, 6 dB, at and above which a steady sound has
ended: a sound must be as much louder than the background to be found."""

COMPARED: Final = 3
"""Number of held frames in each of these means; low-pitched noise scatters less than 6 dB in 0.15 s."""

DROPOUT_MARGIN: Final = 4.0
"""Further ratio, 6 dB, by which a frame with a dropout must be louder: its level is that of as little as 10 ms, and the
switching spreads low frequencies over the band."""

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
    sound_share : float
        Share of the frame without dropouts, from 0 to 1: see `sound_shares`.
    """

    channel_power: FloatArray
    power: float
    spectrum: FloatArray
    sound_share: float


class Segmenter:
    """Decides what is sound, and keeps what came just before it.

    Every frame index yields one message in order: a `Mark` while it is quiet, a `Frame` around sound. When sound
    begins, the pre-roll, whose frame indices were marked as quiet before, is sent as frames.

    Drivers deliver zeros until a device runs, and while it drops out. This digital silence is no measure of the
    background. The warm-up follows it, unless the background is known from less than its window before. Digital silence
    is the background if sound begins after it or ends in it, as that of a noise gate or of a simulation without noise:
    see `SilenceEdges`. It remains so until noise ends at once, or until there is a gap.

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
        self._edges = SilenceEdges(channels, spec.aperture_m, sample_rate_hz)
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
            spectra = self._background.spectra(samples, plain.reshape(count, channels, -1), power.mean(axis=1))
            measured += map(Measured, power, power.mean(axis=1).tolist(), spectra, sound_shares(samples).tolist())
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
            self._edges.restart()
        self._frame_index = cut.frame_index
        self._edges.push(cut)
        is_dropout = not self._is_silence_background and measured.sound_share < LEAST_SOUND
        if measured.power < DIGITAL_SILENCE or is_dropout:
            return self._take_silence(cut, measured, state)
        if self._frames_since_silence is not None:
            self._begin_after_silence(measured)
            self._frames_since_silence += 1
        return self._take_sound(cut, measured, state)

    def _begin_after_silence(self, measured: Measured) -> None:
        """Take digital silence for the background if what ends it begins as sound does."""
        if self._frames_since_silence != 0:
            return
        self._edges.begin()
        is_long = self._silent_frames >= LEAST_SILENT_FRAMES
        if is_long and not self._is_silence_background and self._edges.begins_as_sound():
            self._trust_silence(measured)
            self._activity, self._warm_up = CausalActivity(self._parameters), None
            self._activity.prime(0.0)

    def _trust_silence(self, measured: Measured) -> None:
        """Take digital silence for the background, of which a tone that was all that was learned is not a part."""
        self._is_silence_background = True
        self._background.learn_silence(len(measured.spectrum))

    def _take_sound(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        is_whole = self._is_whole(measured)
        found_hum = is_whole and self._background.learn(measured.spectrum)
        if found_hum and (self._warm_up is None or self._activity.floor_power > 0.0):
            self._activity.restart(self._background.usual_power, self._background.changing_maximum)
        if is_whole:
            self._edges.note_level(self._level(measured))
        if self._warm_up is not None:
            return self._hold_back(cut, measured, state)
        return self._decide(cut, measured, state, active=self._is_active(measured))

    def _is_whole(self, measured: Measured) -> bool:
        """Return whether a frame has no dropout; where silence is the background, none has."""
        return measured.sound_share == 1.0 or self._is_silence_background

    def _is_active(self, measured: Measured) -> bool:
        """Apply the activity rule to the next frame. One with a dropout is no measure of the background."""
        level, least = self._level(measured), self._parameters.least_power(self._activity.floor_power)
        if not self._is_whole(measured) and level < DROPOUT_MARGIN * least:
            return False
        return self._activity.push(level)

    def _level(self, measured: Measured) -> float:
        """Return the level of a frame, full scale squared, without dropouts unless silence is the background."""
        power = self._background.changing_power(measured.spectrum)
        return power if self._is_silence_background else power / max(measured.sound_share, LEAST_SOUND)

    def _take_silence(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        """Take in a frame of digital silence, which is the background after a sound that ended in it."""
        since, was_background = self._frames_since_silence, self._is_silence_background
        if since != 0:
            ends_as_sound = self._edges.ends_as_sound()
            if not ends_as_sound:
                self._is_silence_background = False
            elif since is not None and since <= self._floor_frames and not was_background:
                self._trust_silence(measured)
        self._silent_frames = 1 if since != 0 else self._silent_frames + 1
        self._frames_since_silence = 0
        messages: list[Message] = []
        if self._warm_up:
            messages = self._end_warm_up(state, 0.0 if self._is_silence_background else None)
        if self._is_silence_background:
            self._warm_up = None
            return messages + self._take_sound(cut, measured, state)
        if messages or was_background or self._silent_frames == self._floor_frames:
            self._activity, self._warm_up = CausalActivity(self._parameters), []
        return messages + self._decide(cut, measured, state, active=False)

    def _hold_back(self, cut: Cut, measured: Measured, state: FramerState) -> list[Message]:
        """Hold a frame back for the warm-up, and after silence for as long as a steady sound may turn out to end."""
        held = self._warm_up = [*(self._warm_up or []), (cut, measured)]
        is_primed = self._activity.floor_power > 0.0
        if len(held) < WARM_UP_FRAMES and not is_primed:
            return []
        if self._frames_since_silence is None:
            return self.flush(state)
        if not is_primed:
            self._activity.prime(self._quietest(held))
        levels = [self._level(known) for _, known in held if self._is_whole(known)]
        if len(levels) > COMPARED and FALLEN * sum(levels[-COMPARED:]) <= sum(levels[:COMPARED]):
            return self._end_warm_up(state, min(levels))
        begins = max(levels, default=0.0) >= self._parameters.least_power(self._activity.floor_power)
        if begins or self._frames_since_silence * FRAME_S >= HELD_S:
            return self.flush(state)
        decided = 1 + len(held) - HELD_FRAMES
        self._warm_up = held[decided:]
        return self._decide_all(held[:decided], state)

    def flush(self, state: FramerState) -> list[Message]:
        """End the warm-up, as the end of a short stream must."""
        return self._end_warm_up(state)

    def _end_warm_up(self, state: FramerState, floor_power: float | None = None) -> list[Message]:
        """Decide about the frames that are held back, over a given background, the known one, or the quietest frame."""
        held, self._warm_up = self._warm_up or [], None
        if floor_power is not None:
            self._activity.prime(floor_power)
        elif held and self._activity.floor_power == 0.0:
            self._activity.prime(self._quietest(held))
        return self._decide_all(held, state)

    def _decide_all(self, held: Iterable[tuple[Cut, Measured]], state: FramerState) -> list[Message]:
        return [
            message for cut, known in held for message in self._decide(cut, known, state, active=self._is_active(known))
        ]

    def _quietest(self, held: Sequence[tuple[Cut, Measured]]) -> float:
        """Return the lowest level of some frames, without those with dropouts, and the first if the device fades in."""
        fades_in = len(held) > 1 and _fades_in(self._selected(held[0][0]))
        settled = [known for _, known in (held[1:] if fades_in else held)]
        whole = [known for known in settled if self._is_whole(known)]
        return min(self._level(known) for known in whole or settled)

    def backfill(self, first: int, last: int) -> list[Message]:
        """Return the remembered frames from `first` to `last`, both included, whether or not they were sent."""
        return [self._requested_frame(cut, power) for cut, power in self._recent if first <= cut.frame_index <= last]

    def _selected(self, cut: Cut) -> Float32Array:
        return cut.samples[self._channels]

    def _decide(self, cut: Cut, measured: Measured, state: FramerState, *, active: bool) -> list[Message]:
        power = self._background.changing_power(measured.spectrum)
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
