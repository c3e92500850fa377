"""Power maps of other codes, and of the plain formula, at the grid points that livessl searches, for `peers.py`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import scipy.fft

from livessl.core.correlate.band import band_bins
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.correlate.spectra import Spectra, whole_segment
from livessl.core.geometry import Grid, microphone_pairs, pair_weight
from livessl.core.steering import steering_delays_s
from livessl.core.types import ArraySpec, Float32Array, FloatArray, RealArray
from livessl.lab.bench import kernels as bench

Sounds = Sequence[Float32Array]
Power = Callable[[Sounds], RealArray]
"""Maps each array's samples (K, n) to the summed power (N,) at the grid points that it was made for."""


def room_grid(spacing_m: float) -> Grid:
    """Return a grid of the whole room."""
    return Grid(((0.0, bench.ROOM_M[0]), (0.0, bench.ROOM_M[1]), (0.0, bench.ROOM_M[2])), spacing_m)


def transform_length() -> int:
    """Return the number of samples to which livessl pads a block before the transform."""
    lengths = []

    def front_end(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
        spectra = whole_segment(samples, sample_rate_hz, lags)
        lengths.append(spectra.n_fft)
        return spectra

    (spec,) = bench.array_specs(1)
    GCCPhat(spec, bench.RATE_HZ, bench.C_M_S, front_end)([np.zeros((len(spec.microphones_m), bench.BLOCK), np.float32)])
    return lengths[0]


N_FFT: Final = transform_length()
LOW, HIGH = band_bins(N_FFT, bench.RATE_HZ, bench.BAND_HZ)
FREQUENCY_HZ: Final = np.arange(LOW, HIGH) * (bench.RATE_HZ / N_FFT)

STEERING_BYTES: Final = 2 * 6 * 2 * 4 * (HIGH - LOW)
"""Memory of the steering product's matrices per grid point, in bytes: two arrays, six pairs, complex float32."""


def reference(specs: Sequence[ArraySpec], points_m: FloatArray) -> Power:
    """The plain formula in double precision: 2/K sum_{i<k} 1/B sum_f Re[conj(X_i) X_k / |X_i X_k| e^{j 2 pi f tau}]."""

    def power(sounds: Sounds) -> RealArray:
        total = np.zeros(len(points_m))
        for spec, samples in zip(specs, sounds, strict=True):
            whitened = _whitened(samples.astype(np.float64))
            pairs = microphone_pairs(len(samples))
            delays_s = steering_delays_s(points_m, spec.microphones_m, pairs, bench.C_M_S)
            for (i, k), tau_s in zip(pairs, delays_s, strict=True):
                steering = np.exp(2j * np.pi * tau_s[:, None] * FREQUENCY_HZ)
                terms = steering @ (np.conj(whitened[i]) * whitened[k])
                total += pair_weight(len(samples)) * terms.real / len(FREQUENCY_HZ)
        return total

    return power


def steering_product(specs: Sequence[ArraySpec], points_m: FloatArray) -> Power:
    """The obvious code: whitened cross-spectra times a stored steering matrix, (N, bins) for each pair, float32."""
    matrices: list[Float32Array] = []
    for spec in specs:
        pairs = microphone_pairs(len(spec.microphones_m))
        delays_s = steering_delays_s(points_m, spec.microphones_m, pairs, bench.C_M_S)
        matrix = np.empty((len(points_m), len(pairs), 2, len(FREQUENCY_HZ)), np.float32)
        for pair, tau_s in enumerate(delays_s):
            phase = 2.0 * np.pi * tau_s[:, None] * FREQUENCY_HZ
            matrix[:, pair, 0], matrix[:, pair, 1] = np.cos(phase), -np.sin(phase)
        matrices.append(matrix.reshape(len(points_m), -1))

    def power(sounds: Sounds) -> RealArray:
        total = np.zeros(len(points_m), np.float32)
        for matrix, samples in zip(matrices, sounds, strict=True):
            whitened = _whitened(samples)
            first, second = microphone_pairs(len(samples)).T
            cross = np.conj(whitened[first]) * whitened[second]
            parts = np.stack([cross.real, cross.imag], axis=1).astype(np.float32)
            total += np.float32(pair_weight(len(samples)) / cross.shape[1]) * (matrix @ parts.ravel())
        return total

    return power


class _Nodes:
    """Arbitrary positions (N, 3), as the grid that pyroomacoustics expects."""

    def __init__(self, points_m: FloatArray) -> None:
        self.x, self.y, self.z = np.ascontiguousarray(points_m.T)
        self.n_points = len(points_m)
        self.values = np.zeros(self.n_points)

    def set_values(self, values: FloatArray) -> None:
        self.values = values


def pyroomacoustics_srp(specs: Sequence[ArraySpec], points_m: FloatArray) -> Power:
    """`doa.SRP` of pyroomacoustics with its own loop, adapted to positions instead of directions.

    As it comes its near field cannot be used: several distances raise an error, the grid is the unit sphere whatever
    the distance, and the steering has the sign of the far field turned round. So the grid is replaced by the nodes, and
    the delays of its own near-field steering are taken with the other sign.
    """
    from pyroomacoustics.doa import SRP
    from pyroomacoustics.doa.doa import ModeVector

    localizers = []
    for spec in specs:
        place_m = spec.microphones_m.T
        localizer = SRP(place_m, bench.RATE_HZ, N_FFT, c=bench.C_M_S, azimuth=np.zeros(1))
        localizer.grid = _Nodes(points_m)
        localizer.mode_vec = ModeVector(place_m, bench.RATE_HZ, N_FFT, bench.C_M_S, localizer.grid, mode="near")
        localizer.mode_vec.tau = -localizer.mode_vec.tau
        localizer.num_snap, localizer.freq_bins, localizer.num_freq = 1, np.arange(LOW, HIGH), HIGH - LOW
        localizers.append(localizer)

    def power(sounds: Sounds) -> RealArray:
        total = np.zeros(len(points_m))
        for localizer, samples in zip(localizers, sounds, strict=True):
            localizer._process(np.fft.rfft(samples, N_FFT)[:, :, None])
            total += localizer.grid.values
        return total

    return power


def acoular_beamformer(specs: Sequence[ArraySpec], points_m: FloatArray) -> Power:
    """`BeamformerBase` of acoular on the cross-spectral matrix of phases alone, summed over the band."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that it keeps to one thread beside OpenBLAS, as all do here
        import acoular

    acoular.config.global_caching = "none"
    beamformers = []
    for spec in specs:
        steering = acoular.SteeringVector(
            grid=acoular.ImportGrid(pos=np.ascontiguousarray(points_m.T)),
            mics=acoular.MicGeom(pos_total=spec.microphones_m.T),
            env=acoular.Environment(c=bench.C_M_S),
            steer_type="classic",
        )
        beamformers.append(acoular.BeamformerBase(steer=steering, r_diag=False, cached=False))

    def power(sounds: Sounds) -> RealArray:
        total = np.zeros(len(points_m))
        for beamformer, samples in zip(beamformers, sounds, strict=True):
            whitened = _whitened(samples.astype(np.float64))
            matrix = np.einsum("if,kf->fik", whitened, np.conj(whitened))
            beamformer.freq_data = acoular.PowerSpectraImport(csm=matrix, frequencies=FREQUENCY_HZ)
            total += beamformer.result[:].sum(axis=0)
        return total

    return power


def _whitened(samples: RealArray) -> Any:
    """Return the phases (K, B) in the band."""
    spectra = scipy.fft.rfft(samples, N_FFT)[:, LOW:HIGH]
    return spectra / np.abs(spectra)


PEERS: Final[dict[str, Callable[[Sequence[ArraySpec], FloatArray], Power]]] = {
    "steering product, NumPy": steering_product,
    "acoular": acoular_beamformer,
    "pyroomacoustics": pyroomacoustics_srp,
}
