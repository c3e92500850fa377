"""Scenes: places, order and times of the sources, and that what is rendered is what the truth says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from livessl.core.geometry import tetrahedron
from livessl.core.types import Float32Array
from livessl.simulation.scene import Scene, Source, make_scene, read_sounds, render, synthesised_sounds, truth

ROOM_M = (6.1, 7.3, 3.2)
CENTRES_M = np.array([[3.0, 1.9, 1.6], [3.1, 5.4, 1.5]])
MICROPHONES_M = np.vstack([tetrahedron(0.3) + centre for centre in CENTRES_M])
RATE_HZ = 16000.0
C_M_S = 343.0
NO_NOISE = -np.inf


def hisses() -> list[tuple[str, Float32Array]]:
    """Short noises: their matched filter has one narrow peak."""
    rng = np.random.default_rng(7)
    return [(f"hiss {k}", rng.uniform(-0.5, 0.5, 1600 + 16 * k).astype(np.float32)) for k in range(3)]


def scene(**changes: Any) -> Scene:
    arguments: dict[str, Any] = {
        "rt60_s": 0.25,
        "sounds": hisses(),
        "count": 5,
        "sample_rate_hz": RATE_HZ,
        "c_m_s": C_M_S,
        "keep_away_m": CENTRES_M,
        "seed": 4,
    }
    return make_scene(changes.pop("room_size_m", ROOM_M), **(arguments | changes))


def test_seed_decides() -> None:
    assert truth(scene()) == truth(scene())
    one, other = truth(scene()), truth(scene(seed=5))
    assert all(
        a["position_m"] != b["position_m"] and a["start_s"] != b["start_s"] for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("seed", range(5))
def test_places_are_allowed_ones(seed: int) -> None:
    places_m = np.array([source.position_m for source in scene(count=40, seed=seed).sources])
    assert (places_m >= 0.5).all()
    assert (places_m <= np.array([5.6, 6.8, 2.2])).all()
    assert np.linalg.norm(places_m[:, None] - CENTRES_M, axis=2).min() >= 1.0
    # spread, not huddled: 40 uniform draws miss an outer quarter of an axis once in 0.75^-40 = 1e5
    low, high = np.array([0.5, 0.5, 0.5]), np.array([5.6, 6.8, 2.2])
    assert (places_m.min(axis=0) < low + (high - low) / 4).all()
    assert (places_m.max(axis=0) > high - (high - low) / 4).all()


def test_low_room_cuts_the_heights() -> None:
    places_m = [source.position_m for source in scene(room_size_m=(6.1, 7.3, 1.9), count=40).sources]
    assert np.max(places_m, axis=0)[2] <= 1.4


def test_every_sound_is_used_equally_often() -> None:
    names = [source.name for source in scene(count=8).sources]
    assert sorted(names.count(name) for name, _ in hisses()) == [2, 3, 3]
    assert len(set(names[:3])) == len(set(names[3:6])) == 3
    assert len({tuple(source.name for source in scene(count=3, seed=seed).sources) for seed in range(10)}) > 1


def test_sources_wait_until_it_is_quiet() -> None:
    made = scene(rt60_s=0.6, count=12)
    starts_s = np.array([source.start_s for source in made.sources])
    ends_s = starts_s + [len(source.sound) / RATE_HZ for source in made.sources]
    pauses_s = starts_s[1:] - ends_s[:-1]
    assert starts_s[0] >= 1.5
    assert pauses_s.min() >= 0.6 + 0.8
    assert pauses_s.max() <= 0.6 + 0.8 + 0.5 + 1 / RATE_HZ
    assert pauses_s.std() > 0.05  # no beat
    assert made.duration_s >= ends_s[-1] + 0.6 + 0.8
    np.testing.assert_allclose(starts_s * RATE_HZ, np.round(starts_s * RATE_HZ), atol=1e-6)


def test_truth_is_where_and_when_the_direct_sound_comes_from() -> None:
    made = replace(scene(), noise_dbfs=NO_NOISE)
    recorded = render(made, MICROPHONES_M, seed=0).astype(np.float64)
    told = json.loads(json.dumps(truth(made)))
    assert [entry["name"] for entry in told] == [source.name for source in made.sources]
    for entry, source in zip(told, made.sources, strict=True):
        assert entry["duration_s"] == len(source.sound) / RATE_HZ
        first = round(entry["start_s"] * RATE_HZ)
        travel = np.linalg.norm(MICROPHONES_M - entry["position_m"], axis=1) / C_M_S * RATE_HZ
        heard = recorded[:, first : first + len(source.sound) + 1000]
        matched = np.array([np.correlate(channel, source.sound, "valid") for channel in heard])
        peak = matched.argmax(axis=1)
        # the direct path is the nearest image, so the strongest; its peak is at the sample nearest to its delay
        np.testing.assert_allclose(peak, travel, atol=0.51)
        assert np.ptp(travel) > 5  # so the microphones' order matters
        # nothing before it but the response's ringing
        before = np.abs(recorded[:, first - 100 : first]).max()
        assert before < 1e-3 * np.abs(heard).max()


def test_levels_are_comparable_between_arrays() -> None:
    quiet = replace(scene(), noise_dbfs=NO_NOISE)
    together = render(quiet, MICROPHONES_M, seed=0)
    apart = [render(quiet, part, seed=0) for part in (MICROPHONES_M[:4], MICROPHONES_M[4:])]
    np.testing.assert_array_equal(together, np.concatenate(apart))
    assert np.abs(apart[0]).max() != pytest.approx(
        np.abs(apart[1]).max(), rel=0.01
    )  # each is not scaled to its own peak


def test_anechoic_level_is_that_of_its_distance() -> None:
    click = np.array([0.5], dtype=np.float32)
    position_m = np.array([1.0, 1.0, 1.0])
    sources = (Source("click", 0.5, position_m, click),)
    made = Scene(ROOM_M, 0.0, C_M_S, RATE_HZ, sources, 1.0, noise_dbfs=NO_NOISE, level_dbfs=-20.0)
    # whole samples of delay, so that the peak is a sample: 343 m/s / 16 kHz = 21.4 mm
    distances_m = np.array([100, 200]) * C_M_S / RATE_HZ
    recorded = render(made, position_m + distances_m[:, None] * [1.0, 0.0, 0.0], seed=0)
    assert recorded.argmax(axis=1).tolist() == [8100, 8200]
    # the fade from 0.9 of Nyquist takes half of the upper tenth from a click: 5 %; the bins 0.6 % at most
    np.testing.assert_allclose(recorded.max(axis=1), 0.95 * 0.1 / distances_m, rtol=0.01)


@pytest.mark.parametrize("rt60_s", [0.0, 0.3, 0.7])
def test_peaks_use_full_scale_but_do_not_clip(rt60_s: float) -> None:
    peaks_dbfs = []
    for seed in range(3):
        made = scene(rt60_s=rt60_s, sounds=synthesised_sounds(RATE_HZ, seed), count=4, seed=seed)
        peaks_dbfs.append(20 * np.log10(np.abs(render(made, MICROPHONES_M[::4], seed=1)).max()))
    # 1 m is -9 dBFS: the nearest of four sources 1 to 2.5 m away, and reverberation that adds up well or not
    assert min(peaks_dbfs) > -17
    assert max(peaks_dbfs) < -3


def test_clipping_is_an_error_with_its_cure() -> None:
    with pytest.raises(ValueError, match=r"peak of 1 at most, got .* lower level_dbfs from 20 by \d+.\d dB"):
        render(replace(scene(count=1), level_dbfs=20.0), MICROPHONES_M, seed=0)


def test_noise_is_each_channels_own() -> None:
    made = replace(scene(count=1), sources=(), duration_s=4.0, noise_dbfs=-60.0)
    noise = render(made, MICROPHONES_M[:3], seed=1).astype(np.float64)
    # 64000 samples: rms to 1/sqrt(2n) = 0.3 %, correlation to 1/sqrt(n) = 0.4 %; five sigma
    np.testing.assert_allclose(noise.std(axis=1), 1e-3, rtol=5 * 0.003)
    assert np.abs(np.corrcoef(noise) - np.eye(3)).max() < 5 * 0.004
    np.testing.assert_array_equal(render(made, MICROPHONES_M[:3], seed=1), noise)
    assert np.abs(np.corrcoef(noise[0], render(made, MICROPHONES_M[:1], seed=2)[0])[0, 1]) < 5 * 0.004


def test_progress_counts_sources() -> None:
    seen: list[tuple[int, int]] = []
    render(scene(count=3), MICROPHONES_M[:1], seed=0, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_what_lasts_longer_than_the_scene_is_cut() -> None:
    made = scene(count=2)
    short = replace(made, duration_s=made.sources[1].start_s + 0.05, noise_dbfs=NO_NOISE)
    whole = render(replace(made, noise_dbfs=NO_NOISE), MICROPHONES_M[:2], seed=0)
    recorded = render(short, MICROPHONES_M[:2], seed=0)
    np.testing.assert_array_equal(recorded, whole[:, : recorded.shape[1]])
    assert np.abs(whole[:, recorded.shape[1] :]).max() > 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sounds": []}, "one sound or more, got none"),
        ({"count": 0}, "one source or more, got 0"),
        ({"rt60_s": 0.05}, "by Sabine"),
        ({"margin_m": 4.0}, "leaves no place 4 m from its walls"),
        ({"height_m": (2.0, 1.0)}, "2 to 1 m high; make margin_m smaller or height_m wider"),
        (
            {"room_size_m": (1.8, 1.8, 1.8), "keep_away_m": [[0.9, 0.9, 0.9]]},
            "1 m or more from every array, found none",
        ),
        ({"sounds": [("silence", np.zeros(0, np.float32))]}, r"source 'silence': expected sound \(n,\) float32"),
        ({"sounds": [("stereo", np.zeros((2, 9), np.float32))]}, r"got \(2, 9\) float32"),
        ({"lead_s": -9.0}, "expected a start at 0 s or later"),
    ],
)
def test_impossible_scenes_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene(**changes)


def test_synthesised_sounds_are_all_there() -> None:
    one, same, other = (synthesised_sounds(RATE_HZ, seed) for seed in (1, 1, 2))
    assert [name for name, _ in one] == ["door_slam", "dropped_keys", "phone", "voice"]
    for (_, a), (_, b), (_, c) in zip(one, same, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).any()


def tone(rate_hz: int) -> Float32Array:
    return (0.5 * np.sin(2 * np.pi * 1000 * np.arange(rate_hz) / rate_hz)).astype(np.float32)


def test_files_are_read_as_mono_at_the_wanted_rate(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "b.wav", np.column_stack([tone(44100), np.zeros(44100)]), 44100)
    soundfile.write(tmp_path / "a.FLAC", tone(16000), 16000)
    (tmp_path / "notes.txt").write_text("not a sound")
    (first, a), (second, b) = read_sounds(tmp_path, RATE_HZ)
    assert (first, second) == ("a", "b")
    assert a.dtype == b.dtype == np.float32
    np.testing.assert_allclose(a, tone(16000), atol=2**-15)  # 16 bits
    assert len(b) == 16000
    middle = slice(1000, -1000)  # away from the resampler's edges; its pass-band is flat to 1 %
    np.testing.assert_allclose(b[middle], tone(16000)[middle] / 2, atol=0.01 * 0.25)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.zeros(0), r"bad.wav: expected sound, got a file of no samples; replace or remove it"),
        (np.zeros(100), r"bad.wav: expected sound, got only zeros; replace or remove it"),
        (np.array([0.1, np.nan]), r"bad.wav: expected finite samples, got NaN or infinity; replace or remove it"),
    ],
    ids=["empty", "silent", "NaN"],
)
def test_useless_files_are_named(tmp_path: Path, samples: np.ndarray[Any, Any], message: str) -> None:
    soundfile.write(tmp_path / "bad.wav", samples, 16000, subtype="FLOAT")
    with pytest.raises(ValueError, match=message):
        read_sounds(tmp_path, RATE_HZ)


def test_unreadable_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.wav").write_bytes(b"RIFF and then nothing of the kind")
    message = r"bad.wav: expected a readable WAV or FLAC file, got .*; replace or remove it"
    with pytest.raises(ValueError, match=message):
        read_sounds(tmp_path, RATE_HZ)


def test_directory_without_sounds_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected WAV or FLAC files, got none; give a directory that holds sounds"):
        read_sounds(tmp_path, RATE_HZ)
