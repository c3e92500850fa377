"""Recorded sound as users meet it, by real processes: killed and full recorders, files for microphones, any file."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from livessl.cli.main import main
from livessl.core.types import Float32Array
from small_site import RATE_HZ, Changes, heard, hiss, started, wait_until, write_site, write_wav

LOG = "livessl: "


def livessl(*arguments: object, limit: Callable[[], None] | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; it never shows a traceback."""
    command = [sys.executable, "-m", "livessl", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limit)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def here(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, where an error that it does not report fails the test."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        try:
            code = main([str(word) for word in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess([], code, out.getvalue(), err.getvalue())


def events(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def positions(done: subprocess.CompletedProcess[str]) -> list[Any]:
    return [(event["start_s"], event["position_m"]) for event in events(done)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site, and one file for each array with two sounds."""
    directory = tmp_path_factory.mktemp("scene")
    write_site(directory)
    write_site(directory).rename(directory / "with-node.yaml")
    write_site(directory, {"nodes": {}})
    for array in ("north", "south"):
        write_wav(directory / f"{array}.wav", heard(array))
    return directory


def wavs(directory: Path) -> list[str]:
    return [word for array in ("north", "south") for word in ("--wav", f"{array}={directory / array}.wav")]


@pytest.fixture(scope="module")
def expected(scene: Path) -> list[Any]:
    found = positions(livessl("locate", "--site", scene / "site.yaml", *wavs(scene), "--json"))
    assert len(found) == 2
    return found


# killed


@pytest.mark.parametrize("kind", ["flac", "wav"])
def test_session_of_a_killed_recorder_is_replayed(scene: Path, tmp_path: Path, kind: str, expected: list[Any]) -> None:
    out = tmp_path / "session"
    options = ["--site", scene / "with-node.yaml", "--node", "lab-pc", "--out", out, "--format", kind]
    words = [str(word) for word in (sys.executable, "-m", "livessl", "record", *options, *wavs(scene))]
    quiet: dict[str, Any] = {"stderr": subprocess.DEVNULL}
    lasts_s = heard("north").shape[1] / RATE_HZ
    with started(*words, **quiet) as process:
        wait_until((out / f"south-000.{kind}").exists, "a file of the recorder")
        time.sleep(lasts_s - 0.3)
        process.send_signal(signal.SIGKILL)
        process.wait()
    done = livessl("replay", out, "--speed", "max", "--once", "--json")
    notes = [line for line in done.stderr.splitlines() if "s of sound were found and read" in line]
    assert len(notes) == 2
    for note, array in zip(notes, ("north", "south"), strict=True):
        assert note.startswith(f"{LOG}{out / array}-000.{kind}: its header was never finished; ")
    first, *_ = events(done)
    assert first["position_m"] == pytest.approx(expected[0][1], abs=0.05)  # 24 bits differ a little from a float


# full


def test_recorder_at_a_limit_of_file_size_keeps_what_it_has(scene: Path, tmp_path: Path, expected: list[Any]) -> None:
    """The limit stands for that of a FAT disk; it takes effect after most of the first sound."""
    for kind, bytes_per_sample in (("wav", 16), ("flac", 9)):
        out = tmp_path / kind
        size = round(1.9 * RATE_HZ) * bytes_per_sample

        def limit(size: int = size) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        options = ["--site", scene / "with-node.yaml", "--node", "lab-pc", "--out", out, "--format", kind]
        done = livessl("record", *options, *wavs(scene), limit=limit)
        assert done.returncode == 1
        [line] = [line for line in done.stderr.splitlines() if "error" in line]
        assert line.startswith(f"{LOG}error: {out}: a file has reached the largest size allowed")
        kept_s = float(line.partition("; the ")[2].partition(" s before are kept and can be replayed")[0])
        assert kept_s > 1.5
        for array in ("north", "south"):
            assert soundfile.info(out / f"{array}-000.{kind}").duration >= kept_s - 0.05
        replayed = livessl("replay", out, "--speed", "max", "--once", "--json")
        assert events(replayed)[0]["position_m"] == pytest.approx(expected[0][1], abs=0.05)
        assert "were found and read" not in replayed.stderr


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 400 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("only root may mount a small disk")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.parametrize("kind", ["flac", "wav"])
def test_recorder_on_a_full_disk_keeps_what_it_has(scene: Path, small_disk: Path, kind: str) -> None:
    out = small_disk / "session"
    options = ["--site", scene / "with-node.yaml", "--node", "lab-pc", "--out", out, "--format", kind]
    done = livessl("record", *options, *wavs(scene))
    assert done.returncode == 1
    [line] = [line for line in done.stderr.splitlines() if "error" in line]
    assert line.startswith(f"{LOG}error: {out}: the disk is full, so recording ended; the ")
    assert line.endswith("; free some space, or record to another disk")
    assert livessl("replay", out, "--speed", "max", "--once").returncode == 0


# a file for each microphone, and one for all


def split(scene: Path, directory: Path, array: str) -> list[Path]:
    samples = heard(array)
    return [write_wav(directory / f"{array}-{k}.wav", samples[k : k + 1]) for k in range(len(samples))]


def listed(array: str, paths: list[Path]) -> list[str]:
    return ["--wav", f"{array}={','.join(map(str, paths))}"]


def test_microphones_with_a_file_each_are_located(scene: Path, tmp_path: Path, expected: list[Any]) -> None:
    north = split(scene, tmp_path, "north")
    common = ["locate", "--site", scene / "site.yaml", "--json", "--wav", f"south={scene / 'south.wav'}"]
    assert positions(here(*common, *listed("north", north))) == expected
    turned = here(*common, *listed("north", north[::-1]), "--channels", "north=4,3,2,1")
    assert positions(turned) == expected
    pairs = [write_wav(tmp_path / f"pair-{k}.wav", heard("north")[k : k + 2]) for k in (0, 2)]
    assert positions(here(*common, *listed("north", pairs))) == expected
    comma = write_wav(tmp_path / "hall 1,north.wav", heard("north"))
    assert positions(here(*common, "--wav", f"north={comma}")) == expected


def test_microphones_with_a_file_each_are_recorded(scene: Path, tmp_path: Path) -> None:
    files = [word for array in ("north", "south") for word in listed(array, split(scene, tmp_path, array))]
    out = tmp_path / "session"
    done = livessl("record", "--site", scene / "with-node.yaml", "--node", "lab-pc", "--out", out, *files)
    assert done.returncode == 0
    for array in ("north", "south"):
        recorded = soundfile.read(out / f"{array}-000.flac", dtype="float32")[0].T
        np.testing.assert_allclose(recorded, heard(array), rtol=0, atol=2**-23)


def test_microphones_with_a_file_each_in_the_site_file(scene: Path, tmp_path: Path) -> None:
    files = {array: [path.name for path in split(scene, tmp_path, array)] for array in ("north", "south")}
    device: Changes = {"nodes.lab-pc.device": {"type": "wav", "files": files}}
    site, out = write_site(tmp_path, device), tmp_path / "session"
    assert here("record", "--site", site, "--node", "lab-pc", "--out", out).returncode == 0
    assert soundfile.info(out / "north-000.flac").channels == 4


def refusal(*arguments: object, code: int = 2) -> list[str]:
    done = here(*arguments)
    assert (done.returncode, done.stdout) == (code, "")
    return done.stderr.splitlines()


def test_files_of_one_array_that_differ_are_refused(scene: Path, tmp_path: Path) -> None:
    good = split(scene, tmp_path, "north")
    common = ["locate", "--site", scene / "site.yaml", "--wav", f"south={scene / 'south.wav'}"]
    samples = heard("north")[:1]
    length, short = samples.shape[1], write_wav(tmp_path / "short.wav", samples[:, :-7])
    [line] = refusal(*common, *listed("north", [*good[:3], short]))
    assert f"{short}: expected {length:g} samples as in {good[0]}, also of array 'north', got" in line
    fast = write_wav(tmp_path / "fast.wav", samples, 22050)
    [line] = refusal(*common, *listed("north", [*good[:3], fast]))
    assert f"{fast}: expected 16000 Hz as in {good[0]}, also of array 'north', got 22050 Hz" in line
    [line] = refusal(*common, *listed("north", [*good[:3], good[1]]))
    assert f"{good[1]}: expected each file of array 'north' once, got it twice; remove one" in line
    [line] = refusal(*common, *listed("north", good[:3]))
    assert "expected 4 channels, one for each microphone of array 'north', got 3" in line
    gone = [tmp_path / "gone-1.wav", tmp_path / "gone-2.wav"]
    assert [str(path) in line for path, line in zip(gone, refusal(*common, *listed("north", gone)), strict=True)]
    [line] = refusal(*common, "--wav", f"north={good[0]}")
    assert line.endswith(
        "got 1; if each microphone has a file of its own, give them all: north=1.wav,2.wav,3.wav,4.wav"
    )
    [line] = refusal(*common, *[word for path in good for word in ("--wav", f"north={path}")])
    assert line.endswith("remove one; give one file for each microphone as ARRAY=FILE,FILE,…")
    [line] = refusal("locate", "--site", scene / "site.yaml", "--wav", "north=a.wav,,b.wav")[-1:]
    assert "expected ARRAY=FILE" in line


def wide(directory: Path, first: int) -> Path:
    """A file of 18 channels with the arrays' sound on neighbouring channels from `first` on, counted from 0."""
    samples = hiss(heard("north").shape[1] / RATE_HZ, 18, level=1e-4)
    for place, array in enumerate(("north", "south")):
        samples[first + 4 * place : first + 4 * place + 4] = heard(array)
    return write_wav(directory / "wide.wav", samples)


@pytest.mark.parametrize("first", [0, 3, 10])
def test_two_arrays_in_one_file_take_the_channels_of_their_node(
    tmp_path: Path, scene: Path, first: int, expected: list[Any]
) -> None:
    path = wide(tmp_path, first)
    channels = {a: list(range(first + 1 + 4 * k, first + 5 + 4 * k)) for k, a in enumerate(("north", "south"))}
    site = write_site(tmp_path, {"nodes.lab-pc.arrays": channels})
    both = ["--wav", f"north={path}", "--wav", f"south={path}"]
    assert positions(here("locate", "--site", site, *both, "--json")) == expected
    told = [word for name, numbers in channels.items() for word in ("--channels", f"{name}={str(numbers)[1:-1]}")]
    assert positions(here("locate", "--site", scene / "site.yaml", *both, *told, "--json")) == expected


def test_channel_that_serves_two_arrays_is_refused(tmp_path: Path, scene: Path) -> None:
    path = wide(tmp_path, 0)
    both = ["locate", "--site", scene / "site.yaml", "--wav", f"north={path}", "--wav", f"south={path}"]
    for channels, shared in (
        ([], "1, 2, 3, 4"),
        (["--channels", "north=1,2,3,4", "--channels", "south=1,2,3,4"], "1, 2, 3, 4"),
        (["--channels", "north=2,9,3,7", "--channels", "south=5,6,7,9"], "7, 9"),
    ):
        [line] = refusal(*both, *channels)
        start = f"{LOG}error: {path}: expected each channel to serve one array, got {shared} for 'north' and 'south'; "
        assert line.startswith(start)
        assert "--channels south=" in line
    alias = tmp_path / "alias.wav"
    alias.symlink_to(path)
    [line] = refusal(*both[:-1], f"south={alias}")
    assert line.startswith(f"{LOG}error: {alias}: expected each channel to serve one array")


def test_first_channels_of_a_wide_file_are_taken_with_a_note(tmp_path: Path, scene: Path, expected: list[Any]) -> None:
    path = wide(tmp_path, 0)
    done = livessl("locate", "--site", scene / "site.yaml", "--wav", f"north={path}", *wavs(scene)[2:], "--json")
    assert positions(done) == expected
    [note] = [line for line in done.stderr.splitlines() if "channels" in line]
    assert note.startswith(
        f"{LOG}{path}: it has 18 channels; array 'north' takes the first 4, unless --channels north="
    )


# simulated


@pytest.mark.parametrize(
    ("rates", "written"),
    [
        ({}, {"north": 44100, "south": 44100}),
        ({"pc": 48000}, {"north": 48000, "south": 48000}),
        ({"a": 48000, "b": 32000}, {"north": 48000, "south": 32000}),
        ({"a": 22050, "b": 44100}, {"north": 22050, "south": 44100}),
    ],
)
def test_simulated_session_has_the_rates_of_the_site(
    tmp_path: Path, rates: dict[str, int], written: dict[str, int]
) -> None:
    channels = {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]}
    nodes = {
        name: {
            "device": {"name": name, "sample_rate_hz": rate},
            "arrays": channels if len(rates) == 1 else {array: channels[array]},
        }
        for (name, rate), array in zip(rates.items(), channels, strict=False)
    }
    site, out = write_site(tmp_path, {"nodes": nodes}), tmp_path / "session"
    made = livessl("simulate", "--site", site, "--rt60", 0, "--count", 2, "--seed", 4, "--out", out)
    assert made.returncode == 0, made.stderr
    assert {array: soundfile.info(out / f"{array}.wav").samplerate for array in channels} == written
    truth = [json.loads(line) for line in (out / "truth.jsonl").read_text().splitlines()]
    for done in (
        here("locate", "--site", site, *wavs(out), "--json"),
        here("replay", out, "--speed", "max", "--once", "--json"),
    ):
        found = events(done)
        assert len(found) == 2
        for event, true in zip(found, truth, strict=True):
            assert np.linalg.norm(np.subtract(event["position_m"], true["position_m"])) < 0.25  # a cell of the grid


def test_rate_on_the_command_line_wins(tmp_path: Path) -> None:
    site, out = write_site(tmp_path), tmp_path / "session"
    made = here("simulate", "--site", site, "--rt60", 0, "--count", 1, "--rate", 24000, "--out", out)
    assert made.returncode == 0
    assert soundfile.info(out / "south.wav").samplerate == 24000


# any file


def flac(samples: Float32Array, path: Path) -> bytes:
    soundfile.write(path, samples.T, RATE_HZ, format="FLAC")
    return path.read_bytes()


@pytest.fixture(scope="module")
def samples_of_formats(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """The bytes of short, good files."""
    directory = tmp_path_factory.mktemp("formats")
    made = [write_wav(directory / f"{s}.wav", hiss(0.1), subtype=s).read_bytes() for s in ("PCM_16", "FLOAT")]
    for container in ("FLAC", "RF64", "AIFF", "W64", "OGG"):
        soundfile.write(directory / container, hiss(0.2).T, RATE_HZ, format=container)
        made.append((directory / container).read_bytes())
    return made


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_file_makes_a_traceback(
    samples_of_formats: list[bytes], scene: Path, capsys: pytest.CaptureFixture[str], data: st.DataObject
) -> None:
    """Random bytes, and good files that are cut or have wrong bytes, in this process: quick, so there can be many."""
    if data.draw(st.booleans()):
        content = bytearray(data.draw(st.sampled_from(samples_of_formats)))
        for _ in range(data.draw(st.integers(0, 4))):
            content[data.draw(st.integers(0, min(len(content), 120) - 1))] = data.draw(st.integers(0, 255))
        content = content[: data.draw(st.integers(0, len(content)))]
    else:
        magic = st.sampled_from([b"", b"RIFF", b"RF64\xff\xff\xff\xffWAVEds64", b"fLaC\0\0\0\x22", b"OggS", b"FORM"])
        content = bytearray(data.draw(magic) + data.draw(st.binary(max_size=300)))
    path = scene / f"any.{data.draw(st.sampled_from(['wav', 'flac', 'txt', 'raw', 'mp3']))}"
    path.write_bytes(content)
    code = main(["locate", "--site", str(scene / "site.yaml"), "--json", "--wav", f"north={path}"])
    said = capsys.readouterr()
    assert code in (0, 2)
    assert "Traceback" not in said.err
    for line in said.err.splitlines():
        assert line.startswith(LOG), said.err
    if code == 2:
        assert f"error: {path}: " in said.err


@pytest.mark.parametrize("command", ["locate", "capture", "record", "replay"])
def test_what_is_no_sound_file_is_one_sentence(scene: Path, tmp_path: Path, command: str) -> None:
    folder, text, pipe = tmp_path / "folder.wav", tmp_path / "notes.wav", tmp_path / "pipe.wav"
    folder.mkdir()
    text.write_text("dear diary\n" * 99)
    os.mkfifo(pipe)
    loop = tmp_path / "loop.wav"
    loop.symlink_to(loop)
    cases = {
        folder: "it is a folder",
        text: "Format not recognised",
        pipe: "it is not a file on a disk",
        tmp_path / "none.wav": "no such file",
        tmp_path / ("n" * 300): "",
        loop: "",
        text / "below.wav": "",
    }
    for path, reason in cases.items():
        if command == "replay":
            session = tmp_path / "session"
            session.mkdir(exist_ok=True)
            (session / "site.yaml").write_text((scene / "site.yaml").read_text())
            pieces = [{"array": "north", "file": str(path), "start_utc": "2026-01-01T00:00:00Z"}]
            (session / "session.yaml").write_text(json.dumps({"version": 1, "pieces": pieces}))
            lines = refusal("replay", session, "--once")
        else:
            options = {"locate": ["site.yaml"], "capture": ["with-node.yaml", "--node", "lab-pc"]}
            options["record"] = [*options["capture"], "--out", str(tmp_path / "out")]
            site, *more = options[command]
            files = ["--wav", f"north={path}", *wavs(scene)[2:]]
            lines = refusal(command, "--site", scene / site, *more, *files)
        [line] = lines
        assert line.startswith(f"{LOG}error: {path}: expected a WAV or FLAC file, cannot read it: {reason}")


def test_file_without_permission_is_one_sentence(scene: Path, tmp_path: Path) -> None:
    path = write_wav(tmp_path / "locked.wav", hiss(0.1))
    path.chmod(0)
    prefix: list[str] = []
    if os.access(path, os.R_OK):  # root, who may read everything unless he gives that right up
        prefix = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
        if shutil.which("setpriv") is None:
            pytest.skip("this user may read everything")
    command = [*prefix, sys.executable, "-m", "livessl", "locate", "--site", str(scene / "site.yaml")]
    done = subprocess.run([*command, "--wav", f"north={path}"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"{LOG}error: {path}: expected a WAV or FLAC file, cannot read it: Permission denied\n"
