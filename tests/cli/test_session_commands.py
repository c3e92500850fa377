"""`livessl simulate`, `record` and `replay`: sessions are made and played."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cli.command_runs import Recorded, Run, interrupted, simulate_arguments
from livessl.capture.link import Link
from livessl.cli.main import main
from livessl.clock import SystemClock
from livessl.errors import ConfigError, Fault
from livessl.lab import demo
from livessl.recordings.session import read_session
from livessl.site.models import Site
from livessl.wire import Hello
from small_site import HANG_S, RATE_HZ, running_server, site_of, write_site


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
    ("options", "message"),
    [
        (["--rt60", "0.01"], "0.01"),
        (["--sounds", "{empty}"], "expected WAV or FLAC files, got none"),
        (["--sounds", "{empty}/nowhere"], "expected WAV or FLAC files, got none"),
    ],
)
def test_impossible_simulation_is_an_error(
    run: Run, recorded: Recorded, tmp_path: Path, options: list[str], message: str
) -> None:
    given = [option.format(empty=tmp_path) for option in options]
    done = run(*simulate_arguments(recorded.site, tmp_path / "out"), *given)
    assert done.code == 2
    assert done.err.startswith("livessl: error: ")
    assert message in done.err


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


def test_replay_of_a_folder_without_a_session_is_an_error(run: Run, tmp_path: Path) -> None:
    done = run("replay", tmp_path)
    assert done.code == 2
    assert "expected a recorded session, cannot read it: No such file or directory; make one with" in done.err


def test_server_with_live_nodes_refuses_a_replay(run: Run, recorded: Recorded) -> None:
    with running_server(site_of()) as server:
        link = Link(server.endpoint, Hello("lab-pc", "run", {"north": float(RATE_HZ)}), SystemClock())
        link.wait_connected(lambda: False)
        done = run("replay", recorded.directory, "--server", server.endpoint, "--speed", "max")
        link.close(bye=True)
    assert done.code == 1
    assert "refused the sound: live nodes are connected; stop them first" in done.err


def test_files_are_recorded_as_a_session(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    out = tmp_path / "session"
    begun_ns = SystemClock().now_ns()
    arguments = ["record", "--site", recorded.site, "--node", "lab-pc", "--out", out, "--seconds", "0.4"]
    assert run(*arguments, *recorded.wavs()).code == 0
    session = read_session(out)
    assert {piece.array for piece in session.pieces} == {"north", "south"}
    for piece in session.pieces:
        assert 0 <= piece.start_ns - begun_ns < 2e9
    again = run(*arguments, *recorded.wavs())
    assert again.code == 2
    assert "already holds a session or recordings (north-000.flac); choose another folder" in again.err


@pytest.mark.parametrize("name", ["session.yaml", "old.wav", "OLD.FLAC"])
def test_record_never_overwrites_recordings(run: Run, recorded: Recorded, tmp_path: Path, name: str) -> None:
    """The error comes before the device is opened, because the device of this site does not exist."""
    (tmp_path / name).write_bytes(b"precious")
    done = run("record", "--site", recorded.site, "--node", "lab-pc", "--out", tmp_path)
    assert done.code == 2
    assert f"--out {tmp_path}: already holds a session or recordings ({name}); choose another folder" in done.err
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_interrupted_simulation_exits_130(
    run: Run, recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("livessl.simulation.export.write_scene", interrupted)
    assert run(*simulate_arguments(recorded.site, tmp_path)).code == 130


def test_simulate_never_overwrites_a_recorded_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "session.yaml").write_text("version: 1\n", encoding="utf-8")
    assert main(["simulate", "--site", str(demo.SITE_FILE), "--out", str(tmp_path)]) == 2
    assert "holds a recorded session; choose another folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["session.yaml"]


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
            timeout=HANG_S,
            check=True,
        )
        replayed.append([json.loads(line)["position_m"] for line in done.stdout.splitlines()])
    assert len(replayed[0]) == 1
    assert replayed[1] == replayed[0]


@pytest.mark.parametrize("own", [True, False], ids=["its own site", "a site that is given"])
def test_session_is_replayed_to_this_machine_unless_a_site_says_otherwise(
    tmp_path: Path, own: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = {"server.http": {"host": "0.0.0.0", "port": 8001, "tokens": "tokens.yaml"}, "keys": "keys"}
    path, session = write_site(tmp_path, there), tmp_path / "session"
    made = ["simulate", "--site", str(path), "--rt60", "0", "--count", "1", "--rate", str(RATE_HZ)]
    assert main([*made, "--out", str(session)]) == 0

    def refuse(site: Site, *_: object, **__: object) -> None:
        raise ConfigError(
            [Fault(site.server.http.host, f"{site.server.http.port} {site.server.http.tokens} {site.keys}")]
        )

    monkeypatch.setattr("livessl.cli.replay.Server", refuse)
    assert main(["replay", str(session), *([] if own else ["--site", str(path)])]) == 2
    expected = "127.0.0.1: 8001 None None" if own else "0.0.0.0: 8001 tokens.yaml None"
    assert expected in capsys.readouterr().err
