"""The image method: room impulse responses (reverberation, RT60) of a box with equal walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfft
from scipy.sparse import coo_array

from livessl.core.geometry import as_positions_m
from livessl.core.types import Float32Array, FloatArray, IntArray

OVERSAMPLING: Final = 8
"""Bins per sample of the time axis to which images are added; each image is shared by its two nearest bins.

Sharing lowers the amplitude at high frequencies (droop). At the frequency f, an image at the fraction a of the distance
D (seconds) between two bins has the relative error a(1-a)(2 pi f D)^2/2. The mean over a is corrected at the end, by
`decimation_gain`; the rest has the RMS (2 pi f D)^2/(12 sqrt 5): 0.6 % at the Nyquist frequency, less below.
"""

SHELL_IMAGES: Final = 1 << 18
"""Number of images that are processed at once: a few MB for each of their properties."""

ROLL_OFF: Final = 0.9
"""Fraction of the Nyquist frequency above which the response fades out, so that its ringing is short."""

GUARD: Final = 256
"""Samples after the response that are discarded, because ringing before time 0 wraps into them."""


def absorption(rt60_s: float, room_size_m: ArrayLike, c_m_s: float = 343.0) -> float:
    """Return the absorption coefficient that gives equal walls a reverberation time: alpha = 24 ln(10) V / (c S T).

    Parameters
    ----------
    rt60_s : float
        Reverberation time T in seconds; 0 is anechoic, alpha = 1.
    room_size_m : (3,)
        Metres: volume V, surface S.
    c_m_s : float
        Speed of sound, m/s.

    Raises
    ------
    ValueError
        If no wall absorbs enough (alpha > 1), or an argument is not a finite number of the right sign.

    Notes
    -----
    Sabine, Collected Papers on Acoustics, 1922. The time is nominal: the decay of images in a box is not exponential,
    and T30 is shorter in a dead room and longer in a live one.
    """
    x, y, z = _as_room_m(room_size_m)
    if not (np.isfinite(rt60_s) and rt60_s >= 0):
        raise ValueError(f"reverberation time: expected finite seconds, 0 or more, got {rt60_s}")
    if not (np.isfinite(c_m_s) and c_m_s > 0):
        raise ValueError(f"speed of sound: expected m/s above 0, got {c_m_s}")
    if rt60_s == 0:
        return 1.0
    shortest_s = 24.0 * np.log(10.0) * x * y * z / (c_m_s * 2.0 * (x * y + y * z + z * x))
    if rt60_s < shortest_s:
        raise ValueError(
            f"reverberation time: a room of {x:g} x {y:g} x {z:g} m has at least {shortest_s:.3g} s by Sabine "
            f"(the walls absorb everything), got {rt60_s:g} s; choose a longer time, or 0 for no reflections"
        )
    return float(shortest_s / rt60_s)


def impulse_responses(
    room_size_m: ArrayLike,
    source_m: ArrayLike,
    microphones_m: ArrayLike,
    rt60s_s: Sequence[float],
    *,
    sample_rate_hz: float,
    c_m_s: float = 343.0,
    duration_s: float | None = None,
    own_lengths: bool = False,
    compiled: bool = False,
) -> Float32Array:
    """Compute the responses from a source to microphones, all omnidirectional, by the image method.

    An image after n reflections at distance d arrives after d/c with amplitude beta^n / (4 pi d). Neither d nor n
    depends on the reverberation time, so the images are visited once: h = A B, where A (time, n) sums 1 / (4 pi d) and
    B (n, R) holds beta^n, with beta = sqrt(1 - alpha) and alpha of `absorption`.

    Parameters
    ----------
    room_size_m : (3,)
        Metres, one corner at the origin.
    source_m : (3,)
        Metres, strictly inside.
    microphones_m : (K, 3)
        Metres, strictly inside, none at the source.
    rt60s_s : sequence of R float
        Nominal reverberation times in seconds; 0 is the direct path alone.
    sample_rate_hz : float
        Hertz. The responses fade out from 0.9 of the Nyquist frequency, its half, upwards.
    c_m_s : float
        Speed of sound, m/s.
    duration_s : float or None
        Length in seconds; it contains every image that arrives within it. None takes the longest reverberation time,
        or the time across the room if that is longer.
    own_lengths : bool
        Whether each response is zero after its own reverberation time (or after the time across the room, if that is
        longer).
    compiled : bool
        Whether the images are summed by compiled code: several times faster, and equal except for rounding. Needs
        numba (the extra `fast`).

    Returns
    -------
    (R, K, n) float32
        Sample 0 is the moment of emission; 1 is the amplitude at 1/(4 pi) metres.

    Raises
    ------
    ValueError
        If a position lies outside the room, or an argument has another shape, sign or size than stated.

    Notes
    -----
    Allen & Berkley, Image method for efficiently simulating small-room acoustics, JASA 65(4), 1979, without their
    high-pass: below about 100 Hz, where the images of late reflections add up in phase instead of cancelling, the
    response rings longer than the nominal reverberation time. The images are visited in shells of equal volume, so
    memory grows much more slowly than their number.
    """
    room_m, source, microphones = checked_positions(room_size_m, source_m, microphones_m)
    if not (np.isfinite(sample_rate_hz) and sample_rate_hz > 0):
        raise ValueError(f"sample rate: expected Hz above 0, got {sample_rate_hz}")
    if len(rt60s_s) == 0:
        raise ValueError("reverberation times: expected one or more, got none")
    beta = np.sqrt([1.0 - absorption(rt60_s, room_m, c_m_s) for rt60_s in rt60s_s])
    across_s = float(np.linalg.norm(room_m)) / c_m_s + GUARD / sample_rate_hz
    duration_s = max(*rt60s_s, across_s) if duration_s is None else duration_s
    _check_duration(duration_s, sample_rate_hz)
    count = int(np.ceil(duration_s * sample_rate_hz))
    ends = np.full(len(beta), count, dtype=np.int64)
    if own_lengths:
        ends = np.minimum(count, np.ceil(np.maximum(rt60s_s, across_s) * sample_rate_hz).astype(np.int64))
    fft_size = next_fast_len(count + GUARD, real=True)
    bins_per_m = sample_rate_hz * OVERSAMPLING / c_m_s
    responses = np.zeros((len(beta), len(microphones), count), dtype=np.float32)
    for k, microphone in enumerate(microphones):
        if compiled:
            fine = _all_compiled(room_m, source, microphone, c_m_s * duration_s, bins_per_m, beta, ends)
            for r, end in enumerate(ends):
                size = next_fast_len(int(end) + GUARD, real=True)
                responses[r, k, :end] = _decimated(fine[r, : end * OVERSAMPLING, None], size)[:end, 0]
        else:
            laid = _all(room_m, source, microphone, c_m_s * duration_s, bins_per_m, beta, fft_size * OVERSAMPLING)
            if own_lengths:
                laid[np.arange(len(laid))[:, None] >= ends * OVERSAMPLING] = 0.0
            responses[:, k] = _decimated(laid, fft_size)[:count].T
    for r, end in enumerate(ends):
        responses[r, :, end:] = 0.0
    return responses


def checked_positions(
    room_size_m: ArrayLike, source_m: ArrayLike, microphones_m: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the room's size (3,), the source (3,) and the microphones (K, 3), metres, once they are checked."""
    room_m = _as_room_m(room_size_m)
    source = _as_inside_m(np.atleast_2d(np.asarray(source_m)), room_m, "source")[0]
    microphones = _as_inside_m(microphones_m, room_m, "microphone")
    if (microphones == source).all(axis=1).any():
        raise ValueError(f"room: expected source and microphones apart, got both at {_xyz(source)} m; move one")
    return room_m, source, microphones


def _check_duration(duration_s: float, sample_rate_hz: float) -> None:
    if not (np.isfinite(duration_s) and duration_s * sample_rate_hz >= 1):
        raise ValueError(f"duration: expected at least one sample, {1 / sample_rate_hz:g} s, got {duration_s} s")


def _all(
    room_m: FloatArray,
    source_m: FloatArray,
    microphone_m: FloatArray,
    reach_m: float,
    bins_per_m: float,
    beta: FloatArray,
    bins: int,
) -> FloatArray:
    """Add all images within reach to the fine time axis: (bins, R)."""
    fine = np.zeros((bins, len(beta)))
    for distance_m, order in _shells(room_m, source_m, microphone_m, reach_m):
        _lay_down(fine, distance_m * bins_per_m, order, distance_m, beta)
    return fine


def _all_compiled(
    room_m: FloatArray,
    source_m: FloatArray,
    microphone_m: FloatArray,
    reach_m: float,
    bins_per_m: float,
    beta: FloatArray,
    ends: IntArray,
) -> Float32Array:
    """Add all images by compiled code, each response up to its own end: (R, bins)."""
    from livessl.simulation.images import lay_down_all

    x, y, z = (_axis(*each, reach_m) for each in zip(room_m, source_m, microphone_m, strict=True))
    return lay_down_all((x, y, z), reach_m, bins_per_m, beta, ends * OVERSAMPLING)


def _as_room_m(room_size_m: ArrayLike) -> FloatArray:
    room_m = np.array(room_size_m, dtype=np.float64)
    if room_m.shape != (3,) or not (np.isfinite(room_m).all() and (room_m > 0).all()):
        raise ValueError(f"room: expected three finite lengths above 0 m, got {room_size_m!r}")
    return room_m


def _as_inside_m(positions: ArrayLike, room_m: FloatArray, what: str) -> FloatArray:
    positions_m = as_positions_m(positions)
    for position in positions_m[((positions_m <= 0) | (positions_m >= room_m)).any(axis=1)]:
        raise ValueError(
            f"room: expected every {what} strictly inside {_xyz(room_m)} m, got {_xyz(position)} m; "
            "move it or correct the size of the room"
        )
    return positions_m


def _xyz(position_m: FloatArray) -> str:
    return "(" + ", ".join(f"{x:g}" for x in position_m) + ")"


def _axis(length_m: float, source_m: float, microphone_m: float, reach_m: float) -> tuple[FloatArray, IntArray]:
    """Return squared distances along one axis and numbers of reflections of images within reach, nearest first."""
    ends = int(reach_m / length_m) + 2
    index = np.arange(-ends, ends + 1, dtype=np.int64)
    image_m = index * length_m + np.where(index % 2 == 0, source_m, length_m - source_m)
    square_m2 = np.square(image_m - microphone_m, dtype=np.float64)
    nearest = np.argsort(square_m2)
    nearest = nearest[square_m2[nearest] < reach_m**2]
    return square_m2[nearest], np.abs(index[nearest])


def _shells(
    room_m: FloatArray, source_m: FloatArray, microphone_m: FloatArray, reach_m: float
) -> Iterator[tuple[FloatArray, IntArray]]:
    """Yield distances and numbers of reflections of all images within reach, in shells around the microphone."""
    (x2, x_order), (y2, y_order), (z2, z_order) = (
        _axis(*each, reach_m) for each in zip(room_m, source_m, microphone_m, strict=True)
    )
    column2 = np.add.outer(y2, z2).ravel()  # lines of images parallel to x
    column_order = np.add.outer(y_order, z_order).ravel()
    images = 4.0 / 3.0 * np.pi * reach_m**3 / room_m.prod()
    shells = int(np.ceil(images / SHELL_IMAGES))
    start = np.zeros(len(column2), dtype=np.int64)
    for radius_m in reach_m * np.cbrt(np.arange(1, shells + 1) / shells):
        stop = np.searchsorted(x2, radius_m**2 - column2)
        length = stop - start
        column = np.repeat(np.arange(len(column2)), length)
        x = np.arange(len(column)) - np.repeat(np.cumsum(length) - length - start, length)
        yield np.sqrt(column2[column] + x2[x]), column_order[column] + x_order[x]
        start = stop


def _lay_down(fine: FloatArray, bins: FloatArray, order: IntArray, distance_m: FloatArray, beta: FloatArray) -> None:
    """Add images to the fine time axis (bins, R), each to the two bins it lies between."""
    if len(bins) == 0:
        return
    lower = bins.astype(np.int32)
    first = int(lower.min())
    size = int(lower.max()) - first + 2
    amplitude = 1.0 / (4.0 * np.pi * distance_m)
    upper_part = amplitude * (bins - lower)
    rows = np.concatenate([lower - first, lower - first + 1])
    columns = np.concatenate([order, order]).astype(np.int32)
    taps = coo_array(
        (np.concatenate([amplitude - upper_part, upper_part]), (rows, columns)), shape=(size, int(order.max()) + 1)
    )
    fine[first : first + size] += taps @ (beta ** np.arange(taps.shape[1])[:, None])  # 0^0 = 1: the direct path


def _decimated(fine: FloatArray | Float32Array, fft_size: int) -> FloatArray:
    """Bring the fine axis (bins, R) to the sample rate and undo the droop sinc^2 of the two-bin taps."""
    spectrum = np.asarray(rfft(fine, fft_size * OVERSAMPLING, axis=0))[: fft_size // 2 + 1]
    return np.asarray(irfft(spectrum * decimation_gain(fft_size).astype(fine.dtype)[:, None], fft_size, axis=0))


def decimation_gain(fft_size: int) -> FloatArray:
    """Return the gain in each bin, (fft_size/2 + 1,), that fades the response out and undoes the droop of the taps."""
    of_nyquist = 2.0 * np.arange(fft_size // 2 + 1) / fft_size
    fade = 0.5 + 0.5 * np.cos(np.pi * np.clip((of_nyquist - ROLL_OFF) / (1.0 - ROLL_OFF), 0.0, 1.0))
    return np.asarray(fade / np.sinc(of_nyquist / (2 * OVERSAMPLING)) ** 2)
