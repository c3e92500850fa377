"""Makes the evidence of the method `onset`: each array's onset GCCs, and the lags of its background."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling, require_band
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC, has_long_windows, summed
from livessl.core.geometry import microphone_pairs
from livessl.core.locate.background import background_lags, loud_frames
from livessl.core.locate.beginning import beginning, first_frame
from livessl.core.locate.confidence import background_power
from livessl.core.locate.contributing import FAINT
from livessl.core.locate.estimator import Sound
from livessl.core.locate.frame_gccs import FrameGCCs
from livessl.core.locate.place import Place
from livessl.core.types import GCC, ArraySpec, Evidence, Float32Array, FloatArray


class OnsetEvidence:
    """Makes the evidence of sounds, and keeps the lags at which each array is correlated.

    Parameters
    ----------
    arrays : mapping of str to ArraySpec
        The arrays by name.
    c_m_s : float
        Speed of sound, m/s.
    prepare : callable
        Called with the name of an array and its lags (L,) in seconds when the lags are new.
    """

    def __init__(
        self, arrays: Mapping[str, ArraySpec], c_m_s: float, prepare: Callable[[str, FloatArray], None]
    ) -> None:
        self._arrays = arrays
        self._c_m_s = c_m_s
        self._prepare = prepare
        self._samplings: dict[str, tuple[float, LagSampling]] = {}

    def sampling(self, array: str, sample_rate_hz: float) -> LagSampling:
        """Return the lags of an array at a sampling rate; the tables of the last rate are kept.

        Raises
        ------
        ValueError
            If the rate is too low for the array's band.
        """
        known = self._samplings.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1]
        spec = self._arrays[array]
        require_band(spec, sample_rate_hz)
        sampling = LagSampling.shared(spec.band_hz, sample_rate_hz, spec.aperture_m / self._c_m_s)
        self._samplings[array] = (sample_rate_hz, sampling)
        self._prepare(array, sampling.fine_lags_s)
        return sampling

    def front_end(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd:
        """Return a new front end for an array's frames."""
        return OnsetFrontEnd(self._arrays[array], sample_rate_hz, self.sampling(array, sample_rate_hz))

    def of(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Sum each array's onset GCCs; the evidence is in the order of the arrays' names."""
        first = first_frame(sounds)
        return tuple(self._onset_evidence(name, sounds[name], first) for name in sorted(sounds))

    def of_loud(self, evidence: Sequence[Evidence], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...] | None:
        """Return the evidence of the loud frames alone; None if it is the same, or if no background is known."""
        loud = {part.spec.name: loud_frames(sounds[part.spec.name]) for part in evidence}
        if not any(loud.values()):
            return None

        def limited(part: Evidence) -> Evidence:
            name = part.spec.name
            if not loud[name]:
                return part
            sound, onsets = sounds[name], summed([sounds[name].onsets[k] for k in loud[name]])
            own = self._evidence_of(name, sound, onsets, background_lags(sound, loud[name]))
            return replace(own, beginning=part.beginning)

        return tuple(limited(part) for part in evidence)

    def frames(self, evidence: Evidence, sound: Sound) -> FrameGCCs:
        """Return the GCCs of the frames of an array's sound, at the pairs that its evidence has."""
        sampling = self.sampling(evidence.spec.name, sound.sample_rate_hz)
        live = np.any(evidence.gcc.values, axis=1)
        return FrameGCCs.of(evidence.spec, sampling, sound.onsets, live, sound.course)

    def _onset_evidence(self, array: str, sound: Sound, first: int | None) -> Evidence:
        """Return the evidence of an array's sound, which begins at a frame index."""
        if not sound.onsets:
            onsets = self.front_end(array, sound.sample_rate_hz).push_segments(sound.segments)
            return self._evidence_of(array, sound, onsets, None)
        evidence = self._evidence_of(array, sound, summed(sound.onsets), background_lags(sound))
        is_wide = has_long_windows(self._arrays[array].aperture_m / self._c_m_s)  # as long as a beginning
        begun = None if is_wide else beginning(sound, first)
        if begun is None:
            return evidence
        parts = sound.onsets[begun]
        own = self._evidence_of(array, sound, summed(parts), background_lags(sound, range(len(sound.onsets))[begun]))
        return replace(evidence, beginning=own)

    def _evidence_of(self, array: str, sound: Sound, onsets: OnsetGCC, background: Float32Array | None) -> Evidence:
        """Return the evidence of some onsets of an array's sound, with the lags of the background among them."""
        sampling = self.sampling(array, sound.sample_rate_hz)
        spec = self._arrays[array]
        pairs = microphone_pairs(len(spec.microphones_m))
        gcc = GCC(pairs, sampling.fine_lags_s, sampling.fine(onsets.lags / onsets.heights(pairs)))
        faint = onsets.noise_power <= FAINT * onsets.weight
        kept = sound.without_dead_channels(gcc)
        if background is not None:
            background = sampling.fine(background / onsets.heights(pairs)) * np.any(kept.values, axis=1)[:, None]
        presumed = sound.detected and faint
        return Evidence(spec, kept, noise_rms=onsets.noise_rms, is_presumed=presumed, background=background)


def without_background(evidence: Sequence[Evidence], place: Place, c_m_s: float) -> tuple[Evidence, ...]:
    """Subtract the background, scaled so that no power remains at a place."""
    there, _ = background_power(place.evidence, place.position_m, c_m_s)
    scale = np.float32(place.power / there)

    def rest(part: Evidence) -> Evidence:
        if part.background is None:
            return part
        return replace(part, gcc=replace(part.gcc, values=part.gcc.values - scale * part.background))

    return tuple(rest(part) for part in evidence)
