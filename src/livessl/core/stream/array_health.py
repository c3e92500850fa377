"""What the server knows of each array: its frames, how it is doing, and whether the others agree with it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np

from livessl.core.correlate.band import band_power, dead_channels
from livessl.core.stream.backfill import Allowance
from livessl.core.stream.clock_offsets import ClockOffset, clock_is_off
from livessl.core.stream.correlation_cache import Ear
from livessl.core.types import FRAME_S, ArraySpec, ClockState, Float32Array, Frame, Mark

LOST_NS: Final = 1_500_000_000
"""An array not heard from for so long is lost: marks come every 50 ms, and everyone shall know within 2 s."""

TROUBLE_NS: Final = 10_000_000_000
"""How long a fault keeps an array degraded after it was last seen."""

SILENT_NS: Final = 1_000_000_000
"""All-zero samples for so long are a dead microphone: any real one has noise."""

VOTES: Final = 10
"""Sounds that an array's agreement with the others is told of."""

LEAST_VOTES: Final = 3
"""An array is doubted that was outvoted so often, and in more than half of the last `VOTES` sounds; until it has agreed
so often in a row."""

Votes = tuple[tuple[int, float | None], ...]
"""Of the last sounds, by the frame index each began at: by what angle the array was off, None where it agreed."""


class ArrayState(StrEnum):
    """How an array is doing, as the server sees it."""

    STARTING = "starting"
    HEALTHY = "healthy"
    QUIET = "quiet"
    DEGRADED = "degraded"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class ArrayStatus:
    """One array, for people: powers in full scale squared, age since anything was heard from it."""

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
    """In how many of the last sounds that three arrays or more heard it agreed with the others, and in how many not."""
    clock_offset: ClockOffset | None = None
    corrected_frames: int = 0


@dataclass(slots=True)
class Stream:
    """What is known of one array."""

    spec: ArraySpec
    frames: dict[int, Frame] = field(default_factory=dict)
    watermark: int | None = None
    heard_ns: int | None = None
    waited_for: bool = True
    mark: Mark | None = None
    power: float | None = None
    active: bool = False
    rate_hz: float | None = None
    dead: tuple[int, ...] = ()  # channels from 1, of all-zero samples
    dead_since_ns: int = 0
    weak: tuple[int, ...] = ()  # channels from 1, that hear next to nothing of what the others hear
    weak_since_ns: int = 0
    trouble_ns: int | None = None
    trouble: str = ""
    left: bool = False
    ahead: int = 0  # whole frames that its clock is ahead, taken off what it sends
    rest_ns: int = 0  # that it is ahead besides
    allowance: Allowance = field(default_factory=Allowance)
    ear: Ear = field(default_factory=Ear)
    next_ear: Ear = field(default_factory=Ear)  # for the sound that may come after this one
    counters: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("frames", "marks", "late", "rejected", "lost_frames", "overflows"), 0)
    )

    def worry(self, now_ns: int, what: str) -> None:
        """Take note of a fault, in words."""
        self.trouble_ns, self.trouble = now_ns, what

    def find_dead(self, now_ns: int, alive: Iterable[bool]) -> None:
        """Take note of the channels that had anything but zeros."""
        dead = tuple(k for k, lives in enumerate(alive, start=1) if not lives)
        if dead and not self.dead:
            self.dead_since_ns = now_ns
        self.dead = dead

    def find_weak(self, now_ns: int, samples: Float32Array) -> None:
        """Take note of the channels that hear nothing of a sound."""
        weak = tuple(k for k, dead in enumerate(dead_channels([samples]).tolist(), start=1) if dead)
        if weak and not self.weak:
            self.weak_since_ns = now_ns
        self.weak = weak

    def has_active(self, frame_index: int) -> bool:
        """Whether its frame of a frame index is there, and active."""
        frame = self.frames.get(frame_index)
        return frame is not None and frame.active

    def segments(self, frame_indices: Sequence[int]) -> tuple[list[list[Frame]], list[int]]:
        """The frames at `rasters` (ascending), cut wherever one is missing; and the rasters that are there."""
        pieces: list[list[Frame]] = []
        there: list[int] = []
        for frame_index in frame_indices:
            frame = self.frames.get(frame_index)
            if frame is None:
                continue
            if not there or frame_index != there[-1] + 1:
                pieces.append([])
            pieces[-1].append(frame)
            there.append(frame_index)
        return pieces, there

    def let_go(self, before: int) -> None:
        """Let the samples of its frames before a frame index go; what else is known of them stays."""
        for frame_index, frame in self.frames.items():
            if frame_index < before and frame.samples.size:
                self.frames[frame_index] = replace(frame, samples=frame.samples[:, :0].copy())

    def keeps(self, frame_indices: Iterable[int]) -> bool:
        """Whether the samples of all of its frames at `rasters` are still there."""
        return all(self.frames[frame_index].samples.size for frame_index in frame_indices if frame_index in self.frames)

    def move(self, frames: int) -> None:
        """Take it that its clock is ahead by so many frames more."""
        self.ahead += frames
        self.frames = {r - frames: replace(frame, frame_index=r - frames) for r, frame in self.frames.items()}
        if self.watermark is not None:
            self.watermark -= frames
        self.forget()

    def forget(self) -> None:
        """Forget what was listened to."""
        self.ear, self.next_ear = Ear(), Ear()

    def take_mark(self, mark: Mark, now_ns: int) -> None:
        """Take in what a mark tells."""
        self.counters["marks"] += 1
        if self.mark is not None:
            if mark.overflows > self.mark.overflows:
                self.worry(now_ns, "its device loses samples; use larger blocks or a less busy machine")
            elif mark.lost_frames > self.mark.lost_frames:
                self.worry(now_ns, "frames were torn by a gap in the sound")
        if mark.clock is ClockState.STEPPED:
            self.worry(now_ns, "its clock has stepped")
        self.counters["overflows"], self.counters["lost_frames"] = mark.overflows, mark.lost_frames
        if self.watermark is None or mark.frame_index >= self.watermark:
            self.mark, self.power, self.active = mark, mark.power, False
            self.find_dead(now_ns, (power > 0.0 for power in mark.channel_power))

    def status(self, now_ns: int, votes: Votes, offset: ClockOffset | None, *, levels: bool) -> ArrayStatus:
        """How it is doing; without `levels` nothing is said of its channels' power."""
        mark = self.mark
        age_ns = None if self.heard_ns is None else max(0, now_ns - self.heard_ns)
        state, reason = self._state(age_ns, now_ns, votes)
        if state is ArrayState.HEALTHY and offset is not None and abs(offset.offset_s) > FRAME_S:
            state, reason = ArrayState.DEGRADED, clock_is_off(offset)
        return ArrayStatus(
            name=self.spec.name,
            state=state,
            reason=reason,
            active=self.active and state is not ArrayState.LOST,
            age_s=None if age_ns is None else age_ns / 1e9,
            power=self.power,
            noise_power=mark.noise_power if mark else None,
            channel_power=self._channel_power() if levels else (),
            sample_rate_hz=self.rate_hz,
            drift_ppm=mark.drift_ppm if mark else None,
            clock=mark.clock if mark else None,
            counters=dict(self.counters),
            agreed=sum(off_deg is None for _, off_deg in votes),
            disagreed=sum(off_deg is not None for _, off_deg in votes),
            clock_offset=offset,
            corrected_frames=self.ahead,
        )

    def _channel_power(self) -> tuple[float, ...]:
        """Of the newest interval, whether it was a mark or a frame."""
        newest = self.frames.get(self.watermark) if self.watermark is not None else None
        if newest is not None:
            return tuple(float(power) for power in band_power(newest.samples, newest.sample_rate_hz, self.spec.band_hz))
        return self.mark.channel_power if self.mark else ()

    def _state(self, age_ns: int | None, now_ns: int, votes: Votes) -> tuple[ArrayState, str | None]:
        troubled = self.trouble_ns is not None and now_ns - self.trouble_ns < TROUBLE_NS
        if age_ns is None:
            return (ArrayState.DEGRADED, self.trouble) if troubled else (ArrayState.STARTING, "not heard from yet")
        if self.left:
            return ArrayState.LOST, "its node has ended"
        if age_ns >= LOST_NS:
            silence = f"nothing heard from it for {age_ns / 1e9:.1f} s"
            return ArrayState.LOST, f"{silence}; before that, {self.trouble}" if troubled else silence
        if self.dead and now_ns - self.dead_since_ns >= SILENT_NS:
            every = len(self.dead) == len(self.spec.microphones_m)
            which = "all channels are" if every else f"microphone {list(self.dead)} is"
            return ArrayState.DEGRADED, f"{which} dead: all-zero samples; check cable, gain and channel numbers"
        if self.weak and now_ns - self.weak_since_ns >= SILENT_NS:
            which = f"microphone {list(self.weak)} hears nothing of what the others hear, and is left out"
            return ArrayState.DEGRADED, f"{which}; check cable, gain and channel numbers"
        if troubled:
            return ArrayState.DEGRADED, self.trouble
        if doubts(votes):
            off_deg = [off for _, off in votes if off is not None]
            told = f"{len(off_deg)} of the last {len(votes)} sounds, by {np.median(off_deg):.0f}°"
            return (
                ArrayState.DEGRADED,
                f"disagrees with the others in {told}: is its pose right, and its channels' order?",
            )
        return ArrayState.HEALTHY, None


def doubts(votes: Votes) -> bool:
    """Whether an array is to be doubted: see `LEAST_VOTES`."""
    off = [vote for vote in votes if vote[1] is not None]
    lately = any(vote[1] is not None for vote in votes[-LEAST_VOTES:])
    return len(off) >= LEAST_VOTES and 2 * len(off) > len(votes) and lately
