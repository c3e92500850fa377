"""Reads docs/tutorial.md: commands and what they print, in the order of the page, for each of its two tracks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

PAGE: Final = Path(__file__).parents[1] / "docs" / "tutorial.md"
WITH_ARRAYS: Final = "**With arrays**"
WITHOUT_HARDWARE: Final = "**Without hardware**"

_PART: Final = re.compile(r"^## [^\n]*$|^```(\w+)\n(.*?)^```$|\*\*With[^*]*\*\*", re.MULTILINE | re.DOTALL)
_MEASURED: Final = re.compile(
    r"[-+]?\d[\d,]*\.\d+"  # what has a decimal point
    r"|[-+]?\d+(?= ->| us\b| %| degrees\b| sounds\b| dBFS\b| dB\b)"  # and what has a unit
    r"|(?<=127\.0\.0\.1:)\d+"
    r"|\d{4}-\d\d-\d\dT[\d:.]+"
)
_NUMBER: Final = r"[-+]?\d[-\d,.:T]*"


@dataclass(frozen=True)
class Step:
    """A block of the page: commands, one on each line, or lines that the commands before it print."""

    kind: str
    section: str
    lines: tuple[str, ...]


def steps(track: str) -> Iterator[Step]:
    """The blocks of one track in their order: those with its label, and those without a label."""
    section, label = "", ""
    for part in _PART.finditer(PAGE.read_text(encoding="utf-8")):
        text = part[0]
        if text.startswith("## "):
            section, label = text.removeprefix("## "), ""
        elif text.startswith("**"):
            label = text
        elif label in ("", track):
            yield Step(part[1], section, tuple(part[2].splitlines()))


def is_printed(line: str, output: str) -> bool:
    """Return whether an output has a line of the page; measured numbers may differ, and `…` stands for any text."""
    pattern, end = "", 0
    for number in _MEASURED.finditer(line):
        pattern += _literal(line[end : number.start()]) + _NUMBER
        end = number.end()
    return re.search(pattern + _literal(line[end:]), output) is not None


def _literal(text: str) -> str:
    words = [re.escape(word).replace("…", ".*") for word in re.split(r"\s+", text)]
    return r"\s*".join(words)
