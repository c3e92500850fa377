"""The file of the reasons why events have no clip survives a full disk, a kill and a loss of power."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from livessl.schema.clips import MissingReason
from livessl.server.clips import missing
from livessl.server.clips.missing import FILE, MissingClips


def noted(folder: Path, *starts_ns: int) -> MissingClips:
    """Reasons for events of these starts, which are saved one by one."""
    found = MissingClips(folder)
    found.load()
    for start_ns in starts_ns:
        found.note(f"a-{start_ns}", start_ns, MissingReason.SPEECH)
        found.save()
    return found


def known(folder: Path, *starts_ns: int) -> list[bool]:
    """Whether the next server knows the reasons for events of these starts."""
    found = MissingClips(folder)
    found.load()
    return [found.why(f"a-{start_ns}") is MissingReason.SPEECH for start_ns in starts_ns]


def test_torn_line_takes_no_other_one_with_it_and_is_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    noted(tmp_path, 1)
    with (tmp_path / FILE).open("ab") as file:
        file.write(b'{"event_id":"a-2","sta')  # the power failed
    with caplog.at_level(logging.WARNING):
        noted(tmp_path, 3)
    assert "dropped 1 lines that cannot be read" in caplog.text
    assert known(tmp_path, 1, 2, 3) == [True, False, True]


def test_torn_line_of_a_full_disk_is_written_again(tmp_path: Path) -> None:
    found = noted(tmp_path, 1)
    with (tmp_path / FILE).open("ab") as file:
        file.write(b'{"event_id":"a-2","sta')  # the disk was full; the server still runs
    found.note("a-2", 2, MissingReason.SPEECH)
    found.save()
    assert known(tmp_path, 1, 2) == [True, True]


class KilledError(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("step", range(4))
def test_kill_while_the_file_is_replaced_loses_no_reason_and_the_old_file_is_erased(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    found, steps = noted(tmp_path, *range(5)), iter(range(10))

    def killed_at_a_step(act: Callable[..., None]) -> Callable[..., None]:
        def wrapped(*arguments: Any) -> None:
            stop_at_the_step()
            act(*arguments)
            stop_at_the_step()

        return wrapped

    def stop_at_the_step() -> None:
        if next(steps) == step:
            raise KilledError

    with monkeypatch.context() as patch:
        for name in ("write_through", "overwrite"):
            patch.setattr(missing, name, killed_at_a_step(getattr(missing, name)))
        with pytest.raises(KilledError):
            found.expire(2)
    assert known(tmp_path, 2, 3, 4) == [True] * 3
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_new_file_alone_is_taken(tmp_path: Path) -> None:
    noted(tmp_path, 1, 2)
    (tmp_path / FILE).rename(tmp_path / "missing.new")  # killed between both renames
    assert known(tmp_path, 1, 2) == [True, True]


def test_old_events_that_were_forgotten_for_lack_of_room_leave_the_file_with_the_retention(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(missing, "MOST", 3)
    found = noted(tmp_path, 1, 100, 101, 102)
    assert 'a-1"' in (tmp_path / FILE).read_text()
    found.expire(50)
    assert 'a-1"' not in (tmp_path / FILE).read_text()
    assert known(tmp_path, 100, 101, 102) == [True] * 3


def test_retention_that_the_disk_has_refused_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = noted(tmp_path, 1, 100)
    found.note("a-101", 101, MissingReason.SPEECH)

    def refuse(_: Path) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(missing, "overwrite", refuse)
        with pytest.raises(OSError, match="No space left"):
            found.expire(50)
    found.expire(50)
    found.save()
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    assert 'a-1"' not in (tmp_path / FILE).read_text()
    assert known(tmp_path, 100, 101) == [True, True]
