"""Reports as Markdown: headings, paragraphs, lists, tables and pictures. It knows nothing of what they report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Heading:
    """A title; level 1 is the report's own."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Column titles and rows of text."""

    titles: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """The figure `figures/NAME.png` and its caption."""

    name: str
    caption: str


Block = Heading | Table | Picture | str | tuple[str, ...]
"""One part of a report; a string is a paragraph, a tuple of strings is a list."""


def as_markdown(blocks: Sequence[Block]) -> str:
    """Write blocks as GitHub's Markdown."""
    parts = []
    for block in blocks:
        match block:
            case Heading(level, text):
                parts.append(f"{'#' * level} {text}")
            case Table(titles, rows):
                escaped = [[cell.replace("|", "\\|") for cell in cells] for cells in rows]
                lines = [" | ".join(cells) for cells in (titles, ["---"] * len(titles), *escaped)]
                parts.append("\n".join(f"| {line} |" for line in lines))
            case Picture(name, caption):
                parts.append(f"![{caption}](figures/{name}.png)\n\n*{caption}.*")
            case str():
                parts.append(block)
            case _:
                parts.append("\n".join(f"- {item}" for item in block))
    return "\n\n".join(parts) + "\n"
