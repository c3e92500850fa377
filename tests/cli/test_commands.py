"""The command line: what it prints, what it refuses and how, and its exit codes: 0, 1 at run time, 2 for wrong use."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import soundfile
import yaml
from threadpoolctl import threadpool_info, threadpool_limits

from livessl import __version__
from livessl.capture.link import Link
from livessl.cli.main import main
from livessl.clock import SystemClock, utc_ns, utc_text
from livessl.errors import ConfigError, Fault
from livessl.lab import demo
from livessl.recordings.session import read_session
from livessl.server.receiver import Receiver
from livessl.site.models import Site
from livessl.wire import Hello
from small_site import RATE_HZ, hiss, running_server, site_of, wait_until, write_site, write_wav

COMMANDS = ("demo", "serve", "capture", "locate", "replay", "record", "simulate", "check", "devices", "bench")
STOP_S = 5.0
"""How long a command may take to end on Ctrl-C or SIGTERM."""


@dataclass
class Done:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def objects(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines()]


Run = Callable[..., Done]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command in this process."""

    def run(*arguments: object) -> Done:
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse's way
            code = int(end.code or 0)
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return Done(code, said.out, said.err)

    return run


@dataclass
class Recorded:
    """A simulated session and its site file."""

    directory: Path
    site: Path

    def wavs(self, **others: Path) -> list[str]:
        names = {name: self.directory / f"{name}.wav" for name in ("north", "south")} | others
        return [part for name, path in names.items() for part in ("--wav", f"{name}={path}")]


def simulate_arguments(site: Path, out: Path, seed: int = 5) -> list[str]:
    options = f"--rt60 0 --count 2 --sample-rate {RATE_HZ} --seed {seed}".split()
    return ["simulate", "--site", str(site), "--out", str(out), *options]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    directory = tmp_path_factory.mktemp("recorded")
    site = write_site(tmp_path_factory.mktemp("site"))
    assert main(simulate_arguments(site, directory)) == 0
    return Recorded(directory, site)


# help


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(run: Run, command: str) -> None:
    done = run(command, "--help")
    assert done.code == 0
    assert re.search(rf"^example: livessl {command}", done.out, re.MULTILINE)


def test_help_lists_the_commands(run: Run) -> None:
    done = run("--help")
    assert done.code == 0
    for command in COMMANDS:
        assert re.search(rf"^ +{command} +\S", done.out, re.MULTILINE), command


def test_version(run: Run) -> None:
    assert run("--version").out == f"livessl {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
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
        ("locate --site s.yaml --wav n=n.wav --method music", "invalid choice: 'music'"),
        ("replay d --speed 0", "expected a number > 0 or 'max', got '0'"),
        ("replay d --speed fast", "expected a number > 0 or 'max', got 'fast'"),
        ("replay d --speed inf", "expected a number > 0 or 'max', got 'inf'"),
        ("replay d --speed nan", "expected a number > 0 or 'max', got 'nan'"),
        ("replay d --server foo", "expected tcp://HOST:PORT or ipc://PATH, got 'foo'"),
        ("replay d --server tcp://127.0.0.1:*", "expected tcp://HOST:PORT or ipc://PATH, got 'tcp://127.0.0.1:*'"),
        ("capture --site s.yaml --node n --start-at noon", "expected RFC 3339 with an offset"),
        ("capture --site s.yaml --node n --start-at 2026-01-01T00:00:00", "expected RFC 3339 with an offset"),
        ("record --site s.yaml --node n --out d --duration 0", "expected a number > 0, got '0'"),
        ("record --site s.yaml --node n --out d --format mp3", "invalid choice: 'mp3'"),
        ("simulate --site s.yaml --out d --rt60 -1", "expected seconds from 0 to 5, got '-1'"),
        ("simulate --site s.yaml --out d --count 0", "expected a whole number from 1 on, got '0'"),
    ],
)
def test_wrong_use(run: Run, arguments: str, said: str) -> None:
    done = run(*arguments.split())
    assert done.code == 2
    assert said in done.err
    assert done.out == ""


# check


def test_check_of_a_good_site(run: Run, recorded: Recorded) -> None:
    done = run("check", recorded.site)
    assert done.code == 0
    assert "valid; site 'small', arrays north (4 microphones), south (4 microphones), 3,840 grid points" in done.out
    [told] = run("check", recorded.site, "--json").objects
    expected = {"valid": True, "faults": [], "warnings": [], "site": "small", "arrays": ["north", "south"]}
    assert told == {**expected, "nodes": 3840}


FAULTY = {"fusion.method": "music", "colour": "red", "arrays.north.position_m": [9, 9, 9], "grid.spacing_m": 0.001}


WIDE = [[0.1, 0.1, 2.5], [3.9, 0.1, 2.5], [3.9, 4.9, 2.5], [0.1, 4.9, 2.5]]


def test_warnings_are_told(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    site = write_site(tmp_path, {"arrays.north": {"microphones_m": WIDE}})
    note = "livessl: note: grid.spacing_m: array 'north' is 6.1 m wide: "
    checked = run("check", site)
    assert checked.code == 0
    assert checked.err.startswith(note)
    [warning] = run("check", site, "--json").objects[0]["warnings"]
    assert checked.err == f"livessl: note: {warning}\n"
    assert note in run("locate", "--site", site, *recorded.wavs()).err
    taken = write_site(tmp_path, {"arrays.north": {"microphones_m": WIDE}, "server.events_db": str(tmp_path)})
    assert note in run("serve", "--site", taken).err


def test_check_tells_all_faults_at_once(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, FAULTY)
    done = run("check", path)
    assert done.code == 2
    lines = done.err.splitlines()
    assert len(lines) == len(FAULTY)
    for line in lines:
        assert re.match(rf"livessl: error: {re.escape(str(path))}:\d+: [\w.]+: .+", line)
    for place in ("fusion.method", "colour", "arrays.north", "grid.spacing_m"):
        assert f": {place}: " in done.err
    told = run("check", path, "--json")
    assert told.code == 2
    [result] = told.objects
    assert result["valid"] is False
    assert [f"livessl: error: {fault['where']}: {fault['what']}" for fault in result["faults"]] == lines


@pytest.mark.parametrize(
    "command",
    [
        "serve --site {site}",
        "capture --site {site} --node lab-pc",
        "locate --site {site} --wav north=n.wav",
        "record --site {site} --node lab-pc --out {out}",
        "simulate --site {site} --out {out}",
    ],
)
def test_every_command_tells_all_faults_of_the_site(run: Run, tmp_path: Path, command: str) -> None:
    path = write_site(tmp_path, FAULTY)
    done = run(*command.format(site=path, out=tmp_path / "out").split())
    assert done.code == 2
    assert len(done.err.splitlines()) == len(FAULTY)
    assert not (tmp_path / "out").exists()


def test_site_that_is_not_there(run: Run, tmp_path: Path) -> None:
    done = run("serve", "--site", tmp_path / "site.yaml")
    assert done.code == 2
    assert done.err == f"livessl: error: {tmp_path / 'site.yaml'}: cannot be read: No such file or directory\n"


# locate


def test_locate_prints_what_is_promised(run: Run, recorded: Recorded) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs(), "--json")
    assert done.code == 0
    assert done.err == ""
    events = done.objects
    truth = [json.loads(line) for line in (recorded.directory / "truth.jsonl").read_text().splitlines()]
    assert len(events) == len(truth) == 2
    for event, source in zip(events, truth, strict=True):
        assert set(event) >= {
            "kind", "id", "time_utc", "start_s", "duration_s", "position_m", "covariance_m2", "confidence", "arrays",
            "method", "status", "reason",
        }  # fmt: skip
        assert event["kind"] == "event"
        assert event["time_utc"] is None
        assert event["status"] == "located"
        assert event["method"] == "onset"
        assert np.shape(event["covariance_m2"]) == (3, 3)
        # half the diagonal of a cell of 0.25 m; sound travels at most 7 m in 0.02 s, and frames are 0.05 s long
        assert np.linalg.norm(np.subtract(event["position_m"], source["position_m"])) < 0.22
        assert event["start_s"] == pytest.approx(source["start_s"], abs=0.15)


def test_locate_twice_gives_the_same_bytes(run: Run, recorded: Recorded) -> None:
    arguments = ["locate", "--site", recorded.site, *recorded.wavs(), "--json"]
    first, second = run(*arguments), run(*arguments)
    assert first.out == second.out != ""
    swapped = run(*arguments[:3], *recorded.wavs()[2:], *recorded.wavs()[:2], "--json")
    assert swapped.out == first.out  # nor does the order of the arrays matter


def test_locate_for_people(run: Run, recorded: Recorded) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs())
    lines = done.out.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert re.match(
            r" +\d+\.\d\d s .*\(.+,.+,.+\) +± \d\.\d\d m .*confidence \d\.\d\d .*located .*north, south", line
        )


def test_locate_by_chosen_channels(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    """Eight channels of another order, told which: the answers do not change."""
    samples = soundfile.read(recorded.directory / "north.wav", dtype="float32")[0].T
    shuffled = np.vstack([hiss(samples.shape[1] / RATE_HZ, 4), samples[[3, 2, 1, 0]]])
    path = write_wav(tmp_path / "n.wav", shuffled)
    common = ["locate", "--site", recorded.site, "--json"]
    expected = run(*common, *recorded.wavs()).out
    assert run(*common, *recorded.wavs(north=path), "--channels", "north=8,7,6,5").out == expected
    assert run(*common, *recorded.wavs(north=path)).out != expected


def test_silence_is_no_failure_and_no_riddle(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    path = write_wav(tmp_path / "quiet.wav", hiss(2.0, level=1e-4))
    done = run("locate", "--site", recorded.site, "--wav", f"north={path}", "--json")
    assert (done.code, done.out) == (0, "")
    assert done.err.startswith("livessl: note: no sound found: ")


def bad_file(path: Path, name: str) -> Path:
    good = hiss(0.5)
    if name == "too few channels":
        write_wav(path, good[:3])
    elif name == "another rate":
        write_wav(path, good, 44100)
    elif name == "zero length":
        write_wav(path, good[:, :0])
    elif name == "NaN":
        good[1, 17] = np.nan
        write_wav(path, good)
    elif name == "all zero":
        write_wav(path, 0 * good)
    elif name == "no sound file":
        path.write_text("dear diary", encoding="utf-8")
    return path


BAD_FILES = {
    "too few channels": "expected 4 channels, one for each microphone of array 'north', got 3",
    "another rate": "expected 16000 Hz for array 'north', got 44100 Hz; resample the file or correct nodes.lab-pc.dev",
    "zero length": "expected sound, got a file of zero length; record it again",
    "NaN": "expected finite samples, got NaN or infinity at sample 17 of channel 2; export it again",
    "all zero": "expected sound, got all-zero samples; was the right input recorded?",
    "no sound file": "expected a WAV or FLAC file, cannot read it",
    "missing": "expected a WAV or FLAC file, cannot read it: no such file",
}


@pytest.mark.parametrize("name", BAD_FILES)
@pytest.mark.parametrize("command", ["locate", "capture", "record"])
def test_file_that_does_not_fit(run: Run, recorded: Recorded, tmp_path: Path, name: str, command: str) -> None:
    options: dict[str, list[object]] = {
        "locate": [],
        "capture": ["--node", "lab-pc"],
        "record": ["--node", "lab-pc", "--out", tmp_path / "out"],
    }
    path = bad_file(tmp_path / "n.wav", name)
    done = run(command, "--site", recorded.site, *options[command], *recorded.wavs(north=path))
    assert done.code == 2
    assert done.out == ""
    [line] = done.err.splitlines()
    assert line.startswith(f"livessl: error: {path}: {BAD_FILES[name]}")


def test_all_files_that_do_not_fit_are_told(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    few, rate = write_wav(tmp_path / "few.wav", hiss(0.1, 2)), write_wav(tmp_path / "rate.wav", hiss(0.1), 48000)
    done = run(
        "locate", "--site", recorded.site, "--wav", f"west={few}", "--wav", f"north={few}", "--wav", f"south={rate}"
    )
    assert done.code == 2
    first, second, third = done.err.splitlines()
    assert "no such array; arrays are north, south" in first
    assert "got 2" in second
    assert "got 48000 Hz" in third


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ("north=1,2,3", "expected 4 different channel numbers from 1 to 4 for array 'north', got [1, 2, 3]"),
        ("north=1,2,3,5", "expected 4 different channel numbers from 1 to 4"),
        ("north=1,2,3,3", "expected 4 different channel numbers from 1 to 4"),
        ("west=1,2,3,4", "channels of array 'west': expected an array with a recording (north, south)"),
    ],
)
def test_channels_that_do_not_fit(run: Run, recorded: Recorded, channels: str, said: str) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs(), "--channels", channels)
    assert done.code == 2
    assert said in done.err


# simulate, replay, record


def test_simulate_twice_gives_the_same_bytes(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    assert run(*simulate_arguments(recorded.site, tmp_path / "again")).code == 0
    assert run(*simulate_arguments(recorded.site, tmp_path / "other", seed=6)).code == 0
    names = {path.name for path in recorded.directory.iterdir()}
    assert names == {"north.wav", "south.wav", "truth.jsonl", "session.yaml", "site.yaml"}
    for name in names:
        expected = (recorded.directory / name).read_bytes()
        assert (tmp_path / "again" / name).read_bytes() == expected, name
        assert ((tmp_path / "other" / name).read_bytes() == expected) is (name in ("session.yaml", "site.yaml")), name


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rt60", "0.01"], "0.01"),
        (["--events", "{empty}"], "expected WAV or FLAC files, got none"),
        (["--events", "{empty}/nowhere"], "expected WAV or FLAC files, got none"),
    ],
)
def test_simulation_that_cannot_be(run: Run, recorded: Recorded, tmp_path: Path, options: list[str], said: str) -> None:
    given = [option.format(empty=tmp_path) for option in options]
    done = run(*simulate_arguments(recorded.site, tmp_path / "out"), *given)
    assert done.code == 2
    assert done.err.startswith("livessl: error: ")
    assert said in done.err


def test_replay_gives_the_positions_of_locate(run: Run, recorded: Recorded) -> None:
    located = run("locate", "--site", recorded.site, *recorded.wavs(), "--json").objects
    done = run("replay", recorded.directory, "--once", "--speed", "max", "--json")
    assert done.code == 0
    # the session's own site has microphones to the micrometre, so the least digits of what follows may differ
    assert [event["position_m"] for event in done.objects] == [event["position_m"] for event in located]
    done = run("replay", recorded.directory, "--site", recorded.site, "--once", "--speed", "max", "--json")
    replayed = done.objects
    for name in ("position_m", "covariance_m2", "confidence", "duration_s", "status", "arrays", "contributions"):
        assert [event[name] for event in replayed] == [event[name] for event in located], name
    assert all(event["time_utc"].startswith("2026-01-01T00:00:") for event in replayed)
    apart = [round(events[1]["start_s"] - events[0]["start_s"], 6) for events in (located, replayed)]
    assert apart[0] == apart[1]


def test_replay_of_no_session(run: Run, tmp_path: Path) -> None:
    done = run("replay", tmp_path)
    assert done.code == 2
    assert "expected a recorded session, cannot read it: No such file or directory; make one with" in done.err


def test_replay_into_a_server_that_is_live(run: Run, recorded: Recorded) -> None:
    with running_server(site_of()) as server:
        link = Link(server.endpoint, Hello("lab-pc", "run", {"north": float(RATE_HZ)}), SystemClock())
        link.wait_connected(lambda: False)
        done = run("replay", recorded.directory, "--server", server.endpoint, "--speed", "max")
        link.close(bye=True)
    assert done.code == 1
    assert "refused the sound: live nodes are connected; stop them first" in done.err


def test_record_a_rehearsal(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    out = tmp_path / "session"
    begun_ns = SystemClock().now_ns()
    arguments = ["record", "--site", recorded.site, "--node", "lab-pc", "--out", out, "--duration", "0.4"]
    assert run(*arguments, *recorded.wavs()).code == 0
    session = read_session(out)
    assert {piece.array for piece in session.pieces} == {"north", "south"}
    for piece in session.pieces:
        assert 0 <= piece.start_ns - begun_ns < 2e9
    again = run(*arguments, *recorded.wavs())
    assert again.code == 2
    assert "already holds a session or recordings (north-000.flac); choose another folder" in again.err


@pytest.mark.parametrize("name", ["session.yaml", "old.wav", "OLD.FLAC"])
def test_record_overwrites_nothing(run: Run, recorded: Recorded, tmp_path: Path, name: str) -> None:
    """It is told before the device is opened: this one's name fits none."""
    (tmp_path / name).write_bytes(b"precious")
    done = run("record", "--site", recorded.site, "--node", "lab-pc", "--out", tmp_path)
    assert done.code == 2
    assert f"--out {tmp_path}: already holds a session or recordings ({name}); choose another folder" in done.err
    assert [path.name for path in tmp_path.iterdir()] == [name]


# capture and serve


@pytest.mark.parametrize("command", ["capture", "record"])
def test_unknown_node(run: Run, recorded: Recorded, tmp_path: Path, command: str) -> None:
    out = ["--out", str(tmp_path / "out")] if command == "record" else []
    done = run(command, "--site", recorded.site, "--node", "attic", *out)
    assert done.code == 2
    assert done.err == f"livessl: error: {recorded.site}: nodes: expected one of lab-pc, got --node attic\n"


def test_file_for_an_array_of_another_node(run: Run, recorded: Recorded) -> None:
    done = run("capture", "--site", recorded.site, "--node", "lab-pc", "--wav", "west=w.wav")
    assert done.code == 2
    assert "node 'lab-pc' has the arrays north, south" in done.err


@pytest.mark.parametrize("command", ["capture", "record"])
def test_file_for_some_arrays_only(run: Run, recorded: Recorded, tmp_path: Path, command: str) -> None:
    out = ["--out", tmp_path / "out"] if command == "record" else []
    done = run(command, "--site", recorded.site, "--node", "lab-pc", *recorded.wavs()[:2], *out)
    assert done.code == 2
    assert done.err == "livessl: error: --wav: expected a file for each of north, south; add --wav south=FILE\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--start-at", "2026-01-01T00:00:00Z"), ("--loop",), ("--channels", "north=1,2")])
def test_what_is_for_files_is_not_for_an_audio_interface(
    run: Run, recorded: Recorded, options: tuple[str, ...]
) -> None:
    done = run("capture", "--site", recorded.site, "--node", "lab-pc", *options)
    assert done.code == 2
    assert done.err == (f"livessl: error: {options[0]}: applies to files, and none is given; remove it or add --wav\n")


@pytest.mark.parametrize(("options", "code"), [((), 0), (("--once",), 130)])
def test_interrupted_demo(run: Run, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], code: int) -> None:
    """It runs until Ctrl-C, which is then no failure; once, it is cut short."""
    monkeypatch.setattr("livessl.lab.demo.prepare", interrupted)
    assert run("demo", *options).code == code


def test_interrupted_simulation_is_cut_short(
    run: Run, recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("livessl.cli.simulate.write_scene", interrupted)
    assert run(*simulate_arguments(recorded.site, tmp_path)).code == 130


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_scene_that_cannot_be(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, {"nodes.lab-pc.device": {"type": "scene", "rt60_s": 0.01, "sample_rate_hz": RATE_HZ}})
    done = run("capture", "--site", path, "--node", "lab-pc")
    assert done.code == 2
    assert done.err.startswith("livessl: error: nodes.lab-pc.device: ")
    assert "0.01" in done.err


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def test_capture_with_no_server_says_so_at_the_end(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    site = write_site(tmp_path, {"nodes.lab-pc.server": endpoint})
    begin = utc_text(SystemClock().now_ns() - 10_000_000_000)  # so that all of it is due
    done = run("capture", "--site", site, "--node", "lab-pc", *recorded.wavs(), "--start-at", begin)
    assert done.code == 1
    assert re.search(
        rf"livessl: error: \d+ messages were never acknowledged by the server at {endpoint}; is one running there\?",
        done.err,
    )


def test_capture_into_a_server_is_a_success(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    with running_server(site_of()) as server:
        site = write_site(tmp_path, {"nodes.lab-pc.server": server.endpoint})
        begin_ns = SystemClock().now_ns() - 10_000_000_000
        begin = utc_text(begin_ns // 50_000_000 * 50_000_000)
        done = run("capture", "--site", site, "--node", "lab-pc", *recorded.wavs(), "--start-at", begin)
        assert done.code == 0
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        live = httpx.get(f"{server.url}/api/v1/events").json()["events"][::-1]
    located = run("locate", "--site", recorded.site, *recorded.wavs(), "--json").objects
    assert [event["position_m"] for event in live] == [event["position_m"] for event in located]
    after_s = [(utc_ns(event["time_utc"]) - utc_ns(begin)) / 1e9 for event in live]
    assert after_s == pytest.approx([event["start_s"] for event in located], abs=1e-6)


def test_ports_that_are_taken(run: Run, tmp_path: Path) -> None:
    receiver = Receiver(site_of(), SystemClock())
    done = run("serve", "--site", write_site(tmp_path, {"server.bind": receiver.endpoint}))
    receiver.stop()
    assert done.code == 1
    assert f"error: server.bind: cannot listen on {receiver.endpoint}: Address already in use" in done.err
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        probe.listen()
        port = probe.getsockname()[1]
        done = run("serve", "--site", write_site(tmp_path, {"server.http.port": port}))
    assert done.code == 1
    assert f"error: server.http: cannot listen on 127.0.0.1:{port}: Address already in use" in done.err


def test_database_that_cannot_be_used(run: Run, tmp_path: Path) -> None:
    done = run("serve", "--site", write_site(tmp_path, {"server.events_db": str(tmp_path)}))
    assert done.code == 1
    assert "error: server.events_db: cannot use" in done.err


class Process:
    """A command as a process of its own."""

    def __init__(self, directory: Path, *arguments: object) -> None:
        self._log = directory / f"{arguments[0]}-{id(self)}.log"
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "livessl", *map(str, arguments)], stdout=log, stderr=subprocess.STDOUT
            )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def said(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def wait_for(self, pattern: str) -> re.Match[str]:
        def found() -> re.Match[str] | None:
            assert self.process.poll() is None, self.said
            return re.search(pattern, self.said)

        wait_until(found, f"{pattern} in what it says", 30)
        match = found()
        assert match is not None
        return match

    def end(self, number: signal.Signals) -> tuple[int, float]:
        """Exit code, and how long it took, seconds."""
        began = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(timeout=20)
        return code, time.monotonic() - began


@pytest.mark.processes
def test_signals_end_everything_cleanly(recorded: Recorded, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    site = write_site(
        tmp_path,
        {
            "server.bind": endpoint,
            "nodes": {
                f"{name}-pc": {
                    "server": endpoint,
                    "device": {"type": "wav", "files": {name: str(recorded.directory / f"{name}.wav")}, "loop": True},
                    "arrays": {name: [1, 2, 3, 4]},
                }
                for name in ("north", "south")
            },
        },
    )
    other = tmp_path / "other"
    other.mkdir()
    starts = {"north": SystemClock().now_ns(), "south": SystemClock().now_ns() + 3_600_000_000_000}
    with ExitStack() as stack:

        def command(*arguments: object) -> Process:
            return stack.enter_context(Process(tmp_path, *arguments))

        servers = [command("serve", "--site", site), command("serve", "--site", write_site(other))]
        nodes = [
            command("capture", "--site", site, "--node", f"{name}-pc", "--start-at", utc_text(start_ns))
            for name, start_ns in starts.items()  # one plays, the other waits
        ]
        urls = [server.wait_for(r"dashboard on (http://\S+)")[1] for server in servers]
        for node in nodes:
            node.wait_for("connected to the server")
        for url in urls:
            assert httpx.get(f"{url}/api/v1/health", timeout=10).status_code == 200
        ends = [
            process.end(number)
            for process, number in zip((*nodes, *servers), 2 * (signal.SIGTERM, signal.SIGINT), strict=True)
        ]
        for (code, seconds), process in zip(ends, (*nodes, *servers), strict=True):
            assert code == 0, process.said
            assert seconds < STOP_S
            assert "Traceback" not in process.said
        assert "node 'north-pc' has ended" in servers[0].said


def test_sessions_of_two_nodes_are_replayed_as_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, sites = tmp_path / "whole", tmp_path / "site.yaml"
    sites.write_text(
        demo.SITE_FILE.read_text(encoding="utf-8").replace("0.1}", "0.25}").replace("port: 8000", "port: 0"),
        encoding="utf-8",
    )
    assert main(["simulate", "--site", str(sites), "--rt60", "0", "--count", "1", "--out", str(whole)]) == 0
    for number, array in enumerate(("north", "south")):
        part = tmp_path / f"part{number}"
        part.mkdir()
        (part / "site.yaml").write_bytes((whole / "site.yaml").read_bytes())
        (part / f"{array}.wav").write_bytes((whole / f"{array}.wav").read_bytes())
        described = yaml.safe_load((whole / "session.yaml").read_text(encoding="utf-8"))
        described["pieces"] = [piece for piece in described["pieces"] if piece["array"] == array]
        (part / "session.yaml").write_text(yaml.safe_dump(described), encoding="utf-8")
    capsys.readouterr()
    replayed = []
    for folders in ([whole], [tmp_path / "part0", tmp_path / "part1"]):
        options = ["--site", str(sites), "--once", "--json", "--speed", "max"]
        done = subprocess.run(
            [sys.executable, "-m", "livessl", "replay", *map(str, folders), *options],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        replayed.append([json.loads(line)["position_m"] for line in done.stdout.splitlines()])
    assert len(replayed[0]) == 1
    assert replayed[1] == replayed[0]


def test_simulate_never_overwrites_a_recorded_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "session.yaml").write_text("version: 1\n", encoding="utf-8")
    assert main(["simulate", "--site", str(demo.SITE_FILE), "--out", str(tmp_path)]) == 2
    assert "holds a recorded session; choose another folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["session.yaml"]


def test_demo_on_a_port_in_use_says_so_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["demo", "--once", "--port", str(taken.getsockname()[1])]) == 1
    assert "cannot be used: Address already in use" in capsys.readouterr().err


def test_commands_compute_on_one_thread(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    seen: list[set[int]] = []

    def load(_: Path) -> Site:
        seen.append(threads())
        return site_of()

    monkeypatch.setattr("livessl.cli.check.load_site", load)
    with threadpool_limits(limits=2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this machine's BLAS has one thread anyway")
        assert run("check", write_site(tmp_path)).code == 0
        assert threads() == {2}
    assert seen == [{1}]


@pytest.mark.parametrize("own", [True, False], ids=["its own site", "a site that is given"])
def test_session_is_replayed_to_this_machine_unless_a_site_says_otherwise(
    tmp_path: Path, own: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = {"server.http": {"host": "0.0.0.0", "port": 8001, "tokens": "tokens.yaml"}, "keys": "keys"}
    path, session = write_site(tmp_path, there), tmp_path / "session"
    made = ["simulate", "--site", str(path), "--rt60", "0", "--count", "1", "--sample-rate", str(RATE_HZ)]
    assert main([*made, "--out", str(session)]) == 0

    def refuse(site: Site, *_: object, **__: object) -> None:
        raise ConfigError(
            [Fault(site.server.http.host, f"{site.server.http.port} {site.server.http.tokens} {site.keys}")]
        )

    monkeypatch.setattr("livessl.cli.replay.Server", refuse)
    assert main(["replay", str(session), *([] if own else ["--site", str(path)])]) == 2
    expected = "127.0.0.1: 8001 None None" if own else "0.0.0.0: 8001 tokens.yaml None"
    assert expected in capsys.readouterr().err
