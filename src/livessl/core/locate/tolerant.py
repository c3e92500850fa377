"""Widens the correlations of an array whose channels come from several recorders, and thus have different clocks.

If the channels of an array come from several recorders, their clocks may differ, by a standard deviation of
`Uncertainty.clock_s` between two channels. The delays of the pairs then have no common place, and the sum of sharp
peaks may be highest at a place where some of them meet by chance. A GCC that is averaged over the possible delays is
its convolution with the distribution of these delays, and its wider peaks meet again at the right place.

Wide peaks have less resolution, so the sharp evidence determines the place if both agree.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.types import Evidence, Float32Array, FloatArray

SHARE: Final = 0.5
"""Width of the distribution in units of the clocks' standard deviation. With a half, frequencies above 3 kHz are
reduced but not lost, and peaks that differ by one standard deviation still overlap. With one, little of a band of 6 kHz
would remain."""

_WIDTHS: Final = 3.0
"""Half length of the distribution that is used, in units of its width."""


def tolerant(evidence: Evidence) -> Evidence:
    """Average an array's GCCs over the possible delays between the clocks of its channels.

    Returns
    -------
    Evidence
        The same object if all channels have one clock, or if the GCCs are magnitudes, whose peaks are wide anyway.
    """
    spec, gcc = evidence.spec, evidence.gcc
    width_s, step_s = SHARE * spec.uncertainty.clock_s, float(gcc.lags_s[1] - gcc.lags_s[0])
    reach = round(_WIDTHS * width_s / step_s)
    if reach == 0 or uses_envelope(spec.band_hz):
        return evidence
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) * step_s / width_s))
    weights /= weights.sum()
    values = _averaged(gcc.values, weights)
    background = None if evidence.background is None else _averaged(evidence.background, weights)
    frequencies_hz = np.linspace(*spec.band_hz, 64)
    passed = np.exp(-np.square(2.0 * np.pi * frequencies_hz * width_s))  # power of noise that is left
    noise_rms = evidence.noise_rms * float(np.sqrt(passed.mean()))
    beginning = None if evidence.beginning is None else tolerant(evidence.beginning)
    return replace(
        evidence, gcc=replace(gcc, values=values), noise_rms=noise_rms, background=background, beginning=beginning
    )


def _averaged(values: Float32Array, weights: FloatArray) -> Float32Array:
    """Average values (P, L) along the lags; beyond each end, the value at that end is used."""
    reach = len(weights) // 2
    padded = np.pad(values, ((0, 0), (reach, reach)), mode="edge")
    return np.array([np.convolve(row, weights, mode="valid") for row in padded], dtype=np.float32)
