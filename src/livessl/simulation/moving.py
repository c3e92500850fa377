"""A source that moves through a room (walking talker), as microphones record it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import oaconvolve

from livessl.core.geometry import as_positions_m
from livessl.core.types import Float32Array, FloatArray
from livessl.simulation.room import impulse_responses

STEP_S: Final = 0.05
"""Time, in seconds, between two responses. At a walk of 1 m/s they lie 5 cm apart, and a source is never further than
half of that from one of them."""


def place_on_way(times_s: ArrayLike, waypoints_m: ArrayLike, at_s: ArrayLike) -> FloatArray:
    """Interpolate a way at constant speed between waypoints; before the first and after the last it stands still.

    Parameters
    ----------
    times_s : (N,)
        Time at each waypoint, in seconds, ascending.
    waypoints_m : (N, 3)
        Waypoints, in metres.
    at_s : (T,)
        Times, in seconds, at which the position is wanted.

    Returns
    -------
    (T, 3) float64

    Raises
    ------
    ValueError
        If times and waypoints differ in number, or the times do not ascend.
    """
    times, points_m = np.asarray(times_s, dtype=np.float64), as_positions_m(waypoints_m)
    if times.shape != (len(points_m),) or not (np.diff(times) > 0).all():
        raise ValueError(
            f"way: expected one ascending time in seconds for each of {len(points_m)} waypoints, got {times.tolist()}"
        )
    return np.stack([np.interp(np.asarray(at_s, dtype=np.float64), times, axis) for axis in points_m.T], axis=-1)


def render_moving(
    sound: Float32Array,
    times_s: ArrayLike,
    waypoints_m: ArrayLike,
    microphones_m: ArrayLike,
    *,
    room_size_m: ArrayLike,
    rt60_s: float,
    sample_rate_hz: float,
    c_m_s: float = 343.0,
    step_s: float = STEP_S,
    compiled: bool = False,
) -> Float32Array:
    """Compute what microphones record of a source that moves while it sounds.

    The sound is cut by overlapping triangles `step_s` apart that add up to one. Each part is emitted at the position of
    the source at the part's middle, through the responses of that position. Reverberation thus belongs to the position
    of emission, one position fades into the next, and there is no Doppler shift.

    Parameters
    ----------
    sound : (n,) float32
        Sound from time 0 on.
    times_s : (N,)
    waypoints_m : (N, 3)
        The way: as in `place_on_way`.
    microphones_m : (K, 3)
        Absolute positions, metres.
    room_size_m, rt60_s, sample_rate_hz, c_m_s, compiled
        As in `livessl.simulation.room.impulse_responses`, which makes each response.
    step_s : float
        Time between two responses.

    Returns
    -------
    (K, m) float32
        Recording as long as sound and response together; sample 0 is the emission of the first sample of the sound.
        It has no noise, and its level is not normalized.

    Raises
    ------
    ValueError
        If `step_s` is shorter than a sample, or another argument is invalid.
    """
    step = round(step_s * sample_rate_hz)
    if step < 1:
        raise ValueError(
            f"moving source: expected step_s of one sample, {1 / sample_rate_hz:g} s, or more, got {step_s}"
        )
    middles = range(0, len(sound) + step, step)
    places_m = place_on_way(times_s, waypoints_m, np.array(middles) / sample_rate_hz)
    microphones = as_positions_m(microphones_m)
    for index, middle in enumerate(middles):
        if index == 0 or (places_m[index] != places_m[index - 1]).any():
            responses = impulse_responses(
                room_size_m,
                places_m[index],
                microphones,
                [rt60_s],
                sample_rate_hz=sample_rate_hz,
                c_m_s=c_m_s,
                compiled=compiled,
            )[0]
        if index == 0:  # all responses are of one length
            recorded = np.zeros((len(microphones), len(sound) + responses.shape[1] - 1), dtype=np.float32)
        first = max(0, middle - step)
        part = sound[first : middle + step]
        if len(part):
            weight = 1.0 - np.abs(np.arange(first, first + len(part)) - middle) / step
            wet = oaconvolve(responses, (weight * part).astype(np.float32)[None], axes=1)
            recorded[:, first : first + wet.shape[1]] += wet
    return recorded
