"""The scenario `noise`, shortened to a position of each half and few kinds of sound."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
import soundfile

from evaluate.small_campaign import RATE_HZ, write_sounds
from livessl.cli.evaluate import add_arguments, evaluate
from livessl.core.locate import confidence as confidence_of
from livessl.core.locate.confidence import ConfidenceFeatures
from livessl.lab.evaluate.campaign import run_campaign
from livessl.lab.evaluate.job import Job, read_clips
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.localizer_report import Columns, SummaryRow, read_columns
from livessl.lab.evaluate.noise import APART_M, FACING, WHERE, NoisePosition, NoiseSettings, where
from livessl.lab.evaluate.noise_fit import noise_fit
from livessl.lab.evaluate.noise_kinds import FROM_ONE_PLACE, KINDS, make_noise
from livessl.lab.evaluate.noise_report import write_noise_report
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.noise_summary import (
    ALL,
    MOST_WRONG,
    below_standard,
    reliability,
    summary,
    too_wrong,
    wrong_positions,
)
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.statistics import wilson
from livessl.simulation.room import absorption
from livessl.simulation.scene import synthesised_sounds

CLASSES = ("door_slam", "speech")
SNRS_DB = (20.0, 5.0)
PLAYED = ("white", "fan", "talkers", "diffuse")


def sounds(directory: Path) -> Path:
    write_sounds(directory)
    for seed in (1, 2):
        voice = dict(synthesised_sounds(RATE_HZ, seed))["voice"]
        soundfile.write(directory / f"speech{seed:03d}.wav", voice, int(RATE_HZ))
    return directory


def finished(directory: Path, half: str) -> Path:
    settings = NoiseSettings(1, SNRS_DB, seed=2, half=half, kinds=PLAYED)
    run_campaign(Job(settings, read_clips(sounds(directory / "sounds"), CLASSES, RATE_HZ)), directory / "out", jobs=1)
    return directory / "out"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished(tmp_path_factory.mktemp("noise"), "test")


@pytest.fixture(scope="module")
def columns(folder: Path) -> Columns:
    return read_columns(folder / "results.parquet")


def test_every_kind_and_level_of_noise_gets_the_same_sounds(columns: Columns) -> None:
    in_noise = len(CLASSES) * len(PLAYED) * len(SNRS_DB)
    assert len(columns["method"]) == (in_noise + len(OTHER_SOUNDS)) * len(METHODS)
    told = [
        {
            (columns["clip"][row], *(float(columns[f"{axis}_m"][row]) for axis in "xyz"))
            for row in np.flatnonzero((columns["noise"] == kind) & ~np.isin(columns["sound"], list(OTHER_SOUNDS)))
        }
        for kind in PLAYED
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
    settings = NoiseSettings(1, (20.0,), seed=2, half="development", kinds=("white",), others=False)
    other = NoisePosition(settings, clips)
    assert not {row["clip"] for row in other.rows(0)} & set(columns["clip"].tolist())


@pytest.mark.parametrize("half", HALVES)
def test_rooms_hold_their_arrays_and_can_have_their_reverberation(half: str) -> None:
    assert len({room.size_m for room in NOISE_ROOMS[half]}) == len(NOISE_ROOMS[half]) == 8
    assert any(not room.has_equal_walls for room in NOISE_ROOMS[half])
    for room in NOISE_ROOMS[half]:
        assert ((room.microphones_m > 0.0) & (room.microphones_m < np.array(room.size_m))).all()
        assert 0.0 < absorption(room.rt60_s, room.size_m) < 1.0


def at_levels(rows: list[SummaryRow]) -> list[SummaryRow]:
    """Return the rows of `onset` in each room at each level."""
    return [row for row in rows if row["room"] != ALL and row["snr_db"] != ALL and row["method"] == "onset"]


def test_report_counts_right_and_wrong_sounds(folder: Path, columns: Columns) -> None:
    rows = summary(columns)
    cells = [row for row in rows if row["noise"] != ALL]
    assert len(cells) == len(PLAYED) * len(SNRS_DB) * len(METHODS)
    for row in cells:
        assert row["sounds"] == len(CLASSES)
        assert row["right"] + row["wrong"] * row["located"] == pytest.approx(row["located"], abs=1e-3)
        assert row["right_low"] <= row["right"] <= row["right_high"]
    assert [row["sounds"] for row in at_levels(rows)] == [len(CLASSES) * len(PLAYED)] * len(SNRS_DB)
    for row in at_levels(rows):
        assert row["withheld"] == pytest.approx(row["near"] - row["right"], abs=1e-3)
    written = write_noise_report(folder)
    text = written[1].read_text(encoding="utf-8")
    assert "canteen" in text
    assert all(f"| {name} |" in text for name in OTHER_SOUNDS)
    assert (folder / "figures" / "reliability.png").stat().st_size > 0
    by_sound = [row for row in rows if row["sound"] in OTHER_SOUNDS]
    assert [row["sounds"] for row in by_sound] == [1] * len(OTHER_SOUNDS) * len(METHODS)
    assert "--half test --out DIR" in text


def test_cells_that_fall_short_are_named(columns: Columns) -> None:
    """Sounds of which some are moved, refused or raised in confidence by hand."""
    ours = (columns["method"] == "onset") & (columns["noise"] == "fan") & (columns["snr_db"] == 20.0)
    right = dict(columns) | {"error_m": np.full(len(ours), 0.1), "located": np.ones(len(ours), dtype=np.bool_)}
    assert not too_wrong(summary(right))
    assert not below_standard(summary(right))
    far = right | {"error_m": np.where(ours, 2.0, 0.1)}
    (cell,) = too_wrong(summary(far))
    assert (cell["noise"], cell["snr_db"]) == ("fan", 20.0)
    assert cell["wrong"] > MOST_WRONG
    count = len(CLASSES)
    expected = {"all": count, "within_1_m": 0, "at_noise": 0, "in_a_quarter": count}
    assert wrong_positions(far | {"to_noise_m": np.full(len(ours), 0.6)}) == expected
    nearer = far | {"error_m": np.where(ours, 0.7, 0.1), "to_noise_m": np.full(len(ours), 0.4)}
    assert wrong_positions(nearer) == dict.fromkeys(expected, count)
    refused = right | {"located": ~ours}
    assert not too_wrong(summary(refused))
    assert [row["noise"] for row in below_standard(summary(refused))] == ["fan"]
    withheld = {row["snr_db"]: row["withheld"] for row in at_levels(summary(refused))}
    assert withheld == {20.0: pytest.approx(1.0 / len(PLAYED)), 5.0: 0.0}


def test_confidence_is_compared_with_the_truth(columns: Columns) -> None:
    ours = columns["method"] == "onset"
    told = dict(columns) | {"confidence": np.where(ours, 0.95, np.nan), "error_m": np.where(ours, 2.0, 0.1)}
    found = reliability(told)
    assert set(found) == {ALL, *PLAYED}
    (only,) = found[ALL]
    assert only["sounds"] == len(CLASSES) * len(PLAYED) * len(SNRS_DB)
    assert only["confidence"] == pytest.approx(0.95)
    assert only["near"] == 0.0
    assert only["near_low"] == 0.0 < only["near_high"] < 0.4


def test_a_fit_finds_the_constants_by_which_positions_were_right() -> None:
    """Positions that are right as often as the confidence says, but for a tenth that another source begins."""
    rng, count = np.random.default_rng(5), 6000
    drawn = {
        "margin": rng.uniform(0.0, 0.4, count),
        "standing": rng.uniform(3.0, 9.0, count),
        "crossing_deg": np.full(count, 60.0),
        "second_array": rng.uniform(0.0, 3.0, count),
        "background": np.zeros(count),
        "beginning": np.where(rng.random(count) < 0.3, np.nan, rng.uniform(0.0, 4.0, count)),
        "spread_m": rng.uniform(0.01, 0.5, count),
    }
    whole, of_lines = np.zeros(count, dtype=np.bool_), rng.random(count) < 0.2
    confidence = [
        ConfidenceFeatures(
            float(drawn["margin"][row]),
            float(drawn["standing"][row]),
            float(drawn["crossing_deg"][row]),
            float(drawn["second_array"][row]),
            beginning=None if np.isnan(drawn["beginning"][row]) else float(drawn["beginning"][row]),
            spread_m=float(drawn["spread_m"][row]),
            of_lines=bool(of_lines[row]),
        ).confidence
        for row in range(count)
    ]
    right = rng.random(count) < 0.9 * np.array(confidence)
    told = drawn | {"whole": whole, "of_lines": of_lines, "error_m": np.where(right, 0.1, 2.0)}
    told |= {"share": np.ones(count), "method": np.full(count, "onset"), "sound": np.full(count, CLASSES[0])}
    fit = noise_fit(told)
    assert fit.elsewhere == pytest.approx(0.1, abs=0.03)
    used = (confidence_of._BEGINNING_FIT, confidence_of._WEAK_FIT)
    assert (fit.beginning, fit.weak) == pytest.approx(used, rel=0.25)
    assert fit.lines_spread == pytest.approx(confidence_of._LINES_SPREAD_FIT, rel=0.25)


@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_every_kind_has_unit_power_and_the_places_of_its_sources(kind: str) -> None:
    rng, places_m = np.random.default_rng(1), np.array([[1.0, 2.0, 1.0], [3.0, 1.0, 1.2], [2.0, 3.0, 1.4]])
    microphones_m = np.array([[0.5, 0.5, 1.0], [0.6, 0.5, 1.0], [0.5, 0.7, 1.3]])
    emitters = [(place_m, rng.standard_normal((3, 400), dtype=np.float32)) for place_m in places_m]
    speech = [("a", rng.standard_normal(900, dtype=np.float32)), ("b", rng.standard_normal(700, dtype=np.float32))]
    noise = make_noise(kind, microphones_m, 20000, RATE_HZ, rng, emitters[0], emitters, speech)
    assert noise.samples.shape == (3, 20000)
    assert np.square(noise.samples).mean() == pytest.approx(1.0, rel=0.05)
    expected = {"talkers": 3} | dict.fromkeys(FROM_ONE_PLACE, 1)
    assert len(noise.places_m) == expected.get(kind, 0)
    piece = noise.cut(rng, 5000)
    assert piece.samples.shape == (3, 5000)
    assert np.square(piece.samples).mean() == pytest.approx(1.0, rel=1e-3)


def test_72_positions_have_every_room_with_every_place_and_every_facing() -> None:
    drawn = {(n % 8, n % len(WHERE), n // len(WHERE) % len(FACING)) for n in range(72)}
    assert len(drawn) == 8 * len(WHERE) * len(FACING)


@pytest.mark.parametrize("half", HALVES)
def test_every_place_is_in_one_part_and_most_rooms_have_all_parts(half: str) -> None:
    rng = np.random.default_rng(3)
    for room in NOISE_ROOMS[half]:
        found = {where(room, rng.uniform(0.2, np.array(room.size_m) - 0.2)) for _ in range(200)}
        assert {"inside", "edge"} <= found <= set(WHERE)
        centres_m = [spec.centre_m for spec in room.arrays]
        assert where(room, np.mean(centres_m, axis=0)) == "inside"


@pytest.mark.parametrize("name", OTHER_SOUNDS)
def test_other_sounds_are_drawn_and_stay_in_range(name: str) -> None:
    one, other = (OTHER_SOUNDS[name](np.random.default_rng(seed), RATE_HZ) for seed in (1, 2))
    assert np.abs(one).max() == pytest.approx(1.0)
    assert len(one) == len(other)
    assert np.abs(one - other).max() > 0.1
    power = np.abs(np.fft.rfft(one)) ** 2
    strongest = np.sort(power)[::-1]
    assert (strongest[:20].sum() > 0.9 * power.sum()) == (name in ("tone", "alarm"))  # of one frequency
    assert (len(one) / RATE_HZ > 1.0) == (name != "click")


def test_intervals_are_those_of_wilson_and_an_empty_one_says_nothing() -> None:
    assert wilson(0, 10) == pytest.approx(
        (0.0, 0.2775), abs=1e-3
    )  # Newcombe, Statistics in Medicine 17, 1998, method 3
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--rt60", "0.4"], "remove --rt60"),
        (["--scenario", "noise,rooms"], "noise: each of noise,"),
    ],
)
def test_impossible_arguments_are_refused(tmp_path: Path, extra: list[str], message: str) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    arguments = ["localizer", "--scenario", "noise", "--sounds", str(tmp_path), "--out", str(tmp_path / "out"), *extra]
    with pytest.raises(ValueError, match=message):
        evaluate(parser.parse_args(arguments), 1, lambda done, total: None)


def test_talkers_need_speech(tmp_path: Path) -> None:
    clips = read_clips(sounds(tmp_path), ("door_slam",), RATE_HZ)
    with pytest.raises(ValueError, match="need speech, expected speech among them, got door_slam"):
        NoisePosition(NoiseSettings(1), clips)
