"""Commands write over nothing that they have not made: the site file, sounds, pictures and reports of others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from matplotlib.figure import Figure

from cli.command_runs import Recorded, Run, interrupted, simulate_arguments
from livessl.cli.own_work import is_own_picture, refuse_foreign
from livessl.cli.relocate import BEGINNING, is_begun
from livessl.errors import UseError
from livessl.lab.evaluate.campaign import run_campaign
from livessl.lab.evaluate.report import write_report
from livessl.recordings.session import read_session
from livessl.simulation.export import simulated_files
from small_site import write_site

COMMENTED = "# measured by hand, keep\n"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def never(*_: object, **__: object) -> Any:
    pytest.fail("something was computed before the refusal")


@pytest.fixture
def nothing_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (
        "livessl.simulation.export.write_scene",
        "livessl.lab.plan.design.make_plan",
        "livessl.calibration.sounds_of",
        "livessl.capture.record.record_device",
        "livessl.lab.layout.measures.layout_of",
    ):
        monkeypatch.setattr(name, never)


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "--out", "{folder}"),
        ("record", "--node", "lab-pc", "--out", "{folder}"),
        ("check", "--png", "{site}"),
        ("calibrate", "refine", "--session", "{session}", "--write", "{site}"),
    ],
)
@pytest.mark.parametrize("copied", [False, True])
def test_the_given_site_file_is_never_written_over(
    run: Run, recorded: Recorded, tmp_path: Path, command: tuple[str, ...], copied: bool
) -> None:
    if copied:  # the site of a simulated session, which `simulate` may otherwise replace
        shutil.copytree(recorded.directory, tmp_path, dirs_exist_ok=True)
        site = tmp_path / "site.yaml"
        for path in tmp_path.glob("*.wav") if command[0] == "record" else ():
            path.unlink()
        (tmp_path / "session.yaml").unlink() if command[0] == "record" else None
    else:
        site = write_site(tmp_path)
        site.write_text(COMMENTED + site.read_text(encoding="utf-8"), encoding="utf-8")
        site = site.rename(tmp_path / "site.yaml")
    before = contents(tmp_path)
    given = [part.format(folder=tmp_path, site=site, session=recorded.directory) for part in command]
    at = 2 if given[0] == "calibrate" else 1
    positional = [str(site)] if given[0] == "check" else ["--site", str(site)]
    done = run(*given[:at], *positional, *given[at:])
    assert done.code == 2
    assert "is the site file and would be lost" in done.err
    assert len(done.err.splitlines()) == 1
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize("name", ["south.wav", "site.yaml", "truth.jsonl"])
def test_simulate_refuses_files_of_others(run: Run, recorded: Recorded, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"a: 1  # precious\n")
    done = run(*simulate_arguments(recorded.site, tmp_path))
    assert (done.code, "name another" in done.err) == (2, True)
    assert f"{tmp_path / name}, which does not belong to a complete simulated session" in done.err
    assert contents(tmp_path) == {name: b"a: 1  # precious\n"}


def commented(folder: Path) -> None:
    text = (folder / "site.yaml").read_text(encoding="utf-8")
    (folder / "site.yaml").write_text(text + COMMENTED, encoding="utf-8")


def linked(folder: Path) -> None:
    (folder / "north.wav").rename(folder / "kept.wav")
    (folder / "north.wav").symlink_to("kept.wav")


def without_truth(folder: Path) -> None:
    (folder / "truth.jsonl").unlink()


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize("change", [commented, linked, without_truth])
def test_a_changed_session_is_not_replaced(
    run: Run, recorded: Recorded, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    session = tmp_path / "session"
    shutil.copytree(recorded.directory, session)
    change(session)
    before = contents(session)
    assert run(*simulate_arguments(recorded.site, session)).code == 2
    assert contents(session) == before


def test_a_simulated_session_is_replaced(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    """By one of fewer arrays, too, and by the first again; what is not its own stays."""
    session, fewer = tmp_path / "session", tmp_path / "fewer.yaml"
    shutil.copytree(recorded.directory, session)
    (session / "south-of-us.wav").write_bytes(b"precious")
    site = yaml.safe_load(recorded.site.read_text(encoding="utf-8"))
    del site["arrays"]["south"]
    for node in site["nodes"].values():
        node["arrays"].pop("south", None)
    fewer.write_text(yaml.safe_dump(site), encoding="utf-8")
    for seed, given, names in ((8, fewer, ["north"]), (5, recorded.site, ["north", "south"])):
        assert run(*simulate_arguments(given, session, seed=seed)).code == 0
        assert sorted(path.stem for path in session.glob("*.wav")) == [*names, "south-of-us"]
        assert [piece.array for piece in read_session(session).pieces] == names
    found = contents(session)
    assert found.pop("south-of-us.wav") == b"precious"
    assert found == contents(recorded.directory)


@pytest.mark.parametrize("is_there", [False, True])
def test_an_interrupted_simulation_can_be_repeated(
    run: Run, recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool
) -> None:
    """What was there stays as it was, and nothing else is left."""
    session = tmp_path / "session"
    session.mkdir()
    if is_there:
        shutil.copytree(recorded.directory, session, dirs_exist_ok=True)
    before = contents(session)
    with monkeypatch.context() as patch:
        patch.setattr("livessl.simulation.export.truth", interrupted)  # all arrays are rendered then
        assert run(*simulate_arguments(recorded.site, session, seed=8)).code == 130
    assert contents(session) == before
    assert len(list(session.iterdir())) == len(before)
    assert run(*simulate_arguments(recorded.site, session)).code == 0
    assert contents(session) == contents(recorded.directory)


def test_recordings_elsewhere_are_no_part_of_a_simulated_session(recorded: Recorded, tmp_path: Path) -> None:
    session = tmp_path / "session"
    shutil.copytree(recorded.directory, session)
    text = (session / "session.yaml").read_text(encoding="utf-8")
    for array, file in (("south", "../south.wav"), ("../south", "../south.wav"), ("south", "north.flac")):
        changed = text.replace("array: south", f"array: {array}").replace("file: south.wav", f"file: {file}")
        (session / "session.yaml").write_text(changed, encoding="utf-8")
        names = {path.name for path in simulated_files(session)}
        assert names == {"north.wav", "truth.jsonl", "session.yaml", "site.yaml"}


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize("name", ["plan.json", "plan.png"])
@pytest.mark.parametrize("content", [b" ", b"[1]", b'{"site": "lab"}', b"\x89PNG\r\n\x1a\nof somebody"])
def test_a_plan_refuses_files_of_others(run: Run, tmp_path: Path, name: str, content: bytes) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_bytes(content)
    done = run("plan", "--site", write_site(tmp_path), "--out", out)
    assert (done.code, str(out / name) in done.err) == (2, True)
    assert contents(out) == {name: content}


def test_a_picture_of_our_own_is_drawn_again(run: Run, tmp_path: Path) -> None:
    site, picture = write_site(tmp_path), tmp_path / "room.png"
    for _ in range(2):
        assert run("check", site, "--png", picture).code == 0
    assert is_own_picture(picture)
    picture.write_bytes(b"\x89PNG\r\n\x1a\n of a camera")
    done = run("check", site, "--png", picture)
    assert (done.code, f"{picture}, which does not say that livessl has drawn it" in done.err) == (2, True)


@pytest.mark.parametrize(("dpi", "is_own"), [(110, True), (100, False)])
def test_pictures_of_earlier_releases_are_known_by_their_density(tmp_path: Path, dpi: int, is_own: bool) -> None:
    """They name matplotlib alone, like any figure of somebody else."""
    path = tmp_path / "plan.png"
    Figure(figsize=(1.0, 1.0)).savefig(path, dpi=dpi)
    assert is_own_picture(path) is is_own


def test_an_empty_file_is_an_empty_place(tmp_path: Path) -> None:
    empty, link, folder = tmp_path / "empty", tmp_path / "link", tmp_path / "folder"
    empty.touch()
    folder.mkdir()
    refuse_foreign("--write", [empty], never)
    with pytest.raises(UseError, match="is the site file and would be lost"):
        refuse_foreign("--write", [empty], never, empty)
    link.symlink_to("nowhere")
    for path in (folder, link):
        with pytest.raises(UseError, match=f"got {path}, which would be written over"):
            refuse_foreign("--write", [path], never)


@pytest.mark.usefixtures("nothing_is_computed")
@pytest.mark.parametrize("text", ["shape: {pyramid: 3}\n", "arrays: {}\nroom: {}\n", "text", "["])
def test_a_calibration_replaces_nothing_else(run: Run, recorded: Recorded, tmp_path: Path, text: str) -> None:
    """Neither the file that is named nor the one at the usual place, which may be a geometry."""
    site = write_site(tmp_path)
    usual = tmp_path / "calibration" / "small.yaml"
    usual.parent.mkdir()
    for path, given in ((tmp_path / "other.yaml", ["--write", tmp_path / "other.yaml"]), (usual, ["--write"])):
        path.write_text(text, encoding="utf-8")
        done = run("calibrate", "refine", "--site", site, "--session", recorded.directory, *given)
        assert done.code == 2
        assert path.read_text(encoding="utf-8") == text


@pytest.mark.parametrize("name", ["report.md", "summary.csv", "figures/room.png"])
def test_a_report_refuses_files_of_others(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("# My own\n", encoding="utf-8")
    with pytest.raises(ValueError, match=name.partition("/")[0]):
        write_report(tmp_path, [tmp_path / "none"])
    assert contents(tmp_path) == {name: b"# My own\n"}


@pytest.mark.parametrize("name", ["results.parquet", "report.md", "campaign.json", "cost.jsonl"])
def test_a_campaign_refuses_files_of_others(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("# My own\n", encoding="utf-8")
    job: Any = SimpleNamespace(digest="0")
    with pytest.raises(ValueError, match=r"expected .*empty folder"):
        run_campaign(job, tmp_path, jobs=1)
    assert contents(tmp_path) == {name: b"# My own\n"}


@pytest.mark.parametrize("length", range(0, len(BEGINNING) + 9, 5))
def test_only_the_beginning_of_an_answer_is_taken_for_one(length: int) -> None:
    answer = BEGINNING + b', "event_id": 1'
    assert is_begun(answer[:length])
    assert length == 0 or not is_begun(b"x" + answer[: length - 1])
