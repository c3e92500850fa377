"""The scenario `noise`, shortened to a position of each half and few kinds of sound."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
import soundfile

from evaluate.small_campaign import RATE_HZ, write_sounds
from livessl.cli.evaluate import add_arguments, evaluate
from livessl.lab.evaluate.campaign import run_campaign
from livessl.lab.evaluate.job import Job, read_clips
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.localizer_report import Columns, read_columns
from livessl.lab.evaluate.noise import APART_M, KINDS, NoisePosition, NoiseSettings
from livessl.lab.evaluate.noise_report import ALL, summary, write_noise_report
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.statistics import wilson
from livessl.simulation.room import absorption
from livessl.simulation.scene import synthesised_sounds

CLASSES = ("door_slam", "speech")
SNRS_DB = (20.0, 5.0)


def sounds(directory: Path) -> Path:
    write_sounds(directory)
    for seed in (1, 2):
        voice = dict(synthesised_sounds(RATE_HZ, seed))["voice"]
        soundfile.write(directory / f"speech{seed:03d}.wav", voice, int(RATE_HZ))
    return directory


def finished(directory: Path, half: str) -> Path:
    settings = NoiseSettings(1, SNRS_DB, seed=2, half=half)
    run_campaign(Job(settings, read_clips(sounds(directory / "sounds"), CLASSES, RATE_HZ)), directory / "out", jobs=1)
    return directory / "out"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished(tmp_path_factory.mktemp("noise"), "test")


@pytest.fixture(scope="module")
def columns(folder: Path) -> Columns:
    return read_columns(folder / "results.parquet")


def test_every_kind_and_level_of_noise_gets_the_same_sounds(columns: Columns) -> None:
    assert len(columns["method"]) == len(CLASSES) * len(KINDS) * len(SNRS_DB) * len(METHODS)
    told = [
        {
            (columns["clip"][row], *(float(columns[f"{axis}_m"][row]) for axis in "xyz"))
            for row in np.flatnonzero(columns["noise"] == kind)
        }
        for kind in KINDS
    ]
    assert all(each == told[0] for each in told)
    assert len(told[0]) == len(CLASSES)


def test_sounds_in_weak_noise_are_found_where_they_are(columns: Columns) -> None:
    ours = (columns["method"] == "onset") & (columns["snr_db"] == 20.0) & (columns["noise"] == "white")
    assert columns["error_m"][ours].max() < 0.3  # two tetrahedra in a dry room


def test_noise_sources_have_a_place_away_from_the_sound_and_other_noise_has_none(columns: Columns) -> None:
    for kind, has_place in {"white": False, "diffuse": False, "fan": True, "talkers": True}.items():
        here = columns["noise"] == kind
        to_noise_m = columns["to_noise_m"][here].astype(np.float64)
        assert np.isfinite(to_noise_m).all() == has_place
        if has_place:  # the triangle inequality: a sound found well is as far from the noise as the sound is
            assert (to_noise_m + columns["error_m"][here] >= APART_M - 1e-3).all()


def test_the_halves_share_no_room_and_no_clip(columns: Columns, tmp_path: Path) -> None:
    rooms = [{room.name for room in NOISE_ROOMS[half]} for half in HALVES]
    assert not rooms[0] & rooms[1]
    clips = read_clips(sounds(tmp_path), CLASSES, RATE_HZ)
    other = NoisePosition(NoiseSettings(1, (20.0,), seed=2, half="development"), clips)
    assert not {row["clip"] for row in other.rows(0)} & set(columns["clip"].tolist())


@pytest.mark.parametrize("half", HALVES)
def test_rooms_hold_their_arrays_and_can_have_their_reverberation(half: str) -> None:
    assert len({room.size_m for room in NOISE_ROOMS[half]}) == len(NOISE_ROOMS[half])
    for room in NOISE_ROOMS[half]:
        assert ((room.microphones_m > 0.0) & (room.microphones_m < np.array(room.size_m))).all()
        assert 0.0 < absorption(room.rt60_s, room.size_m) < 1.0


def test_report_counts_right_and_wrong_sounds(folder: Path, columns: Columns) -> None:
    rows = summary(columns)
    cells = [row for row in rows if row["noise"] != ALL]
    assert len(cells) == len(KINDS) * len(SNRS_DB) * len(METHODS)
    for row in cells:
        assert row["sounds"] == len(CLASSES)
        assert row["right"] + row["wrong"] * row["located"] == pytest.approx(row["located"], abs=1e-3)
        assert row["right_low"] <= row["right"] <= row["right_high"]
    written = write_noise_report(folder)
    text = written[1].read_text(encoding="utf-8")
    assert "canteen" in text
    assert "--half test --out DIR" in text


def test_intervals_are_those_of_wilson_and_an_empty_one_says_nothing() -> None:
    assert wilson(0, 10) == pytest.approx(
        (0.0, 0.2775), abs=1e-3
    )  # Newcombe, Statistics in Medicine 17, 1998, method 3
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--rt", "0.4"], "remove --rt"),
        (["--scenario", "noise,rooms"], "noise: each of noise,"),
    ],
)
def test_impossible_arguments_are_refused(tmp_path: Path, extra: list[str], message: str) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    arguments = ["localizer", "--scenario", "noise", "--events", str(tmp_path), "--out", str(tmp_path / "out"), *extra]
    with pytest.raises(ValueError, match=message):
        evaluate(parser.parse_args(arguments), 1, lambda done, total: None)


def test_talkers_need_speech(tmp_path: Path) -> None:
    clips = read_clips(sounds(tmp_path), ("door_slam",), RATE_HZ)
    with pytest.raises(ValueError, match="need speech, expected speech among them, got door_slam"):
        NoisePosition(NoiseSettings(1), clips)
