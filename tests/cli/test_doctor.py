"""`livessl doctor`: faults in recordings are named in words and as JSON, with the channel and the input."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

from cli.command_runs import Recorded, Run
from livessl.cli.doctor import blind_spot_line
from livessl.cli.main import main
from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.types import Float32Array
from small_site import RATE_HZ, hiss, write_site, write_wav

CODES = {"kind", "fault", "array", "channel", "input", "severity", "confidence", "message", "cure"}


@pytest.fixture(scope="module")
def ten_sounds(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Ten sounds in the small room, with some reverberation; no test changes them."""
    directory = tmp_path_factory.mktemp("ten")
    site = write_site(tmp_path_factory.mktemp("site"))
    options = f"--rt60 0.3 --count 10 --rate {RATE_HZ} --seed 8".split()
    assert main(["simulate", "--site", str(site), "--out", str(directory), *options]) == 0
    return Recorded(directory, site)


def damaged(sounds: Recorded, directory: Path, change: Callable[[Float32Array], Float32Array]) -> list[str]:
    """Options of a command that reads the recordings, that of `south` changed."""
    samples, _ = soundfile.read(sounds.directory / "south.wav", dtype="float32", always_2d=True)
    return sounds.wavs(south=write_wav(directory / "south.wav", change(samples.T.copy())))


def with_channel(channel: int, factor: float) -> Callable[[Float32Array], Float32Array]:
    def change(samples: Float32Array) -> Float32Array:
        samples[channel - 1] *= factor
        return samples

    return change


def test_a_good_session_has_no_faults(run: Run, ten_sounds: Recorded) -> None:
    done = run("doctor", "--session", ten_sounds.directory)
    assert done.code == 0
    assert all("these sounds cannot show whether" in line for line in done.err.splitlines())
    assert done.out == "no fault found in 10 sounds\n"


def test_a_good_session_prints_nothing_as_json(run: Run, ten_sounds: Recorded) -> None:
    done = run("doctor", "--session", ten_sounds.directory, "--json")
    assert (done.code, done.objects) == (0, [])


@pytest.mark.parametrize(
    ("change", "fault", "channel", "words"),
    [
        (with_channel(3, -1.0), "inverted", 3, "channel 3 of 'south' has the opposite polarity"),
        (with_channel(2, 0.0), "dead", 2, "channel 2 of 'south' is silent"),
        (lambda samples: samples[[0, 1, 3, 2]], "swapped", None, "channels 3 and 4 of 'south' are swapped"),
        (lambda samples: samples[[0, 0, 2, 3]], "duplicate", 2, "the same signal as channel 1"),
    ],
)
def test_an_error_is_named_with_its_channel_and_input(
    run: Run,
    ten_sounds: Recorded,
    tmp_path: Path,
    change: Callable[[Float32Array], Float32Array],
    fault: str,
    channel: int | None,
    words: str,
) -> None:
    wavs = damaged(ten_sounds, tmp_path, change)
    done = run("doctor", "--site", ten_sounds.site, *wavs, "--json")
    assert done.code == 1
    (found,) = done.objects
    assert set(found) == CODES
    assert (found["kind"], found["fault"], found["array"]) == ("finding", fault, "south")
    assert (found["channel"], found["severity"]) == (channel, "error")
    assert found["input"] == (None if channel is None else 4 + channel)  # the site's inputs 5 to 8
    assert words in found["message"]
    assert found["cure"]
    assert 0.5 < found["confidence"] <= 1.0


def test_a_warning_is_told_and_is_no_failure(run: Run, ten_sounds: Recorded, tmp_path: Path) -> None:
    done = run("doctor", "--site", ten_sounds.site, *damaged(ten_sounds, tmp_path, with_channel(4, 0.2)))
    assert done.code == 0
    (line,) = done.out.splitlines()
    assert re.match(r"warning +level +channel 4 of 'south' is 1[345] dB weaker than its neighbours \(input 8\); ", line)
    assert "set the gains of the array's inputs alike" in line


def test_too_few_sounds_are_told(run: Run, recorded: Recorded) -> None:
    done = run("doctor", "--session", recorded.directory)
    assert done.code == 0
    assert "2 sounds found: too few to examine poses and the order of channels" in done.err


def test_silence_is_examined_too(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    samples = hiss(5.0, level=1e-4)
    samples[1] += np.float32(0.1)
    wavs = [f"--wav={name}={write_wav(tmp_path / f'{name}.wav', samples)}" for name in ("north", "south")]
    done = run("doctor", "--site", site, *wavs, "--json")
    assert {(one["fault"], one["array"], one["channel"]) for one in done.objects} >= {
        ("dc", "north", 2),
        ("dc", "south", 2),
    }
    assert "0 sounds found" in done.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "expected --session DIR, or --wav ARRAY=FILE for each array, or --url"),
        (["--wav", "north=n.wav"], "expected --site FILE with --wav"),
        (["--session", "nowhere"], "nowhere"),
    ],
)
def test_wrong_use_is_told_in_one_line(run: Run, options: list[str], words: str) -> None:
    done = run("doctor", *options)
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1


def test_what_the_sounds_hide_is_said_with_its_size_direction_and_cure() -> None:
    moved = blind_spot_line(BlindSpot("moved", ("north", "south"), 0.84, (0.6, 0.8, 0.0)))
    turned = blind_spot_line(BlindSpot("turned", ("west",), 12.4, (0.0, 0.0, 1.0)))
    assert "whether 'north' or 'south' is moved by less than 0.8 m along (0.60, 0.80, 0.00)" in moved
    assert "whether 'west' is turned by less than 12 degrees about (0.00, 0.00, 1.00)" in turned
    assert all(
        line.endswith("clap at places that you know, and run livessl calibrate verify") for line in (moved, turned)
    )
