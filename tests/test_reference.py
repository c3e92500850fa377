"""The API reference is built from the docstrings without a warning."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import livessl

ROOT = Path(__file__).parents[1]


def build(config: Path, into: Path) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--config-file",
        str(config),
        "--site-dir",
        str(into),
    ]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=110, check=False)


def test_reference_is_built_without_warnings_and_has_every_name(tmp_path: Path) -> None:
    done = build(ROOT / "mkdocs.yml", tmp_path)
    assert done.returncode == 0, done.stderr
    text = "".join(page.read_text(encoding="utf-8") for page in tmp_path.glob("*.html"))
    listed = set(re.findall(r'id="livessl[\w.]*\.(\w+)"', text))
    assert set(livessl.__all__) - {"METHODS", "__version__"} <= listed


def test_a_warning_fails_the_build(tmp_path: Path) -> None:
    pages = tmp_path / "pages"
    pages.mkdir()
    (pages / "index.md").write_text("[nowhere](missing.md)\n", encoding="utf-8")
    config = tmp_path / "mkdocs.yml"
    config.write_text(f"site_name: broken\ndocs_dir: {pages}\ntheme: {{name: mkdocs}}\n", encoding="utf-8")
    assert build(config, tmp_path / "built").returncode != 0
