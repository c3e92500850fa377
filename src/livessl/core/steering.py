"""Delays between an array's microphones for a position (TDOA), and from which frequency a grid has spatial aliasing."""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.types import FloatArray, IntArray

NEAREST_M: Final = 1e-9
"""Least length, in metres, by which the vector from a microphone to a point is divided; they may coincide."""


def steering_delays_s(points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, c_m_s: float) -> FloatArray:
    """Lag at which a sound from each point peaks in each pair's GCC: (|r - r_k| - |r - r_i|) / c.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
        Microphones (i, k).
    c_m_s : float
        Speed of sound, m/s.

    Returns
    -------
    (P, N) float64
        Seconds.
    """
    delays = np.stack([np.sqrt(((points_m - m) ** 2).sum(axis=1)) for m in microphones_m]) / c_m_s
    return np.asarray(delays[pairs[:, 1]] - delays[pairs[:, 0]])


def delay_gradients_s_m(points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, c_m_s: float) -> FloatArray:
    """Gradient of each pair's delay at each point: (u_k - u_i) / c, u the unit vector from a microphone to the point.

    It is exact near and far. Its length is 2 sin(gamma/2)/c with gamma the angle that the pair subtends.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
    c_m_s : float

    Returns
    -------
    (P, N, 3) float64
        Seconds per metre.
    """
    towards = points_m - microphones_m[:, None]
    unit = towards / np.maximum(np.sqrt((towards**2).sum(axis=2, keepdims=True)), NEAREST_M)
    return np.asarray((unit[pairs[:, 1]] - unit[pairs[:, 0]]) / c_m_s)


def alias_free_hz(
    points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, spacing_m: float, c_m_s: float
) -> FloatArray:
    """Frequency up to which a pair's map has no spatial aliasing on a grid: f_max = 1 / (2 D |grad tau|).

    With grid spacing D, the phase 2 pi f tau changes by less than pi between neighbouring grid points
    (García-Barrios, Gutiérrez-Arriola et al., IEEE Access 2021, arXiv 2402.06586). It is infinite where the delay does
    not change.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
    spacing_m, c_m_s : float

    Returns
    -------
    (P, N) float64
        Hertz.

    Raises
    ------
    ValueError
        If the spacing is not above 0.
    """
    if not spacing_m > 0:
        raise ValueError(f"grid spacing: expected metres above 0, got {spacing_m}")
    steepness = np.sqrt((delay_gradients_s_m(points_m, microphones_m, pairs, c_m_s) ** 2).sum(axis=2))
    limit = np.full(steepness.shape, np.inf)
    return np.asarray(np.divide(1.0 / (2.0 * spacing_m), steepness, out=limit, where=steepness > 0.0))
