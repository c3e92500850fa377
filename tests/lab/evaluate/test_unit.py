"""One position and its parts, against sums and rooms that are computed in another way."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from evaluate.small_campaign import CLASSES, small_job, write_sounds
from livessl.core.correlate.band import band_bins
from livessl.core.correlate.gcc_phat import CrossSpectra
from livessl.core.correlate.spectra import whole_segment
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.steering import alias_free_hz, steering_delays_s
from livessl.core.types import ArraySpec, Float32Array, FloatArray
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.maps import PairMatrices, PairTables, reach_samples
from livessl.lab.evaluate.paper import BAND_HZ, C_M_S, EXPERIMENTS, Settings, pair, tetrahedron_in_cube
from livessl.lab.evaluate.unit import Position, active_segment, recorded, t30_s
from livessl.simulation.room import impulse_responses

RATE_HZ = 16000.0
GRID = Grid(((0.0, 8.0), (0.0, 10.0), (0.0, 4.0)), 1.0)


def array(edge_m: float) -> ArraySpec:
    return ArraySpec("any", tetrahedron_in_cube(edge_m) + np.array([4.1, 4.9, 2.0]), BAND_HZ)


def noise(seed: int = 0) -> Float32Array:
    """Four channels with a common part, without delay."""
    rng = np.random.default_rng(seed)
    return (rng.standard_normal((4, 6000)) + rng.standard_normal(6000)).astype(np.float32)


def summed_directly(spec: ArraySpec, samples: Float32Array, *, band_limit: bool) -> FloatArray:
    """The map by definition: Re sum over the kept bins of each pair's phase, turned by each grid point's delay."""
    pairs = microphone_pairs(4)
    reach = reach_samples(spec.aperture_m, RATE_HZ, C_M_S)
    spectra = whole_segment(samples, RATE_HZ, reach)
    low, high = band_bins(spectra.n_fft, RATE_HZ, BAND_HZ)
    frequency_hz = np.arange(low, high) * RATE_HZ / spectra.n_fft
    inside = spectra.values[0, :, low:high].astype(np.complex128)
    delay_s = steering_delays_s(GRID.points_m(), spec.microphones_m, pairs, C_M_S)
    limit_hz = alias_free_hz(GRID.points_m(), spec.microphones_m, pairs, GRID.spacing_m, C_M_S)
    power = np.zeros(GRID.size)
    for p, (i, k) in enumerate(pairs):
        phase = np.conj(inside[i]) * inside[k]
        phase /= np.abs(phase)
        for node in range(GRID.size):
            kept = frequency_hz <= (limit_hz[p, node] if band_limit else np.inf)
            turned = phase[kept] * np.exp(2j * np.pi * frequency_hz[kept] * delay_s[p, node])
            power[node] += 2.0 / 4.0 * turned.real.sum() / (high - low)
    return power


@pytest.mark.parametrize(("edge_m", "budget"), [(0.5, 0.02), (3.0, 0.10)])
def test_matrices_give_the_sum_of_the_definition(edge_m: float, budget: float) -> None:
    # Cut-offs are smoothed over 1/(20 ms) = 50 Hz: on this 1 m grid they are around 1600 Hz (0.5 m) and 270 Hz (3 m),
    # of which that is 3 % and 20 %. The bins in doubt count half: 2 % and 10 %.
    spec, samples = array(edge_m), noise()
    pairs = microphone_pairs(4)
    reach = reach_samples(spec.aperture_m, RATE_HZ, C_M_S)
    cross = CrossSpectra(whole_segment(samples, RATE_HZ, reach), pairs, RATE_HZ, BAND_HZ)
    lags = cross.correlations(reach).real[None].astype(np.float32)
    found = {}
    for band_limit in (True, False):
        matrices = PairMatrices(GRID, RATE_HZ, C_M_S, band_limit=band_limit)
        found[band_limit] = matrices.power(spec, pairs, lags)[:, 0]
        wanted = summed_directly(spec, samples, band_limit=band_limit)
        assert np.linalg.norm(found[band_limit] - wanted) < budget * np.linalg.norm(wanted)
    assert np.linalg.norm(found[True] - found[False]) > 0.1 * np.linalg.norm(found[False])  # the limit has an effect
    # tables look the nearest eighth of a sample up: 8 degrees at 6 kHz
    tables = PairTables(GRID, RATE_HZ, C_M_S, band_limit=False).power(spec, pairs, lags)[:, 0]
    assert np.linalg.norm(tables - found[False]) < 0.05 * np.linalg.norm(found[False])


def test_a_position_is_one_row_per_event_condition_and_method(tmp_path: Path) -> None:
    job = small_job(tmp_path)
    position = job.unit()
    rows = position.rows(0)
    keys = {(row["system"], row["method"], row["sound"], row["rt60_s"]) for row in rows}
    assert len(rows) == len(keys) == 2 * 3 * 2 * 2
    for row in rows:
        truth, found = (np.array([row[f"{prefix}{axis}_m"] for axis in "xyz"]) for prefix in ("", "found_"))
        assert row["error_m"] == pytest.approx(np.linalg.norm(found - truth))
        assert row["error_m"] >= abs(row["radial_m"]) - 1e-9
        assert abs(row["azimuth_deg"]) <= 180.0
        assert np.abs((found - 0.5) % 1.0).min() < 1e-9  # a point of the 1 m grid
    assert position.rows(0) == rows
    assert position.rows(1)[0]["x_m"] != rows[0]["x_m"]


def test_a_small_array_in_a_dry_room_finds_the_direction(tmp_path: Path) -> None:
    job = small_job(tmp_path)
    position = job.unit()
    rows = [row for number in range(8) for row in position.rows(number)]
    dry = [row for row in rows if row["rt60_s"] == 0.0 and row["system"] == "small" and row["method"] == "srp-phat"]
    # a cell of 1 m is 1/3 rad wide at 3 m: half of it is 10 degrees; one in four may be nearer
    assert np.median([abs(row["azimuth_deg"]) for row in dry]) < 10.0


def test_sampling_faster_changes_hardly_anything(tmp_path: Path) -> None:
    found = []
    for rate_hz in (16000.0, 44100.0):
        settings = Settings("one-array", 6, (0.0,), seed=5, spacing_m=1.0, sample_rate_hz=rate_hz)
        position = Position(settings, read_clips(write_sounds(tmp_path), CLASSES, rate_hz))
        rows = [row for number in range(6) for row in position.rows(number) if row["method"] == "srp-phat"]
        found.append(np.array([[row[f"found_{axis}_m"] for axis in "xyz"] for row in rows]))
    # the same grid points, except between two of them, where rounding to frames of 50 ms decides
    assert (found[0] == found[1]).all(axis=1).mean() > 0.8
    assert len(np.unique(found[0], axis=0)) > 3


def test_eight_microphones_are_the_vertices_of_a_cube() -> None:
    one, other = pair(np.array([4.0, 5.0, 2.0]), 1, 0.0)
    edge_m = 0.5 / np.sqrt(2.0)
    steps = np.array(list(itertools.product((-edge_m / 2, edge_m / 2), repeat=3)))
    vertices = steps + np.array([4.0, 5.0, 2.0])
    found = np.vstack([one.microphones_m, other.microphones_m])
    assert {tuple(place) for place in found.round(9)} == {tuple(place) for place in vertices.round(9)}
    far = pair(np.array([4.0, 5.0, 2.0]), 1, 5.0)
    assert far[0].centre_m - far[1].centre_m == pytest.approx([0.0, 5.0, 0.0])
    for name in ("one-array", "diversity", "office"):
        experiment = EXPERIMENTS[name]
        for system in experiment.systems:
            assert (system.microphones_m > 0.0).all()
            assert (system.microphones_m < experiment.room_m).all()


KEY = np.random.SeedSequence(5, spawn_key=(3, 1))


def noise_of(wet: Float32Array, snr_db: float, key: tuple[int, int] = (1, 0)) -> tuple[FloatArray, FloatArray]:
    """The noise of a recording, (K, n), and its sound, (K, n), separated by least squares."""
    samples = recorded(wet, snr_db, KEY, key).astype(np.float64)
    sound = wet.astype(np.float64)
    sound *= (samples * sound).sum() / (sound**2).sum()
    return samples - sound, sound


@pytest.mark.parametrize("snr_db", [40.0, 20.0, 0.0, -6.0])
def test_noise_is_added_at_the_ratio_stated(snr_db: float) -> None:
    # unequal channels, and half of it silent: the ratio is of the means over all microphones and the whole recording
    wet = noise() * np.array([[1.0], [0.5], [2.0], [0.1]], dtype=np.float32)
    wet[:, 3000:] = 0.0
    added, sound = noise_of(wet, snr_db)
    found_db = 10.0 * np.log10((sound**2).mean() / (added**2).mean())
    # the power of n = 24000 normal samples scatters by sqrt(2 / n) = 0.9 %, 0.04 dB; so does the share taken away.
    # Rounding to 16 bits is 90 dB below full scale.
    assert found_db == pytest.approx(snr_db, abs=3 * 0.06)
    # independent at each microphone, as strong at the soft one as at the loud one, and in silence; and white
    correlation = np.corrcoef(added) - np.eye(4)
    assert np.abs(correlation).max() < 4.0 / np.sqrt(6000)
    np.testing.assert_allclose(added.std(axis=1) / added.std(), 1.0, atol=0.05)
    np.testing.assert_allclose(added[:, 3000:].std() / added[:, :3000].std(), 1.0, atol=0.05)
    halves = np.split(np.abs(np.fft.rfft(added, axis=1)[:, 1:]) ** 2, 2, axis=1)
    assert halves[0].mean() / halves[1].mean() == pytest.approx(1.0, abs=0.1)


def test_noise_depends_on_the_key() -> None:
    first, _ = noise_of(noise(), 10.0)
    again, _ = noise_of(noise(), 10.0)
    other, _ = noise_of(noise(), 10.0, (2, 0))
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 4.0 / np.sqrt(24000)
    # without noise there is the sound alone, its peak at half of full scale, rounded to 16 bits and float32
    without = recorded(noise(), None, KEY, (1, 0)) - 0.5 / np.abs(noise()).max() * noise()
    assert np.abs(without).max() < 0.51 / 32768


def test_strong_noise_destroys_the_estimate(tmp_path: Path) -> None:
    clips = small_job(tmp_path).clips
    errors = []
    for snr_db in (None, 40.0, -20.0):
        position = Position(Settings("one-array", 4, (0.0,), seed=5, spacing_m=1.0, snr_db=snr_db), clips)
        rows = [row for number in range(4) for row in position.rows(number)]
        errors.append([row["error_m"] for row in rows if (row["system"], row["method"]) == ("small", "srp-phat")])
    quiet, soft, loud = (np.array(each) for each in errors)
    assert (soft == quiet).mean() >= 0.75  # of eight: the same grid points, with at most two close calls
    # with noise 20 dB above the sound the estimate is random: uniform in 8 x 10 x 4 m, the median distance is metres
    assert np.median(loud) > 2.0
    assert np.median(quiet) < 2.0


def test_segment_is_the_longest_or_the_loudest() -> None:
    frame = 800
    samples = np.zeros((2, 10 * frame + 99), dtype=np.float32)
    samples[:, 1 * frame : 4 * frame] = 0.5
    samples[:, 6 * frame : 7 * frame] = 0.7
    assert active_segment(samples, RATE_HZ, "longest") == (frame, 4 * frame)
    assert active_segment(samples, RATE_HZ, "peak") == (6 * frame, 7 * frame)


def test_t30_is_that_of_an_exponential_decay() -> None:
    time_s = np.arange(16000) / RATE_HZ
    decay = np.exp(-time_s * 3.0 * np.log(10.0) / 0.6)  # 60 dB in 0.6 s
    response = (np.random.default_rng(1).standard_normal(16000) * decay).astype(np.float32)
    # the level between -5 and -35 dB scatters by less than 1 dB of 30
    assert t30_s(response, RATE_HZ, BAND_HZ) == pytest.approx(0.6, rel=0.03)
    rumble = np.cos(2.0 * np.pi * 20.0 * time_s) * 0.5 * np.exp(-time_s)  # rings for seconds below the band
    assert t30_s((response + rumble).astype(np.float32), RATE_HZ, BAND_HZ) == pytest.approx(0.6, rel=0.05)
    assert t30_s((response + rumble).astype(np.float32), RATE_HZ, (5.0, 6000.0)) > 1.0
    assert t30_s(np.eye(1, 1600, 20, dtype=np.float32)[0], RATE_HZ, BAND_HZ) == 0.0


def test_compiled_rooms_are_the_same_rooms() -> None:
    rt60s_s = [0.0, 0.3, 0.5]
    plain, compiled = (
        impulse_responses(
            [4.0, 5.0, 3.0],
            [1.1, 2.2, 1.3],
            [[3.1, 2.2, 1.0], [2.9, 4.1, 2.0]],
            rt60s_s,
            sample_rate_hz=RATE_HZ,
            own_lengths=True,
            compiled=compiled,
        )
        for compiled in (False, True)
    )
    for one, other, rt60_s in zip(plain, compiled, rt60s_s, strict=True):
        # float32 sums: each image errs by 6e-8 of its own
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-5 * np.abs(one).max())
        end = int(max(rt60_s, 0.05) * RATE_HZ)
        assert not one[:, end:].any()
        assert one[:, : end // 2].any()
    assert np.abs(plain[1] - plain[2]).max() > 0.01 * np.abs(plain[1]).max()
