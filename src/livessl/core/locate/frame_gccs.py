"""Correlates a sound frame by frame, and removes one source from the correlations to reveal a second one.

All pairs of an array receive a source with the same spectrum, so the share of the source in their GCCs is the same even
function of lag, shifted to the delay of each pair. The mean over the pairs around their delays gives this share for
each frame. The remainder comes from other sources, from reverberation and from noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.geometry import microphone_pairs
from livessl.core.locate.estimator import Course
from livessl.core.types import GCC, ArraySpec, BoolArray, Evidence, Float32Array, FloatArray, IntArray

MAX_FRAMES: Final = 40
"""Largest number of separate frames. Frames of a longer sound are merged, so that memory and time do not grow
further."""

MAX_BYTES: Final = 64 << 20
"""Largest memory, in bytes, of the separate frames of one array. `MAX_FRAMES` frames of a tetrahedron of 0.5 m at 48
kHz take 1 MB. Those of a joint array of 16 microphones across a room would take hundreds of MB, so more frames are
merged."""

LITTLE: Final = 200.0
"""Onset weight of a frame below which the frame is mostly noise and counts less. Noise at 10 dB has about 30, a source
in a clear frame thousands."""

SAME_DELAY_S: Final = 1e-4
"""Difference of two delays, in seconds, up to which a pair does not distinguish two sources. Wrong geometry and unequal
clocks shift a delay by that much, and the first source then leaves a remainder there."""

SAME_DELAY_SHARE: Final = 0.07
"""Value of `SAME_DELAY_S` for a small array, as a share of its largest delay; both are equal at an aperture of 0.5
m."""

REFLECTED: Final = 1.0
"""Height of the strongest reflection in a frame relative to that of the source itself. In a room without carpet, walls
and floor reflect a clap almost without loss."""

BACKGROUND: Final = 3.0
"""Ratio of the highest remainder of a steady noise in a frame to the root mean square in the pre-roll."""

BEGINNING: Final = 2
"""Number of last frames of the pre-roll in which the sound may already begin. The activity rule needs power, and the
start of an onset has little, although its correlation is already clear."""

_FITTED_DELAYS: Final = 3.0
"""Number of independent delays of an array of four microphones, the unit of prominence."""


@dataclass(frozen=True)
class FrameGCCs:
    """One array's correlations frame by frame.

    Parameters
    ----------
    spec : ArraySpec
    lags_s : (L,) float64
        Seconds.
    values : (F, P, L) float32
        GCCs of the frames, not normalised.
    weights : (F,) float64
        Onset weight of each frame.
    powers : (F,) float64
        Highest in-band mean power of the frames that were merged into each frame, full scale squared.
    quiet : (F,) bool
        Whether the frame belongs to the pre-roll, except its last `BEGINNING` frames.
    """

    spec: ArraySpec
    lags_s: FloatArray
    values: Float32Array
    weights: FloatArray
    powers: FloatArray
    quiet: BoolArray

    @classmethod
    def of(
        cls, spec: ArraySpec, sampling: LagSampling, frames: Sequence[OnsetGCC], live: BoolArray, course: Course | None
    ) -> FrameGCCs:
        """Interpolate an array's onset GCCs, which must not be envelopes.

        Pairs that are not `live` (P,) become zeros. Without a course no frame is quiet, and powers are 0.
        """
        bytes_per_frame = len(live) * len(sampling.fine_lags_s) * np.dtype(np.float32).itemsize
        most = max(1, min(MAX_FRAMES, MAX_BYTES // bytes_per_frame))
        firsts = range(0, len(frames), -(-len(frames) // most))
        together = [summed(frames[first : first + firsts.step]) for first in firsts]
        powers, quiet = np.zeros(len(together)), np.zeros(len(together), dtype=np.bool_)
        if course is not None:
            powers = np.maximum.reduceat(course.powers, firsts)
            quiet = np.maximum.reduceat(course.frame_indices, firsts) < course.begin - BEGINNING
        whole = summed(together)
        even = live[:, None] * np.float32(whole.weight) / whole.heights(microphone_pairs(len(spec.microphones_m)))
        coarse = np.asarray(np.stack([one.lags for one in together]).real * even, dtype=np.float32)
        fine = sampling.fine(coarse.reshape(-1, coarse.shape[2])).reshape(*coarse.shape[:2], -1)
        return cls(spec, sampling.fine_lags_s, fine, np.array([one.weight for one in together]), powers, quiet)

    def without(self, delays_s: FloatArray) -> Remainder:
        """Return the remainder after a source at the delays (P,), in seconds, of the pairs is removed."""
        return Remainder(self, delays_s)

    @cached_property
    def live(self) -> IntArray:
        """Pairs whose GCCs are not all zeros."""
        return np.flatnonzero(self.values.any(axis=(0, 2)))

    @cached_property
    def rms(self) -> FloatArray:
        """Root mean square of each frame's GCCs over the live pairs: (F,)."""
        square = np.einsum("fpl,fpl->f", self.values, self.values, dtype=np.float64)  # the other pairs add nothing
        return np.asarray(np.sqrt(square / max(1, len(self.live) * len(self.lags_s))))

    def lag_indices(self, delays_s: FloatArray) -> IntArray:
        """Return the nearest lag of each delay."""
        step_s = self.lags_s[1] - self.lags_s[0]
        places = np.rint((delays_s - self.lags_s[0]) / step_s).astype(np.int64)
        return np.asarray(np.clip(places, 0, len(self.lags_s) - 1))


class Remainder:
    """The remainder of an array's frames after a source is removed.

    Parameters
    ----------
    frames : FrameGCCs
    delays_s : (P,) float64
        Delays of the removed source, seconds.
    """

    def __init__(self, frames: FrameGCCs, delays_s: FloatArray) -> None:
        self._frames = frames
        self._delays_s = delays_s
        self._same_s = min(SAME_DELAY_S, SAME_DELAY_SHARE * float(frames.lags_s[-1]))
        self._share, self._starts = self._removed()
        self.removed_heights = np.maximum(self._share[:, self._share.shape[1] // 2], 0.0).astype(np.float64)
        """Mean height over the pairs of the removed source in each frame, at least 0: (F,)."""

    def evidence(self) -> Evidence:
        """Return the sum of the remainders, in which louder frames have less weight; those below `LITTLE` are equal."""
        weights = self._frames.weights
        scale = 1.0 / np.maximum(weights, LITTLE)
        return self._summed(scale / max(float((weights * scale).sum()), 1e-9))

    def evidence_of(self, delays_s: FloatArray) -> Evidence:
        """Return the sum of the remainders, in which the weight of a frame is the share of a source at delays (P,).

        The weight is the squared share of that source in the height of the frame; the other shares are those of the
        removed source and of the root mean square. It is 0 in the pre-roll. Loud frames count more, as in the evidence
        of a single source.
        """
        frames = self._frames
        heights = np.where(frames.quiet, 0.0, np.maximum(self.heights(delays_s)[0], 0.0))
        scale = np.square(heights / np.maximum(heights + self.removed_heights + frames.rms, 1e-9))
        return self._summed(scale / max(float((frames.weights * scale).sum()), 1e-9))

    def _summed(self, scale: FloatArray) -> Evidence:
        frames, count = self._frames, len(self._frames.lags_s)
        values = np.einsum("f,fpl->pl", scale.astype(np.float32), frames.values)
        weighed = scale.astype(np.float32) @ self._share
        for pair in frames.live:
            values[pair] -= weighed[self._starts[pair] : self._starts[pair] + count]
        return Evidence(frames.spec, GCC(microphone_pairs(len(frames.spec.microphones_m)), frames.lags_s, values))

    def heights(self, delays_s: FloatArray) -> tuple[FloatArray, int]:
        """Return the mean height of a source at delays (P,) in each frame, and the number of independent delays used.

        Pairs that receive both sources with nearly the same delay are not used: see `SAME_DELAY_S`.
        """
        frames = self._frames
        used = frames.live[np.abs(delays_s - self._delays_s)[frames.live] > self._same_s]
        if not len(used):
            return np.zeros(len(frames.weights)), 0
        at = frames.lag_indices(delays_s)[used]
        heights = frames.values[:, used, at] - self._share[:, self._starts[used] + at]
        independent = len(np.unique(microphone_pairs(len(frames.spec.microphones_m))[used])) - 1
        return heights.mean(axis=1, dtype=np.float64), independent

    def prominences(self, delays_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the prominence of a source at delays (P,) in each frame, above reflections and above noise: (F,) each.

        Prominence is the mean height over the pairs, in units of the height that is possible without such a source. The
        unit includes the root mean square of the frame, the noise before the sound and, in the first of the two
        results, reflections of the removed source. Prominence is 0 in the pre-roll.
        """
        frames = self._frames
        heights, independent = self.heights(delays_s)
        heights = np.sqrt(independent / _FITTED_DELAYS) * heights
        before = float(np.square(heights[frames.quiet]).mean()) if frames.quiet.any() else 0.0
        noise = np.square(frames.rms) + BACKGROUND**2 * before
        reflections = np.square(REFLECTED * self.removed_heights)
        heights = np.where(frames.quiet, 0.0, heights)
        above_noise, above_all = (heights / np.sqrt(np.maximum(power, 1e-18)) for power in (noise, noise + reflections))
        return above_all, above_noise

    def _removed(self) -> tuple[Float32Array, IntArray]:
        """Return the source's share in each frame, (F, 2 L - 1), and the index at which each pair's lags begin, (P,).

        The share is r(t) = mean over pairs of [R_p(tau_p + t) + R_p(tau_p - t)] / 2, t as far as the lags reach.
        """
        frames, (number, _, count) = self._frames, self._frames.values.shape
        share = np.zeros((number, 2 * count - 1), dtype=np.float32)
        terms = np.zeros(2 * count - 1, dtype=np.float32)
        starts = count - 1 - frames.lag_indices(self._delays_s)
        for pair in frames.live:
            share[:, starts[pair] : starts[pair] + count] += frames.values[:, pair]
            terms[starts[pair] : starts[pair] + count] += 1.0
        return (share + share[:, ::-1]) / np.maximum(terms + terms[::-1], 1.0), starts
