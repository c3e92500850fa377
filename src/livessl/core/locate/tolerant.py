"""Evidence that bears microphones of one array that clocks of their own sample. It sees correlations and no sound.

Where an array's channels come from several recorders, their clocks may be apart, by a standard deviation of
`Uncertainty.clock_s` between two channels. The peaks of its pairs then lie at delays that belong to no common place,
and the sum of sharp peaks may be highest where some of them meet by chance. Averaged over the delays that the clocks
allow, the GCC of a pair is its convolution with their distribution, and peaks that the clocks have moved meet again.

What this costs is resolution, so the sharp evidence determines the place wherever both agree.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.types import Evidence, Float32Array, FloatArray

SHARE: Final = 0.5
"""Width of the distribution in units of the clocks' standard deviation. Half of it passes what is above 3 kHz in part,
and peaks that are apart by one standard deviation still overlap; the whole would leave little of a band of 6 kHz."""

_WIDTHS: Final = 3.0
"""Half length of the distribution that is used, in units of its width."""


def tolerant(evidence: Evidence) -> Evidence:
    """Average an array's GCCs over the delays between its channels that their clocks allow.

    Returns
    -------
    Evidence
        The same object if its channels have one clock, or if its GCCs are magnitudes, whose peaks are wide as they are.
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
    """Average values (P, L) along the lags; beyond the ends they stay as they are there."""
    reach = len(weights) // 2
    padded = np.pad(values, ((0, 0), (reach, reach)), mode="edge")
    return np.array([np.convolve(row, weights, mode="valid") for row in padded], dtype=np.float32)
