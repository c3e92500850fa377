"""Finds copied and inverted channels in live sound, and words why an array with them is not used.

An array with such a fault gives wrong directions with high confidence, so its sound is not used. This module uses
samples and correlations, and locates nothing. `array_health` finds dead and weak channels, and
`livessl.core.commission` finds swapped ones.

- *Copies.* Every microphone has its own noise, so two microphones never have the same signal in quiet frames, whatever
  the sound field. Two channels are copies if their signals are the same up to a factor. This is checked first in the
  differences from sample to sample, in which hum and rumble are small, and then in every part of the spectrum, so that
  a single tone is not enough.
- *Two arrays on the same channels.* The first samples of each channel are looked up among those of all other arrays at
  the same frame index, so that the cost of a frame does not grow with the number of arrays.
- *Inverted channels.* The GCC of a pair has its extreme at the delay of the direct sound. The extreme is negative if
one
  of the two channels is inverted. If the signs of the pairs are clear and consistent, they show which channels differ.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.geometry import microphone_pairs
from livessl.core.types import BoolArray, Float32Array, FloatArray, Frame

QUIET_FRAMES: Final = 3
"""Number of consecutive quiet frames in which channels must be the same to count as copies. There are quiet frames
before and after every sound."""

SHARED_FRAMES: Final = 2
"""Number of frames with sound in which channels must also be the same."""

COMPARED_FRAMES: Final = 4
"""Number of frames, from the beginning of a sound, in which an array's channels are compared."""

COPIED_SOUNDS: Final = 3
"""Number of consecutive sounds in which channels must be the same if the background is digital silence. Two microphones
can receive exactly the same signal from one sound if it comes from the plane midway between them."""

SAME: Final = 0.99
"""Least correlation, and least mean cosine of the phase differences, of channels that are the same. Copies give 1.
Distinct microphones give less than 0.9, because each adds its own noise."""

CLEAR: Final = 2.0
"""Least ratio between the positive and negative extremes of a pair's GCC at which its sign is clear. A sound of many
frequencies has a ratio of 3 to 5, a tone of 1."""

COHERENT: Final = 0.3
"""Least height of the larger extreme, relative to that of a single direct sound; noise stays below 0.15."""

INVERTED_SOUNDS: Final = 2
"""Number of sounds with the same signs, among the last `SIGNED_SOUNDS`, after which channels are reported as inverted.
A single such sound is located without the array if the array has at least `LEAST_SIGNS` channels."""

LEAST_SIGNS: Final = 3
"""Least number of channels of an array that is excluded because of a single sound. The sign of a single pair cannot be
checked by others, and it was wrong for 1 of 240 real claps because of reflections."""

SIGNED_SOUNDS: Final = 5
"""Number of latest sounds whose signs are kept."""

_PRINT_SAMPLES: Final = 48
"""Number of samples that identify a channel's frame. If one bit of each sample is noise, they have more possible values
than there will ever be frames."""

_COMPARED_SAMPLES: Final = 512
"""Number of samples that are compared first; if they differ, the rest of the frame is not examined."""

_PRINTED_FRAMES: Final = 64
"""Number of frame indices whose samples are remembered: 3 s, longer than any array may be late."""

Pair = tuple[int, int]


@dataclass(slots=True)
class _Likeness:
    """Counts the frames and sounds in which two channels, or the channels of two arrays, were the same."""

    quiet_frames: int = 0
    active_frames: int = 0
    sounds: int = 0

    def note(self, *, active: bool, begins: bool) -> None:
        self.quiet_frames += not active
        self.active_frames += active
        self.sounds += begins

    @property
    def is_copy(self) -> bool:
        """True if both sound and background were the same; simulated microphones may differ only in the sound."""
        background = self.quiet_frames >= QUIET_FRAMES or self.sounds >= COPIED_SOUNDS
        return background and self.active_frames >= SHARED_FRAMES


@dataclass(slots=True)
class _Channels:
    """State of one array's channels, which are counted from 0."""

    last_active: int | None = None
    active_frames: int = 0  # of the sound that goes on
    alike: dict[Pair, _Likeness] = field(default_factory=dict)
    signs: dict[int, tuple[int, ...]] = field(default_factory=dict)  # frame index of a sound's start -> signs


class ChannelFaults:
    """The faults of the channels of all arrays. Any thread may read the words, which are replaced and never changed.

    Parameters
    ----------
    arrays : iterable of str
        Names of the arrays.
    """

    def __init__(self, arrays: Iterable[str]) -> None:
        self._channels = {name: _Channels() for name in arrays}
        self._prints: dict[int, dict[str, list[bytes]]] = {}
        self._where: dict[int, dict[bytes, tuple[str, int]]] = {}
        self._shared: dict[frozenset[str], tuple[_Likeness, dict[str, list[int]]]] = {}
        self._words: dict[str, str] = {}

    def of(self, array: str) -> str | None:
        """Return the fault of an array's channels, in words; None without one."""
        return self._words.get(array)

    def among(self, arrays: Iterable[str]) -> dict[str, str]:
        """Return the faults, in words, of the given arrays that have one."""
        return {name: self._words[name] for name in arrays if name in self._words}

    def clear(self) -> None:
        """Forget everything."""
        self._channels = {name: _Channels() for name in self._channels}
        self._prints.clear()
        self._where.clear()
        self._shared.clear()
        self._words = {}

    # --- samples

    def take(self, frame: Frame) -> None:
        """Take in the newest frame of an array."""
        known = self._channels[frame.array]
        begins = frame.active and known.last_active != frame.frame_index - 1
        if frame.active:
            known.last_active = frame.frame_index
            known.active_frames = 1 if begins else known.active_frames + 1
        if not frame.active or known.active_frames <= COMPARED_FRAMES:
            self._compare(known, frame, begins=begins)
        self._look_up(frame, begins=begins)
        self._word(frame.array)

    def _compare(self, known: _Channels, frame: Frame, *, begins: bool) -> None:
        """Compare the channels of one array with one another."""
        comparable, same = _same(frame.samples)
        for pair in list(known.alike):
            if comparable[pair] and not same[pair]:
                del known.alike[pair]
        for first, second in np.argwhere(np.triu(same, 1)).tolist():
            known.alike.setdefault((first, second), _Likeness()).note(active=frame.active, begins=begins)

    def _look_up(self, frame: Frame, *, begins: bool) -> None:
        """Compare the channels of an array with those of all other arrays at the same frame index."""
        where = self._where.setdefault(frame.frame_index, {})
        printed = self._prints.setdefault(frame.frame_index, {})
        shared: dict[str, list[Pair]] = {}
        prints = [_print(channel) for channel in frame.samples]
        for channel, samples in enumerate(prints):
            other = where.get(samples) if samples else None
            if other is not None and other[0] != frame.array:
                shared.setdefault(other[0], []).append((channel, other[1]))
        for other_name in printed:
            both = frozenset((frame.array, other_name))
            if other_name not in shared and both in self._shared and any(prints):
                del self._shared[both]
                self._word(other_name)
        for other_name, pairs in shared.items():
            likeness, channels = self._shared.setdefault(frozenset((frame.array, other_name)), (_Likeness(), {}))
            channels[frame.array], channels[other_name] = [own for own, _ in pairs], [theirs for _, theirs in pairs]
            likeness.note(active=frame.active, begins=begins)
            self._word(other_name)
        printed[frame.array] = prints
        for channel, samples in enumerate(prints):
            if samples:
                where.setdefault(samples, (frame.array, channel))
        while len(self._where) > _PRINTED_FRAMES:
            oldest = next(iter(self._where))
            del self._where[oldest], self._prints[oldest]

    # --- correlations

    def examine(self, array: str, start: int, onsets: Sequence[OnsetGCC]) -> str | None:
        """Examine the sound of an array; return the fault, in words, because of which it must not be used.

        Parameters
        ----------
        array : str
        start : int
            Frame index at which the sound began. A sound that is examined again is counted once.
        onsets : sequence of OnsetGCC
            Correlations of its frames.
        """
        known = self._channels[array]
        signs = polarity(summed(onsets)) if onsets else None
        if signs is not None:
            known.signs.pop(start, None)
            known.signs[start] = signs
            while len(known.signs) > SIGNED_SOUNDS:
                del known.signs[next(iter(known.signs))]
            self._word(array)
        is_clear = signs is not None and min(signs) < 0 and len(signs) >= LEAST_SIGNS
        return self.of(array) or (_inverted(signs) if signs is not None and is_clear else None)

    # --- words

    def _word(self, array: str) -> None:
        words = self._fault(array)
        if words == self._words.get(array):
            return
        others = {name: fault for name, fault in self._words.items() if name != array}
        self._words = others if words is None else {**others, array: words}

    def _fault(self, array: str) -> str | None:
        known = self._channels[array]
        copies = [pair for pair, likeness in known.alike.items() if likeness.is_copy]
        if copies:
            return _copied(copies)
        for both, (likeness, channels) in self._shared.items():
            if array in both and likeness.is_copy:
                (other,) = both - {array}
                return _taken_twice(channels[array], other, channels[other])
        latest = list(known.signs.values())
        if latest and min(latest[-1]) < 0 and latest.count(latest[-1]) >= INVERTED_SOUNDS:
            return _inverted(latest[-1])
        return None


def polarity(onsets: OnsetGCC) -> tuple[int, ...] | None:
    """Return the sign of each channel relative to most others, 1 or -1; None if the signs are not clear.

    The signs follow from the pairs of one channel whose pairs are all clear. All other clear pairs must be consistent.
    """
    if np.iscomplexobj(onsets.lags):
        return None  # magnitudes have no sign
    count = len(onsets.levels)
    pairs = microphone_pairs(count)
    highest, lowest = onsets.lags.max(axis=1), -onsets.lags.min(axis=1)
    least = COHERENT * onsets.heights(pairs)[:, 0]
    signs = np.zeros((count, count), dtype=np.int64)
    signs[pairs[:, 0], pairs[:, 1]] = np.where((highest >= CLEAR * lowest) & (highest >= least), 1, 0) - np.where(
        (lowest >= CLEAR * highest) & (lowest >= least), 1, 0
    )
    signs += signs.T
    clear = np.count_nonzero(signs, axis=1)
    root = int(clear.argmax())
    if clear[root] < count - 1:
        return None
    each = signs[root].copy()
    each[root] = 1
    if np.any(signs * np.outer(each, each) < 0):
        return None
    if 2 * np.count_nonzero(each < 0) > count or (2 * np.count_nonzero(each < 0) == count and each[0] < 0):
        each = -each
    return tuple(each.tolist())


def _same(samples: Float32Array) -> tuple[BoolArray, BoolArray]:
    """Return which pairs of channels can be compared, and which are the same up to a factor: (K, K) each."""
    steps = np.diff(samples[:, : _COMPARED_SAMPLES + 1].astype(np.float64), axis=1)
    products = steps @ steps.T
    power = np.diag(products)
    comparable = np.outer(power, power) > 0.0
    same = comparable & (np.abs(products) >= SAME * np.sqrt(np.outer(power, power)))
    if np.triu(same, 1).any():
        for first, second in np.argwhere(np.triu(same, 1)):
            same[first, second] = _mean_cosine(samples[[first, second]]) >= SAME
    return comparable, same


def _mean_cosine(samples: Float32Array) -> float:
    """Return the absolute mean, over all frequencies, of the cosine of the phase difference of channels (2, n)."""
    spectra = scipy.fft.rfft(samples.astype(np.float64), axis=1)[:, 1:]
    cross = np.conj(spectra[0]) * spectra[1]
    size: FloatArray = np.abs(cross)
    known = size > 0.0
    return abs(float(np.mean(cross.real[known] / size[known]))) if known.any() else 0.0


def _print(channel: Float32Array) -> bytes:
    """Return bytes that identify a channel's frame (n,); empty if all samples are equal."""
    first = channel[:_PRINT_SAMPLES]
    return first.tobytes() if first.size and np.any(first != first[0]) else b""


def _copied(copies: Collection[Pair]) -> str:
    groups: list[set[int]] = []
    for pair in sorted(copies):
        joined = [group for group in groups if group & set(pair)]
        groups = [*(group for group in groups if group not in joined), set(pair).union(*joined)]
    which = "; ".join(f"channels {_listed(group)} are the same signal" for group in sorted(groups, key=min))
    return (
        f"{which}; check the cables, the routing of the device, and the channels in the site file (nodes.NAME.arrays)"
    )


def _taken_twice(own: Collection[int], other: str, theirs: Collection[int]) -> str:
    channels, be = ("channel", "is") if len(own) == 1 else ("channels", "are")
    same = f"its {channels} {_listed(own)} {be} the same signal as {channels} {_listed(theirs)} of {other!r}"
    return f"{same}; give each array channels of its own (nodes.NAME.arrays), and check the routing of the device"


def _inverted(signs: Sequence[int]) -> str:
    negative = [channel for channel, sign in enumerate(signs) if sign < 0]
    cure = "exchange the two signal wires of a plug (pins 2 and 3 of an XLR), or invert the channel in the device"
    if 2 * len(negative) == len(signs):
        positive = [channel for channel, sign in enumerate(signs) if sign > 0]
        channels = "channels" if len(negative) > 1 else "channel"
        return f"{channels} {_listed(negative)} and {channels} {_listed(positive)} have opposite polarity; {cure}"
    channels, be = ("channel", "is") if len(negative) == 1 else ("channels", "are")
    return f"{channels} {_listed(negative)} {be} inverted against the others; {cure}"


def _listed(channels: Iterable[int]) -> str:
    *most, last = (str(1 + channel) for channel in sorted(channels))
    return f"{', '.join(most)} and {last}" if most else last
