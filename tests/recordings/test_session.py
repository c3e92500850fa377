"""A session on disk describes its files, their start times and the site, and needs nothing outside its folder."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from numpy.testing import assert_allclose

from livessl.errors import ConfigError
from livessl.recordings.session import SESSION_FILE, piece, read_session, site_text, write_session
from livessl.site.load import parse_site
from small_site import Changes, site_of

START_NS = 1_767_225_600_123_456_000
RICH: Changes = {
    "arrays.north.geometry": "square.yaml",
    "arrays.north.orientation_deg": {"yaw": 33.0, "pitch": -12.0, "roll": 5.0},
    "arrays.north.band_hz": [200, 3000],
    "arrays.west": {"microphones_m": [[1.0, 1.0, 1.0], [1.0, 1.2, 1.0]]},
    "temperature_c": 18.5,
    "fusion.min_arrays": 2,
    "activity.floor_factor": 5.0,
    "nodes.player": {"device": {"type": "wav", "files": {"west": "west.wav"}}, "arrays": {"west": [1, 2]}},
}
SQUARE = {"microphones_m": [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0.05]]}


def test_pieces_survive_writing_and_reading(tmp_path: Path) -> None:
    pieces = [piece("north", "north-000.flac", START_NS), piece("south", "south-000.flac", START_NS + 1_000)]
    write_session(tmp_path, site_of(), pieces)
    session = read_session(tmp_path)
    assert session.pieces == tuple(pieces)
    assert [item.start_ns for item in session.pieces] == [START_NS, START_NS + 1_000]
    assert session.path(session.pieces[0]) == tmp_path / "north-000.flac"
    assert session.site().site == "small"


def test_start_is_plain_text_in_utc(tmp_path: Path) -> None:
    write_session(tmp_path, site_of(), [piece("north", "n.wav", START_NS)])
    [described] = yaml.safe_load((tmp_path / SESSION_FILE).read_text(encoding="utf-8"))["pieces"]
    assert described == {"array": "north", "file": "n.wav", "start_utc": "2026-01-01T00:00:00.123456Z"}


def test_site_of_a_session_needs_no_other_files(tmp_path: Path) -> None:
    (tmp_path / "square.yaml").write_text(yaml.safe_dump(SQUARE), encoding="utf-8")
    site = site_of(RICH, tmp_path)
    (tmp_path / "square.yaml").unlink()
    alone = parse_site(site_text(site))
    assert [spec.name for spec in alone.specs] == [spec.name for spec in site.specs]
    for spec in site.specs:
        # positions are written to the micrometre
        assert_allclose(alone.array(spec.name).microphones_m, spec.microphones_m, rtol=0, atol=0.51e-6)
        assert alone.array(spec.name).band_hz == spec.band_hz
    assert alone.c_m_s == site.c_m_s
    for name in ("room", "grid", "nodes", "server", "activity", "fusion", "zones"):
        assert getattr(alone, name) == getattr(site, name), name
    assert {type(node.device).__name__ for node in alone.nodes.values()} == {"SoundDeviceConfig", "WavDeviceConfig"}


def test_site_text_is_a_fixed_point() -> None:
    once = site_text(site_of())
    assert site_text(parse_site(once)) == once


def fault_of(directory: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        read_session(directory)
    [fault] = caught.value.faults
    assert fault.where.startswith(str(directory / SESSION_FILE))
    return str(fault)


def test_folder_without_session_is_refused(tmp_path: Path) -> None:
    said = fault_of(tmp_path)
    assert "expected a recorded session, cannot read it: No such file or directory" in said
    assert "make one with `livessl record` or `livessl simulate`" in said


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "valid dictionary"),
        ("[", "not valid YAML"),
        ("version: 2026-02-31", "not valid YAML"),
        ("version: 1\npieces: []\n", r"pieces: .*at least 1 item"),
        ("version: 2\npieces: [{array: n, file: n.wav, start_utc: '2026-01-01T00:00:00Z'}]\n", "version 1, got 2"),
        ("version: 1\npieces: [{array: n, file: n.wav}]\n", "pieces.0.start_utc: missing; add it"),
        ("version: 1\npieces: [{array: n, file: n.wav, start_utc: yesterday}]\n", "expected RFC 3339 .*'yesterday'"),
        ("version: 1\npieces: [{array: n, file: n.wav, start_utc: '1700-12-31T00:00:00Z'}]\n", "years 1701 to 2239"),
        ("version: 1\npieces: [{array: n, file: n.wav, start_utc: '9999-12-31T23:59:59-01:00'}]\n", "years 1701"),
        ("version: 1\npieces: [{array: n, file: n.wav, start_utc: '2026-01-01T00:00:00Z', x: 1}]\n", "pieces.0.x"),
    ],
)
def test_invalid_session_is_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / SESSION_FILE).write_text(text, encoding="utf-8")
    said = fault_of(tmp_path)
    assert re.search(what, said), said


def test_session_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / SESSION_FILE).write_bytes(b"\xff\xfe\xfa")
    assert "not valid YAML" in fault_of(tmp_path)


def test_session_without_site_file_is_refused(tmp_path: Path) -> None:
    write_session(tmp_path, site_of(), [piece("north", "n.wav", START_NS)])
    (tmp_path / "site.yaml").unlink()
    with pytest.raises(ConfigError, match=r"site\.yaml: cannot be read: No such file"):
        read_session(tmp_path).site()


def test_session_leaves_out_the_paths_of_secrets() -> None:
    """Sessions are copied to other machines and replayed there without keys."""
    secrets = {"tokens": "tokens.yaml", "certificate": "site.crt", "private_key": "site.key"}
    site = site_of({"keys": "keys", "server.http": {"host": "0.0.0.0", "port": 8001, **secrets}})
    written = yaml.safe_load(site_text(site))
    assert "keys" not in written
    assert written["server"]["http"] == {"host": "0.0.0.0", "port": 8001}
