"""`livessl check`, and how commands report the faults of a site file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cli.command_runs import Recorded, Run
from small_site import write_site


def test_check_summarizes_a_valid_site(run: Run, recorded: Recorded) -> None:
    done = run("check", recorded.site)
    assert done.code == 0
    assert "valid; site 'small', arrays north (4 microphones), south (4 microphones), 3,840 grid points" in done.out
    [checked] = run("check", recorded.site, "--json").objects
    expected = {"valid": True, "faults": [], "warnings": [], "site": "small", "arrays": ["north", "south"]}
    layout = checked.pop("layout")
    assert checked == {**expected, "nodes": 3840}
    assert set(layout["arrays"]) == {"north", "south"}


FAULTY = {"fusion.method": "music", "colour": "red", "arrays.north.position_m": [9, 9, 9], "grid.spacing_m": 0}


WIDE = [[0.1, 0.1, 2.5], [3.9, 0.1, 2.5], [3.9, 4.9, 2.5], [0.1, 4.9, 2.5]]


def test_warnings_of_a_site_are_printed(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    site = write_site(tmp_path, {"arrays.north": {"microphones_m": WIDE}})
    note = "livessl: note: grid.spacing_m: array 'north' is 6.1 m wide: "
    checked = run("check", site)
    assert checked.code == 0
    assert checked.err.startswith(note)
    [warning] = run("check", site, "--json").objects[0]["warnings"]
    assert checked.err == f"livessl: note: {warning}\n"
    assert note in run("locate", "--site", site, *recorded.wavs()).err
    taken = write_site(tmp_path, {"arrays.north": {"microphones_m": WIDE}, "server.events_db": str(tmp_path)})
    assert note in run("serve", "--site", taken).err


def test_check_prints_all_faults_at_once(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, FAULTY)
    done = run("check", path)
    assert done.code == 2
    lines = done.err.splitlines()
    assert len(lines) == len(FAULTY)
    for line in lines:
        assert re.match(rf"livessl: error: {re.escape(str(path))}:\d+: [\w.]+: .+", line)
    for place in ("fusion.method", "colour", "arrays.north", "grid.spacing_m"):
        assert f": {place}: " in done.err
    as_json = run("check", path, "--json")
    assert as_json.code == 2
    [result] = as_json.objects
    assert result["valid"] is False
    assert [f"livessl: error: {fault['where']}: {fault['what']}" for fault in result["faults"]] == lines


@pytest.mark.parametrize(
    "command",
    [
        "serve --site {site}",
        "capture --site {site} --node lab-pc",
        "locate --site {site} --wav north=n.wav",
        "record --site {site} --node lab-pc --out {out}",
        "simulate --site {site} --out {out}",
    ],
)
def test_every_command_prints_all_faults_of_the_site(run: Run, tmp_path: Path, command: str) -> None:
    path = write_site(tmp_path, FAULTY)
    done = run(*command.format(site=path, out=tmp_path / "out").split())
    assert done.code == 2
    assert len(done.err.splitlines()) == len(FAULTY)
    assert not (tmp_path / "out").exists()


def test_missing_site_file_is_an_error(run: Run, tmp_path: Path) -> None:
    done = run("serve", "--site", tmp_path / "site.yaml")
    assert done.code == 2
    assert done.err == (
        f"livessl: error: {tmp_path / 'site.yaml'}: cannot be read: No such file or directory; "
        "correct the name, or make a site file with `livessl init`\n"
    )


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "config").glob("*.yaml")), ids=lambda path: path.stem
)
def test_shipped_configs_pass_the_check_without_a_note(run: Run, path: Path) -> None:
    done = run("check", path)
    assert (done.code, done.err) == (0, "")
    assert "expected error at 1.5 m height" in done.out
