"""A server under a real systemd: it is started again when it hangs, and systemd learns of its reload and end."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conftest import require
from small_site import HANG_S, wait_until, write_site

SYSTEMD = Path("/usr/lib/systemd/systemd")

UNIT = Path(__file__).parent.parent / "deploy" / "livessl-server.service"

SANDBOX = ("Protect", "Private", "User=", "DynamicUser=", "NoNewPrivileges=", "CapabilityBoundingSet=", "Restrict",
           "LockPersonality=", "SystemCall", "WorkingDirectory=", "Environment=", "ExecReload=/opt")  # fmt: skip
"""Settings of the unit that a service manager of one user cannot apply."""

HANGING = """\
import sys
import time
from pathlib import Path

from livessl.cli.main import main
from livessl.server.engine import Engine

wanted, turn = Path(sys.argv.pop(1)), Engine.turn


def turn_or_hang(engine):
    while wanted.exists():
        time.sleep(0.05)
    turn(engine)


Engine.turn = turn_or_hang
sys.exit(main())
"""
"""A server whose fusion hangs as long as a file exists."""


class Systemd:
    """A real service manager, as one user's, that runs one unit in namespaces of its own."""

    def __init__(self, folder: Path, unit: str) -> None:
        self.log = folder / "systemd.log"
        (folder / "run.service").write_text(unit, encoding="utf-8")
        script = (
            "mount -t tmpfs tmpfs /run && mkdir -p -m 700 /run/systemd/system /run/user/systemd/user && "
            f"cp {folder}/run.service /run/user/systemd/user/ && export XDG_RUNTIME_DIR=/run/user HOME={folder} && "
            f"{SYSTEMD} --user --unit=run.service & wait"
        )
        command = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c", script)
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log)

    def __enter__(self) -> Systemd:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()  # and with it everything in its namespace
        self._process.wait(timeout=HANG_S)

    def control(self, *arguments: str) -> str:
        """Return what systemctl prints, nothing as long as it cannot connect."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        if not children:
            return ""
        inside = ("nsenter", f"--target={children[0]}", "--mount", "--pid", "env", "XDG_RUNTIME_DIR=/run/user")
        done = subprocess.run(
            [*inside, "systemctl", "--user", *arguments, "run.service"], capture_output=True, text=True, check=False
        )
        return done.stdout

    def shows(self, **wanted: str) -> bool:
        """Whether properties of the unit begin with these texts."""
        time.sleep(0.1)  # a look costs a process
        properties = ",".join(wanted)
        shown = dict(line.split("=", 1) for line in self.control("show", f"--property={properties}").splitlines())
        return all(shown.get(name, "").startswith(value) for name, value in wanted.items())


def user_unit(folder: Path, site: Path) -> str:
    """Return the server's unit with a server that may hang, as one user may run it."""
    text = UNIT.read_text(encoding="utf-8")
    kept = "\n".join(line for line in text.splitlines() if not line.startswith(SANDBOX))
    program = f"{sys.executable} {folder}/hanging.py {folder}/hang"
    started = kept.replace("/opt/livessl/bin/livessl", program).replace("/etc/livessl/site.yaml", str(site))
    assert started.count(program) == 1
    log = f"StandardOutput=append:{folder}/server.log\nStandardError=append:{folder}/server.log"
    environment = "\n".join(f"Environment={name}={os.environ[name]}" for name in ("PYTHONPATH",) if name in os.environ)
    return re.sub("WatchdogSec=.*", "WatchdogSec=6", started).replace("[Service]", f"[Service]\n{log}\n{environment}")


@pytest.mark.processes
def test_systemd_starts_a_server_that_hangs_again_and_learns_of_its_reload_and_end(tmp_path: Path) -> None:
    require(SYSTEMD.exists(), "systemd is not installed")
    may = subprocess.run(["unshare", "--mount", "--pid", "--fork", "true"], capture_output=True, check=False)
    require(may.returncode == 0, "this user may not make namespaces")
    (tmp_path / "hanging.py").write_text(HANGING, encoding="utf-8")
    hang, log = tmp_path / "hang", tmp_path / "server.log"
    with Systemd(tmp_path, user_unit(tmp_path, write_site(tmp_path))) as systemd:
        wait_until(lambda: systemd.shows(ActiveState="active", StatusText="starting: north: "), "a ready server")
        first = systemd.control("show", "--property=MainPID")
        assert systemd.shows(NRestarts="0")
        systemd.control("reload")
        wait_until(lambda: "the site file was read again: nothing has changed" in log.read_text(), "the reload")
        wait_until(lambda: systemd.shows(ActiveState="active", SubState="running"), "the end of the reload")
        hang.touch()
        wait_until(lambda: "Fatal Python error: Aborted" in log.read_text(), "the end of the server that hangs")
        hang.unlink()
        wait_until(lambda: systemd.shows(ActiveState="active", StatusText="starting: north: "), "the next server")
        assert systemd.control("show", "--property=MainPID") != first
        assert "in turn_or_hang" in log.read_text(), "the journal shows where it hung"
        systemd.control("stop")
        wait_until(lambda: systemd.shows(ActiveState="inactive", Result="success"), "its end")
