"""The page that has one line for every file is what its script writes, and the script misses no file."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "list_files"
PAGE = ROOT / "docs" / "files.md"
DESCRIBED = (".py", ".js", ".css", ".html", ".sh", ".yaml", ".yml", ".service", ".conf")

page: Callable[[Path], str] = runpy.run_path(str(SCRIPT))["page"]


def rows(text: str) -> dict[str, str]:
    """Return the line about each file."""
    return dict(re.findall(r"^\| `([^`]+)` \| (.+) \|$", text, re.MULTILINE))


def test_the_committed_page_is_current() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_every_file_has_a_line_that_says_something() -> None:
    lines = rows(PAGE.read_text(encoding="utf-8"))
    package = ROOT / "src" / "livessl"
    expected = {path.relative_to(package).as_posix() for path in package.rglob("*") if path.suffix in DESCRIBED}
    for folder in ("scripts", "benchmarks", "examples", "config", "deploy"):
        below = (path for path in (ROOT / folder).rglob("*") if path.suffix in DESCRIBED)
        expected |= {path.relative_to(ROOT).as_posix() for path in below}
    assert len(expected) > 500
    assert expected - set(lines) == set()
    assert [name for name, line in lines.items() if len(line) < 4] == []


def checkout(folder: Path, **modules: str) -> Path:
    package = folder / "src" / "livessl"
    (package / "core").mkdir(parents=True)
    for name, text in modules.items():
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    return package


def test_a_line_has_the_first_sentences_of_a_docstring_and_no_commands(tmp_path: Path) -> None:
    package = checkout(
        tmp_path,
        one='"""Counts a | b.\n\nIt wraps\nlines. Long ' + "long " * 60 + '."""\n',
        two='"""Runs things.\n\n    python two.py\n"""\n',
    )
    (package / "core" / "three.js").write_text("// Draws\n// dots:\n//   three.js --all\nlet x;\n", encoding="utf-8")
    assert rows(page(tmp_path)) == {
        "one.py": "Counts a \\| b. It wraps lines.",
        "two.py": "Runs things.",
        "core/three.js": "Draws dots.",
    }


def test_a_file_without_a_head_is_named(tmp_path: Path) -> None:
    checkout(tmp_path, bare="x = 1\n", good='"""Says it."""\n')
    with pytest.raises(Exception, match=r"^\S+bare\.py: expected a docstring or a comment at the head") as caught:
        page(tmp_path)
    assert "good.py" not in str(caught.value)


def test_parts_are_in_the_order_of_the_layers() -> None:
    titles = re.findall(r"^## (\S+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    layers = ["cli/", "lab/", "server/", "capture/", "simulation/", "recordings/", "site/", "core/stream/", "core/"]
    assert [title for title in titles if title in layers] == layers
