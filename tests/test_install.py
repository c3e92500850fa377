"""The installer for Debian: releases side by side, one link to the one in use, and back again if the new one fails.

And the versions that it installs.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import sysconfig
import tomllib
from contextlib import closing
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
INSTALLER = ROOT / "deploy" / "install.sh"
SYSTEMCTL = """#!/bin/sh
echo "$*" >>"$CALLS"
case $1 in restart) [ ! -e "$CALLS.migrates" ] || { . "$CALLS.migrates"; rm "$CALLS.migrates"; } ;; esac
case $1 in is-active) [ ! -e "$CALLS.down" ] || { rm "$CALLS.down"; exit 3; } ;; esac
"""
"""Stands in for systemd, which does not run in a test: it notes its calls, and the units are down if a file says so."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True, timeout=280)
    (made,) = out.glob("*.whl")
    return made


class Machine:
    """A machine to install on: folders of its own, the test's libraries, and what stands in for systemd."""

    def __init__(self, folder: Path) -> None:
        self.prefix, self.units = folder / "opt", folder / "units"
        self.site = folder / "etc" / "site.yaml"
        self.site.parent.mkdir()
        shutil.copy(ROOT / "config" / "demo.yaml", self.site)
        self.calls = folder / "calls"
        programs = folder / "programs"
        programs.mkdir()
        (programs / "systemctl").write_text(SYSTEMCTL)
        (programs / "systemctl").chmod(0o755)
        (programs / "python3").symlink_to(sys.executable)
        self._environment = os.environ | {
            "PATH": f"{programs}:{os.environ['PATH']}",
            "CALLS": str(self.calls),
            "PYTHONPATH": sysconfig.get_path("purelib"),  # instead of downloading what is here already
            "PIP_NO_COMPILE": "1",  # little of what is installed four times is run
            "PIP_NO_DEPS": "1",
            "PIP_NO_INDEX": "1",
        }

    def install(self, *options: str) -> subprocess.CompletedProcess[str]:
        places = ("--prefix", str(self.prefix), "--units", str(self.units), "--site", str(self.site), "--extras", "")
        return subprocess.run(
            ["sh", str(INSTALLER), *places, *options],
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )

    @property
    def in_use(self) -> str:
        return str((self.prefix / "bin").readlink())


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def migrating_history(machine: Machine) -> Path:
    """A history of an old revision, as a server writes it, that the next restart migrates."""
    site, path = yaml.safe_load(machine.site.read_text()), machine.site.parent / "history" / "events.sqlite"
    site["server"] = {**site.get("server", {}), "events_db": str(path)}
    machine.site.write_text(yaml.safe_dump(site))
    path.parent.mkdir()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("CREATE TABLE alembic_version (version_num)")
        database.execute("INSERT INTO alembic_version VALUES ('0001')")
    change = "import sqlite3, sys; sqlite3.connect(sys.argv[1], isolation_level=None).execute(sys.argv[2])"
    words = [sys.executable, "-c", change, str(path), "UPDATE alembic_version SET version_num = '9000'"]
    Path(f"{machine.calls}.migrates").write_text(shlex.join(words))
    return path


def test_update_that_does_not_come_up_is_taken_back(machine: Machine, wheel: Path) -> None:
    """Install, update, and an update that fails: with a real wheel in real environments."""
    options = ("--wheel", str(wheel), "--server", "--node", "lab-pc")
    first = machine.install(*options)
    assert first.returncode == 0, first.stderr
    assert machine.in_use == "releases/1/bin"
    said = subprocess.run([machine.prefix / "bin" / "livessl", "--version"], capture_output=True, text=True, check=True)
    assert said.stdout.startswith("livessl ")
    unit = (machine.units / "livessl-server.service").read_text()
    assert f"ExecStart={machine.prefix}/bin/livessl serve --site {machine.site}\n" in unit
    calls = machine.calls.read_text()
    assert "daemon-reload" in calls
    assert "restart livessl-server.service livessl-node@lab-pc.service" in calls

    second = machine.install(*options)
    assert second.returncode == 0, second.stderr
    assert "--roll-back returns to release 1" in second.stderr
    assert machine.in_use == "releases/2/bin"

    history = migrating_history(machine)
    Path(f"{machine.calls}.down").touch()
    third = machine.install(*options)
    assert third.returncode == 1
    assert "the units of release 3 did not stay up: release 2 is in use again; see" in third.stderr
    assert "stop livessl-server.service livessl-node@lab-pc.service" in machine.calls.read_text()
    with closing(sqlite3.connect(history)) as database:
        assert database.execute("SELECT version_num FROM alembic_version").fetchall() == [("0001",)]
        assert not Path(f"{machine.calls}.migrates").exists()
    assert [path.name for path in history.parent.iterdir()] == [history.name]
    assert machine.in_use == "releases/2/bin"
    assert sorted(path.name for path in (machine.prefix / "releases").iterdir()) == ["1", "2"]

    back = machine.install("--roll-back")
    assert back.returncode == 0, back.stderr
    assert machine.in_use == "releases/1/bin"
    again = machine.install("--roll-back")
    assert again.returncode == 1
    assert "there is no release before 1" in again.stderr


def test_site_file_that_the_new_release_refuses_changes_nothing(machine: Machine, wheel: Path) -> None:
    machine.site.write_text("site: lab\n")
    done = machine.install("--wheel", str(wheel), "--server")
    assert done.returncode == 1
    assert f"the new release does not accept {machine.site}; nothing was changed" in done.stderr
    assert not (machine.prefix / "bin").exists()
    assert not list((machine.prefix / "releases").iterdir())
    assert not machine.units.exists()
    assert not machine.calls.exists()


def test_dry_run_does_nothing(machine: Machine) -> None:
    done = machine.install("--server", "--version", "9.9.9", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "pip install --quiet --disable-pip-version-check livessl==9.9.9" in done.stdout
    assert "systemctl restart livessl-server.service" in done.stdout
    assert not machine.prefix.exists()
    assert not machine.units.exists()
    assert not machine.calls.exists()


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["--servre"], 2, "expected an option, got --servre"),
        (["--node"], 2, "expected a value after --node"),
        (["--wheel", "a.whl", "--version", "1"], 2, "expected --wheel or --version, got both"),
        (["--wheel", "absent.whl"], 1, "expected a wheel, found no file absent.whl"),
        (["--site", "/absent/site.yaml", "--server"], 1, "expected a site file at /absent/site.yaml, found none"),
        (["--roll-back"], 1, "expected an installation at"),
    ],
)
def test_wrong_use_is_one_sentence(machine: Machine, options: list[str], code: int, said: str) -> None:
    done = machine.install(*options)
    assert done.returncode == code
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not machine.prefix.exists()


def test_installation_by_hand_is_left_alone(machine: Machine) -> None:
    (machine.prefix / "bin").mkdir(parents=True)
    done = machine.install("--server", "--version", "9.9.9")
    assert done.returncode == 1
    assert f"expected {machine.prefix}/bin to be a link that this installer made, got a folder" in done.stderr


def test_lock_has_what_the_project_needs_with_checksums() -> None:
    """If this fails, run scripts/lock."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "deploy" / "requirements.lock").read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    locked = {}
    for line in lines[1:]:
        pinned, *checksums = line.split()
        name, _, locked[name] = pinned.partition("==")
        assert checksums
        assert all(re.fullmatch("--hash=sha256:[0-9a-f]{64}", each) for each in checksums), line
    for requirement in map(Requirement, [*project["dependencies"], *project["optional-dependencies"]["fast"]]):
        assert requirement.specifier.contains(locked[requirement.name.lower()]), requirement
