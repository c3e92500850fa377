"""`livessl simulate` after a run that was killed: its half-written folder goes, and nothing else does."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cli.command_runs import Recorded, Run, simulate_arguments
from livessl.recordings.session import read_session
from small_site import started, wait_until


def unfinished(out: Path) -> list[Path]:
    return sorted(out.glob("unfinished-*"))


def is_free(folder: Path) -> bool:
    """Whether no process holds the lock of a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(descriptor)
    return True


def test_what_a_killed_run_has_left_is_removed_by_the_next_one(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    """While the other run lives, though it does nothing, its folder stays."""
    out = tmp_path / "out"
    arguments = simulate_arguments(recorded.site, out)
    slow = [*arguments, "--rt60", "1", "--count", "200"]
    with started(sys.executable, "-m", "livessl", *slow) as process:
        wait_until(lambda: out.is_dir() and unfinished(out) and is_free(out), "the folder of the run")
        process.send_signal(signal.SIGSTOP)
        [left] = unfinished(out)
        (left / "north.wav").write_bytes(b"half")

        done = run(*arguments)
        assert (done.code, unfinished(out)) == (0, [left])

        process.kill()
        assert process.wait() == -signal.SIGKILL
    last = subprocess.run([sys.executable, "-m", "livessl", *arguments], capture_output=True, text=True, check=True)
    assert unfinished(out) == []
    assert f"removed {left}" in last.stderr
    assert {piece.array for piece in read_session(out).pieces} == {"north", "south"}


@pytest.mark.parametrize("name", ["unfinished-business", "unfinished-simulation-of_a_car"])
def test_other_folders_stay(run: Run, recorded: Recorded, tmp_path: Path, name: str) -> None:
    other = tmp_path / name
    other.mkdir()
    (other / "notes.txt").write_bytes(b"precious")
    done = run(*simulate_arguments(recorded.site, tmp_path))
    assert (done.code, unfinished(tmp_path)) == (0, [other])
    assert (other / "notes.txt").read_bytes() == b"precious"
