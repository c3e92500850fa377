"""Finds the code blocks of the Markdown documents, and the livessl commands in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent
from typing import Final

ROOT: Final = Path(__file__).parents[1]

_FENCE: Final = re.compile(r"^( *)```(\w+)\n(.*?)^\1```[ ]*$", re.MULTILINE | re.DOTALL)
_ANY_FENCE: Final = re.compile(r"^ *```.*?^ *```[ ]*$", re.MULTILINE | re.DOTALL)
_INLINE: Final = re.compile(r"`(livessl [^`]+)`")
_ENDS: Final = frozenset({"|", "||", "&", "&&", ";", ">", ">>", "<", "2>", "(", ")"})


@dataclass(frozen=True)
class Block:
    """A code block of a page."""

    page: str
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        """Its page and line."""
        return f"{self.page}:{self.line}"


def pages() -> list[Path]:
    """The documents for users and developers. Decisions are records of their time."""
    found = [path for path in (ROOT / "docs").rglob("*.md") if "decisions" not in path.parts]
    others = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "deploy/README.md", "examples/README.md")]
    return [*others, *sorted(found)]


def blocks_of(path: Path) -> Iterator[Block]:
    """The code blocks of a page that name a language."""
    text = path.read_text(encoding="utf-8")
    page = str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else path.name
    for found in _FENCE.finditer(text):
        yield Block(page, text.count("\n", 0, found.start()) + 1, found[2], dedent(found[3]))


def blocks(language: str) -> list[Block]:
    """The code blocks of all pages in a language."""
    return [block for path in pages() for block in blocks_of(path) if block.language == language]


def inline_commands() -> list[tuple[str, str]]:
    """Each page with each command in its sentences, which need not be complete."""
    found = []
    for path in pages():
        text = _ANY_FENCE.sub("", path.read_text(encoding="utf-8"))
        found += [(str(path.relative_to(ROOT)), " ".join(one.split())) for one in _INLINE.findall(text)]
    return found


def commands(text: str) -> Iterator[list[str]]:
    """The arguments of each livessl command in lines of a shell."""
    for line in text.replace("\\\n", " ").splitlines():
        words = list(_words(line))
        for start, word in enumerate(words):
            is_first = start == 0 or words[start - 1] in _ENDS or words[start - 1] in ("sudo", "nice", "exec")
            if is_first and Path(word).name == "livessl":
                end = next((at for at in range(start, len(words)) if words[at] in _ENDS), len(words))
                yield words[start + 1 : end]


def _words(line: str) -> Iterator[str]:
    reader = shlex.shlex(line, posix=True, punctuation_chars=True)
    reader.whitespace_split = True
    yield from reader
