"""Keeps one array's frames on the joint frame index, their correlations, and whether the array is awaited."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from livessl.core.correlate.band import band_power
from livessl.core.stream.array_health import LOST_NS, ArrayHealth, ArrayStatus, NodeReport
from livessl.core.stream.clock_offsets import ClockOffset
from livessl.core.stream.correlation_cache import Correlations
from livessl.core.stream.outlier_votes import Votes
from livessl.core.types import ArraySpec, Frame


@dataclass(slots=True)
class ArrayStream:
    """The frames of one array that a result may still need, and the frame index that the array has reached."""

    spec: ArraySpec
    health: ArrayHealth
    frames_ahead: int = 0  # whole frames that its clock is ahead, subtracted from its frame indices
    rest_ns: int = 0  # the rest of its clock's offset, subtracted from the times of events
    frames: dict[int, Frame] = field(default_factory=dict)
    complete_until: int | None = None  # all up to this frame index has come
    last_message_ns: int | None = None
    keeps_up: bool = True  # False after it missed a deadline, until it has caught up
    has_left: bool = False
    sample_rate_hz: float | None = None
    correlations: Correlations = field(default_factory=Correlations)
    upcoming: Correlations = field(default_factory=Correlations)  # for the sound that may follow this one

    def renewed(self) -> ArrayStream:
        """Return an empty stream of the same array with the same counters and the same correction of its clock."""
        health = ArrayHealth(self.health.microphones, self.health.counters)
        return ArrayStream(self.spec, health, self.frames_ahead, self.rest_ns)

    def is_newest(self, frame_index: int) -> bool:
        """Return whether no message of a later frame index has arrived."""
        return self.complete_until is None or frame_index >= self.complete_until

    def advance(self, frame_index: int, now_ns: int) -> None:
        """Record that all messages up to a frame index have arrived."""
        self.last_message_ns, self.has_left = now_ns, False
        self.complete_until = frame_index if self.complete_until is None else max(self.complete_until, frame_index)

    def catch_up(self) -> None:
        """Record that the array keeps up with the others and can be awaited."""
        self.keeps_up = True

    def fall_behind(self) -> None:
        """Record that the array does not keep up; it is no longer awaited."""
        self.keeps_up = False

    def leave(self) -> None:
        """Record that the array's node has ended on purpose."""
        self.has_left = True

    def add(self, frame: Frame) -> None:
        """Add a frame. A new sampling rate means another device, and discards all earlier frames."""
        if frame.sample_rate_hz != self.sample_rate_hz:
            self.frames.clear()
            self.discard_correlations()
            self.sample_rate_hz = frame.sample_rate_hz
        self.frames[frame.frame_index] = frame

    def has_active(self, frame_index: int) -> bool:
        """Return whether there is an active frame at a frame index."""
        frame = self.frames.get(frame_index)
        return frame is not None and frame.active

    def segments(self, frame_indices: Iterable[int]) -> tuple[list[list[Frame]], list[int]]:
        """Return the frames at ascending frame indices, split where one is missing, and the indices present."""
        segments: list[list[Frame]] = []
        there: list[int] = []
        for frame_index in frame_indices:
            frame = self.frames.get(frame_index)
            if frame is None:
                continue
            if not there or frame_index != there[-1] + 1:
                segments.append([])
            segments[-1].append(frame)
            there.append(frame_index)
        return segments, there

    def release_samples(self, before: int) -> None:
        """Release the samples of the frames before a frame index; the frames are kept without samples."""
        for frame_index, frame in self.frames.items():
            if frame_index < before and frame.samples.size:
                self.frames[frame_index] = frame.without_samples()

    def has_samples(self, frame_indices: Iterable[int]) -> bool:
        """Return whether all frames at these indices still have their samples."""
        return all(self.frames[frame_index].samples.size for frame_index in frame_indices if frame_index in self.frames)

    def correct_clock(self, frames_ahead: int, rest_ns: int) -> int:
        """Correct the clock by `frames_ahead` and `rest_ns`; return by how many frames the correction has grown."""
        self.rest_ns = rest_ns
        more = frames_ahead - self.frames_ahead
        if more:
            self.frames_ahead = frames_ahead
            self.frames = {k - more: replace(frame, frame_index=k - more) for k, frame in self.frames.items()}
            if self.complete_until is not None:
                self.complete_until -= more
            self.discard_correlations()
        return more

    def begin_correlations(self, *, from_upcoming: bool = False) -> None:
        """Begin the correlations of a sound anew, or with those that were made ahead for it."""
        self.correlations = self.upcoming if from_upcoming else Correlations()

    def begin_upcoming(self) -> None:
        """Begin the correlations for the next sound anew."""
        self.upcoming = Correlations()

    def discard_correlations(self) -> None:
        """Discard all correlations of the frames."""
        self.correlations, self.upcoming = Correlations(), Correlations()

    def prune(self, oldest: int) -> None:
        """Discard the frames and correlations before a frame index."""
        frames, onsets = self.frames, self.correlations.onsets
        while frames and (first := next(iter(frames))) < oldest:
            del frames[first]
        while onsets and (first := next(iter(onsets))) < oldest:
            del onsets[first]

    def status(
        self,
        now_ns: int,
        votes: Votes,
        offset: ClockOffset | None,
        node: NodeReport,
        channel_fault: str | None = None,
        *,
        levels: bool,
    ) -> ArrayStatus:
        """Return the array's status; without `levels` it has no channel powers. Any thread may call it."""
        health, mark = self.health, self.health.mark
        age_ns = None if self.last_message_ns is None else max(0, now_ns - self.last_message_ns)
        is_lost = age_ns is not None and (self.has_left or age_ns >= LOST_NS)
        state, reason = health.state(
            now_ns,
            age_ns=age_ns,
            has_left=self.has_left,
            votes=votes,
            clock_offset=offset,
            node=node,
            channel_fault=channel_fault,
        )
        return ArrayStatus(
            name=self.spec.name,
            state=state,
            reason=reason,
            active=health.active and not is_lost,
            age_s=None if age_ns is None else age_ns / 1e9,
            power=health.power,
            noise_power=mark.noise_power if mark else None,
            channel_power=self._channel_power() if levels else (),
            sample_rate_hz=self.sample_rate_hz,
            drift_ppm=mark.drift_ppm if mark else None,
            clock=mark.clock if mark else None,
            counters=dict(health.counters),
            agreed=sum(off_deg is None for _, off_deg in votes),
            disagreed=sum(off_deg is not None for _, off_deg in votes),
            clock_offset=offset,
            corrected_frames=self.frames_ahead,
        )

    def _channel_power(self) -> tuple[float, ...]:
        """Return the channels' powers at the newest frame index, from its frame or mark."""
        newest = self.frames.get(self.complete_until) if self.complete_until is not None else None
        if newest is not None and newest.samples.size:
            return tuple(float(power) for power in band_power(newest.samples, newest.sample_rate_hz, self.spec.band_hz))
        return self.health.mark.channel_power if self.health.mark else ()
