"""`livessl relocate --url` against scripted answers of a server: busy, changed, of another release."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from livessl.cli import relocate_at_server
from livessl.cli.main import main
from livessl.cli.server_answers import RefusedError
from messages import event_message

URL = "http://127.0.0.1:9"
NAMES = ("method", "status", "reason", "position_m", "covariance_m2", "confidence", "arrays", "candidates")
ANSWER = {**{name: event_message()[name] for name in NAMES}, "std_m": 0.1}


class Scripted:
    """A server of some events; a test chooses how often it is busy, and which digests it states."""

    def __init__(self, *event_ids: str) -> None:
        self.event_ids = event_ids
        self.asked: list[str] = []
        self.busy = 0
        self.digests: Callable[[str], str | None] = lambda _: "0" * 16
        self.is_old = False
        self.deleted: str | None = None

    def ask_for(self, model: Any, url: str, path: str, token_file: Path | None) -> Any:
        self.asked.append(path)
        answers: dict[str, Any] = {
            "relocation-settings": {"digest": self.digests(path)},
            "events": {"events": [event_message(id=name) for name in self.event_ids[::-1]],
                       "next_cursor": None, "previous_cursor": None},
            "clips": {"event_id": "any", "state": "stored", "keep": False, "position_m": None, "files": [],
                      "methods": []},
        }  # fmt: skip
        if path == f"events/{self.deleted}/clips":
            raise RefusedError("not found", 404, f"no event {self.deleted!r}")
        kind = path.partition("?")[0] if "?" in path else path.rpartition("/")[2]
        if self.is_old and kind == "relocation-settings":
            raise RefusedError("not found", 404, "Not Found")
        return model.model_validate({"v": 1, **answers.get(kind, event_message(id=kind))})

    def order(self, model: Any, url: str, path: str, token_file: Path | None, wanted: Any, wait_s: float) -> Any:
        self.asked.append(path)
        if self.busy > 0:
            self.busy -= 1
            raise RefusedError("refused", 503, "the server is overloaded")
        about = {"event_id": path.split("/")[1], "set_up": "then", "moved_arrays": [], "distance_m": 0.0}
        about |= {"stored": ANSWER, "again": ANSWER, "other_sources": [], "took_s": 0.1}
        return model.model_validate({"v": 1, "digest": self.digests(path), **about})


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    server = Scripted("a-1", "a-2", "a-3")
    monkeypatch.setattr(relocate_at_server, "ask_for", server.ask_for)
    monkeypatch.setattr(relocate_at_server, "order", server.order)
    monkeypatch.setattr(relocate_at_server, "FIRST_WAIT_S", 0.001)
    return server


@pytest.mark.parametrize("times", [1, 4])
def test_busy_server_is_asked_again(server: Scripted, capsys: pytest.CaptureFixture[str], times: int) -> None:
    server.busy = times
    assert main(["relocate", "--url", URL, "--json"]) == 0
    told = capsys.readouterr()
    found = [json.loads(line) for line in told.out.splitlines()]
    assert [(each["event_id"], each["error"]) for each in found] == [(name, None) for name in server.event_ids]
    assert {each["time_utc"] for each in found} == {"2026-01-01T00:00:00.000000Z"}
    assert [path for path in server.asked if path.endswith("/relocate")][: times + 1] == ["events/a-1/relocate"] * (
        times + 1
    )
    assert told.err.count("the server is overloaded; trying again for up to 120 s") == 1


def test_server_that_stays_busy_ends_the_command_with_its_reason(
    server: Scripted, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(relocate_at_server, "BUSY_S", 0.01)
    server.busy, out = 1 << 30, tmp_path / "answers.jsonl"
    assert main(["relocate", "--url", URL, "--out", str(out)]) == 1
    assert "refused" in capsys.readouterr().err.splitlines()[-1]
    assert "events/a-2/relocate" not in server.asked
    assert out.read_bytes() == b""  # no event counts as tried
    server.busy = 0
    assert main(["relocate", "--url", URL, "--out", str(out)]) == 0
    assert len(out.read_bytes().splitlines()) == 3


def test_events_that_are_answered_are_not_asked_for(server: Scripted, tmp_path: Path) -> None:
    out = tmp_path / "answers.jsonl"
    command = ["relocate", "--url", URL, "--out", str(out)]
    assert main(command) == 0
    server.event_ids, server.asked = ("a-1", "a-2", "a-3", "a-4"), []
    assert main(command) == 0
    assert [path for path in server.asked if "/" in path] == ["events/a-4/clips", "events/a-4", "events/a-4/relocate"]


def test_answers_of_other_settings_are_refused_before_anything_is_asked_for(
    server: Scripted, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answers.jsonl"
    command = ["relocate", "--url", URL, "--out", str(out)]
    assert main(command) == 0
    before, server.asked = out.read_bytes(), []
    server.digests = lambda _: "1" * 16
    assert main(command) == 2
    assert "has answers of another calibration" in capsys.readouterr().err
    assert (server.asked, out.read_bytes()) == (["relocation-settings?set_up=then"], before)


def test_settings_that_change_meanwhile_end_the_command(
    server: Scripted, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answers.jsonl"
    server.digests = lambda path: "1" * 16 if "a-2" in path else "0" * 16
    assert main(["relocate", "--url", URL, "--out", str(out)]) == 2
    assert "have changed meanwhile; start again, with another --out" in capsys.readouterr().err
    assert [json.loads(line)["event_id"] for line in out.read_text().splitlines()] == ["a-1"]


def test_event_that_is_deleted_after_it_was_listed_is_left_out(
    server: Scripted, capsys: pytest.CaptureFixture[str]
) -> None:
    server.deleted = "a-2"
    assert main(["relocate", "--url", URL, "--json"]) == 0
    told = capsys.readouterr()
    assert [json.loads(line)["event_id"] for line in told.out.splitlines()] == ["a-1", "a-3"]
    assert "1 of 3 located events have no recordings and are left out" in told.err


@pytest.mark.parametrize("is_without_route", [True, False])
def test_server_of_an_earlier_release_is_named(
    server: Scripted, capsys: pytest.CaptureFixture[str], is_without_route: bool
) -> None:
    server.is_old = is_without_route
    server.digests = lambda _: None
    assert main(["relocate", "--url", URL]) == 1
    assert "got an earlier release; update it" in capsys.readouterr().err


def test_file_of_answers_keeps_its_link_and_other_files_theirs(server: Scripted, tmp_path: Path) -> None:
    """Lines about events that failed are taken out of the file to which the name leads."""
    real, link, other = tmp_path / "there" / "real.jsonl", tmp_path / "link.jsonl", tmp_path / "link.jsonl.partial"
    real.parent.mkdir()
    link.symlink_to(real)
    other.write_text("mine", encoding="utf-8")
    command = ["relocate", "--url", URL, "--out", str(link)]
    assert main(command) == 0
    real.chmod(0o640)
    whole = [json.loads(line) for line in real.read_text().splitlines()]
    whole[1]["again"] = None
    real.write_text("".join(json.dumps(line) + "\n" for line in whole))
    assert main(command) == 0
    assert [json.loads(line)["event_id"] for line in real.read_text().splitlines()] == ["a-1", "a-3", "a-2"]
    assert (link.is_symlink(), other.read_text(), real.stat().st_mode & 0o777) == (True, "mine", 0o640)
    assert sorted(path.name for path in real.parent.iterdir()) == ["real.jsonl"]
