"""The limit of `onset` in noise: its errors beside those with ideal weights, which need the true direct sound.

`python benchmarks/limits.py --events DIR`: development sounds in the paper's room, two arrays. *Known* weights each hop
and band by the true powers of the direct sound and of the rest, noise and reverberation, instead of by estimates from
the past.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import scipy.fft

from livessl.core.correlate.onset_gcc import _STRONGEST, OnsetFrontEnd, OnsetGCC
from livessl.core.correlate.spectra import Spectra
from livessl.core.locate.estimator import Estimator, Sound, create
from livessl.core.types import ArraySpec, BoolArray, ComplexArray, Float32Array, FloatArray
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.localizer import LEAD_S, PRE_ROLL_FRAMES, _active
from livessl.lab.evaluate.paper import C_M_S, EXPERIMENTS, ROOM_M, pair
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.unit import PEAK, convolved
from livessl.simulation.room import impulse_responses

RATE_HZ: Final = 16000.0
FRAME: Final = 800
RT60S_S: Final = (1.0, 2.0)
CLASSES: Final = ("doorslam", "keysDrop", "phone", "speech")


class Known:
    """Computes the onset GCC of frames like the front end, but with weights from their true direct sound."""

    def __init__(self, front_end: OnsetFrontEnd, channels: int) -> None:
        self._front_end = front_end
        self._tail = np.zeros((2 * channels, 0), dtype=np.float32)

    def push(self, samples: Float32Array, direct: Float32Array) -> OnsetGCC:
        """Return the onset GCC of a frame (K, n) with ideal weights from its direct part (K, n)."""
        here, length = self._front_end, len(self._front_end._window)
        joined = np.concatenate([self._tail, np.concatenate([samples, direct])], axis=1)
        hops = max(0, (joined.shape[1] - length) // here._hop + 1)
        self._tail = joined[:, hops * here._hop :]
        if hops == 0:
            return here.nothing
        cut = np.lib.stride_tricks.sliding_window_view(joined, length, axis=1)[:, :: here._hop][:, :hops]
        spectra = np.asarray(scipy.fft.rfft(cut.swapaxes(0, 1) * here._window, here._n_fft, axis=2), dtype=np.complex64)
        whole, straight = np.split(spectra, 2, axis=1)
        power, rest = (_power(part[:, :, here._band]) for part in (straight, whole - straight))
        rest += here._parameters.least
        weights = np.minimum(power**2 / (rest * (rest + 2.0 * power)), _STRONGEST).astype(np.float32)
        cross = here._cross(Spectra(whole, here._n_fft), weights, np.broadcast_to(here._state.noise, weights.shape))
        return OnsetGCC(here._sampling.sample(cross), cross.levels)


def _power(spectra: ComplexArray) -> Float32Array:
    """Return power (T, B) of spectra (T, K, B): the mean over microphones and three bins, as in the front end."""
    mean = np.square(np.abs(spectra)).mean(axis=1)
    padded = np.pad(mean, ((0, 0), (1, 1)), mode="edge")
    return np.asarray((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / 3.0)


def errors_m(
    estimator: Estimator,
    arrays: Sequence[ArraySpec],
    samples: Float32Array,
    direct: Float32Array,
    source_m: FloatArray,
) -> tuple[float, float]:
    """Return the errors of one event (K, n) with the default and with ideal weights; refused results count, too."""
    prepared: tuple[dict[str, Sound], dict[str, Sound]] = ({}, {})
    for spec, every, straight in zip(
        arrays, np.split(samples, len(arrays)), np.split(direct, len(arrays)), strict=True
    ):
        active: BoolArray = _active(every, RATE_HZ)
        loud = np.flatnonzero(active)
        listener = estimator.onset_front_end(spec.name, RATE_HZ)
        if listener is None or not len(loud):
            raise SystemExit(f"{spec.name}: no active frame")
        known = Known(listener, len(every))
        frames = [slice(k * FRAME, (k + 1) * FRAME) for k in range(max(0, loud[0] - PRE_ROLL_FRAMES), loud[-1] + 1)]
        shipped = [listener.push(every[:, at], quiet=not active[at.start // FRAME]) for at in frames]
        ideal = [known.push(every[:, at], straight[:, at]) for at in frames]
        for sounds, onsets in zip(prepared, (shipped, ideal), strict=True):
            sounds[spec.name] = Sound((every,), RATE_HZ, onsets)
    one, other = (float(np.linalg.norm(estimator.locate(sounds).position_m - source_m)) for sounds in prepared)
    return one, other


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=Path, required=True, help="clips named like doorslam001.wav")
    parser.add_argument(
        "--positions", type=int, default=40, help="number of source positions, with four sounds each (default: 40)"
    )
    parser.add_argument(
        "--snr", type=float, default=10.0, help="level of the sound above the noise, in dB (default: 10)"
    )
    parser.add_argument("--seed", type=int, default=9191)
    arguments = parser.parse_args()
    clips = read_clips(arguments.events, CLASSES, RATE_HZ)
    arrays = pair(np.array(ROOM_M) / 2.0, 1, 5)
    estimator = create("onset", arrays, EXPERIMENTS["diversity"].grid(0.1), C_M_S)
    microphones_m = np.vstack([spec.microphones_m for spec in arrays])
    found: dict[tuple[float, str], list[tuple[float, float]]] = {}
    for number in range(arguments.positions):
        rng = np.random.default_rng([arguments.seed, number])
        source_m = rng.uniform(0.0, 1.0, 3) * ROOM_M
        lead = round((LEAD_S + rng.uniform(0.0, 0.05)) * RATE_HZ)
        free, *rooms = impulse_responses(
            ROOM_M, source_m, microphones_m, (0.0, *RT60S_S), sample_rate_hz=RATE_HZ, c_m_s=C_M_S,
            own_lengths=True, compiled=True,
        )  # fmt: skip
        for name in CLASSES:
            ours = clips[name][HALVES.index("development") :: 2]
            sound = ours[int(rng.integers(len(ours)))][1]
            straight = convolved(sound, free)
            for rt60_s, response in zip(RT60S_S, rooms, strict=True):
                wet = np.pad(convolved(sound, response), ((0, 0), (lead, 0)))
                direct = np.zeros_like(wet)
                direct[:, lead : lead + straight.shape[1]] = straight[:, : wet.shape[1] - lead]
                rms = np.sqrt(np.square(wet[:, lead:]).mean() * 10.0 ** (-arguments.snr / 10.0))
                samples = wet + np.float32(rms) * rng.standard_normal(wet.shape, dtype=np.float32)
                scale = np.float32(PEAK / np.abs(samples).max())
                off = errors_m(estimator, arrays, samples * scale, direct * scale, source_m)
                found.setdefault((rt60_s, name), []).append(off)
    print(f"median error of {arguments.positions} positions at {arguments.snr:g} dB, m: default weights, ideal weights")
    for rt60_s in RT60S_S:
        rows = {name: found[rt60_s, name] for name in CLASSES}
        rows["all"] = [pair for some in rows.values() for pair in some]
        for name, some in rows.items():
            shipped, known = np.median(some, axis=0)
            print(f"RT {rt60_s:g} s  {name:9}  {shipped:.3f}  {known:.3f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
