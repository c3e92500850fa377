"""Combines the beams of the arrays into one enhanced signal by signal-to-noise ratio, and chooses these arrays.

`server/clips/record.py` sets its level and writes it.

Every array's beam is brought to the time of emission by the travel time from the place to its centre. What is left
between the arrays' clocks is measured by cross-correlating the beams. The aligned beams are then combined as the
microphones of one array are (`livessl.core.enhance.beam`), with the amplitudes of the sound in place of the direct
responses and noise that is independent from array to array. All steps are linear, so that `Enhancement.apply` shows
what becomes of any part of the recordings, such as the noise alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.enhance.align import (
    LEAST_PROMINENCE,
    lag_between,
    resampled,
    resampled_mask,
    shifted,
    shifted_mask,
)
from livessl.core.enhance.beam import INSIDE, ArraySound, Beam, Method, covariance, passing, steer
from livessl.core.enhance.stft import Spectra, Stft
from livessl.core.types import BoolArray, Float32Array, FloatArray

MOST_ARRAYS: Final = 8
"""Most arrays that are combined, those of the greatest signal-to-noise ratio: more add less than a decibel."""

_SUBTRACTED: Final = 2.0
"""Multiple of the noise power that is subtracted before beams are correlated; what noise exceeds it is rare."""

LEAST_SHARE: Final = 0.25
"""Least share of the sound that is made up for where other arrays have a gap; below it the signal is quieter there,
because what is left would be mostly noise."""

_LEAST_FLOOR: Final = 1e-6
"""Least noise power of a bin, as a share of the largest of all bins and arrays."""

_LEAST_POWER: Final = 1e-20
"""Least power, full scale squared, by which is divided."""


@dataclass(frozen=True, slots=True)
class Part:
    """The part of one array in an enhanced clip.

    Parameters
    ----------
    array : str
    beam : Beam
    sample_rate_hz : float
        Rate of the array's samples.
    lag_s : float
        What was left between this beam's time and that of the first array, in seconds; positive if it was later.
    snr_db : float or None
        Signal-to-noise ratio of the beam in the array's band; None without quiet, and where no sound stands out.
    shares : (F,) float64
        Its share of the sound in each bin of the combination, 0 to 1; 0 for an array that was left out.
    first : float
        Place of its first sample on the clip's time axis, in samples.
    weights : (F,) complex128
        Its weights in the combination.
    known : (n,) bool
        Where it has samples, on the clip's time axis.
    """

    array: str
    beam: Beam
    sample_rate_hz: float
    lag_s: float
    snr_db: float | None
    shares: FloatArray
    first: float
    weights: Spectra
    known: BoolArray

    @property
    def share(self) -> float:
        """Share of the combination, 0 to 1, as a mean over all bins; 0 for an array that was left out."""
        return float(self.shares.mean())


@dataclass(frozen=True, slots=True)
class Enhancement:
    """The way in which one signal is made of the recordings of several arrays.

    Parameters
    ----------
    time_ns : int
        Site time at which the source emits the clip's first sample, in nanoseconds.
    sample_rate_hz : float
    length : int
        Samples of the clip.
    parts : tuple of Part
        The arrays, the one of the greatest signal-to-noise ratio first.
    """

    time_ns: int
    sample_rate_hz: float
    length: int
    parts: tuple[Part, ...]

    def apply(self, samples: Mapping[str, Float32Array]) -> FloatArray:
        """Return the signal (length,) made of each array's samples (K, n), or of a part of them.

        It has the level of the first array's beam. Where no array has samples it is zero.
        """
        stft = Stft.of(self.sample_rate_hz)
        total, there = np.zeros((1, 1), dtype=np.complex128), np.zeros((1, 1))
        for part in self.parts:
            if part.share > 0.0:
                beam = resampled(part.beam.apply(samples[part.array]), part.sample_rate_hz, self.sample_rate_hz)
                present = stft.share(part.known)[:, None]
                total = total + present * part.weights.conj() * stft.forward(shifted(beam, part.first, self.length))
                there = there + present * part.shares
        return stft.inverse(total / np.maximum(there, LEAST_SHARE), self.length)


def plan(sounds: Sequence[ArraySound], position_m: FloatArray, c_m_s: float, method: Method = "mvdr") -> Enhancement:
    """Return how the recordings of a sound at a place are made one signal.

    Parameters
    ----------
    sounds : sequence of ArraySound
        One or more, each of another array.
    position_m : (3,) float64
        The place, metres.
    c_m_s : float
        Speed of sound, m/s.
    method : {"mvdr", "delay-and-sum"}
        Beam of each array.

    Raises
    ------
    ValueError
        If there is no array.
    """
    if not sounds:
        raise ValueError("enhanced clip: expected the sound of one array or more, got none")
    beams = [_Beamed.of(sound, steer(sound, position_m, c_m_s, method), position_m, c_m_s) for sound in sounds]
    beams = sorted(beams, key=lambda one: one.ratio, reverse=True)[:MOST_ARRAYS]
    rate_hz = beams[0].sound.sample_rate_hz
    origin_ns = min(one.emitted_ns for one in beams)
    length = max(
        int(np.ceil((one.emitted_ns - origin_ns) / 1e9 * rate_hz))
        + int(np.ceil(len(one.signal) * rate_hz / one.sound.sample_rate_hz))
        for one in beams
    )
    axis = _Axis(origin_ns, rate_hz, length)
    reference = _aligned(beams[0], axis, 0.0)
    placed, stft = [reference], Stft.of(rate_hz)
    first = reference.prominent(stft)
    for one in beams[1:]:
        other = _aligned(one, axis, 0.0)
        band_hz = _common_band(beams[0].sound, one.sound)
        lag_s, prominence = lag_between(first, other.prominent(stft), rate_hz, band_hz)
        placed.append(_aligned(one, axis, lag_s) if prominence >= LEAST_PROMINENCE else other.left_out())
    weights, shares = _combination([one for one in placed if one.is_used], rate_hz)
    return Enhancement(origin_ns, rate_hz, length, tuple(_parts(beams, placed, weights, shares)))


@dataclass(frozen=True, slots=True)
class _Axis:
    origin_ns: int
    sample_rate_hz: float
    length: int


@dataclass(frozen=True, slots=True)
class _Beamed:
    """An array's beam as a signal on the array's own axis, with the time at which its first sample was emitted."""

    sound: ArraySound
    beam: Beam
    signal: FloatArray
    emitted_ns: int
    ratio: float

    @classmethod
    def of(cls, sound: ArraySound, beam: Beam, position_m: FloatArray, c_m_s: float) -> _Beamed:
        travel_s = float(np.linalg.norm(sound.spec.centre_m - position_m)) / c_m_s
        signal = beam.apply(sound.samples)
        stft = Stft.of(sound.sample_rate_hz)
        noise, both = _powers(stft.forward(signal), stft.share(sound.quiet), stft.share(sound.sound))
        inside = _in_band(sound)
        level, floor = float(both[inside].sum()), float(noise[inside].sum())
        ratio = max(level - floor, 0.0) / max(floor, _LEAST_POWER)
        return cls(sound, beam, signal, sound.time_ns - round(travel_s * 1e9), ratio)

    @property
    def snr_db(self) -> float | None:
        """Signal-to-noise ratio in the array's band; None without quiet, and where no sound stands out."""
        return 10.0 * float(np.log10(self.ratio)) if self.beam.noise_is_known and self.ratio > 0.0 else None


@dataclass(frozen=True, slots=True)
class _Aligned:
    """A beam on the common axis."""

    signal: FloatArray
    known: BoolArray
    quiet: BoolArray
    sound: BoolArray
    first: float
    lag_s: float
    is_used: bool = True

    def prominent(self, stft: Stft) -> FloatArray:
        """Return the signal of the windows and bins that exceed the noise, where the sound is expected."""
        spectra = stft.forward(np.where(self.sound, self.signal, 0.0))
        noise, _ = _powers(stft.forward(self.signal), stft.share(self.quiet), stft.share(self.sound))
        power = np.square(np.abs(spectra))
        gain = np.maximum(1.0 - _SUBTRACTED * noise / np.maximum(power, _LEAST_POWER), 0.0)
        return stft.inverse(gain * spectra, len(self.signal))

    def left_out(self) -> _Aligned:
        """Return it as one that is not combined."""
        return replace(self, is_used=False)


def _powers(spectra: Spectra, quiet: FloatArray, during: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean powers (F,) of windows (T, F) in the quiet, 0 without any, and in the sound."""
    power, before = np.square(np.abs(spectra)).astype(np.float64), quiet > INSIDE
    noise = power[before].mean(axis=0) if before.any() else np.zeros(power.shape[1])
    return noise, np.asarray((during @ power) / max(float(during.sum()), _LEAST_POWER))


def _in_band(sound: ArraySound) -> BoolArray:
    frequencies_hz = Stft.of(sound.sample_rate_hz).frequencies_hz(sound.sample_rate_hz)
    low, high = sound.spec.band_hz
    return np.asarray((frequencies_hz >= low) & (frequencies_hz <= high))


def _common_band(one: ArraySound, other: ArraySound) -> tuple[float, float]:
    low = max(one.spec.band_hz[0], other.spec.band_hz[0])
    return low, max(low, min(one.spec.band_hz[1], other.spec.band_hz[1]))


def _aligned(one: _Beamed, axis: _Axis, lag_s: float) -> _Aligned:
    own_hz, rate_hz = one.sound.sample_rate_hz, axis.sample_rate_hz
    signal = resampled(one.signal, own_hz, rate_hz)
    first = ((one.emitted_ns - axis.origin_ns) / 1e9 - lag_s) * rate_hz
    known, quiet, sound = (
        shifted_mask(resampled_mask(mask, own_hz, rate_hz, len(signal)), first, axis.length)
        for mask in (one.sound.known, one.sound.quiet, one.sound.sound)
    )
    return _Aligned(shifted(signal, first, axis.length), known, quiet, sound, first, lag_s)


def _combination(beams: Sequence[_Aligned], rate_hz: float) -> tuple[Spectra, FloatArray]:
    """Return the weights and the shares of aligned beams in each bin, (F, A) each."""
    stft = Stft.of(rate_hz)
    spectra = np.stack([stft.forward(one.signal) for one in beams])
    during = np.max([stft.share(one.sound) for one in beams], axis=0)
    each = [_powers(own, stft.share(one.quiet), stft.share(one.sound)) for own, one in zip(spectra, beams, strict=True)]
    levels = np.array([max(float((both - noise).sum()), 0.0) for noise, both in each])
    count = spectra.shape[2]
    if levels[0] == 0.0 or len(beams) == 1:  # nothing to combine, or nothing stands out: the first alone
        first = np.eye(1, len(beams)).repeat(count, axis=0)
        return np.asarray(first, dtype=np.complex128), first
    towards = np.sqrt(levels / levels[0])[None].repeat(count, axis=0)
    floors = np.stack([noise for noise, _ in each], axis=1)
    floors = np.maximum(floors, floors.max(initial=0.0) * _LEAST_FLOOR + _LEAST_POWER)
    noise = np.asarray(floors[:, :, None] * np.eye(len(beams)), dtype=np.complex128)
    both = covariance(spectra, during)
    weights = passing(both, noise, np.asarray(towards, dtype=np.complex64), float(during.sum()))
    parts = np.maximum((weights.conj() * np.einsum("fab,fb->fa", both - noise, weights)).real, 0.0)
    total = parts.sum(axis=1, keepdims=True)
    return weights, np.asarray(np.where(total > 0.0, parts / np.maximum(total, _LEAST_POWER**2), 1.0 / len(beams)))


def _parts(
    beams: Sequence[_Beamed], placed: Sequence[_Aligned], weights: Spectra, shares: FloatArray
) -> Iterator[Part]:
    """Yield the parts of all arrays; those that are left out have no share."""
    number = 0
    nothing = np.zeros(len(weights))
    for one, own in zip(beams, placed, strict=True):
        column = (weights[:, number], shares[:, number]) if own.is_used else (nothing.astype(np.complex128), nothing)
        number += own.is_used
        yield Part(
            one.sound.spec.name,
            one.beam,
            one.sound.sample_rate_hz,
            own.lag_s,
            one.snr_db,
            column[1],
            own.first,
            column[0],
            own.known,
        )
