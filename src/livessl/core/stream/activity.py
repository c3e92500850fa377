"""Activity detection: from which level (threshold) on a frame is active, noise floor, default hang-over and pre-roll.

The rule (Garcia-Barrios et al., section on the sound activity detector): a frame is active if its mean power is at
least a tenth of the reference power. Over a finished event the reference is the event's maximum. Live it is a decaying
maximum with a lower limit, and the noise floor stays below a tenth of that limit. `CausalActivity` measures the noise
floor of an array: the smallest smoothed power of the last seconds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import FRAME_S, BoolArray, FloatArray

THRESHOLD: Final = 0.1
"""Share of the reference power at and above which a frame is active: the paper's 10 %."""

_FLOOR_SMOOTHING: Final = 5
"""Number of frames averaged before the minimum is taken: the power of single frames of low-pitched noise scatters by
several dB."""


def is_active(power: FloatArray, reference: float | FloatArray, threshold: float = THRESHOLD) -> BoolArray:
    """Apply the rule: active where power >= threshold * reference and power > 0."""
    return np.asarray((power >= threshold * np.asarray(reference)) & (power > 0.0))


def exact_mask(power: FloatArray, threshold: float = THRESHOLD) -> BoolArray:
    """Return which frames of a finished event are active; the reference is the maximum of its `power` (n,)."""
    return is_active(power, float(power.max()), threshold) if len(power) else np.zeros(0, dtype=np.bool_)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return the segments of consecutive active frames as (start, stop) indices."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


@dataclass(frozen=True, slots=True)
class ActivityParameters:
    """Parameters of the causal form of the rule.

    Parameters
    ----------
    threshold : float
        Share of the reference power at and above which a frame is active.
    release_s : float
        Time constant of the decaying maximum. 1 s is 4 dB a second: slower than any room's decay, so that
        reverberation ends a sound instead of becoming one.
    floor_window_s : float
        Length of the window whose smallest smoothed power is the noise floor.
    floor_factor : float
        Least ratio of an active frame's power to the noise floor.
    min_power : float
        Least power of an active frame, full scale squared.
    pre_roll_s, hang_over_s : float
        Length of the sound that is kept before the first and after the last active frame.
    """

    threshold: float = THRESHOLD
    release_s: float = 1.0
    floor_window_s: float = 3.0
    floor_factor: float = 4.0
    min_power: float = 1e-9
    pre_roll_s: float = 0.4
    hang_over_s: float = 0.3

    @property
    def pre_roll_frames(self) -> int:
        """Number of frames kept before the first active one."""
        return round(self.pre_roll_s / FRAME_S)

    @property
    def hang_over_frames(self) -> int:
        """Number of quiet frames kept after the last active one."""
        return round(self.hang_over_s / FRAME_S)

    @property
    def keep(self) -> float:
        """Factor by which the maximum decays from frame to frame."""
        return float(np.exp(-FRAME_S / self.release_s))

    def least_power(self, floor_power: float) -> float:
        """Return the least power of an active frame above a noise floor, both in full scale squared."""
        return max(self.floor_factor * floor_power, self.min_power)


class CausalActivity:
    """The rule, applied frame by frame to a stream."""

    def __init__(self, parameters: ActivityParameters) -> None:
        self._parameters = parameters
        self._keep = parameters.keep
        self._maximum = 0.0
        self._latest: deque[float] = deque(maxlen=_FLOOR_SMOOTHING)
        self._smoothed: deque[float] = deque(maxlen=max(1, round(parameters.floor_window_s / FRAME_S)))
        self._floor_power = 0.0  # the smallest of `_smoothed`

    @property
    def floor_power(self) -> float:
        """The noise floor, full scale squared; 0 before the first frame."""
        return self._floor_power

    def prime(self, floor_power: float) -> None:
        """Start from a known noise floor, full scale squared, as if it had lasted until now."""
        self._latest.extend([floor_power] * _FLOOR_SMOOTHING)
        self._smoothed.append(floor_power)
        self._floor_power = min(self._smoothed)

    def restart(self, floor_power: float, maximum: float) -> None:
        """Start over, because part of the power is no longer counted.

        `floor_power` is the noise floor and `maximum` the decaying maximum without that part, full scale squared.
        """
        self._maximum = min(self._maximum, maximum)
        self._latest.clear()
        self._smoothed.clear()
        self.prime(floor_power)

    def push(self, power: float) -> bool:
        """Return whether the next frame, of mean power `power`, is active."""
        parameters = self._parameters
        self._maximum = max(self._maximum * self._keep, power)
        reference = max(self._maximum, parameters.least_power(self.floor_power) / parameters.threshold)
        self._latest.append(power)
        self._smoothed.append(sum(self._latest) / len(self._latest))
        self._floor_power = min(self._smoothed)
        return bool(power >= parameters.threshold * reference and power > 0.0)  # `is_active` of one frame
