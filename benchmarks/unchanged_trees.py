"""Two source trees of livessl whose commands are run, and pure functions that compare what they put out.

This module imports nothing of livessl: the code under comparison runs in processes of its own.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

CONTEXT_BYTES: Final = 40
"""Bytes of text shown on either side of the first difference: enough for a JSON key and its value."""

CONTEXT_BINARY_BYTES: Final = 8
"""Bytes shown on either side of the first difference of what is no text: a number of 64 bits."""

MAX_ERROR_CHARACTERS: Final = 300
"""Longest end of a command's stderr that an error repeats."""

HELP_COLUMNS: Final = "200"
"""Width for argparse's help, in characters, so that no choice is broken between two lines."""

Outputs = Mapping[str, bytes]
"""Named outputs of one tree."""


class ProbeError(Exception):
    """A probe could not be carried out; the text says in which tree and why."""


@dataclass(frozen=True)
class Done:
    """The exit code and the output of a command that has ended."""

    code: int
    out: bytes
    err: str

    def outputs(self, name: str) -> dict[str, bytes]:
        """Exit code and stdout under a name, ready to be compared; stderr is for people and may change."""
        return {f"{name}, exit code": str(self.code).encode(), f"{name}, stdout": self.out}


@dataclass(frozen=True)
class Tree:
    """A checkout of livessl.

    Parameters
    ----------
    name : str
        What messages call it: base or head.
    root : Path
        The folder that holds `src`, `config` and `benchmarks`.
    """

    name: str
    root: Path

    def environment(self) -> dict[str, str]:
        """Return the environment in which Python imports this tree's code."""
        return {**os.environ, "PYTHONPATH": str(self.root / "src"), "COLUMNS": HELP_COLUMNS}

    def python(self, *arguments: object, folder: Path) -> Done:
        """Run this interpreter with the tree's code, from a folder that holds no code."""
        process = self.start(*arguments, folder=folder)
        try:
            out, err = process.communicate()
        except BaseException:  # Ctrl-C must not leave its grandchildren behind
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
        return Done(process.returncode, out, err.decode(errors="replace"))

    def start(self, *arguments: object, folder: Path, said: Path | None = None) -> subprocess.Popen[bytes]:
        """Start this interpreter with the tree's code as the leader of a process group.

        Its stdout and stderr are pipes, or both go to the file `said`: a pipe that is never read would block it.
        """
        with ExitStack() as stack:
            file = subprocess.PIPE if said is None else stack.enter_context(said.open("wb"))
            return subprocess.Popen(  # noqa: S603 - our own code
                [sys.executable, *map(str, arguments)],
                cwd=folder,
                env=self.environment(),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )

    def livessl(self, *arguments: object, folder: Path) -> Done:
        """Run a livessl command."""
        return self.python("-m", "livessl", *arguments, folder=folder)

    def must(self, done: Done, what: str) -> Done:
        """Return `done` if it succeeded.

        Raises
        ------
        ProbeError
            Where its exit code is not 0.
        """
        if done.code != 0:
            said = done.err.strip()[-MAX_ERROR_CHARACTERS:]
            raise ProbeError(f"{self.name}: {what}: expected exit code 0, got {done.code}: {said}")
        return done

    def check_import(self, folder: Path) -> None:
        """Make sure that it is this tree's code which is imported, not an installed livessl.

        Raises
        ------
        ProbeError
            Where it is not.
        """
        done = self.must(self.python("-c", "import livessl; print(livessl.__file__)", folder=folder), "import livessl")
        found = Path(done.out.decode().strip()).resolve()
        if not found.is_relative_to((self.root / "src").resolve()):
            raise ProbeError(f"{self.name}: expected livessl to be imported from {self.root / 'src'}, got {found}")

    def site_files(self) -> dict[str, Path]:
        """Return the shipped site files by name: those in `config`, and the demo's own wherever it lies."""
        files = {f"config/{path.name}": path for path in sorted((self.root / "config").glob("*.yaml"))}
        return files | {f"the demo's {path.name}": path for path in sorted((self.root / "src").rglob("demo.yaml"))}


@dataclass(frozen=True)
class Pair:
    """The two trees and a folder for whatever the probes write."""

    base: Tree
    head: Tree
    folder: Path

    def both(self) -> tuple[Tree, Tree]:
        """Return base and head."""
        return self.base, self.head


@contextmanager
def checked_out(repository: Path, base: str, head: str | None) -> Iterator[Pair]:
    """Check out `base`, and `head` unless it is the working tree, into a temporary folder that is removed at the end.

    Raises
    ------
    ValueError
        Where one of them names no commit.
    """
    for commit in (base, head):
        if commit is not None and _git(repository, "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}").code:
            raise ValueError(f"expected a commit of {repository}, got {commit!r}; see git log")
    with tempfile.TemporaryDirectory(prefix="livessl-unchanged-") as name, ExitStack() as worktrees:
        folder = Path(name)

        def tree(label: str, commit: str | None) -> Tree:
            if commit is None:
                return Tree(label, repository)
            path = folder / label
            worktrees.callback(_git, repository, "worktree", "remove", "--force", str(path))
            done = _git(repository, "worktree", "add", "--quiet", "--detach", str(path), commit)
            if done.code:
                raise ProbeError(f"git worktree add: {done.err.strip()}")
            return Tree(label, path)

        (folder / "probes").mkdir()
        pair = Pair(tree("base", base), tree("head", head), folder / "probes")
        for one in pair.both():
            one.check_import(pair.folder)
        yield pair


def _git(repository: Path, *arguments: str) -> Done:
    command = ["git", "-C", str(repository), *arguments]
    done = subprocess.run(command, check=False, capture_output=True)  # noqa: S603 - fixed words and a commit
    return Done(done.returncode, done.stdout, done.stderr.decode(errors="replace"))


def differences(base: Outputs, head: Outputs) -> list[str]:
    """Compare outputs byte for byte.

    Returns
    -------
    list of str
        One line for each name whose output differs, or that only one tree has; empty if all are the same.
    """
    found = [f"{name}: only base has it" for name in base if name not in head]
    found += [f"{name}: only head has it" for name in head if name not in base]
    return found + [
        f"{name}: {_first_difference(data, head[name])}"
        for name, data in base.items()
        if name in head and head[name] != data
    ]


def _first_difference(base: bytes, head: bytes) -> str:
    at = next((k for k, (one, other) in enumerate(zip(base, head, strict=False)) if one != other), None)
    if at is None:
        at = min(len(base), len(head))
    lengths = f"{len(base)}" if len(base) == len(head) else f"{len(base)} and {len(head)}"
    return f"byte {at} of {lengths}: base {_shown(base, at)}, head {_shown(head, at)}"


def _shown(data: bytes, at: int) -> str:
    """Return what surrounds a byte: text as text, anything else in hexadecimal digits."""
    text = data[max(0, at - CONTEXT_BYTES) : at + CONTEXT_BYTES].decode(errors="replace")
    if text.replace("\n", "").isprintable() and "\ufffd" not in text:
        return repr(text)
    return data[max(0, at - CONTEXT_BINARY_BYTES) : at + CONTEXT_BINARY_BYTES].hex(" ")


Keys = dict[str, set[str]]
"""Dotted path of every JSON value to the kinds of value found there."""


def keys_of(value: Any, path: str, keys: Keys | None = None) -> Keys:
    """Collect the paths of a JSON value and the kinds of what is there; all items of a list share one path."""
    keys = {} if keys is None else keys
    kind = {dict: "object", list: "list", bool: "boolean", str: "string", type(None): "null"}.get(type(value), "number")
    keys.setdefault(path, set()).add(kind)
    if isinstance(value, dict):
        for key, inner in value.items():
            keys_of(inner, f"{path}.{key}", keys)
    elif isinstance(value, list):
        for inner in value:
            keys_of(inner, f"{path}[]", keys)
    return keys


def missing_keys(base: Keys, head: Keys) -> list[str]:
    """Name the JSON fields of base that head lacks or fills with another kind of value; head may have more.

    What lies inside a value that is null or an empty list in head cannot be compared.
    """
    found = []
    for path, kinds in base.items():
        if path in head:
            known = head[path] | {"null"}
            if head[path] != {"null"} and not kinds <= known:
                found.append(f"{path}: base has {_listed(kinds)}, head has {_listed(head[path])}")
        elif not any(_is_empty(above, head) for above in _above(path)):
            found.append(f"{path}: head lacks it")
    return found


def _is_empty(path: str, keys: Keys) -> bool:
    return keys.get(path) == {"null"} or (keys.get(path) == {"list"} and f"{path}[]" not in keys)


def _above(path: str) -> Iterator[str]:
    """Yield the paths of the values that hold the value at `path`."""
    for k, character in enumerate(path):
        if character in ".[":
            yield path[:k]
        elif character == "]":
            yield path[: k + 1]


def _listed(kinds: set[str]) -> str:
    return " or ".join(sorted(kinds))


def missing(base: set[str], head: set[str]) -> list[str]:
    """Name what base offers and head does not; head may offer more."""
    return [f"{name}: head lacks it" for name in sorted(base - head)]


@dataclass(frozen=True)
class Ratio:
    """The time of head over that of base for one row of `livessl bench`.

    Parameters
    ----------
    name : str
        The row's name.
    ratio : float
        Median over head's runs over the median over base's.
    lowest, highest : float
        Head's fastest run over base's slowest, and head's slowest over base's fastest.
    """

    name: str
    ratio: float
    lowest: float
    highest: float

    @property
    def within_spread(self) -> bool:
        """Return whether the ranges of both trees' runs overlap: the runs then show no difference."""
        return self.lowest <= 1.0 <= self.highest


def ratios(base: Sequence[Mapping[str, float]], head: Sequence[Mapping[str, float]]) -> list[Ratio]:
    """Compare the times, by name, of several runs of each tree; names that are not in all runs are left out."""
    found = []
    for name in base[0]:
        if all(name in run for run in (*base, *head)):
            before, after = ([run[name] for run in runs] for runs in (base, head))
            ratio = statistics.median(after) / statistics.median(before)
            found.append(Ratio(name, ratio, min(after) / max(before), max(after) / min(before)))
    return found


def load_json(data: bytes, what: str) -> Any:
    """Parse JSON.

    Raises
    ------
    ProbeError
        Where it is none.
    """
    try:
        return json.loads(data)
    except ValueError as error:
        raise ProbeError(f"{what}: expected JSON, got {data[:CONTEXT_BYTES]!r}") from error
