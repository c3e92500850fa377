"""Cuts the frames of one array into one recording around an event; gaps are filled by zeros and listed.

How long before and after an event is kept is a setting: `ClipsConfig` in `site/server_models.py`.

`record` writes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.enhance.beam import ArraySound
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, BoolArray, Float32Array, Frame, read_only

GUARD_NS: Final = FRAME_NS
"""Time, in nanoseconds, before an event's first active frame that does not count as quiet: a sound can begin in a frame
that is too quiet to be active."""


@dataclass(frozen=True, slots=True)
class CutFrame:
    """A frame's place in a recording, and what its node and the fusion said about it.

    Parameters
    ----------
    frame_index : int
        Index on the joint grid of frames, from which the known offset of the array's clock, in whole frames, is
        subtracted.
    begin, length : int
        Number of its first sample in the recording, and number of its samples.
    power : float
        In-band mean power, full scale squared.
    active, requested : bool
        As in `Frame`.
    """

    frame_index: int
    begin: int
    length: int
    power: float
    active: bool
    requested: bool


@dataclass(frozen=True, slots=True)
class Cut:
    """The samples that an array recorded around an event.

    Parameters
    ----------
    spec : ArraySpec
    time_ns : int
        Site time of the first sample, in nanoseconds, corrected by the known offset of the array's clock.
    sample_rate_hz : float
    samples : (K, n) float32
        Zero where frames are missing.
    gaps_s : tuple of (float, float)
        Begin and end of each gap, in seconds after the first sample.
    known, active : (n,) bool
        Where there are samples, and where the array's activity detection found sound.
    frames : tuple of CutFrame
        The frames that it was joined from, in order.
    """

    spec: ArraySpec
    time_ns: int
    sample_rate_hz: float
    samples: Float32Array
    gaps_s: tuple[tuple[float, float], ...]
    known: BoolArray
    active: BoolArray
    frames: tuple[CutFrame, ...]

    def __post_init__(self) -> None:
        for array in (self.samples, self.known, self.active):
            read_only(array)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return float(self.samples.shape[1] / self.sample_rate_hz)

    def sound(self, start_ns: int, end_ns: int) -> ArraySound:
        """Return this cut as input of the enhancement; the times span the event's active frames, in site time."""
        begin, end = (round((at_ns - self.time_ns) / 1e9 * self.sample_rate_hz) for at_ns in (start_ns, end_ns))
        at = np.arange(len(self.known))
        before = at < begin - round(GUARD_NS / 1e9 * self.sample_rate_hz)
        earlier = np.flatnonzero(self.active & before)
        quiet = self.known & before & (at > (earlier[-1] if len(earlier) else -1))
        during = self.known & (at >= begin) & (at < end)
        return ArraySound(self.spec, self.time_ns, self.sample_rate_hz, self.samples, self.known, quiet, during)


def cut(spec: ArraySpec, frames: Sequence[Frame], offset_ns: int = 0, frames_ahead: int = 0) -> Cut | None:
    """Return the recording that frames of one array make.

    Parameters
    ----------
    spec : ArraySpec
    frames : sequence of Frame
        In order of their frame indices, each once; frames whose rate or number of channels differs from that of the
        last one are left out.
    offset_ns : int
        How far the array's clock is ahead.
    frames_ahead : int
        The part of `offset_ns`, in whole frames, by which the fusion corrects the array's frame indices. The indices of
        `frames` are not corrected.

    Returns
    -------
    Cut or None
        None without frames.
    """
    if not frames:
        return None
    rate_hz, channels = frames[-1].sample_rate_hz, len(spec.microphones_m)
    used = [frame for frame in frames if frame.sample_rate_hz == rate_hz and len(frame.samples) == channels]
    if not used:
        return None
    parts: list[Float32Array] = []
    known: list[BoolArray] = []
    active: list[BoolArray] = []
    gaps_s: list[tuple[float, float]] = []
    placed: list[CutFrame] = []
    length = 0

    def add(samples: Float32Array, is_known: bool, is_active: bool) -> None:
        parts.append(samples)
        known.append(np.full(samples.shape[1], is_known))
        active.append(np.full(samples.shape[1], is_active))

    for number, frame in enumerate(used):
        missing = 0 if number == 0 else frame.frame_index - used[number - 1].frame_index - 1
        if missing > 0:
            count = round(missing * FRAME_S * rate_hz)
            gaps_s.append((length / rate_hz, (length + count) / rate_hz))
            add(np.zeros((channels, count), dtype=np.float32), False, False)
            length += count
        count, index = frame.samples.shape[1], frame.frame_index - frames_ahead
        placed.append(CutFrame(index, length, count, frame.power, frame.active, frame.requested))
        add(frame.samples, True, frame.active)
        length += count
    joined = np.concatenate(parts, axis=1)
    time_ns = used[0].time_ns - offset_ns
    masks = np.concatenate(known), np.concatenate(active)
    return Cut(spec, time_ns, rate_hz, joined, tuple(gaps_s), *masks, tuple(placed))
