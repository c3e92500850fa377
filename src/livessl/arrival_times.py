"""Finds when arrays that one clock samples received the same sounds, from their recordings.

It is used by `calibrate`; the delays within one array are measured in `core/commission/observe.py`.

With rough poses and places the microphones of each array are shifted to the time of emission and summed; what is left
between the arrays is below the length of a window, and is measured like the delays within an array.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import scipy

from livessl.core.commission.arrivals import Arrivals, mean_times_s
from livessl.core.commission.observe import LEAST_SHARPNESS, observe, receive
from livessl.core.geometry import Grid, circle
from livessl.core.locate.estimator import Sound, create
from livessl.core.locate.map_estimator import MapEstimator
from livessl.core.types import MAX_MICROPHONES, ArraySpec, Float32Array, FloatArray
from livessl.recordings.assign import AssignedRecording

BEFORE_S: Final = 0.3
AFTER_S: Final = 0.4
"""Length of the sound before and after its begin that is compared, seconds."""

REACH_M: Final = 1.2
"""Largest error of the difference of two distances that is measured, metres: rough poses are better."""

_METHOD: Final = "onset"
_NAME: Final = "times"


def arrival_times(
    parts: Sequence[AssignedRecording],
    microphones: Mapping[str, FloatArray],
    starts_s: Sequence[float],
    places_m: FloatArray,
    c_m_s: float,
    band_hz: tuple[float, float],
) -> Arrivals:
    """Measure when arrays received some sounds.

    Parameters
    ----------
    parts : sequence of AssignedRecording
        Recordings of arrays that one clock samples; only the first `MAX_MICROPHONES` are compared.
    microphones : mapping of array to (K, 3) float64
        Measured roughly, metres.
    starts_s : sequence of float
        Site time at which each sound begins, seconds.
    places_m : (S, 3) float64
        Where the sounds were made, roughly, metres; NaN leaves a sound out.
    c_m_s : float
        Speed of sound, m/s.
    band_hz : (float, float)
        Band that is compared.
    """
    parts = parts[:MAX_MICROPHONES]  # each is like a microphone of one array
    names = tuple(part.array for part in parts)
    rate_hz = parts[0].recording.sample_rate_hz
    spec = ArraySpec(_NAME, circle(0.5 * REACH_M, len(names)), band_hz)
    estimator = create(_METHOD, [spec], Grid(((0.0, 1.0), (0.0, 1.0), (0.0, 1.0)), 1.0), c_m_s)
    assert isinstance(estimator, MapEstimator)
    mean_s = mean_times_s([microphones[name] for name in names], places_m, c_m_s)
    segments = [_segments(part, starts_s) for part in parts]
    times_s = np.full((len(starts_s), len(names)), np.nan)
    for index, place_m in enumerate(places_m):
        if not np.isfinite(place_m).all():
            continue
        shifted = [
            _emitted(
                own[index], np.linalg.norm(microphones[name] - place_m, axis=1) / c_m_s - mean_s[index].mean(), rate_hz
            )
            for name, own in zip(names, segments, strict=True)
        ]
        together = np.stack(shifted)
        (evidence,) = estimator.evidence({_NAME: Sound([together], rate_hz)})
        observed = observe([receive(evidence, [together])])
        if observed and observed[0].sharpness >= LEAST_SHARPNESS:
            times_s[index] = mean_s[index] + observed[0].delays_s
    return Arrivals(names, times_s)


def _segments(part: AssignedRecording, starts_s: Sequence[float]) -> list[Float32Array]:
    """Cut the sounds (K, n) out of a recording; what lies outside is silence."""
    rate_hz, rows = part.recording.sample_rate_hz, np.array(part.channels) - 1
    length = round((BEFORE_S + AFTER_S) * rate_hz)
    firsts = [round((start_s - BEFORE_S - part.start_ns / 1e9) * rate_hz) for start_s in starts_s]
    cut = [np.zeros((len(rows), length), dtype=np.float32) for _ in firsts]
    for block in part.recording.blocks(0):
        begin, count = block.first_index, block.samples.shape[1]
        for first, segment in zip(firsts, cut, strict=True):
            low, high = max(begin, first), min(begin + count, first + length)
            if low < high:
                segment[:, low - first : high - first] = block.samples[rows, low - begin : high - begin]
    return cut


def _emitted(samples: Float32Array, travel_s: FloatArray, rate_hz: float) -> Float32Array:
    """Shift microphones (K, n) back by their travel times (K,) and sum them: (n,)."""
    length = samples.shape[1]
    spectra = scipy.fft.rfft(samples, axis=1)
    frequencies_hz = scipy.fft.rfftfreq(length, 1.0 / rate_hz)
    spectra *= np.exp(2j * np.pi * frequencies_hz * travel_s[:, None])
    return np.asarray(scipy.fft.irfft(spectra.mean(axis=0), length), dtype=np.float32)
