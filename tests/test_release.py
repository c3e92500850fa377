"""The release check: wheel and sdist build, install in a clean environment, and the demo runs from the wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def release(*arguments: str, out: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHON": sys.executable, "OUT": str(out), "PIP_NO_COMPILE": "1"}
    return subprocess.run(
        ["sh", "scripts/release", *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=580,
        check=False,
    )


@pytest.mark.processes
@pytest.mark.timeout(600)
def test_wheel_installs_cleanly_and_runs_the_demo(tmp_path: Path) -> None:
    done = release("--check", out=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "can be released" in done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for needed in ("server/static/index.html", "lab/demo.yaml", "py.typed", "shipped/config/paper.yaml"):
        assert f"livessl/{needed}" in names
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert any(name.endswith("/tests/test_release.py") for name in archive.getnames())


def test_unknown_option_is_refused(tmp_path: Path) -> None:
    done = release("--publish", out=tmp_path)
    assert done.returncode == 1
    assert "expected --check or nothing, got --publish" in done.stderr
