"""The spool keeps frames in order, within its bounds, through killed processes and full disks."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl import wire
from livessl.capture import spool as spools
from livessl.capture.spool import SEGMENT_BYTES, Spool, SpoolError
from livessl.core.types import Frame
from small_site import frame

SIZE = len(wire.encode(frame()))


def frame_indices(spool: Spool) -> list[tuple[str, int]]:
    return [(kept.array, kept.frame_index) for kept in spool.frames()]


def contents(spool: Spool) -> list[bytes]:
    return [spool.read(kept) for kept in spool.frames()]


def filled(directory: Path | None, numbers: range = range(1, 11), **limits: float) -> Spool:
    spool = Spool(directory, **limits)  # type: ignore[arg-type]
    for k in numbers:
        spool.append(frame(k, frame_index=k, array="south" if k % 3 == 0 else "north"))
    return spool


@pytest.fixture(params=["memory", "disk"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | None:
    return tmp_path / "spool" if request.param == "disk" else None


def test_frames_come_back_unchanged_in_order_of_time(place: Path | None) -> None:
    spool = Spool(place)
    frames = [
        frame(k, frame_index=r, array=a, seed=k) for k, (a, r) in enumerate([("a", 3), ("b", 1), ("a", 5), ("b", 4)])
    ]
    for one in frames:
        spool.append(one)
    assert contents(spool) == [wire.encode(frames[k]) for k in (1, 0, 3, 2)]
    spool.close()


def test_settled_frames_are_released(place: Path | None) -> None:
    spool = filled(place)
    spool.forget("north", 6)
    assert frame_indices(spool) == [("south", 3), ("south", 6), ("north", 7), ("north", 8), ("south", 9), ("north", 10)]
    spool.forget("south", 100)
    spool.forget("nobody", 100)
    assert len(spool) == 3
    spool.close()


def test_oldest_frames_are_removed_and_returned(place: Path | None) -> None:
    spool = filled(place, range(1, 5), max_bytes=4 * SIZE)
    _, gone = spool.append(frame(5, frame_index=5))
    assert [(kept.array, kept.frame_index) for kept in gone] == [("north", 1)]
    assert [frame_index for _, frame_index in frame_indices(spool)] == [2, 3, 4, 5]
    spool.close()


def test_old_frames_are_removed(place: Path | None) -> None:
    spool = filled(place, range(1, 40), max_age_s=0.5)
    assert [frame_index for _, frame_index in frame_indices(spool)] == list(range(29, 40))
    spool.close()


def test_clock_set_back_removes_later_frames(place: Path | None) -> None:
    spool = filled(place, range(1, 9))
    _, gone = spool.append(frame(9, frame_index=5))
    assert sorted(kept.frame_index for kept in gone) == [5, 7, 8]
    assert frame_indices(spool) == [("north", 1), ("north", 2), ("south", 3), ("north", 4), ("north", 5), ("south", 6)]
    spool.close()


def test_frames_outlive_the_process(tmp_path: Path) -> None:
    spool = filled(tmp_path)
    expected = contents(spool)
    # not closed, as after a kill
    again = Spool(tmp_path)
    assert contents(again) == expected
    assert again.torn == 0
    again.append(frame(11, frame_index=11))
    assert len(Spool(tmp_path)) == 11
    spool.close()
    again.close()


def test_killed_node_leaves_whole_frames(tmp_path: Path) -> None:
    """A real process is killed with signal 9 while it writes."""
    ready, told = os.pipe()
    child = os.fork()
    if child == 0:
        spool = Spool(tmp_path)
        for k in range(1, 100_000):
            spool.append(frame(k, frame_index=k))
            if k == 20:
                os.write(told, b"!")
        os._exit(1)
    os.read(ready, 1)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    again = Spool(tmp_path)
    got = [frame_index for _, frame_index in frame_indices(again)]
    assert len(got) >= 20
    assert got == list(range(1, len(got) + 1))
    for data in contents(again):
        assert isinstance(wire.decode(data), Frame)
    again.close()


@settings(deadline=None, max_examples=25)
@given(cut=st.integers(1, 5 * SIZE), flip=st.none() | st.integers(0, 5 * SIZE))
def test_torn_or_changed_tail_ends_a_segment(
    tmp_path_factory: pytest.TempPathFactory, cut: int, flip: int | None
) -> None:
    directory = tmp_path_factory.mktemp("spool")
    spool = filled(directory, range(1, 6))
    spool.close()
    (path,) = directory.iterdir()
    data = bytearray(path.read_bytes())
    if flip is not None:
        data[flip] ^= 1
    torn = bytes(data[: len(data) - cut])
    path.write_bytes(torn)
    again = Spool(directory)
    whole = max(0, len(torn) - 8) // (SIZE + 8)
    if flip is None:
        assert len(again) == whole
    assert [frame_index for _, frame_index in frame_indices(again)] == list(range(1, len(again) + 1))
    for kept in again.frames():
        assert wire.decode(again.read(kept)) is not None
    again.close()


def test_segment_without_needed_frames_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spools, "SEGMENT_BYTES", 3 * (SIZE + 8) + 8)
    spool = filled(tmp_path)
    assert len(list(tmp_path.iterdir())) == 4
    spool.forget("north", 6)
    spool.forget("south", 6)
    assert len(list(tmp_path.iterdir())) == 3
    assert len(contents(spool)) == 5
    spool.close()
    again = Spool(tmp_path)
    assert [frame_index for _, frame_index in frame_indices(again)] == list(
        range(4, 11)
    )  # two more than needed: they share a segment
    again.forget("north", 100)
    again.forget("south", 100)
    assert list(tmp_path.iterdir()) == []
    again.close()
    assert SEGMENT_BYTES > 3 * SIZE


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond this size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_loses_nothing_while_memory_lasts(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    spool = Spool(tmp_path)
    with disk_of(SIZE // 2):
        for k in range(1, 8):
            spool.append(frame(k, frame_index=k))
    assert [frame_index for _, frame_index in frame_indices(spool)] == list(range(1, 8))
    for data in contents(spool):
        assert isinstance(wire.decode(data), Frame)
    spool.append(frame(8, frame_index=8))
    assert len(contents(spool)) == 8
    assert caplog.text.count("kept in memory now; free space") == 1
    spool.close()
    again = Spool(tmp_path)
    assert [frame_index for _, frame_index in frame_indices(again)] == [8]
    again.close()


def test_unusable_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(SpoolError, match=r"spool\.directory: cannot use .*file.*; name a writable folder, or null"):
        Spool(tmp_path / "file")


def test_changed_segment_is_reported(tmp_path: Path) -> None:
    spool = filled(tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[: SIZE // 2])
    with pytest.raises(SpoolError, match="has changed; does anything else use the spool"):
        spool.read(spool.frames()[0])
    path.unlink()
    with pytest.raises(SpoolError, match="cannot be read"):
        spool.read(spool.frames()[0])
    spool.close()


def test_foreign_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.spool").write_text("mine", encoding="utf-8")
    (tmp_path / "000000000007.spool").write_bytes(b"no spool of ours")
    spool = Spool(tmp_path)
    assert len(spool) == 0
    spool.append(frame())
    assert len(contents(spool)) == 1
    assert (tmp_path / "notes.spool").exists()
    spool.close()
