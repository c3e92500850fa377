"""Help, wrong use, and what all commands share."""

from __future__ import annotations

import json
import re
import socket
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from threadpoolctl import threadpool_info, threadpool_limits

from cli.command_runs import COMMANDS, Run, interrupted
from livessl import __version__
from livessl.capture.portaudio import InputDevice
from livessl.cli.main import main
from livessl.cli.parser import Parser
from livessl.site.models import Site
from small_site import site_of, write_site


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(run: Run, command: str) -> None:
    done = run(command, "--help")
    assert done.code == 0
    assert re.search(rf"^example: livessl {command}", done.out, re.MULTILINE)


ACTIONS = (
    *("keys server", "keys node", "keys enrol", "keys token", "keys revoke", "keys list"),
    *("calibrate verify", "calibrate poses", "calibrate refine", "config show"),
)


@pytest.mark.parametrize("command", [*COMMANDS, *ACTIONS])
def test_defaults_are_written_in_one_form(run: Run, command: str) -> None:
    """An option is described by a whole phrase, and a default is written as `(default: X)`."""
    shown = " ".join(run(*command.split(), "--help").out.split())
    assert re.findall(r"\(default\b(?!: )[^)]*\)", shown) == []
    assert "repeatable" not in shown


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("calibrate refine", "--count 3 | --sounds 3"),
        ("demo", "--count 3 | --events 3"),
        (
            "evaluate localizer --out o",
            "--sounds d --rt60 0,1 --rate 8000 --spacing 0.2 | --events d --rt 0,1 --sample-rate 8000 --grid 0.2",
        ),
        ("init s.yaml", "--rate 8000 | --sample-rate 8000"),
        ("levels", "--rate 8000 | --sample-rate 8000"),
        ("record --site s --node n --out o", "--seconds 3 | --duration 3"),
        ("simulate --site s --out o", "--sounds d --rate 8000 | --events d --sample-rate 8000"),
    ],
)
def test_older_names_of_options_work_and_are_hidden(run: Run, command: str, options: str) -> None:
    """One thing has one name in all commands: `--sounds` is a folder, `--count` a number of sounds."""
    name = command.partition(" ")[0]
    parser = Parser()
    import_module(f"livessl.cli.{name}").add_arguments(parser)
    parsed = [vars(parser.parse_args([*command.split()[1:], *half.split()])) for half in options.split(" | ")]
    assert parsed[0] == parsed[1]
    given = re.findall(r"--\S+", options)
    shown = run(*command.split()[: 2 if name == "calibrate" else 1], "--help").out
    current, older = given[: len(given) // 2], given[len(given) // 2 :]
    assert all(re.search(rf"{option}\b", shown) for option in current)
    assert not any(re.search(rf"{option}\b", shown) for option in older)


def test_help_lists_the_commands(run: Run) -> None:
    done = run("--help")
    assert done.code == 0
    for command in COMMANDS:
        assert re.search(rf"^ +{command} +\S", done.out, re.MULTILINE), command


def test_version_is_printed(run: Run) -> None:
    assert run("--version").out == f"livessl {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "the following arguments are required: COMMAND"),
        ("listen", "invalid choice: 'listen'"),
        ("serve", "the following arguments are required: --site"),
        ("capture --site s.yaml", "the following arguments are required: --node"),
        ("locate --site s.yaml", "the following arguments are required: --wav"),
        ("locate --site s.yaml --wav north", "expected ARRAY=FILE, got 'north'"),
        ("locate --site s.yaml --wav =n.wav", "expected ARRAY=FILE, got '=n.wav'"),
        ("locate --site s.yaml --wav n=n.wav --channels n=1,two", "expected ARRAY=1,2,3,4, got 'n=1,two'"),
        ("locate --site s.yaml --wav n=n.wav --channels 1,2,3,4", "expected ARRAY=1,2,3,4, got '1,2,3,4'"),
        ("locate --site s.yaml --wav n=n.wav --joint both=n", "expected NAME=ARRAY,ARRAY with two arrays or more"),
        ("serve --site s.yaml --joint =n,s", "expected NAME=ARRAY,ARRAY with two arrays or more, got '=n,s'"),
        ("locate --site s.yaml --wav n=n.wav --method music", "got 'music'; write a method of your own as MODULE:NAME"),
        ("locate --site s.yaml --wav n=n.wav --method srp_phat", "got 'srp_phat'; did you mean 'srp-phat'?"),
        ("replay d --speed 0", "expected a number > 0 or 'max', got '0'"),
        ("replay d --speed fast", "expected a number > 0 or 'max', got 'fast'"),
        ("replay d --speed inf", "expected a number > 0 or 'max', got 'inf'"),
        ("replay d --speed nan", "expected a number > 0 or 'max', got 'nan'"),
        ("replay d --server foo", "expected tcp://HOST:PORT or ipc://PATH, got 'foo'"),
        ("replay d --server tcp://127.0.0.1:*", "expected tcp://HOST:PORT or ipc://PATH, got 'tcp://127.0.0.1:*'"),
        ("capture --site s.yaml --node n --start-at noon", "expected RFC 3339 with an offset"),
        ("capture --site s.yaml --node n --start-at 2026-01-01T00:00:00", "expected RFC 3339 with an offset"),
        ("record --site s.yaml --node n --out d --seconds 0", "expected a number > 0, got '0'"),
        ("record --site s.yaml --node n --out d --format mp3", "invalid choice: 'mp3'"),
        ("simulate --site s.yaml --out d --rt60 -1", "expected seconds from 0 to 5, got '-1'"),
        ("simulate --site s.yaml --out d --count 0", "expected a whole number >= 1, got '0'"),
    ],
)
def test_wrong_use_exits_2_and_states_what_was_expected(run: Run, arguments: str, message: str) -> None:
    done = run(*arguments.split())
    assert done.code == 2
    assert message in done.err
    assert done.out == ""


def test_commands_compute_on_one_thread(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    seen: list[set[int]] = []

    def load(_: Path) -> Site:
        seen.append(threads())
        return site_of()

    monkeypatch.setattr("livessl.site.load.load_site", load)
    with threadpool_limits(limits=2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this machine's BLAS has one thread anyway")
        assert run("check", write_site(tmp_path)).code == 0
        assert threads() == {2}
    assert seen == [{1}]


@pytest.mark.parametrize(("options", "code"), [((), 0), (("--once",), 130)])
def test_interrupted_demo_succeeds_unless_it_runs_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], code: int
) -> None:
    """Without --once the demo runs until Ctrl-C, so that exit code 0 is right; --once is interrupted early."""
    monkeypatch.setattr("livessl.lab.demo.prepare", interrupted)
    assert run("demo", *options).code == code


def test_demo_on_a_port_in_use_fails_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["demo", "--once", "--port", str(taken.getsockname()[1])]) == 1
    assert "cannot be used: Address already in use" in capsys.readouterr().err


TEXT_ONLY = {"serve", "hub", "capture", "record", "simulate", "keys", "calibrate", "init", "config"}
"""Commands that print no results; the actions of `keys`, `calibrate` and `config` that do are tested elsewhere."""


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in TEXT_ONLY])
def test_commands_with_results_print_them_as_json_on_request(run: Run, command: str) -> None:
    assert "--json" in run(command, "--help").out


@pytest.mark.parametrize("action", ["server", "node", "enrol", "token", "revoke", "list"])
def test_help_of_an_action_of_keys_shows_an_example(run: Run, action: str) -> None:
    done = run("keys", action, "--help")
    assert f"example: livessl keys {action}" in done.out
    assert ("--json" in done.out) is (action not in ("enrol", "revoke"))


def test_devices_without_an_input_fails_with_a_cure(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.cli.devices.list_inputs", list)
    done = run("devices")
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("livessl: error: no audio input found; connect an audio interface, then run")
    as_json = run("devices", "--json")
    assert (as_json.code, as_json.out, as_json.err) == (1, "[]\n", done.err)


def test_devices_lists_the_inputs(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [InputDevice("UMC1820", "ALSA", 8, 48000.0)]
    monkeypatch.setattr("livessl.cli.devices.list_inputs", lambda: found)
    done = run("devices")
    assert done.code == 0
    assert re.search(r"^ +8 +48000Hz  ALSA: UMC1820$", done.out, re.MULTILINE)
    assert json.loads(run("devices", "--json").out) == [asdict(found[0])]


def test_devices_prints_a_line_to_paste_that_tells_equal_interfaces_apart(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [
        InputDevice("HDA Intel: ALC257 (hw:0,0)", "ALSA", 2, 44100.0),
        InputDevice("UMC1820: USB Audio (hw:1,0)", "ALSA", 8, 48000.0, "A1", "usb-0000:00:14.0-1"),
        InputDevice("UMC1820: USB Audio (hw:2,0)", "ALSA", 8, 48000.0, "A2", "usb-0000:00:14.0-2"),
        InputDevice("Cheap: USB Audio (hw:3,0)", "ALSA", 4, 48000.0, "0", "usb-0000:00:14.0-3"),
        InputDevice("Cheap: USB Audio (hw:4,0)", "ALSA", 4, 48000.0, "0", "usb-0000:00:14.0-4"),
        InputDevice("pulse", "ALSA", 32, 44100.0),
    ]
    monkeypatch.setattr("livessl.cli.devices.list_inputs", lambda: found)
    lines = run("devices").out.partition("under nodes.NAME:\n")[2].splitlines()
    assert lines == [
        '  device: {name: "HDA Intel: ALC257", sample_rate_hz: 44100}',
        '  device: {name: "UMC1820: USB Audio", serial: "A1", sample_rate_hz: 48000}',
        '  device: {name: "UMC1820: USB Audio", serial: "A2", sample_rate_hz: 48000}',
        '  device: {name: "Cheap: USB Audio", usb_port: "usb-0000:00:14.0-3", sample_rate_hz: 48000}',
        '  device: {name: "Cheap: USB Audio", usb_port: "usb-0000:00:14.0-4", sample_rate_hz: 48000}',
        '  device: {name: "ALSA: pulse", sample_rate_hz: 44100}',
    ]
    for device, line in zip(found, lines, strict=True):
        entry = yaml.safe_load(line)["device"]
        same = [other for other in found if other.matches(entry["name"])]
        assert [
            other
            for other in same
            if entry.get("serial", other.serial) == other.serial
            and entry.get("usb_port", other.usb_port) == other.usb_port
        ] == [device]


def test_evaluate_prints_the_files_written(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "livessl.cli.evaluate.evaluate", lambda *_: [Path("out/results.parquet"), Path("out/report.md")]
    )
    arguments = ["evaluate", "report", "--out", "out", "--with", "out"]
    assert run(*arguments).out.split() == ["out/results.parquet", "out/report.md"]
    assert json.loads(run(*arguments, "--json").out) == {"files": ["out/results.parquet", "out/report.md"]}
