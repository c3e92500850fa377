"""Every path in a site file is relative to the site file's folder, wherever the command is started."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from conftest import require
from livessl.capture.node import capture_recordings
from livessl.capture.playback import node_recordings
from livessl.clock import UnpacedClock
from livessl.site import keys
from livessl.site.load import load_site
from livessl.site.tokens import add_token
from small_site import Changes, hiss, running_server, scene_recordings, write_site, write_wav

SQUARE = {"microphones_m": [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The site file's folder; the current directory is another one, and stays empty."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    folder = tmp_path / "site"
    folder.mkdir()
    yield folder
    assert list(elsewhere.iterdir()) == []


def test_geometry(folder: Path) -> None:
    (folder / "calibration").mkdir()
    (folder / "calibration" / "square.yaml").write_text(yaml.safe_dump(SQUARE), encoding="utf-8")
    site = load_site(write_site(folder, {"arrays.north.geometry": "calibration/square.yaml"}))
    assert site.array("north").microphones_m.tolist()[0] == pytest.approx([2.0, 1.3, 1.4])


def test_files_of_a_wav_device(folder: Path) -> None:
    files = {"north": "north.wav", "south": "south.wav"}
    for name in files.values():
        write_wav(folder / name, hiss(0.1))
    device = {"type": "wav", "files": files}
    recordings = node_recordings(load_site(write_site(folder, {"nodes.lab-pc.device": device})), "lab-pc", 0)
    assert [assigned.recording.name for assigned in recordings] == [
        str(folder / f"{n}.wav") for n in ("north", "south")
    ]


def test_spool_directory(folder: Path) -> None:
    site = load_site(write_site(folder, {"nodes.lab-pc.spool.directory": "spool"}))
    stops = iter([False] * 300)
    capture_recordings(site, "lab-pc", scene_recordings(0), UnpacedClock(), "run-1", lambda: next(stops, True))
    assert list((folder / "spool" / "lab-pc").glob("*.spool"))


def test_keys(folder: Path) -> None:
    site = load_site(write_site(folder, {"keys": "keys"}))
    public = keys.make_server_keys(folder / "keys")
    keys.make_node_keys(folder / "keys", "lab-pc")
    server, node = keys.server_keys(site), keys.node_keys(site, "lab-pc")
    assert server is not None
    assert node is not None
    assert server.own.public == node.server == public


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"server.events_db": "events.db"}, "events.db"),
        ({"server.sinks": [{"type": "jsonl", "path": "events.jsonl"}]}, "events.jsonl"),
    ],
    ids=["events_db", "sinks"],
)
def test_files_that_the_server_writes(folder: Path, changes: Changes, name: str) -> None:
    with running_server(load_site(write_site(folder, changes))):
        assert (folder / name).exists()


def test_tokens(folder: Path) -> None:
    add_token(folder / "tokens.yaml", "wall", "viewer")
    with running_server(load_site(write_site(folder, {"server.http.tokens": "tokens.yaml"}))) as server:
        assert server.url


def test_certificate_and_private_key(folder: Path) -> None:
    require(shutil.which("openssl") is not None, "openssl is not installed (Debian: apt install openssl)")
    new = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=livessl", "-keyout", "a.key", "-out", "a.crt"]
    subprocess.run(["openssl", *new], cwd=folder, check=True, capture_output=True)
    files: Changes = {"server.http.certificate": "a.crt", "server.http.private_key": "a.key"}
    with running_server(load_site(write_site(folder, files))) as server:
        assert server.url.startswith("https://")
