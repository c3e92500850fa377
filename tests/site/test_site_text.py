"""Texts and files that are no site, and values that are meant to do harm."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from livessl.errors import ConfigError
from livessl.site.load import load_site
from site_faults import ARRAY, faults_of, line_of
from small_site import text_of, write_site

BILLIONS = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10))


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", "site.yaml", "expected a mapping with the keys site, room and arrays"),
        ("# nothing\n", "site.yaml", "expected a mapping"),
        ("- a\n- b\n", "site.yaml", "expected a mapping"),
        ("just words", "site.yaml", "expected a mapping"),
        ("site: lab\nroom: [1, 2\n", "site.yaml:3", "not valid YAML: expected ',' or ']'"),
        ("site: lab\n\troom: 5\n", "site.yaml:2", "not valid YAML"),
        ("site: a\0b", "site.yaml", "not valid YAML"),
        ("site: 2026-02-31\n", "site.yaml", "not valid YAML"),
        ("site: !!bool perhaps\n", "site.yaml", "not valid YAML"),
        ("site: !!python/object:os.system {}\n", "site.yaml:1", "not valid YAML"),
        ("site: &a [*a]\n", "site.yaml", "an alias contains itself"),
        ("[" * 2000, "site.yaml", "not valid YAML"),
        (BILLIONS, "site.yaml", "its aliases stand for more than 1,000,000 values; write them out"),
        ("site: lab\nfusion: {min_arrays: 0x" + "f" * 4000 + "}\n", "site.yaml:2", "a number of at most 30 digits"),
        ("site: lab\nfusion: {min_arrays: " + "9" * 5000 + "}\n", "site.yaml:2", "a number of at most 30 digits"),
        ("site: \x01", "site.yaml", "not valid YAML: unacceptable character"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_text_that_is_not_a_site_is_refused(text: str, where: str, what: str) -> None:
    [(at, said)] = faults_of(text)
    assert at == where
    assert said.startswith(what) or what in said


@pytest.mark.parametrize(
    ("changes", "where", "what"),
    [
        ({"arrays.south.geometry": "a\0b"}, "arrays.south.geometry", "without NUL characters, got 'a\\x00b'"),
        ({"calibration": "a\0b"}, "calibration", "without NUL characters"),
        ({"zones_file": "a\0b"}, "zones_file", "without NUL characters"),
        (
            {"room.size_m": [999.0] * 3, "grid.spacing_m": 1e-4},
            "grid.spacing_m",
            "at most 1e+18 grid points, got 1e+21",
        ),
        ({"nodes.lab-pc.device": {"type": "scene", "seed": -1}}, "nodes.lab-pc.device.seed", "greater than or equal"),
    ],
)
def test_hostile_value_is_one_fault(changes: dict[str, Any], where: str, what: str) -> None:
    [(at, said)] = faults_of(text_of(changes))
    assert at.partition(": ")[2] == where
    assert what in said


def test_unreadable_file_is_refused(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "missing.yaml", "No such file or directory"),
        (tmp_path, "Is a directory"),
        (tmp_path / "latin.yaml", "it is not UTF-8 text; save it as UTF-8"),
    ):
        (tmp_path / "latin.yaml").write_bytes("site: Tür".encode("latin-1"))
        with pytest.raises(ConfigError) as caught:
            load_site(path)
        [fault] = caught.value.faults
        assert fault.where == str(path)
        assert fault.what.startswith("cannot be read: ")
        assert reason in fault.what


def test_file_is_named_with_its_line(tmp_path: Path) -> None:
    path = write_site(tmp_path, {"fusion.method": "music"})
    with pytest.raises(ConfigError) as caught:
        load_site(path)
    line = line_of(path.read_text(encoding="utf-8"), "fusion.method")
    assert str(caught.value).startswith(f"{path}:{line}: fusion.method: expected one of")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("microphones_m: [[0, 0, 0]]\n", "microphones_m: .*at least 2 items"),
        ("microphones_m: [[0, 0, 0], [0, 0]]\n", "microphones_m.1.2: missing"),
        ("positions: []\n", "positions: unknown key"),
        ("microphones_m: [\n", "cannot be read"),
        ("date: 2026-02-31\n", "cannot be read"),
    ],
)
def test_invalid_geometry_file_is_refused(tmp_path: Path, content: str, what: str) -> None:
    (tmp_path / "array.yaml").write_text(content, encoding="utf-8")
    path = write_site(tmp_path, {f"{ARRAY}.geometry": "array.yaml"})
    with pytest.raises(ConfigError) as caught:
        load_site(path)
    [fault] = caught.value.faults
    assert fault.where.endswith(f": {ARRAY}.geometry")
    assert str(tmp_path / "array.yaml") in fault.what
    assert re.search(what, fault.what), fault.what
