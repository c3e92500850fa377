"""Links of the Markdown documents lead to files and headings that exist."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS_WITHOUT_DOCUMENTS = {".git", ".venv", "node_modules", "build", "dist"}
LINK = re.compile(r"\]\(\s*<?([^()\s<>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
SOURCES = (ROOT, ROOT / "src", ROOT / "src" / "livessl", ROOT / "tests")
TABLE_ROW = re.compile(r"^\|.*\|$", re.MULTILINE)
FILE_NAME = re.compile(r"`([\w./-]*(?:/|\.(?:py|js|sh|toml|yml|md)))`")
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def documents() -> list[Path]:
    return [
        path
        for path in sorted(ROOT.rglob("*.md"))
        if not FOLDERS_WITHOUT_DOCUMENTS.intersection(path.relative_to(ROOT).parts)
    ]


def anchors(path: Path) -> set[str]:
    """Names that GitHub gives to the headings of a document."""
    names: set[str] = set()
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for heading in re.findall(r"^#{1,6} +(.+?) *$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        name = base = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        number = 0
        while name in names:
            number += 1
            name = f"{base}-{number}"
        names.add(name)
    return names


def broken_links(path: Path) -> list[str]:
    broken = []
    for target in LINK.findall(CODE.sub("", path.read_text(encoding="utf-8"))):
        if re.match(r"[a-z][a-z0-9+.-]*:", target):
            continue
        name, _, anchor = unquote(target).partition("#")
        file = (path.parent / name).resolve() if name else path
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            broken.append(target)
    return broken


def test_there_are_documents_to_check() -> None:
    assert {"README.md", "CHANGELOG.md"} <= {path.name for path in documents()}


@pytest.mark.parametrize("path", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_of_a_document_resolve(path: Path) -> None:
    assert broken_links(path) == []


def test_a_link_to_a_missing_file_or_heading_is_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Other\n\n## `Some` heading, twice\n", encoding="utf-8")
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n[a](other.md#some-heading-twice) [b](#page) [c](https://example.org) `[d](code.md)`\n"
        "[e](gone.md) [f](other.md#gone) [g](#gone)\n",
        encoding="utf-8",
    )
    assert broken_links(page) == ["gone.md", "other.md#gone", "#gone"]


def broken_rows(path: Path) -> list[str]:
    """Rows that Markdown would show as plain text, as no table begins above them, or with cells of another number."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    broken = []
    for rows in re.findall(r"(?:^\|.*\n?)+", text, re.MULTILINE):
        lines = rows.splitlines()
        widths = [len(re.findall(r"(?<!\\)\|", line)) for line in lines]
        has_head = len(lines) > 1 and re.fullmatch(r"[-| :]+", lines[1]) is not None
        broken += [line for line, width in zip(lines, widths, strict=True) if not has_head or width != widths[0]]
    return broken


@pytest.mark.parametrize("path", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_tables_of_a_document_are_shown_as_tables(path: Path) -> None:
    assert broken_rows(path) == []


def test_a_row_without_a_table_and_a_row_of_another_width_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("| a | b |\n|---|---|\n| `x \\| y` | 1 |\n| 2 |\n\n| lost | row |\n", encoding="utf-8")
    assert broken_rows(page) == ["| 2 |", "| lost | row |"]


def test_the_index_links_every_document() -> None:
    index = ROOT / "docs" / "README.md"
    linked = {name.partition("#")[0] for name in LINK.findall(index.read_text(encoding="utf-8"))}
    pages = {path.name for path in index.parent.glob("*.md")} - {"README.md"}
    assert len(pages) > 15
    assert pages - linked == set()


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_files_that_tables_name_exist(name: str) -> None:
    rows = TABLE_ROW.findall((ROOT / name).read_text(encoding="utf-8"))
    names = [found for row in rows for found in FILE_NAME.findall(row)]
    assert len(names) > 20
    assert [found for found in names if not any((source / found).exists() for source in SOURCES)] == []


def test_the_readme_names_every_module_and_package_at_the_root() -> None:
    rows = TABLE_ROW.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    named = {name.removeprefix("src/livessl/").rstrip("/") for row in rows for name in re.findall(r"`([\w./-]+)`", row)}
    below = (ROOT / "src" / "livessl").iterdir()
    there = {path.name for path in below if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert len(there) > 20
    assert there - named - {"__init__.py", "__main__.py"} == set()


def test_tests_that_a_table_names_exist() -> None:
    rows = [re.findall(r"`([\w./]+)`", row) for row in TABLE_ROW.findall((ROOT / "CONTRIBUTING.md").read_text("utf-8"))]
    named = [(names[0], name) for names in rows if names and "test_" in names[0] for name in names[1:]]
    assert len(named) == 20
    missing = [
        (file, name)
        for file, name in named
        if f"def test_{name}(" not in (ROOT / "tests" / file).read_text(encoding="utf-8")
    ]
    assert missing == []


def test_troubleshooting_has_each_message_once_in_a_section() -> None:
    sections = re.split(r"^## ", (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    messages = [
        (section.partition("\n")[0], message)
        for section in sections
        for message in re.findall(r"^\| `([^`]+)`", section, re.MULTILINE)
    ]
    assert len(messages) > 200
    assert sorted({one for one in messages if messages.count(one) > 1}) == []
