"""`livessl demo --sound-card`: from a virtual audio interface through node and server to a subscriber."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli.command_runs import Run
from conftest import require
from livessl.lab import virtual_interface
from livessl.lab.processes import free_port

EVENTS = 2

TRIES = 3
"""Runs of the demo: an overloaded machine loses blocks of the interface, as the node then says."""


@pytest.mark.sound_card
def test_sounds_of_a_virtual_interface_are_located(run: Run) -> None:
    lack = virtual_interface.missing()
    require(lack is None, str(lack))
    for _ in range(TRIES):
        done = run("demo", "--once", "--sound-card", "--count", str(EVENTS), "--port", str(free_port()), "--json")
        if done.code == 0:
            break
    assert done.code == 0, done.err
    assert f"{EVENTS} of {EVENTS} sounds located" in done.err
    errors_m: dict[str, list[float]] = {}
    for one in done.objects:
        if one["error_m"] is not None:
            errors_m.setdefault(json.dumps(one["truth"]), []).append(one["error_m"])
    assert len(errors_m) == EVENTS
    assert all(min(each) < 0.1 for each in errors_m.values()), errors_m


@pytest.mark.parametrize(
    ("there", "words"),
    [("gcc", "there is no C compiler (gcc)"), ("linux", "made of ALSA, which only Linux has")],
)
def test_what_a_machine_lacks_is_named_before_anything_starts(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, there: str, words: str
) -> None:
    if there == "gcc":
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        monkeypatch.setattr("sys.platform", "darwin")
    virtual_interface.built.cache_clear()
    done = run("demo", "--once", "--sound-card", "--port", str(free_port()))
    assert done.code == 1
    assert words in done.err
    assert "apt install gcc libasound2-dev libportaudio2" in done.err
