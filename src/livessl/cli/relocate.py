"""`livessl relocate`: locates stored events again by another method or calibration, and resumes if interrupted.

The recordings are in a folder, or at a running server, which locates its own events.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final, Protocol

from livessl.cli import argument, progress
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_joint, add_json, add_method, import_from_here, read_site, refuse_unused
from livessl.cli.output import complain, xyz
from livessl.cli.server_answers import add_server
from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.server.clips.reader import ClipReader
    from livessl.server.clips.relocate_many import Task
    from livessl.site.models import Site


BEGINNING: Final = b'{"kind": "relocation"'
"""Beginning of each line in a file of results."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add = parser.add_argument
    add("clips", type=Path, nargs="?", help="folder of clips (default: server.clips of the site file)")
    parser.add_argument(
        "--site", type=Path, help="site file of the clips; required without --url, and not allowed with it"
    )
    add_server(
        parser,
        "the server locates its own stored events again; if the server uses tokens, give an operator's. The stored "
        "events do not change",
    )
    add_method(parser, "the method by which each event was located before")
    add_joint(parser)
    add(
        "--set-up",
        choices=("then", "now"),
        default="then",
        help="`then`: poses and speed of sound of the time of the event; `now`: those of the site "
        "file and its calibration file (with --url: those in force at the server) (default: then)",
    )
    add("--since", type=argument.time, metavar="TIME", help="only events that began at TIME or later (RFC 3339)")
    add("--until", type=argument.time, metavar="TIME", help="only events that began at TIME or earlier (RFC 3339)")
    add(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the results to FILE, one JSON object per line; events that FILE already has with a "
        "result are skipped, and failed ones are tried again",
    )
    add("--jobs", type=argument.positive, help="number of parallel processes (default: one per core)")
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    import_from_here()
    archive: Archive = _at_server(arguments) if arguments.url is not None else _in_folder(arguments)
    held = [] if arguments.out is None else _read_answers(arguments.out, archive)  # a wrong file is refused at once
    known = {answer.event_id for answer in held if answer.is_located}
    wanted = archive.ids(arguments.since, arguments.until, known)
    if not wanted:
        complain(f"{archive.place}: no event of that span has recordings", kind="note")
    distances_m: list[float] = []
    failed = 0
    with (
        _answers(arguments.out, held, frozenset(wanted)) as keep,
        progress.counted("locating", "event") as bar,
    ):
        missing = [name for name in wanted if name not in known]
        bar(len(wanted) - len(missing), len(wanted))
        for done, found in enumerate(archive.relocate(missing), len(wanted) - len(missing) + 1):
            keep(found)
            _print(found, as_json=arguments.json)
            failed += found["again"] is None
            distances_m += [] if found["distance_m"] is None else [found["distance_m"]]
            bar(done, len(wanted))
    if distances_m and not arguments.json:
        print(
            f"{len(distances_m)} positions: median {median(distances_m):.2f} m apart, at most {max(distances_m):.2f} m"
        )
    return FAILED if failed else OK


class Archive(Protocol):
    """Recordings of events, and the method and set-up by which they are located again."""

    @property
    def method(self) -> str | None:
        """The method; None for the method by which each event was located."""
        ...

    @property
    def set_up(self) -> str:
        """`then` or `now`."""
        ...

    @property
    def digest(self) -> str:
        """Digest of everything, except the recordings, on which the results depend."""
        ...

    @property
    def place(self) -> str:
        """The folder or the address."""
        ...

    def ids(self, since_ns: int | None, until_ns: int | None, known: Collection[str] = ()) -> list[str]:
        """Return the ids of the events of a span that have recordings, readable or not.

        Events in `known` are included without being looked up.
        """
        ...

    def relocate(self, event_ids: Sequence[str]) -> Iterator[dict[str, Any]]:
        """Yield the results for some events in the order in which they are ready."""
        ...


def _at_server(arguments: argparse.Namespace) -> Archive:
    from livessl.cli.relocate_at_server import ServerArchive

    given = {
        "folder": arguments.clips,
        "--site": arguments.site,
        "--jobs": arguments.jobs,
        "--joint": arguments.joint,
    }
    if wrong := [name for name, value in given.items() if value]:
        raise UseError(
            f"relocate: expected no {' and no '.join(wrong)} with --url, because the server locates; take one away"
        )
    return ServerArchive(arguments.url, arguments.token_file, arguments.method, arguments.set_up)


def _in_folder(arguments: argparse.Namespace) -> Archive:
    from livessl.core.methods import is_import_path
    from livessl.server.clips.relocate_many import Task
    from livessl.site.build.fusion import make_estimator

    if arguments.site is None:
        raise UseError("relocate: expected --site FILE or --url ADDRESS, got neither; give one")
    refuse_unused("relocate", {"--token-file": arguments.token_file}, "without --url, because no server is asked")
    site = read_site(arguments)
    if arguments.method is not None and is_import_path(arguments.method):
        make_estimator(site, arguments.method)  # one error before all, instead of one for each event
    jobs = len(os.sched_getaffinity(0)) if arguments.jobs is None else arguments.jobs
    return _FolderArchive(Task(site, _folder(arguments.clips, site), arguments.method, arguments.set_up), jobs)


@dataclass(frozen=True)
class _FolderArchive:
    """A folder of clips, located again on some cores."""

    task: Task
    jobs: int

    @property
    def method(self) -> str | None:
        return self.task.method

    @property
    def set_up(self) -> str:
        return self.task.set_up

    @property
    def digest(self) -> str:
        return self.task.digest

    @property
    def place(self) -> str:
        return str(self.task.folder)

    def ids(self, since_ns: int | None, until_ns: int | None, known: Collection[str] = ()) -> list[str]:  # noqa: ARG002
        from livessl.server.clips.reader import ClipReader, ClipsError

        clips = ClipReader(self.task.folder)
        try:
            ids = clips.ids()
        except ClipsError as error:
            raise UseError(str(error)) from error
        return [name for name in ids if _is_in_span(clips, name, since_ns, until_ns)]

    def relocate(self, event_ids: Sequence[str]) -> Iterator[dict[str, Any]]:
        from livessl.server.clips.relocate_many import relocate_many

        return relocate_many(self.task, event_ids, self.jobs)


def _folder(given: Path | None, site: Site) -> Path:
    if given is not None:
        return given
    if site.server.clips is None:
        raise UseError("relocate: expected a folder of clips, as the site file has no server.clips; name it")
    return site.file(site.server.clips.folder)


def _is_in_span(folder: ClipReader, event_id: str, since_ns: int | None, until_ns: int | None) -> bool:
    from livessl.server.clips.reader import UnreadableClipError

    if since_ns is None and until_ns is None:
        return True
    try:
        clip = folder.read(event_id)
    except UnreadableClipError:  # it is reported as an event that cannot be located again
        return True
    if clip is None:
        return False
    is_after = since_ns is None or clip.start_ns >= since_ns
    return is_after and (until_ns is None or clip.start_ns <= until_ns)


@dataclass(frozen=True, slots=True)
class _Answer:
    """A line of a file of answers: the event that it is about, and whether that was located."""

    event_id: str
    is_located: bool
    line: bytes


def _read_answers(path: Path, task: Archive) -> list[_Answer]:
    """Return the answers in a file, which is created if it is not there.

    Raises
    ------
    UseError
        If it has answers of another method, set-up or calibration, or something else, or cannot be read or written.
    """
    held: list[_Answer] = []
    try:
        with path.open("ab"):
            pass
        lines = path.read_bytes().splitlines(keepends=True)
    except OSError as error:
        raise _unwritable(path, error) from error
    for line in lines:
        if not line.endswith(b"\n") and is_begun(line):  # a command that was killed has left it; it is written again
            break
        held.append(_held(path, line, task))
    return held


@contextmanager
def _answers(
    path: Path | None, held: Sequence[_Answer], wanted: frozenset[str]
) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Open the file of answers; yield a function that appends an answer.

    What the file says of wanted events that could not be located is removed, because they are tried again.

    Raises
    ------
    UseError
        If the file cannot be written.
    """
    if path is None:
        yield lambda _: None
        return
    try:
        content = b"".join(answer.line for answer in held if answer.is_located or answer.event_id not in wanted)
        if content != path.read_bytes():
            _replace(path.resolve(), content)
        opened = path.open("ab")
    except OSError as error:
        raise _unwritable(path, error) from error
    with opened as file:

        def keep(found: dict[str, Any]) -> None:
            file.write(json.dumps(found).encode() + b"\n")
            file.flush()

        yield keep


def _unwritable(path: Path, error: OSError) -> UseError:
    return UseError(f"--out {path}: expected a file that can be written: {error.strerror or error}")


def _replace(path: Path, content: bytes) -> None:
    """Replace a file whole, by way of a new one of a random name in its folder; a link's target, not the link."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as fresh:
            fresh.write(content)
        shutil.copymode(path, name)
        Path(name).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(name).unlink()
        raise


def is_begun(line: bytes) -> bool:
    """Return whether bytes are the beginning of an answer, and not another file without an end of line."""
    return line[: len(BEGINNING)] == BEGINNING[: len(line)]


def _held(path: Path, line: bytes, task: Archive) -> _Answer:
    """Return what a line of the file of answers is about.

    Raises
    ------
    UseError
        If the line is no answer, or one of another task.
    """
    try:
        found = json.loads(line)
        event_id, method, set_up, digest = (found[name] for name in ("event_id", "method", "set_up", "digest"))
        is_located = found["again"] is not None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UseError(f"--out: expected answers of `livessl relocate` in {path}, got another file") from error
    if (method, set_up) != (task.method, task.set_up):
        raise UseError(f"--out: {path} has answers of --method {method} --set-up {set_up}; name another file")
    if digest != task.digest:
        raise UseError(
            f"--out: {path} has answers of another calibration, --joint, site file, server or release, which do not "
            "belong beside those of now; name another file"
        )
    return _Answer(str(event_id), is_located, line)


def _print(found: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(found), flush=True)
        return
    stored, again = found["stored"], found["again"]
    if again is None:
        print(f"{found['event_id']}  {found['error']}", flush=True)
        return
    apart = "" if found["distance_m"] is None else f"{found['distance_m']:.2f} m apart"
    print(f"{found['event_id']}  {_answer(stored)}  ->  {_answer(again)}  {apart}", flush=True)


def _answer(answer: dict[str, Any]) -> str:
    what = xyz(answer["position_m"]) if answer["status"] == "located" else answer["status"]
    return f"{what:<22} {answer['method']} {answer['confidence']:.2f}"
