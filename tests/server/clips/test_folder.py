"""The folder of clips: complete or not there, limited, and deleted for good."""

from __future__ import annotations

import errno
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clip_desk import head, recordings
from livessl.schema.clips import ClipFile
from livessl.server.clips.erase import PARTIAL, erase
from livessl.server.clips.folder import ClipFolder
from livessl.server.clips.reader import ClipsError, UnreadableClipError, parsed

SOUND = b"what somebody said"
real_rmtree = shutil.rmtree


def write(start_ns: int, content: bytes = SOUND) -> Any:
    return recordings(start_ns, {"a.flac": content})


def on_disk(path: Path) -> set[str]:
    return {str(each.relative_to(path)) for each in path.rglob("*") if each.is_file()}


def test_clip_is_stored_read_kept_and_deleted(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path / "clips")
    folder.put("lab-1", write(5))
    clip = folder.read("lab-1")
    assert clip is not None
    assert (clip.start_ns, clip.keep) == (5, False)
    assert (tmp_path / "clips").stat().st_mode & 0o077 == 0
    path = clip.file("a.flac")
    assert path is not None
    assert path.read_bytes() == SOUND
    assert folder.keep("lab-1", True)
    assert (folder.figures.count, folder.figures.kept, folder.figures.nbytes) == (1, 1, len(SOUND))
    assert folder.delete("lab-1")
    assert (folder.figures.count, folder.figures.kept, folder.figures.nbytes) == (0, 0, 0)
    assert on_disk(tmp_path) == set()
    assert not folder.delete("lab-1")
    assert not folder.keep("lab-1", True)


def test_deleted_sound_is_overwritten_before_it_is_unlinked(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))
    os.link(tmp_path / "lab-1" / "a.flac", tmp_path / "other-name")  # shows what was on the disk's blocks
    folder.delete("lab-1")
    assert (tmp_path / "other-name").read_bytes() == bytes(len(SOUND))


@pytest.mark.parametrize(
    "name", ["../secret", "..", ".", "", "a/b", "a\0b", f"{PARTIAL}x", "x" * 300, "clip.json", "b.flac"]
)
def test_names_that_are_no_recording_lead_nowhere(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_text("secret", encoding="utf-8")
    folder = ClipFolder(tmp_path / "clips")
    folder.put("lab-1", write(5))
    clip = folder.read("lab-1")
    assert clip is not None
    assert clip.file(name) is None
    assert folder.read(name) is None
    assert not folder.delete(name)
    with pytest.raises(ValueError, match="expected an event id"):
        folder.put("../x", write(5))


def test_error_while_writing_leaves_nothing_and_keeps_the_earlier_clip(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))

    def full(partial: Path) -> dict[str, Any]:
        (partial / "a.flac").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    for name in ("lab-1", "lab-2"):
        with pytest.raises(OSError, match="No space"):
            folder.put(name, full)
    assert on_disk(tmp_path) == {"lab-1/a.flac", "lab-1/clip.json"}
    assert folder.read("lab-2") is None


def test_clip_that_is_written_again_stays_kept(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))
    folder.keep("lab-1", True)
    folder.put("lab-1", write(5, b"longer than before"))
    clip = folder.read("lab-1")
    assert clip is not None
    assert clip.keep
    assert folder.figures.nbytes == len(b"longer than before")


def test_restart_finds_the_clips_and_deletes_what_is_unfinished(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))
    folder.put("lab-2", write(6))
    folder.keep("lab-2", True)
    (tmp_path / f"{PARTIAL}lab-3").mkdir()
    (tmp_path / f"{PARTIAL}lab-3" / "a.flac").write_bytes(SOUND)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    again = ClipFolder(tmp_path)
    again.load()
    assert (again.figures.count, again.figures.kept, again.figures.nbytes) == (2, 1, 2 * len(SOUND))
    assert (tmp_path / "foreign").is_dir()
    assert on_disk(tmp_path) == {"lab-1/a.flac", "lab-1/clip.json", "lab-2/a.flac", "lab-2/clip.json", "notes.txt"}


@pytest.mark.parametrize(
    "changes",
    [{"files": ...}, {"files": None}, {"files": ["a"]}, {"files": [{"name": "a.txt", "bytes": 1}]}, {"start_ns": "x"},
     {"files": [{"name": "a.flac", "bytes": None}]}, {"keep": ...}, {"keep": "no"}, {"position_m": 3}],
)  # fmt: skip
def test_clip_that_another_program_has_changed_is_unreadable(tmp_path: Path, changes: dict[str, Any]) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))
    path = tmp_path / "lab-1" / "clip.json"
    about = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in about.items() if value is not ...}))
    with pytest.raises(UnreadableClipError, match=rf"got another one: .*{next(iter(changes))}"):
        folder.read("lab-1")


def broken(*names: str) -> Any:
    """Stands in for `shutil.rmtree`: some folders cannot be deleted."""

    def rmtree(path: Path) -> None:
        if path.name in names:
            raise PermissionError(13, "Permission denied")
        real_rmtree(path)

    return rmtree


def test_start_goes_on_after_folders_that_cannot_be_read_or_erased(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-9", write(5))
    (tmp_path / f"{PARTIAL}going-lab-1").mkdir()
    (tmp_path / "lab-2").mkdir()
    monkeypatch.setattr(shutil, "rmtree", broken(f"{PARTIAL}going-lab-1"))
    again = ClipFolder(tmp_path)
    again.load()
    assert again.figures.count == 1
    assert "going-lab-1: cannot be read or deleted: Permission denied; correct its permissions or" in caplog.text
    assert "lab-2: expected a clip with clip.json, got none; it is left alone" in caplog.text


UNREADABLE: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "it is empty"),
    "cut short": (b'{"keep": tr', "it is not JSON"),
    "no text": (b"\xff\xfe\x00", "it is not JSON"),
    "not a number": (b'{"start_ns": NaN}', "it is not JSON"),
    "a list": (b"[]", "input should be an object"),
    "another object": (b"{}", "'start_ns' is missing"),
}


def damaged(folder: ClipFolder, path: Path, content: bytes) -> None:
    folder.put("lab-1", write(5))
    (path / "lab-1" / "clip.json").write_bytes(content)


@pytest.mark.parametrize(("content", "why"), UNREADABLE.values(), ids=UNREADABLE)
def test_unreadable_clip_is_told_from_none_counted_and_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes, why: str
) -> None:
    folder = ClipFolder(tmp_path)
    damaged(folder, tmp_path, content)
    assert folder.figures.unreadable == 0
    for act in (folder.read, folder.read, lambda event_id: folder.keep(event_id, True)):
        with pytest.raises(UnreadableClipError, match=f"event 'lab-1': expected a clip.json that .*: {why}.*or delete"):
            act("lab-1")
    assert caplog.text.count("server.clips.folder: event 'lab-1': expected a clip.json") == 1
    assert (folder.figures.unreadable, folder.has("lab-1"), folder.ids()) == (1, True, ["lab-1"])
    assert folder.delete("lab-1")
    assert (folder.figures.unreadable, folder.read("lab-1"), on_disk(tmp_path)) == (0, None, set())


def test_unreadable_clip_is_replaced_and_what_was_kept_stays_kept(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))
    folder.keep("lab-1", True)
    (tmp_path / "lab-1" / "clip.json").write_bytes(b"")
    with pytest.raises(UnreadableClipError):
        folder.read("lab-1")
    folder.put("lab-1", write(5))
    clip = folder.read("lab-1")
    assert clip is not None
    assert (clip.keep, folder.figures.unreadable) == (True, 0)


@pytest.mark.parametrize("by_age", [True, False])
def test_unreadable_clips_outlive_a_restart_and_are_deleted_by_age_and_size(tmp_path: Path, by_age: bool) -> None:
    content = b'{"keep": false}'
    damaged(ClipFolder(tmp_path), tmp_path, content)
    os.utime(tmp_path / "lab-1" / "clip.json", ns=(7, 7))
    again = ClipFolder(tmp_path)
    again.load()
    assert (again.figures.count, again.figures.unreadable, again.figures.nbytes) == (1, 1, len(SOUND) + len(content))
    limits = (7, again.figures.nbytes), (8, again.figures.nbytes) if by_age else (7, again.figures.nbytes - 1)
    assert [again.expire(*limit) for limit in limits] == [0, 1]
    assert on_disk(tmp_path) == set()


def refused_file(name: str, number: int) -> Any:
    """Stands in for `Path.open`: the system refuses the file about one clip."""
    real = Path.open

    def opened(path: Path, *how: Any, **more: Any) -> Any:
        if path.parent.name == name and path.name == "clip.json":
            raise OSError(number, os.strerror(number))
        return real(path, *how, **more)

    return opened


CUT_SHORT = st.integers(0, 27).map(lambda length: b'{"keep": false, "start_ns": 5'[:length])
KEPT = st.dictionaries(st.sampled_from(["start_ns", "files"]), st.none(), max_size=1).map(
    lambda about: json.dumps({**about, "keep": True}).encode()
)


@settings(max_examples=25)
@given(content=st.sampled_from([content for content, _ in UNREADABLE.values()]) | CUT_SHORT | KEPT)
def test_no_unreadable_clip_that_may_be_kept_is_deleted_after_a_restart(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("clips")
    (path / "lab-1").mkdir()
    (path / "lab-1" / "clip.json").write_bytes(content)
    again = ClipFolder(path)
    again.load()
    assert again.expire(1 << 62, -1) == 0
    assert (on_disk(path), again.figures.kept_bytes) == ({"lab-1/clip.json"}, len(content))


@pytest.mark.parametrize(("content", "keep"), [(b"", True), (b'{"keep": true}', True), (b'{"keep": false}', False)])
def test_clip_that_replaces_an_unreadable_one_is_kept_if_that_may_be(
    tmp_path: Path, content: bytes, keep: bool
) -> None:
    damaged(ClipFolder(tmp_path), tmp_path, content)
    again = ClipFolder(tmp_path)
    again.load()
    assert again.put("lab-1", write(6)).keep is keep


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO, errno.EACCES])
def test_clip_that_the_disk_refuses_at_the_start_is_left_alone_and_counts_once_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    first = ClipFolder(tmp_path)
    for name in ("lab-1", "lab-2", "lab-3"):
        first.put(name, write(5))
    first.keep("lab-1", True)
    again = ClipFolder(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", refused_file("lab-1", number))
        again.load()
        assert (again.figures.count, again.figures.kept, again.figures.unreadable, again.expire(10, 0)) == (3, 0, 1, 2)
        with pytest.raises(UnreadableClipError, match=r"be read: .*; correct its permissions, the disk") as caught:
            again.read("lab-1")
        assert os.strerror(number) in str(caught.value)
        assert "delete" not in str(caught.value)
    assert again.expire(10, 0) == 0  # it reads the clip again
    assert (again.figures.count, again.figures.kept, again.figures.unreadable, again.figures.nbytes) == (
        1,
        1,
        0,
        len(SOUND),
    )
    assert caplog.text.count("clip.json cannot be read") == 1
    again.keep("lab-1", False)
    assert again.expire(10, 0) == 1


def test_clip_whose_folder_is_refused_at_the_start_counts_once_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ClipFolder(tmp_path).put("lab-1", write(5))
    again = ClipFolder(tmp_path)

    def refused(folder: Path) -> Any:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as patch:
        patch.setattr(again, "_entry", refused)
        again.load()
        assert again.figures.count == 0
    assert again.read("lab-1") is not None
    assert (again.figures.count, again.figures.kept, again.expire(10, 0)) == (1, 0, 1)


def test_clip_that_could_not_be_read_again_is_not_stored(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    with pytest.raises(UnreadableClipError, match="'position_m' is missing"):
        folder.put("lab-1", lambda _: {"start_ns": 5, "files": []})
    assert on_disk(tmp_path) == set()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(data=st.data())
def test_no_content_of_the_file_about_a_clip_does_more_than_make_it_unreadable(data: st.DataObject) -> None:
    about: dict[str, Any] = {**head(5, {"enhanced.flac": 7, "array-north.flac": 9}), "keep": False}
    place = data.draw(st.sampled_from([about, about["files"][0]]))
    place[data.draw(st.sampled_from(sorted(place)))] = data.draw(VALUES)
    whole = json.dumps(about).encode()
    content = data.draw(st.sampled_from([whole, whole[: data.draw(st.integers(0, len(whole)))]]) | st.binary())
    with suppress(UnreadableClipError):
        clip = parsed("lab-1", Path("lab-1"), content)
        for file in clip.files:
            ClipFile.model_validate(file)
            assert file["name"].endswith((".flac", ".wav"))
            assert "/" not in file["name"]
        assert (type(clip.start_ns), type(clip.keep), type(clip.nbytes)) == (int, bool, int)


def test_file_about_a_clip_is_on_the_disk_before_the_clip_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[tuple[str, bool]] = []

    def fsync(number: int) -> None:
        synced.append((Path(f"/proc/self/fd/{number}").readlink().name, (tmp_path / "lab-1").exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    ClipFolder(tmp_path).put("lab-1", write(5))
    assert synced == [("clip.json", False)]


def test_sound_that_cannot_be_overwritten_is_deleted_nevertheless(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder = ClipFolder(tmp_path)
    folder.put("lab-1", write(5))

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert folder.delete("lab-1")
    assert list(tmp_path.iterdir()) == []
    assert "deleted without being overwritten: No space left on device" in caplog.text


def test_a_single_file_is_overwritten_before_it_is_deleted(tmp_path: Path) -> None:
    sound, also = tmp_path / "sound", tmp_path / "also"
    sound.write_bytes(b"speech")
    os.link(sound, also)  # another name of the same bytes on the disk
    erase(sound)
    assert [each.name for each in tmp_path.iterdir()] == ["also"]
    assert also.read_bytes() == bytes(6)


def test_clip_that_could_not_be_erased_is_erased_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ClipFolder(tmp_path)
    for name in ("lab-1", "lab-2"):
        folder.put(name, write(5))
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", broken(f"{PARTIAL}going-lab-1"))
        with pytest.raises(PermissionError):
            folder.expire(10, 1000)
        assert [each.name for each in tmp_path.iterdir()] == [f"{PARTIAL}going-lab-1"]  # the other one is gone
        with pytest.raises(PermissionError):
            folder.erase_left()
    folder.erase_left()
    assert list(tmp_path.iterdir()) == []


def test_clip_that_is_kept_while_old_ones_are_deleted_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ClipFolder(tmp_path)
    for number in (1, 2):
        folder.put(f"lab-{number}", write(number))
    erase = folder._wastebasket.erase

    def kept_meanwhile(going: Path) -> None:
        folder.keep("lab-2", True)
        erase(going)

    monkeypatch.setattr(folder._wastebasket, "erase", kept_meanwhile)
    assert folder.expire(10, 1000) == 1
    assert (folder.figures.count, folder.figures.kept) == (1, 1)
    assert folder.read("lab-2") is not None


@given(
    clips=st.dictionaries(st.integers(0, 30), st.tuples(st.integers(1, 50), st.booleans()), max_size=12),
    before=st.none() | st.integers(0, 30),
    most=st.integers(0, 300),
)
def test_expiry_deletes_old_ones_then_the_oldest_and_never_kept_ones(
    tmp_path_factory: pytest.TempPathFactory,
    clips: dict[int, tuple[int, bool]],
    before: int | None,
    most: int,
) -> None:
    folder = ClipFolder(tmp_path_factory.mktemp("clips"))
    for start, (size, keep) in clips.items():
        folder.put(f"lab-{start}", write(start, b"x" * size))
        folder.keep(f"lab-{start}", keep)
    left = {start for start, (_, keep) in clips.items() if keep or before is None or start >= before}
    for start in sorted(clips):
        if sum(clips[each][0] for each in left) > most and start in left and not clips[start][1]:
            left.discard(start)
    gone = folder.expire(before, most)
    assert {start for start in clips if folder.read(f"lab-{start}")} == left
    assert (gone, folder.figures.count) == (len(clips) - len(left), len(left))


def test_clips_that_somebody_has_removed_do_not_count(tmp_path: Path) -> None:
    folder = ClipFolder(tmp_path)
    for k in range(4):
        folder.put(f"lab-{k}", write(k))
    folder.keep("lab-1", True)
    for name in ("lab-0", "lab-1"):
        shutil.rmtree(tmp_path / name)
    assert folder.expire(None, 2 * len(SOUND)) == 0
    assert (folder.figures.count, folder.figures.nbytes, folder.figures.kept_bytes) == (2, 2 * len(SOUND), 0)
    assert folder.read("lab-2") is not None


def test_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ClipsError, match=r"server\.clips\.folder: cannot write .*; name a folder in which"):
        ClipFolder(tmp_path / "file" / "clips")
