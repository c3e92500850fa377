"""Front ends: identities that hold to rounding, and what each is for."""

from __future__ import annotations

import numpy as np
import pytest

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.correlate import spectra
from livessl.core.correlate.gcc_phat import CrossSpectra, GCCPhat
from livessl.core.correlate.spectra import averaged, cepstral, minimum_phase_cepstrum, whole_segment
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.joint_array import joined
from livessl.core.locate.estimator import Localization, Sound, create
from livessl.core.locate.map_estimator import third_octaves_below_hz
from livessl.core.locate.srp import SRPMapper
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.methods import METHODS
from livessl.core.steering import alias_free_hz, steering_delays_s
from livessl.core.types import ArraySpec, Float32Array, FloatArray

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
BOUNDS_M = ((0.0, 4.2), (0.0, 5.1), (0.0, 2.7))
SOURCE_M = np.array([1.13, 3.31, 1.47])
PAIR = microphone_pairs(2)


def noise(count: int = 20000, channels: int = 2, seed: int = 0) -> Float32Array:
    return np.random.default_rng(seed).standard_normal((channels, count)).astype(np.float32)


def through(channel: FloatArray, sound: FloatArray) -> FloatArray:
    return np.convolve(sound, channel)[: len(sound)]


def test_folded_real_cepstrum_is_the_complex_one_without_its_odd_part() -> None:
    n_fft = 1024
    spectrum = np.fft.rfft(np.random.default_rng(1).standard_normal((3, 400)), n_fft, axis=1)
    folded = minimum_phase_cepstrum(np.abs(spectrum), n_fft)
    # the complex cepstrum, with a phase that is right up to multiples of 2 pi: these are odd too and cancel
    full = np.fft.fft(np.fft.irfft(spectrum, n_fft, axis=1), axis=1)
    complex_cepstrum = np.fft.ifft(np.log(np.abs(full)) + 1j * np.angle(full), axis=1).real
    expected = complex_cepstrum.copy()
    expected[:, 1 : n_fft // 2] += complex_cepstrum[:, : n_fft // 2 : -1]
    expected[:, n_fft // 2 + 1 :] = 0.0
    # bins where X is real and negative have a phase of pi at both ends of the axis: two of a thousand, 1/n_fft each
    np.testing.assert_allclose(folded, expected, atol=2.0 * np.pi / n_fft)
    assert np.abs(folded - complex_cepstrum).max() > 0.1


def test_minimum_phase_sound_is_its_own_minimum_phase_part() -> None:
    n_fft = 4096
    decaying = 0.5 ** np.arange(60.0)  # one pole inside the unit circle, no zero outside
    spectrum = np.fft.rfft(decaying, n_fft)[None]
    rebuilt = np.exp(np.fft.rfft(minimum_phase_cepstrum(np.abs(spectrum), n_fft), axis=1))
    np.testing.assert_allclose(rebuilt, spectrum, rtol=1e-9)
    reversed_spectrum = np.fft.rfft(decaying[::-1], n_fft)[None]  # all zeros outside: not its own
    rebuilt = np.exp(np.fft.rfft(minimum_phase_cepstrum(np.abs(reversed_spectrum), n_fft), axis=1))
    assert np.abs(rebuilt - reversed_spectrum).max() > 0.5


def test_the_spectrum_of_the_source_cancels_in_a_pair() -> None:
    n_fft = 8192
    rng = np.random.default_rng(2)
    source = np.fft.rfft(rng.standard_normal(3000), n_fft)
    channels = np.fft.rfft(rng.standard_normal((2, 500)) * 0.99 ** np.arange(500), n_fft, axis=1)
    of_channels, of_sounds = (minimum_phase_cepstrum(np.abs(x), n_fft) for x in (channels, channels * source))
    np.testing.assert_allclose(of_sounds[0] - of_sounds[1], of_channels[0] - of_channels[1], atol=1e-9)
    assert np.abs(of_sounds - of_channels).max() > 0.1


def test_the_cepstral_front_end_removes_a_minimum_phase_channel() -> None:
    rng = np.random.default_rng(3)
    sound = rng.standard_normal(30000)
    echo = np.zeros(200)
    echo[[0, 37, 90]] = 1.0, 0.5, 0.3  # minimum phase, because the echoes are weaker than the first sound in sum
    two_channels = np.stack([sound, through(echo, sound)]).astype(np.float32)
    reach = 100
    peaks = []
    for front_end in (whole_segment, cepstral):
        cross = CrossSpectra(front_end(two_channels, RATE_HZ, reach), PAIR, RATE_HZ, BAND_HZ)
        values = cross.correlations(reach).real[0]
        assert values.argmax() == reach  # no delay
        peaks.append(values[reach])
    assert peaks[1] > 0.97  # the edges of frames leave a remainder
    assert peaks[0] < 0.93


def test_cepstral_frames_are_short_and_share_a_running_cepstrum(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cepstral(noise(16000), RATE_HZ, 100).values.shape[0] == 2  # halves of 0.5 s
    assert cepstral(noise(32000), RATE_HZ, 100).values.shape[0] == 3  # 0.6 s each, 0.2 s left out
    sound = noise(32000)
    usual = cepstral(sound, RATE_HZ, 100).values
    monkeypatch.setattr(spectra, "MEMORY", 0.5)
    moved = cepstral(sound, RATE_HZ, 100).values
    np.testing.assert_array_equal(moved[0], usual[0])  # the first frame begins the channel
    assert np.abs(np.angle(moved[1] / usual[1])).max() > 0.1


def test_the_averaged_gcc_is_the_mean_of_its_frames() -> None:
    sound = noise(5 * 200 + 200)
    reach = 50
    together = CrossSpectra(averaged(sound, RATE_HZ, reach), PAIR, RATE_HZ, BAND_HZ).correlations(reach)
    window = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(400) / 400)).astype(np.float32)
    alone = []
    for first in range(0, 801, 200):
        frame = np.zeros((2, 400), dtype=np.float32)
        frame[:] = sound[:, first : first + 400] * window
        padded = whole_segment(frame, RATE_HZ, 400)
        alone.append(CrossSpectra(padded, PAIR, RATE_HZ, BAND_HZ).correlations(reach))
    np.testing.assert_allclose(together, np.mean(alone, axis=0), atol=1e-6)
    assert np.abs(together - alone[0]).max() > 0.01


@pytest.mark.parametrize("front_end", [whole_segment, averaged, cepstral])
@pytest.mark.parametrize("count", [1, 3, 399, 401, 1000])
def test_any_length_and_silence_give_finite_values(front_end: spectra.FrontEnd, count: int) -> None:
    for samples in (noise(count), np.zeros((2, count), dtype=np.float32)):
        spectra = front_end(samples, RATE_HZ, 30)
        assert spectra.values.shape[1:] == (2, spectra.n_fft // 2 + 1)
        values = CrossSpectra(spectra, PAIR, RATE_HZ, BAND_HZ).correlations(30)
        assert np.isfinite(values).all()
        assert samples.any() or not values.any()


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_method_locates_a_sound_in_free_field(method: str) -> None:
    grid = Grid(BOUNDS_M, 0.1)
    sound = burst(9000)
    sounds = {spec.name: Sound((heard(spec, SOURCE_M, sound),), RATE_HZ) for spec in (NORTH, SOUTH)}
    found = create(method, [NORTH, SOUTH], grid, C_M_S).locate(sounds)
    assert np.linalg.norm(found.position_m - SOURCE_M) < 0.05  # half a cell: the edges of frames cost accuracy


def test_the_alias_free_frequency_follows_from_the_gradient_of_the_delay() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([0.1, 0.1, 0.1], [4.0, 5.0, 2.5], (40, 3))
    pairs = microphone_pairs(4)
    step = 1e-6
    gradient = np.stack(
        [
            steering_delays_s(points + step * axis, NORTH.microphones_m, pairs, C_M_S)
            - steering_delays_s(points - step * axis, NORTH.microphones_m, pairs, C_M_S)
            for axis in np.eye(3)
        ]
    ) / (2.0 * step)
    expected = 1.0 / (2.0 * 0.5 * np.linalg.norm(gradient, axis=0))
    limit = alias_free_hz(points, NORTH.microphones_m, pairs, 0.5, C_M_S)
    np.testing.assert_allclose(limit, expected, rtol=1e-5)
    assert limit.min() >= C_M_S / (4.0 * 0.5)  # the lowest limit is between two microphones


def test_the_alias_free_frequency_of_the_papers_arrays() -> None:
    # a pair 0.5 m apart, broadside, 3 m away, on grids of 0.5 m and 0.1 m
    microphones = np.array([[-0.25, 0.0, 0.0], [0.25, 0.0, 0.0]])
    point = np.array([[0.0, 3.0, 0.0]])
    for spacing_m, expected_hz in ((0.5, 2065.0), (0.1, 10326.0)):
        assert alias_free_hz(point, microphones, PAIR, spacing_m, C_M_S)[0, 0] == pytest.approx(expected_hz, rel=1e-3)
    assert np.isinf(alias_free_hz(np.array([[2.0, 0.0, 0.0]]), microphones, PAIR, 0.5, C_M_S)[0, 0])  # endfire


def test_cut_offs_keep_the_lower_band_without_normalising() -> None:
    correlate = GCCPhat(NORTH, RATE_HZ, C_M_S)
    samples = heard(NORTH, SOURCE_M, burst(4000))
    cut_offs_hz = third_octaves_below_hz(BAND_HZ)
    assert cut_offs_hz[0] == pytest.approx(4762, abs=1)
    assert cut_offs_hz[2] == pytest.approx(3000)
    assert min(cut_offs_hz) > 100.0
    whole, *cut = correlate.below([samples], cut_offs_hz)
    np.testing.assert_array_equal(whole.values, correlate([samples]).values)
    for one, cut_off_hz in zip(cut, cut_offs_hz, strict=True):
        share = (cut_off_hz - BAND_HZ[0]) / (BAND_HZ[1] - BAND_HZ[0])  # of the bins; each adds 1/B at the peak
        np.testing.assert_allclose(one.values.max(axis=1), share, atol=0.02)


def test_the_mapper_looks_each_point_up_below_its_limit() -> None:
    grid = Grid(BOUNDS_M, 0.5)
    correlate = GCCPhat(NORTH, RATE_HZ, C_M_S)
    gccs = correlate.below([heard(NORTH, SOURCE_M, burst(4000))], (3000.0, 1500.0))
    mapper = SRPMapper(NORTH, grid, correlate.pairs, correlate.lags_s, C_M_S, (3000.0, 1500.0))
    limit = alias_free_hz(grid.points_m(), NORTH.microphones_m, correlate.pairs, 0.5, C_M_S)
    lags = steering_delays_s(grid.points_m(), NORTH.microphones_m, correlate.pairs, C_M_S)
    step = correlate.lags_s[1] - correlate.lags_s[0]
    place = (lags - correlate.lags_s[0]) / step
    column = np.rint(place).astype(int)
    clear = (np.abs(place - column) < 0.499).all(axis=0)  # half-way between two lags float32 may take the other
    table = np.where(limit >= BAND_HZ[1], 0, np.where(limit >= 3000.0, 1, 2))
    assert set(np.unique(table)) == {0, 1, 2}
    stacked = np.stack([gcc.values for gcc in gccs])
    expected = 0.5 * stacked[table, np.arange(6)[:, None], column].sum(axis=0)
    np.testing.assert_allclose(mapper(*gccs)[clear], expected[clear], atol=1e-6)
    assert clear.mean() > 0.9


def test_the_band_limit_changes_hardly_anything_on_a_fine_grid() -> None:
    sound = burst(4000)
    grid = Grid(BOUNDS_M, 0.1)
    sounds = {spec.name: Sound((heard(spec, SOURCE_M, sound),), RATE_HZ) for spec in (NORTH, SOUTH)}
    (free, all_), (limited, less), (_, usual) = (located([NORTH, SOUTH], grid, sounds, b) for b in (False, True, None))
    np.testing.assert_array_equal(usual, all_)  # not limited where it does not matter
    assert (
        np.linalg.norm(limited.position_m - free.position_m) < 1e-6
    )  # refined with the whole band from the same grid point
    assert less.argmax() == all_.argmax()
    assert not np.array_equal(less, all_)


def test_the_band_is_limited_on_a_coarse_grid() -> None:
    grid = Grid(BOUNDS_M, 0.5)
    sounds = {"north": Sound((heard(NORTH, SOURCE_M, burst(4000)),), RATE_HZ)}
    (_, all_), (_, less), (_, usual) = (located([NORTH], grid, sounds, b) for b in (False, True, None))
    np.testing.assert_array_equal(usual, less)
    assert np.abs(usual - all_).max() > 0.1 * all_.max()


def located(
    specs: list[ArraySpec], grid: Grid, sounds: dict[str, Sound], band_limit: bool | None
) -> tuple[Localization, Float32Array]:
    """Return the localization and the fused map."""
    estimator = SrpPhat(specs, grid, C_M_S, band_limit=band_limit)
    found = estimator.locate(sounds)
    return found, estimator.power_maps(found.evidence).fused


def test_joint_arrays_have_every_pair() -> None:
    both = joined([NORTH, SOUTH], {"north": "rack", "south": "rack"}, "both")
    np.testing.assert_array_equal(both.microphones_m, np.vstack([NORTH.microphones_m, SOUTH.microphones_m]))
    assert len(microphone_pairs(len(both.microphones_m))) == 28
    samples = heard(both, SOURCE_M, burst(9000))
    found = SrpPhat([both], Grid(BOUNDS_M, 0.1), C_M_S).locate({"both": Sound((samples,), RATE_HZ)})
    assert np.linalg.norm(found.position_m - SOURCE_M) < 0.001


@pytest.mark.parametrize("clocks", [{"north": "rack", "south": "desk"}, {"north": "rack"}, {}])
def test_joint_arrays_of_two_clocks_are_an_error(clocks: dict[str, str]) -> None:
    with pytest.raises(
        ValueError, match="array 'both': joint processing expects arrays sampled by one clock, got 'north'"
    ):
        joined([NORTH, SOUTH], clocks, "both")


def test_joint_arrays_of_two_bands_are_an_error() -> None:
    other = ArraySpec("south", SOUTH.microphones_m.copy(), (200.0, 6000.0))
    with pytest.raises(ValueError, match="arrays of one band"):
        joined([NORTH, other], {"north": "rack", "south": "rack"}, "both")


def test_joint_arrays_of_too_many_microphones_are_an_error() -> None:
    names = ["north", "south", "east", "west", "top"]
    arrays = [ArraySpec(name, NORTH.microphones_m + k, BAND_HZ) for k, name in enumerate(names)]
    clocks = dict.fromkeys(names, "rack")
    assert len(joined(arrays[:4], clocks, "most").microphones_m) == 16
    with pytest.raises(ValueError, match="array 'all': joint processing expects 16 microphones at most, got 20; join"):
        joined(arrays, clocks, "all")
