"""The beam of one array at a place (beamforming): delay-and-sum or minimum variance (MVDR), its weights.

A sound S at the place reaches microphone k directly as d_k S, with d_k = (r/r_k) exp(-j 2 pi f (r_k - r)/c), r_k the
distance to the microphone and r that to the array's centre. The beam is w^H X. Delay-and-sum takes w = d/(d^H d): all
that comes directly from the place adds up.

In a room early reflections come with the direct sound, within one window of the transform, and carry as much of it. The
minimum-variance beam (MVDR) therefore takes the whole response h instead of d, estimated from the sound itself. L h is
the principal eigenvector of L^-1 R_x L^-H. R_x is the covariance during the sound, and R = L L^H that of the noise in
the quiet before it (covariance whitening: Markovich, Gannot and Cohen, IEEE TASLP 17(6), 2009). It passes the sound as
delay-and-sum does, w^H h = d^H h / (d^H d), so that only what comes from the place is passed, and minimizes the noise:
w = R^-1 h (h^H d) / (h^H R^-1 h d^H d). Where the sound hardly exceeds the noise, h is drawn to d (`PRIOR`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from livessl.core.enhance.stft import Spectra, Stft
from livessl.core.steering import NEAREST_M
from livessl.core.types import ArraySpec, BoolArray, Float32Array, FloatArray, read_only

Method = Literal["delay-and-sum", "mvdr"]

LOADING: Final = 1.0
"""Power that is added to the diagonal of the noise covariance, as a share of its mean. It keeps the beam's white-noise
gain near that of delay-and-sum where few windows of quiet are known or the microphones are not quite in place."""

PRIOR: Final = 0.5
"""Weight of the direct sound in the estimate of the response, in units of the standard deviation by which a covariance
of noise from as many windows errs."""

LEAST_QUIET: Final = 4
"""Fewest windows of quiet from which a noise covariance is estimated."""

INSIDE: Final = 0.99
"""Share of a window's energy that must lie within the quiet, or the sound, for the window to count as part of it."""

_LEAST_POWER: Final = 1e-20
"""Power, full scale squared, that is added to the noise covariance, so that digital silence has an inverse."""


@dataclass(frozen=True, slots=True)
class ArraySound:
    """The samples that one array recorded around a sound.

    Parameters
    ----------
    spec : ArraySpec
    time_ns : int
        Site time of the first sample in nanoseconds; a known offset of the array's clock is already subtracted.
    sample_rate_hz : float
    samples : (K, n) float32
        Zero where they are missing.
    known : (n,) bool
        Where samples exist.
    quiet : (n,) bool
        Where only background is expected: before the sound.
    sound : (n,) bool
        Where the sound is expected.

    Raises
    ------
    ValueError
        If the shapes do not fit together.
    """

    spec: ArraySpec
    time_ns: int
    sample_rate_hz: float
    samples: Float32Array
    known: BoolArray
    quiet: BoolArray
    sound: BoolArray

    def __post_init__(self) -> None:
        expected = (len(self.spec.microphones_m), *self.known.shape)
        if self.samples.shape != expected or self.known.ndim != 1:
            raise ValueError(
                f"sound of array {self.spec.name!r}: expected samples (microphones, n) = {expected}, "
                f"got {self.samples.shape}"
            )
        if not self.known.shape == self.quiet.shape == self.sound.shape:
            raise ValueError(f"sound of array {self.spec.name!r}: expected masks of one length")
        for array in (self.samples, self.known, self.quiet, self.sound):
            read_only(array)


@dataclass(frozen=True, slots=True)
class Beam:
    """The weights of one array's microphones.

    Parameters
    ----------
    stft : Stft
    weights : (F, K) complex64
        The beam is `conj(weights) . X` in each bin.
    noise_is_known : bool
        False if there was too little quiet for a noise covariance; the beam is then delay-and-sum.
    """

    stft: Stft
    weights: Spectra
    noise_is_known: bool

    def apply(self, samples: Float32Array) -> FloatArray:
        """Return the beam (n,) of an array's samples (K, n)."""
        spectra = self.stft.forward(samples)
        return self.stft.inverse(np.einsum("fk,ktf->tf", self.weights.conj(), spectra), samples.shape[1])


def steering_vector(spec: ArraySpec, position_m: FloatArray, frequencies_hz: FloatArray, c_m_s: float) -> Spectra:
    """Return the responses d (F, K) of an array's microphones to a sound at a position, relative to its centre.

    Parameters
    ----------
    spec : ArraySpec
    position_m : (3,) float64
    frequencies_hz : (F,) float64
    c_m_s : float
        Speed of sound, m/s.
    """
    far_m = np.maximum(np.linalg.norm(spec.microphones_m - position_m, axis=1), NEAREST_M)
    centre_m = max(float(np.linalg.norm(spec.centre_m - position_m)), NEAREST_M)
    phase = -2j * np.pi * frequencies_hz[:, None] * (far_m - centre_m) / c_m_s
    return np.asarray(np.exp(phase) * (centre_m / far_m), dtype=np.complex64)


def steer(sound: ArraySound, position_m: FloatArray, c_m_s: float, method: Method = "mvdr") -> Beam:
    """Return the beam of an array at a position.

    Parameters
    ----------
    sound : ArraySound
        Its quiet gives the noise covariance, its sound the response of the room.
    position_m : (3,) float64
    c_m_s : float
        Speed of sound, m/s.
    method : {"mvdr", "delay-and-sum"}
    """
    stft = Stft.of(sound.sample_rate_hz)
    towards = steering_vector(sound.spec, position_m, stft.frequencies_hz(sound.sample_rate_hz), c_m_s)
    spectra = stft.forward(sound.samples)
    quiet, during = stft.share(sound.quiet) > INSIDE, stft.share(sound.sound)
    is_known = int(quiet.sum()) >= LEAST_QUIET
    if method == "delay-and-sum" or not is_known:
        weights = towards / np.square(np.abs(towards)).sum(axis=1, keepdims=True)
    else:
        noise = loaded(covariance(spectra, quiet), LOADING)
        weights = passing(covariance(spectra, during), noise, towards, float(during.sum()))
    return Beam(stft, np.asarray(weights, dtype=np.complex64), is_known)


def covariance(spectra: Spectra, windows: FloatArray | BoolArray) -> Spectra:
    """Return the covariance (F, K, K) of spectra (K, T, F) over windows with these weights (T,)."""
    weighted = spectra * windows[:, None]
    sums = np.matmul(weighted.transpose(2, 0, 1), spectra.transpose(2, 1, 0).conj())
    return np.asarray(sums / max(float(windows.sum()), 1e-9), dtype=np.complex128)


def loaded(noise: Spectra, loading: float) -> Spectra:
    """Return a covariance (F, K, K) with a share of its mean power added to the diagonal."""
    count = noise.shape[1]
    mean = np.trace(noise, axis1=1, axis2=2).real / count
    return np.asarray(noise + (loading * mean + _LEAST_POWER)[:, None, None] * np.eye(count))


def passing(both: Spectra, noise: Spectra, towards: Spectra, windows: float) -> Spectra:
    """Return the weights (F, K) that pass a sound as delay-and-sum does and minimize the noise.

    Parameters
    ----------
    both : (F, K, K) complex128
        Covariance of sound and noise.
    noise : (F, K, K) complex128
        Covariance of the noise, invertible.
    towards : (F, K) complex64
        Response to the direct sound.
    windows : float
        Number of windows from which `both` was estimated.
    """
    white = np.linalg.inv(np.linalg.cholesky(noise))
    white_towards = np.matmul(white, towards[..., None])[..., 0]
    unit = white_towards / np.maximum(np.linalg.norm(white_towards, axis=1, keepdims=True), _LEAST_POWER)
    excess = np.matmul(np.matmul(white, both), white.conj().transpose(0, 2, 1)) - np.eye(noise.shape[1])
    prior = PRIOR / np.sqrt(max(windows, 1.0)) * unit[:, :, None] * unit[:, None, :].conj()
    principal = np.linalg.eigh(excess + prior)[1][:, :, -1]
    response = np.linalg.solve(white, principal[..., None])[..., 0]  # h; in white noise it has length 1
    minimal = np.matmul(white.conj().transpose(0, 2, 1), principal[..., None])[..., 0]
    passed = (response.conj() * towards).sum(axis=1) / np.square(np.abs(towards)).sum(axis=1)
    return np.asarray(minimal * passed[:, None])
