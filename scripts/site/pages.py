"""Adds pages and files outside docs/ to the site of documents, and turns relative links of a checkout into its links.

A hook of MkDocs, named in mkdocs.yml. The documents are written for a plain checkout: they link to ../deploy/README.md,
to folders and to source files. No page is rewritten for the site. A link to a file of the site leads there, a link to
another file of the repository becomes plain text, and a link to nothing is left to MkDocs, which warns of it.
"""

from __future__ import annotations

import posixpath
import re
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import yaml
from markdown import Extension, Markdown
from markdown.blockprocessors import build_block_parser
from markdown.preprocessors import Preprocessor
from markdown.treeprocessors import Treeprocessor
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]

NAMES = {
    "README.md": "overview.md",  # the first page of the site is docs/README.md
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "LICENSE": "LICENSE.txt",
    "CITATION.cff": "CITATION.cff",
    "scripts/site/iframe-worker.js": "assets/iframe-worker.js",
}
"""Single files outside docs/ that the site has, and their names there."""

FOLDERS = ("calibration", "config", "deploy", "examples")
"""Folders all of whose files the site has, under the same names."""

LISTS = {"calibration": "Calibration files of arrays", "config": "Site files to start from"}
"""Folders without a README.md, and the title of the page that lists their files."""

ITEM = re.compile(r"(?:[-*+]|\d+[.)]) ")
"""Beginning of a list item."""

INTERRUPTING_ITEM = re.compile(r"(?:[-*+]|1[.)]) ")
"""Beginning of a list that may follow the lines of a paragraph without an empty line between, as on GitHub."""

NO_PARAGRAPH = re.compile(r"[#|>]|\s")
"""Beginning of a line that begins no paragraph."""

INDENT = 3
"""Columns by which the documents indent the second paragraph or the code of a list item."""

line_of: Callable[[Path], str] = runpy.run_path(str(ROOT / "scripts" / "list_files"))["line_of"]
"""Returns the line about a file in docs/files.md."""

LinkChange = Callable[[str], str | None]
"""Takes a relative link of a page, and returns that of the site, or None if it is to become plain text."""


class Links(Treeprocessor):
    """Changes the relative links of a page."""

    def __init__(self, changed: LinkChange) -> None:
        super().__init__()
        self._changed = changed

    def run(self, root: Element) -> None:
        """Change the links of a parsed page in place."""
        for element in root.iter():
            key = {"a": "href", "img": "src"}.get(element.tag, "")
            target = element.get(key, "")
            if not target or re.match(r"[a-z][a-z0-9+.-]*:|[/#]", target):
                continue
            changed = self._changed(target)
            if changed is None:
                element.tag = "span"
                del element.attrib[key]
            else:
                element.set(key, changed)


class ListsApart(Preprocessor):
    """Puts an empty line before a list that follows a paragraph at once, for Python-Markdown sees no list there."""

    def run(self, lines: list[str]) -> list[str]:
        """Return the lines of a page whose blocks of code are already taken out."""
        apart: list[str] = []
        in_paragraph = in_block = False
        for line in lines:
            if in_paragraph and INTERRUPTING_ITEM.match(line):
                apart.append("")
                in_paragraph = False
            elif not in_block:
                in_paragraph = bool(line) and not ITEM.match(line) and not NO_PARAGRAPH.match(line)
            in_block = bool(line.strip())
            in_paragraph = in_paragraph and in_block
            apart.append(line)
        return apart


class CheckoutMarkdown(Extension):
    """Reads a page as it is written for a checkout: its links, its lists, and its indents."""

    def __init__(self) -> None:
        super().__init__()
        self._links: Links | None = None

    def begin(self, changed: LinkChange) -> None:
        """Take part in the next conversion, which is that of a page; docstrings on it are converted after it began."""
        self._links = Links(changed)

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 (Markdown's name)
        """Add the processors to the conversion of a page."""
        if self._links is None:
            return
        md.tab_length = INDENT
        md.parser = build_block_parser(md)  # those that were built before kept the former indent
        md.preprocessors.register(ListsApart(md), "lists_apart", priority=24)  # after blocks of code, at 25
        md.treeprocessors.register(self._links, "links_of_checkout", priority=5)  # before MkDocs' own, at 0
        self._links = None


def files_outside() -> Iterator[tuple[str, str]]:
    """Yield the path in the repository of each file outside docs/ that the site has, and its name in the site."""
    yield from NAMES.items()
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                name = path.relative_to(ROOT).as_posix()
                yield name, name


def about(path: Path) -> str:
    """Return what a file says about itself, in one line: its key `description`, or the comment at its head."""
    if path.suffix != ".yaml":
        return "a drawing to print"
    description = yaml.safe_load(path.read_text(encoding="utf-8")).get("description")
    return " ".join(description.split()) if description else line_of(path)


def list_of_files(folder: str) -> str:
    """Return a page that links each file of a folder, with what it says about itself."""
    rows = [f"| [{path.name}]({path.name}) | {about(path)} |" for path in sorted((ROOT / folder).iterdir())]
    return "\n".join([f"# {LISTS[folder]}", "", "| file | |", "|---|---|", *rows, ""])


def link_change(page: File, files: Files) -> LinkChange:
    """Return what changes the links of a page, given all files of the site."""
    uri_of = {f"docs/{file.src_uri}": file.src_uri for file in files if file.generated_by is None}
    uri_of |= dict(files_outside()) | {f"{folder}/README.md": f"{folder}/README.md" for folder in LISTS}
    path_of = {uri: path for path, uri in uri_of.items()}
    here = posixpath.dirname(path_of.get(page.src_uri, page.src_uri))

    def changed(target: str) -> str | None:
        name, mark, anchor = target.partition("#")
        path = posixpath.normpath(posixpath.join(here, unquote(name)))
        for candidate in (path, f"{path}/README.md"):
            file = files.get_file_from_path(uri_of.get(candidate, ""))
            if file is not None and file.inclusion.is_included():
                return posixpath.relpath(file.src_uri, posixpath.dirname(page.src_uri) or ".") + mark + anchor
        return None if (ROOT / path).exists() else target

    return changed


extension = CheckoutMarkdown()


def on_config(config: MkDocsConfig) -> None:
    """Let the extension take part in all conversions, before others that add to the parser of blocks."""
    if extension not in config.markdown_extensions:
        config.markdown_extensions.insert(0, extension)  # type: ignore[arg-type]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages and files outside docs/ to those of the site."""
    for path, uri in files_outside():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    for folder in LISTS:
        files.append(File.generated(config, f"{folder}/README.md", content=list_of_files(folder)))


def on_page_markdown(_: str, page: Page, config: MkDocsConfig, files: Files) -> None:  # noqa: ARG001 (MkDocs' names)
    """Say which page is converted next."""
    extension.begin(link_change(page.file, files))
