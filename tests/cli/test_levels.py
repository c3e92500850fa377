"""`livessl levels` on virtual interfaces with known sounds, on files, and on a terminal."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any, Self

import numpy as np
import pytest
import soundfile

from cli.command_runs import Run
from livessl.cli.levels_view import Lines, Objects, Screen, table
from livessl.core.commission.levels import InputLevel
from livessl.core.commission.taps import Tap
from livessl.core.types import Block, Float32Array
from livessl.site.node_models import SoundDeviceConfig
from small_site import HANG_S, hiss, started, wait_until, write_site, write_wav
from virtual_interface import Interface, Interfaces

CARD_HZ = 48000
PLACES = {1: ("north", 1), 2: ("north", 2)}
GOOD = InputLevel(-20.0, -30.0, 0, 0.0, None, None, -70.0)
BAD = InputLevel(0.0, -3.0, 42, 0.2, 50.0, -12.0, -40.0, None, ("clipping", "dc", "hum"))


@pytest.fixture
def interfaces(tmp_path: Path) -> Interfaces:
    return Interfaces(tmp_path)


class Levels:
    """A run of the command with `--json`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.objects: list[dict[str, Any]] = []
        self._thread = Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.objects.extend(json.loads(line) for line in self.process.stdout)

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [each for each in self.objects if each["kind"] == kind]

    def wait_for(self, kind: str, count: int = 1) -> None:
        wait_until(lambda: len(self.of(kind)) >= count, f"{count} objects of kind {kind!r}, got {self.objects[-3:]}")

    def wait_for_problem(self, words: str) -> None:
        """Wait for a problem with these words; a slow machine may report others before."""
        wait_until(
            lambda: any(words in (each["message"] or "") for each in self.of("problem")),
            f"{words!r}, got {self.of('problem')}",
        )

    def ended(self) -> int:
        code = self.process.wait(HANG_S)
        self._thread.join(HANG_S)
        return code


@contextmanager
def levels(interfaces: Interfaces, *arguments: object) -> Iterator[Levels]:
    command = [sys.executable, "-m", "livessl", "levels", "--json", *map(str, arguments)]
    with started(*command, env=interfaces.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        yield Levels(process)


def play_known(card: Interface) -> Float32Array:
    """Tones of -6, -12, … dBFS on the inputs, but on the last three a constant, hum with a tap, and silence."""
    t = np.arange(2 * CARD_HZ) / CARD_HZ
    tones = [10.0 ** (-0.3 * (k + 1)) * np.sin(2.0 * np.pi * 500.0 * (k + 1) * t) for k in range(card.channels - 3)]
    hum = 0.01 * np.sin(2.0 * np.pi * 50.0 * t)
    hum[CARD_HZ : CARD_HZ + 480] += 0.4 * np.hanning(480) * np.sin(2.0 * np.pi * 3000.0 * t[:480])
    played = np.stack([*tones, 0.05 + 0.001 * np.sin(2.0 * np.pi * 700.0 * t), hum, np.zeros_like(t)])
    card.play(played.astype(np.float32))
    return played.astype(np.float32)


@pytest.mark.processes
@pytest.mark.sound_card
def test_known_sounds_of_an_interface_are_metered(interfaces: Interfaces, tmp_path: Path) -> None:
    card = interfaces.add(channels=9)
    played = play_known(card)
    site = write_site(tmp_path, {"nodes.lab-pc.device.sample_rate_hz": CARD_HZ})
    out = tmp_path / "listen.wav"
    options = ("--site", site, "--node", "lab-pc", "--seconds", 5, "--tap", "--listen", 2, "--out", out)
    with levels(interfaces, *options) as running:
        assert running.ended() == 0
    found = running.of("summary")
    names = [(array, number) for array in ("north", "south") for number in (1, 2, 3, 4)] + [(None, None)]
    assert [(each["array"], each["microphone"]) for each in found] == names
    assert [each["input"] for each in found] == list(range(1, 10))
    for k, each in enumerate(found[:6]):
        level_db = -6.0 * (k + 1)
        # 5 s are not a whole number of periods, and 0.2 dB cover a block that this machine lost
        assert each["peak_dbfs"] == pytest.approx(level_db, abs=0.2)
        assert each["rms_dbfs"] == pytest.approx(level_db - 10.0 * math.log10(2.0), abs=0.2)
        assert "dc" not in each["faults"]
        assert each["clipped"] == 0
    assert found[6]["mean"] == pytest.approx(0.05, abs=0.001)
    assert "dc" in found[6]["faults"]
    assert (found[7]["hum_hz"], found[7]["faults"]) == (50.0, ["hum"])
    assert found[7]["hum_dbfs"] == pytest.approx(-43.0, abs=2.0)
    assert found[8]["faults"] == ["dead"]
    taps = running.of("tap")
    assert taps
    assert {(tap["input"], tap["array"], tap["microphone"]) for tap in taps} == {(8, "south", 4)}
    assert len({each["time_s"] for each in running.of("levels")}) >= 3
    heard, rate_hz = soundfile.read(out, dtype="float32")
    assert rate_hz == CARD_HZ
    assert len(heard) == round(found[0]["time_s"] * CARD_HZ)
    spectrum = np.abs(np.fft.rfft(heard[:CARD_HZ]))
    assert int(np.argmax(spectrum)) == 1000
    assert np.abs(heard).max() == pytest.approx(np.abs(played[1]).max(), abs=1e-6)


@pytest.mark.processes
@pytest.mark.sound_card
def test_meter_waits_for_an_absent_interface_and_names_one_that_is_unplugged(interfaces: Interfaces) -> None:
    card = interfaces.add(channels=6)
    interfaces.unplug(card)
    with levels(interfaces, "--device", "umc1820") as running:
        running.wait_for_problem("device 'umc1820' is not connected; connect it, or")
        assert running.of("levels") == []
        interfaces.plug(card)
        running.wait_for("levels", 6)
        assert [each["input"] for each in running.of("levels")[:6]] == [1, 2, 3, 4, 5, 6]
        wait_until(lambda: running.of("problem")[-1]["message"] is None, f"sound, got {running.of('problem')}")
        interfaces.unplug(card)
        running.wait_for_problem("device 'umc1820' was unplugged; waiting for it")
        interfaces.plug(card)
        wait_until(lambda: running.of("problem")[-1]["message"] is None, f"sound, got {running.of('problem')}")
        running.process.send_signal(signal.SIGINT)
        assert running.ended() == 0
        assert running.process.stderr is not None
        assert re.search(r"the device was interrupted \d+ times: unplugged, ", running.process.stderr.read())
    assert len(running.of("summary")) == 6


@pytest.mark.processes
@pytest.mark.sound_card
def test_command_without_standard_streams_meters(interfaces: Interfaces) -> None:
    """Some services and scripts close them."""
    interfaces.add(channels=2).play(hiss(1.0, 2, level=0.01))
    command = (sys.executable, "-m", "livessl", "levels", "--json", "--device", "UMC1820", "--seconds", "1.2")
    closing = ("sh", "-c", 'exec "$@" 0<&- 2>&-', "sh", *command)
    with started(*closing, env=interfaces.environment, stdout=subprocess.PIPE) as process:
        running = Levels(process)
        assert running.ended() == 0
    assert [each["input"] for each in running.of("summary")] == [1, 2]


class Delivering:
    """A device that opens, although no search finds it."""

    problem = None
    has_cause = False
    lost_blocks = interruptions = 0

    def __init__(self, config: SoundDeviceConfig, channels: int, clock: object) -> None:
        self.channels = channels
        self.sample_rate_hz = config.sample_rate_hz

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __iter__(self) -> Iterator[Block]:
        size = round(self.sample_rate_hz / 10)
        return (Block(size * k, hiss(0.1, self.channels, k)[:, :size].copy(), 0) for k in count())


@pytest.mark.parametrize(("options", "inputs"), [((), 1), (("--inputs", "3"), 3)])
def test_device_that_opens_although_no_search_finds_it_is_metered(
    run: Run, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], inputs: int
) -> None:
    monkeypatch.setattr("livessl.capture.input_search.search_input", lambda wanted: None)
    monkeypatch.setattr("livessl.capture.sound_device.SoundDevice", Delivering)
    done = run("levels", "--device", "UMC1820", "--rate", "8000", "--seconds", "0.5", "--json", *options)
    assert done.code == 0
    found = [json.loads(line) for line in done.out.splitlines()]
    assert [each["input"] for each in found if each["kind"] == "summary"] == list(range(1, inputs + 1))


@pytest.mark.processes
@pytest.mark.sound_card
def test_fewer_inputs_than_the_arrays_have_are_metered(interfaces: Interfaces, tmp_path: Path) -> None:
    interfaces.add(channels=18).play(hiss(1.0, 18, level=0.01))
    site = write_site(tmp_path, {"nodes.lab-pc.device.sample_rate_hz": CARD_HZ})
    with levels(interfaces, "--site", site, "--node", "lab-pc", "--inputs", 6, "--seconds", 1.5) as running:
        assert running.ended() == 0
    names = [("north", 1), ("north", 2), ("north", 3), ("north", 4), ("south", 1), ("south", 2)]
    assert [(each["array"], each["microphone"]) for each in running.of("summary")] == names
    assert {each["noise_dbfs"] is None for each in running.of("summary")} == {False}


@pytest.mark.processes
@pytest.mark.sound_card
def test_busy_interface_is_named_and_the_command_fails_without_sound(interfaces: Interfaces) -> None:
    with interfaces.add().held(), levels(interfaces, "--device", "UMC1820", "--seconds", 0.5) as running:
        assert running.ended() == 1
        assert running.process.stderr is not None
        assert "device 'UMC1820' delivered no sound" in running.process.stderr.read()
    assert any("is busy: " in each["message"] for each in running.of("problem"))
    assert running.of("summary") == []


@pytest.mark.processes
@pytest.mark.sound_card
def test_meter_on_a_terminal_is_drawn_until_sigterm(interfaces: Interfaces) -> None:
    interfaces.add(channels=2).play(hiss(1.0, 2, level=0.01))
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)
    command = (sys.executable, "-m", "livessl", "levels", "--device", "UMC1820")
    printed = ""

    def drawn() -> bool:
        nonlocal printed
        with suppress(BlockingIOError):
            printed += os.read(ours, 65536).decode()
        return printed.count("Ctrl-C ends") >= 3 and "#" in printed

    environment = {**interfaces.environment, "COLUMNS": "100", "LINES": "30"}
    with started(*command, env=environment, stdout=theirs, stderr=subprocess.PIPE) as process:
        wait_until(drawn, "three drawings")
        process.terminate()
        assert process.wait(HANG_S) == 0
    drawn()
    os.close(ours)
    os.close(theirs)
    assert "UMC1820, in all " in printed
    assert "input " in printed


def test_file_is_metered_at_once(run: Run, tmp_path: Path) -> None:
    samples = hiss(3.0, 2, level=1e-3)
    samples[1, 20000:20100] += np.hanning(100).astype(np.float32) * 0.5
    path = write_wav(tmp_path / "two.wav", samples)
    done = run("levels", "--wav", path, "--tap", "--json")
    assert done.code == 0
    [tap, first, second] = done.objects
    assert (tap["kind"], tap["input"], tap["inputs"]) == ("tap", 2, [2])
    assert tap["time_s"] == pytest.approx(20000 / 16000, abs=0.02)
    assert (first["kind"], first["input"], first["faults"]) == ("summary", 1, [])
    assert first["rms_dbfs"] == pytest.approx(-60.0, abs=0.2)
    assert second["peak_dbfs"] == pytest.approx(-6.0, abs=0.2)
    text = run("levels", "--wav", path, "--tap", "--seconds", 2).out.splitlines()
    assert "tap on input 2: " in text[0]
    assert text[1] == "in all 2.0 s"
    assert [line.split()[0] for line in text[4:]] == ["1", "2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "expected one of --device, --site with --node, or --wav, got none"),
        ("--device a --wav b.wav", "expected one of --device, --site with --node, or --wav, got --device and --wav"),
        ("--site s.yaml", "--node: expected --site and --node together"),
        ("--device a --node n", "--node: expected --site and --node together"),
        ("--wav b.wav --rate 8000", "--rate: applies to --device only"),
        ("--wav b.wav --inputs 4", "--inputs: applies to a device only"),
        ("--device a --out x.wav", "--out: needs --listen; add --listen CH, or remove --out"),
        ("--wav missing.wav", "missing.wav: expected a WAV or FLAC file, cannot read it: no such file"),
        ("--device a --listen 0", "expected a whole number >= 1, got '0'"),
    ],
)
def test_wrong_use_is_refused(run: Run, arguments: str, message: str) -> None:
    done = run("levels", *arguments.split())
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert done.err.count("add --listen") <= 1, "a cure is given once"


def test_listening_neither_replaces_files_nor_stores_sound_where_that_is_forbidden(run: Run, tmp_path: Path) -> None:
    path = write_wav(tmp_path / "sound.wav", hiss(0.5, 2))
    assert "expected a new file, but it exists" in run("levels", "--wav", path, "--listen", 1, "--out", path).err
    out = tmp_path / "new.wav"
    refused = run("levels", "--wav", path, "--listen", 3, "--out", out)
    assert (refused.code, "expected an input from 1 to 2, got 3" in refused.err) == (2, True)
    site = write_site(tmp_path, {"privacy": "positions-only"})
    refused = run("levels", "--site", site, "--node", "lab-pc", "--listen", 1, "--out", out)
    assert (refused.code, "positions-only forbids storing sound" in refused.err) == (2, True)
    assert not out.exists()
    assert run("levels", "--wav", path, "--listen", 2, "--out", out).code == 0
    assert np.array_equal(soundfile.read(out, dtype="float32")[0], hiss(0.5, 2)[1])


def test_site_without_that_node_or_without_an_interface_is_refused(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    assert "expected one of lab-pc, got --node lab" in run("levels", "--site", site, "--node", "lab").err
    site = write_site(tmp_path, {"nodes.lab-pc.device": {"type": "scene"}})
    done = run("levels", "--site", site, "--node", "lab-pc")
    assert (done.code, "expected an audio interface, got type scene" in done.err) == (2, True)


def screen_of(text: str) -> list[str]:
    """Return what a terminal shows after these characters: lines, cursor up, and erasing are understood."""
    lines, at = [""], 0
    for part in text.replace("\x1b[2K", "").replace("\x1b[J", "").split("\n"):
        if part.startswith("\x1b[") and "A" in part:
            number, _, part = part[2:].partition("A")
            at -= int(number)
        lines[at:] = [part, *lines[at + 1 :]] if at < len(lines) else [part]
        at += 1
    return lines


def test_table_on_a_terminal_is_redrawn_in_place(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("LINES", "24")
    monkeypatch.setenv("NO_COLOR", "1")
    screen = Screen("UMC1820", PLACES)
    screen.levels(1.0, [BAD, GOOD, GOOD])
    screen.tap(Tap(1.5, (1,), -12.0, 50.0, 30.0))
    screen.levels(2.0, [GOOD, BAD, GOOD])
    shown = screen_of(capsys.readouterr().out)
    assert shown[0] == "UMC1820, 2 s"
    assert shown[3].startswith("1 north/1  ##############  |       ")
    assert shown[4].endswith("    0.0    -3.0   -40.0       42  +20.00  50, -12  clipping, dc, hum")
    assert shown[5].startswith("3     ")
    assert shown[6].endswith(
        "tap on input 2 ('north', microphone 2): -12 dBFS, 50 dB over its background, 30 dB over the next input"
    )
    assert shown[7] == "Ctrl-C ends"
    screen.problem("device 'UMC1820' was unplugged; waiting for it")
    gone = capsys.readouterr().out
    assert "UMC1820, 2 s" in gone
    assert "was unplugged" in gone
    assert "north/1" not in gone


def test_words_of_faults_fit_a_terminal_of_80_columns_and_bars_take_what_is_left() -> None:
    for columns in (0, 80, 90, 120):
        rows = table([BAD, GOOD], PLACES, columns)[2:]
        assert rows[0].endswith("clipping, dc, hum")
        assert columns == 0 or max(map(len, rows)) < columns
        assert ("#" in rows[1]) == (columns >= 90)


@pytest.mark.parametrize(("lines", "columns"), [(10, 60), (24, 80), (6, 40)])
def test_table_fits_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, lines: int, columns: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("LINES", str(lines))
    monkeypatch.setenv("NO_COLOR", "1")
    screen = Screen("UMC1820", {})
    screen.levels(1.0, [GOOD] * 18)
    shown = screen_of(capsys.readouterr().out)
    assert len(shown) <= lines
    assert max(map(len, shown)) < columns
    hidden = 18 - sum(line.split()[0].isdigit() and "more" not in line for line in shown if line)
    assert hidden == 0 or f"{hidden} more inputs; make the window higher" in shown


def test_words_of_faults_are_red_on_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv("NO_COLOR", raising=False)
    Screen("UMC1820", {}).levels(1.0, [BAD, GOOD])
    out = capsys.readouterr().out
    assert "\x1b[31mclipping,\x1b[0m \x1b[31mdc,\x1b[0m \x1b[31mhum\x1b[0m" in out
    assert out.count("\x1b[31m") == 3
    assert "hum" in out.splitlines()[1]


def test_sound_on_several_inputs_is_no_tap(capsys: pytest.CaptureFixture[str]) -> None:
    sound = Tap(1.5, (1, 0), -12.0, 50.0, 2.0)
    Lines({}, taps_only=True).tap(sound)
    assert "inputs 1, 2 rose together: a sound in the room, or one signal on several" in capsys.readouterr().out
    Objects(PLACES).tap(sound)
    told = json.loads(capsys.readouterr().out)
    assert (told["input"], told["array"], told["inputs"]) == (None, None, [2, 1])
