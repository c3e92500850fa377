"""Absurd values on the command line, and answers that no server gives: one clear error each, and never a traceback."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli.command_runs import Run
from livessl.cli import doctor, server_answers
from livessl.cli.server_sounds import ServerSounds
from livessl.errors import RunError
from small_site import write_site

URL = "http://127.0.0.1:9"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("levels --device a --rate 1e9", "expected a sampling rate from 100 to 1,000,000 Hz, got '1e9'"),
        ("levels --device a --rate nan", "expected a sampling rate from 100 to 1,000,000 Hz, got 'nan'"),
        ("init s.yaml --rate 1e300", "expected a sampling rate from 100 to 1,000,000 Hz, got '1e300'"),
        ("init s.yaml --arrays 65", "expected 1 to 64 arrays, got 65"),
        (f"init s.yaml --arrays {'9' * 5000}", f"expected a whole number >= 1, got '{'9' * 40}'…"),
        ("simulate --site s.yaml --out d --rate 1e12", "expected a sampling rate from 100 to 1,000,000 Hz"),
        ("simulate --site s.yaml --out d --seed -1", "expected a seed from 0 to 9223372036854775807, got '-1'"),
        ("simulate --site s.yaml --out d --count ²", "expected a whole number >= 1, got '²'"),
        ("simulate --site s.yaml --out d --count 1000000001", "expected a whole number >= 1, got '1000000001'"),
        ("events --min-confidence nan", "expected a number from 0 to 1, got 'nan'"),
        ("events --min-confidence 1.5", "expected a number from 0 to 1, got '1.5'"),
        ("capture --site s.yaml --node n --start-at 0001-01-01T00:00:00Z", "expected one in the years 1701 to 2239"),
        ("events --track 1.5", "expected a whole number >= 0, got '1.5'"),
        ("doctor --url http://[", "--url: expected an address such as http://127.0.0.1:8000, got 'http://['"),
        ("calibrate verify --at 1,1,1 --url http://x:99999", "--url: expected an address such as"),
        ("support-bundle --site s.yaml --out d.zip --url http://a?b=c", "--url: expected an address such as"),
    ],
)
def test_absurd_value_is_refused_in_one_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*arguments.split())
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert [path.name for path in tmp_path.iterdir()] == []


def test_number_with_thousands_of_zeros_before_it_is_a_number(run: Run) -> None:
    done = run(*f"init s.yaml --arrays {'0' * 5000}65".split())
    assert "expected 1 to 64 arrays, got 65" in done.err


def test_rate_too_low_for_the_own_sounds_is_refused(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "session"
    done = run("simulate", "--site", write_site(tmp_path), "--out", out, "--rate", 7999)
    assert done.code == 2
    assert "sampling rate: expected 8000 to 1e+06 Hz for the project's own sounds, got 7999" in done.err
    assert not out.exists()


@pytest.mark.parametrize(("command", "options"), [("simulate", ("--count", 1, "--rt60", 0)), ("plan", ("--rt60", 0))])
def test_folder_that_is_a_file_is_refused(run: Run, tmp_path: Path, command: str, options: tuple[object, ...]) -> None:
    site = write_site(tmp_path)
    done = run(command, "--site", site, "--out", site, *options)
    assert done.code == 2
    assert f"--out {site}: cannot be made: expected a folder, got a file; name another folder" in done.err


def test_file_that_cannot_be_written_is_named_with_the_cure(run: Run, tmp_path: Path) -> None:
    drawing = tmp_path / "nowhere" / "site.png"
    done = run("check", write_site(tmp_path), "--png", drawing)
    assert done.code == 1
    assert f"error: {drawing}: No such file or directory; correct the path or its permissions\n" in done.err


@pytest.mark.parametrize("name", [None, "out.json"])
@pytest.mark.parametrize(
    ("number", "cure"),
    [(errno.ENOSPC, "; free some space"), (errno.EDQUOT, "; free some space"), (errno.EMFILE, ""), (errno.EIO, ""),
     *((number, "; correct the path or its permissions")
       for number in (errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR, errno.EROFS))],
)  # fmt: skip
def test_errors_of_files_have_the_cure_that_helps(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, cure: str, name: str | None
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number), name)

    monkeypatch.setattr("livessl.site.load.load_site", fails)
    done = run("plan", "--site", tmp_path / "site.yaml")
    (line,) = done.err.splitlines()
    assert done.code == 1
    assert line.startswith(f"livessl: error: {name}: " if name else "livessl: error: ")
    assert line.endswith(os.strerror(number) + (cure if name or "space" in cure else ""))


@pytest.mark.parametrize("content", ["", "one\ntwo", "schlüssel", "a\x07b"])
def test_file_without_a_token_is_refused_without_repeating_it(run: Run, tmp_path: Path, content: str) -> None:
    file = tmp_path / "token"
    file.write_text(content, encoding="utf-8")
    done = run("doctor", "--url", URL, "--token-file", file)
    assert done.code == 2
    assert f"--token-file: expected the line that `livessl keys token` printed in {file}, got another" in done.err
    assert not content or content not in done.err


FINDING = {
    "kind": "finding", "fault": "dead", "array": "north", "channel": 1, "severity": "error", "confidence": 0.9,
    "message": "channel 1 of 'north' is silent", "cure": "switch it on", "input": 1,
}  # fmt: skip
FINDINGS = {"v": 1, "sounds": 7, "findings": [FINDING]}
SITE = {
    "v": 1, "site": "lab", "version": "1", "mode": "live", "room": {"size_m": [4.0, 5.0, 3.0]},
    "grid": {"bounds_m": [[0.0, 4.0], [0.0, 5.0], [0.0, 3.0]], "spacing_m": 0.1, "shape": [40, 50, 30]},
    "speed_of_sound_m_s": 343.0, "band_hz": [100.0, 6000.0], "method": "onset", "frame_s": 0.05,
    "activity": {"threshold": 0.1, "floor_factor": 4.0},
    "arrays": {"north": {"position_m": [1.0, 1.0, 1.0], "band_hz": [100.0, 6000.0],
                         "microphones_m": [[1.0, 1.0, 1.0], [1.2, 1.0, 1.0], [1.0, 1.2, 1.3]]}},
    "joint": {}, "zones": {}, "can_draw": True, "floor_plan": None,
    "privacy": {"mode": "recording", "retention_days": None},
}  # fmt: skip
OBSERVATION = {
    "array": "north", "delays_us": [1.0, None, -2.0], "inverted": [False, False, False], "coherence": [1.0, 0.9, 1.0],
    "powers": [0.1, 0.1, 0.1], "sharpness": 7.5, "closure_us": 4.0,
}  # fmt: skip
HEARD = {"number": 1, "id": "lab-1", "time_utc": "2026-01-31T12:00:00Z", "position_m": [1.0, 2.0, 1.0],
         "status": "located", "reason": None, "observations": [OBSERVATION]}  # fmt: skip
SOUNDS = {"v": 1, "now_utc": "2026-01-31T12:00:00Z", "last": 1, "sounds": [HEARD]}

VALUES: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from([None, True, "", "x", [], {}, [[]], -1, 0.5, 10**400]),
    st.floats(allow_nan=True),
    st.text(max_size=3),
)


def places_in(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The place of each value in JSON, the whole included."""
    yield place
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in parts:
        yield from places_in(part, (*place, key))


def changed(value: Any, place: tuple[Any, ...], other: Any) -> Any:
    """JSON with another value at a place."""
    if not place:
        return other
    copied = value.copy()
    copied[place[0]] = changed(value[place[0]], place[1:], other)
    return copied


def read(kind: str, body: bytes) -> object:
    """What a command makes of a server's answer."""
    with patch.object(server_answers, "fetch", lambda *_: body):
        sounds = ServerSounds(URL, None, 1.0)
        readers = {"findings": lambda: doctor._ask(URL, None), "site": sounds.site, "sounds": sounds.kept}
        return readers[kind]()


VALID = {"findings": FINDINGS, "site": SITE, "sounds": SOUNDS}


@pytest.mark.parametrize("kind", VALID)
def test_answer_of_a_server_is_read(kind: str) -> None:
    assert read(kind, json.dumps(VALID[kind]).encode())


@given(data=st.data(), kind=st.sampled_from(sorted(VALID)), other=VALUES)
def test_wrong_answer_of_a_server_is_one_error(data: st.DataObject, kind: str, other: object) -> None:
    place = data.draw(st.sampled_from(list(places_in(VALID[kind]))))
    body = json.dumps(changed(VALID[kind], place, other)).encode()
    with suppress(RunError):
        read(kind, body)


@pytest.mark.parametrize("body", [b"<html>", b"\xff", b"[" * 100_000, b"[]", b"{}", b"null"])
@pytest.mark.parametrize("kind", VALID)
def test_answer_of_another_server_is_an_error(kind: str, body: bytes) -> None:
    with pytest.raises(RunError, match="address"):
        read(kind, body)
