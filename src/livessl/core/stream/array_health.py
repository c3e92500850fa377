"""Decides the health of an array (healthy, quiet, degraded, lost, disabled), its reason, and dead or weak channels.

`ArrayHealth.state` is the only function that decides the state. The module also keeps the figures of each array.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import band_bins, dead_channels
from livessl.core.stream.clock_offsets import ClockOffset, clock_is_off
from livessl.core.stream.outlier_votes import Votes, is_suspect
from livessl.core.types import FRAME_S, ClockState, Float32Array, Frame, Mark

LOST_NS: Final = 1_500_000_000
"""Time, in nanoseconds, without a message after which an array is lost. Messages arrive every 50 ms, and clients
must be notified of a loss within 2 s."""

TROUBLE_NS: Final = 10_000_000_000
"""Time, in nanoseconds, for which an array stays degraded after a fault was last observed."""

DEAD_CHANNEL_NS: Final = 1_000_000_000
"""Time, in nanoseconds, after which a channel of all-zero samples counts as a dead microphone. Working microphones
always have noise."""

WEAK_FRAMES: Final = 10
"""Interval, in active frames, at which channels are checked for missing sound; a fault is reported after a second."""

HUM: Final = 10.0
"""Ratio of a quiet frame's power to the background from which hum or rumble is reported. Without hum or rumble, quiet
frames stay below four times the background."""

HUM_MARKS: Final = 20
"""Number of consecutive quiet frames, one second, after which hum or rumble is reported."""

_ZERO_STRIDE: Final = 64
"""Interval, in samples, at which a channel is checked for zeros. All samples of a channel that seems silent are then
checked."""


class ArrayState(StrEnum):
    """State of an array."""

    STARTING = "starting"
    HEALTHY = "healthy"
    QUIET = "quiet"
    DEGRADED = "degraded"
    LOST = "lost"
    DISABLED = "disabled"


@dataclass(frozen=True, slots=True)
class NodeReport:
    """Further facts about an array: from its node's messages without sound, from past sounds, and from the operator.

    Parameters
    ----------
    problem : str or None
        Fault of its device that the node reports.
    is_live : bool
        Whether the node has recently sent any message, with or without sound.
    is_disabled : bool
        Whether an operator has disabled the array.
    finding : str or None
        What is wrong with its clock, or what past sounds say is wrong with its channels or its pose.
    """

    problem: str | None = None
    is_live: bool = False
    is_disabled: bool = False
    finding: str | None = None


@dataclass(frozen=True, slots=True)
class ArrayStatus:
    """One array's health and figures, for people; powers in full scale squared, `age_s` since its last message."""

    name: str
    state: ArrayState
    reason: str | None
    active: bool
    age_s: float | None
    power: float | None
    noise_power: float | None
    channel_power: tuple[float, ...]
    sample_rate_hz: float | None
    drift_ppm: float | None
    clock: ClockState | None
    counters: Mapping[str, int]
    agreed: int = 0
    disagreed: int = 0
    """Number of the last events with a consensus in which the array agreed with it, and in which it was an outlier."""
    clock_offset: ClockOffset | None = None
    corrected_frames: int = 0


@dataclass(slots=True)
class ArrayHealth:
    """Faults and figures of one array, from its messages."""

    microphones: int
    counters: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("frames", "marks", "late", "rejected", "lost_frames", "overflows"), 0)
    )
    mark: Mark | None = None
    power: float | None = None
    active: bool = False
    fault: str = ""
    fault_ns: int | None = None
    dead: tuple[int, ...] = ()  # channels from 1, of all-zero samples
    dead_since_ns: int = 0
    weak: tuple[int, ...] = ()  # channels from 1, with next to nothing of a sound that the others receive
    weak_since_ns: int = 0
    hum_marks: int = 0  # quiet frames in a row with hum or rumble
    hum_power: float = 0.0
    hum_hz: float | None = None  # strongest frequency, once a quiet frame has come

    def note(self, now_ns: int, fault: str) -> None:
        """Note a fault, in words."""
        self.fault_ns, self.fault = now_ns, fault

    def reject(self, now_ns: int, fault: str) -> None:
        """Count a message that is not used, and note the reason."""
        self.counters["rejected"] += 1
        self.note(now_ns, fault)

    def note_late(self, now_ns: int, frames: int = 0) -> None:
        """Note that the array is late; `frames` is the number of late frames that have arrived, which may be 0."""
        self.counters["late"] += frames
        self.note(now_ns, "its frames come after their deadline")

    def count_frame(self) -> None:
        """Count a frame that is used."""
        self.counters["frames"] += 1

    def take_frame(self, frame: Frame, band_hz: tuple[float, float], now_ns: int) -> None:
        """Take in the newest frame of an array with this band."""
        self.power, self.active = frame.power, frame.active
        if not frame.samples.size:
            return
        self._find_dead(now_ns, _alive(frame.samples))
        if frame.active and frame.frame_index % WEAK_FRAMES == 0:
            self._find_weak(now_ns, frame.samples)
        if self.hum_marks >= HUM_MARKS and self.hum_hz is None and not frame.active:
            self.hum_hz = strongest_hz(frame.samples, frame.sample_rate_hz, band_hz)

    def take_mark(self, mark: Mark, now_ns: int, *, is_newest: bool) -> None:
        """Take in a mark; `is_newest` is False if a message of a later frame index arrived before it."""
        self.counters["marks"] += 1
        if self.mark is not None:
            if mark.overflows > self.mark.overflows:
                self.note(now_ns, "its device loses samples; use larger blocks or a less busy machine")
            elif mark.lost_frames > self.mark.lost_frames:
                self.note(now_ns, "the device skipped samples; frames at the gap were dropped")
        if mark.clock is ClockState.STEPPED:
            self.note(now_ns, "its clock has stepped")
        self.counters["overflows"], self.counters["lost_frames"] = mark.overflows, mark.lost_frames
        if is_newest:
            self.mark, self.power, self.active = mark, mark.power, False
            self._find_dead(now_ns, (power > 0.0 for power in mark.channel_power))
            self._find_hum(mark)

    def state(
        self,
        now_ns: int,
        *,
        age_ns: int | None,
        has_left: bool,
        votes: Votes,
        clock_offset: ClockOffset | None,
        node: NodeReport,
        channel_fault: str | None = None,
    ) -> tuple[ArrayState, str | None]:
        """Decide the array's state; return it and the reason for it.

        Parameters
        ----------
        now_ns : int
        age_ns : int or None
            Time since the last message of the array, nanoseconds; None before the first message.
        has_left : bool
            Whether the node of the array has ended on purpose.
        votes : Votes
        clock_offset : ClockOffset or None
            Offset of the node's clock; None if it is not known.
        node : NodeReport
        channel_fault : str or None
            Fault of its channels, in words, because of which its sound is not used; None without a fault.
        """
        state, reason = self._state_by_messages(now_ns, age_ns, votes, has_left=has_left)
        if channel_fault is not None and state in (ArrayState.HEALTHY, ArrayState.DEGRADED):
            state, reason = ArrayState.DEGRADED, f"not used: {channel_fault}"
        if state is ArrayState.HEALTHY and clock_offset is not None and abs(clock_offset.offset_s) > FRAME_S:
            state, reason = ArrayState.DEGRADED, clock_is_off(clock_offset)
        if node.finding is not None and state in (ArrayState.HEALTHY, ArrayState.DEGRADED):
            state, reason = ArrayState.DEGRADED, node.finding
        if node.problem is not None:
            state, reason = ArrayState.DEGRADED if state is ArrayState.HEALTHY else state, node.problem
        if state is ArrayState.LOST and node.is_live:
            state, reason = ArrayState.QUIET, node.problem or "its node is there, but no sound comes from its device"
        if node.is_disabled:
            otherwise = f"{state}: {reason}" if reason else state
            reason = f"an operator has disabled it, and its sound is not used; otherwise {otherwise}"
            state = ArrayState.DISABLED
        return state, reason

    def _state_by_messages(
        self, now_ns: int, age_ns: int | None, votes: Votes, *, has_left: bool
    ) -> tuple[ArrayState, str | None]:
        troubled = self.fault_ns is not None and now_ns - self.fault_ns < TROUBLE_NS
        if age_ns is None:
            return (ArrayState.DEGRADED, self.fault) if troubled else (ArrayState.STARTING, "no message yet")
        if has_left:
            return ArrayState.LOST, "its node has ended"
        if age_ns >= LOST_NS:
            silence = f"no message for {age_ns / 1e9:.1f} s"
            return ArrayState.LOST, f"{silence}; before that, {self.fault}" if troubled else silence
        reason = self._channel_fault(now_ns) or (self.fault if troubled else _disagreement(votes))
        return (ArrayState.HEALTHY, self._hum()) if reason is None else (ArrayState.DEGRADED, reason)

    def _hum(self) -> str | None:
        """Return a note on hum or rumble, which does not stop an array from working; None without hum or rumble."""
        if self.hum_marks < HUM_MARKS:
            return None
        where = "" if self.hum_hz is None else f", strongest near {self.hum_hz:.0f} Hz"
        level = f"steady hum or rumble at {10.0 * np.log10(self.hum_power):.0f} dBFS{where}"
        return f"{level}, is not counted as sound; look for a ground loop, a fan or a lamp"

    def _channel_fault(self, now_ns: int) -> str | None:
        if self.dead and now_ns - self.dead_since_ns >= DEAD_CHANNEL_NS:
            which = "all channels are" if len(self.dead) == self.microphones else f"microphone {list(self.dead)} is"
            return f"{which} dead: all-zero samples; check cable, gain and channel numbers"
        if self.weak and now_ns - self.weak_since_ns >= DEAD_CHANNEL_NS:
            which = f"microphone {list(self.weak)} receives next to nothing of what the others receive, and is excluded"
            return f"{which}; check cable, gain and channel numbers"
        return None

    def _find_dead(self, now_ns: int, alive: Iterable[bool]) -> None:
        dead = tuple(k for k, lives in enumerate(alive, start=1) if not lives)
        if dead and not self.dead:
            self.dead_since_ns = now_ns
        self.dead = dead

    def _find_hum(self, mark: Mark) -> None:
        self.hum_power = mark.power
        self.hum_marks = self.hum_marks + 1 if 0.0 < HUM * mark.noise_power <= mark.power else 0
        if not self.hum_marks:
            self.hum_hz = None

    def _find_weak(self, now_ns: int, samples: Float32Array) -> None:
        weak = tuple(k for k, dead in enumerate(dead_channels([samples]).tolist(), start=1) if dead)
        if weak and not self.weak:
            self.weak_since_ns = now_ns
        self.weak = weak


def is_connected(last_message_ns: int | None, now_ns: int) -> bool:
    """Return whether the last message came less than `LOST_NS` ago."""
    return last_message_ns is not None and now_ns - last_message_ns < LOST_NS


def strongest_hz(samples: Float32Array, sample_rate_hz: float, band_hz: tuple[float, float]) -> float:
    """Return the frequency, in hertz, at which the channels (K, n) together are strongest within a band."""
    count = samples.shape[1]
    spectra = scipy.fft.rfft(samples * np.hanning(count).astype(np.float32), axis=1)
    low, high = band_bins(count, sample_rate_hz, band_hz)
    power = (spectra.real**2 + spectra.imag**2).sum(axis=0)[low:high]
    peak = int(power.argmax())
    around = power[max(0, peak - 1) : peak + 2]  # the centre of the window's main lobe
    first = low + max(0, peak - 1)
    return float((np.arange(first, first + len(around)) @ around) / around.sum() * sample_rate_hz / count)


def _disagreement(votes: Votes) -> str | None:
    if not is_suspect(votes):
        return None
    off_deg = [off for _, off in votes if off is not None]
    events = f"{len(off_deg)} of the last {len(votes)} events, by {np.median(off_deg):.0f}°"
    return f"an outlier in {events}; check its pose and the order of its channels"


def _alive(samples: Float32Array) -> list[bool]:
    """Return which channels are not all zeros."""
    if all(samples[:, 0].tolist()):
        return [True] * len(samples)
    alive: list[bool] = np.asarray(np.any(samples[:, ::_ZERO_STRIDE], axis=1)).tolist()
    return alive if all(alive) else np.asarray(np.any(samples, axis=1)).tolist()
