"""Code blocks of the documents: commands parse, site files validate, Python imports what exists, JSON parses."""

from __future__ import annotations

import ast
import json
import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

from document_blocks import Block, blocks, blocks_of, commands, inline_commands
from livessl.cli.main import COMMANDS, _parser
from livessl.errors import ConfigError
from livessl.site.load import parse_site
from small_site import small

PLACEHOLDERS = {"SERVER_KEY": "a" * 64, "NODE_KEY": "b" * 64}
"""Words of the pages that stand for a value which the command checks."""

NO_SITE_FILES = {"http:": "a dynamic configuration of Traefik"}
"""First lines of YAML blocks that are no part of a site file, and what they are."""

PLAN = '<svg xmlns="http://www.w3.org/2000/svg" width="200" height="250"/>'
"""The floor plan that a block names."""

NAMES = {command.name for command in COMMANDS}


def fault_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str | None:
    """Return the error of the command line's parser for arguments; None if it accepts them."""
    given = [PLACEHOLDERS.get(word, word) for word in arguments]
    try:
        _parser(given).parse_args(given)
    except SystemExit as end:
        if end.code:
            return f"livessl {' '.join(arguments)}: {capsys.readouterr().err}"
    return None


def test_commands_of_shell_blocks_parse(capsys: pytest.CaptureFixture[str]) -> None:
    found = [(block, arguments) for block in blocks("sh") for arguments in commands(block.text)]
    assert len(found) > 60
    faults = [(block.where, fault_of(arguments, capsys)) for block, arguments in found]
    assert [fault for fault in faults if fault[1] is not None] == []


def test_commands_in_sentences_exist_and_have_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    found = inline_commands()
    assert len(found) > 100
    unknown: list[tuple[str, ...]] = []
    for page, command in found:
        words = command.split()[1:]
        at = next((number for number, word in enumerate(words) if word in NAMES), None)
        if at is None and not words[0].startswith("-"):
            unknown.append((page, command))
            continue
        known = help_text([], capsys)
        known += "".join(help_text(words[at:][:count], capsys) for count in (1, 2) if at is not None)
        options = re.findall(r"(?<=\s)--[a-z][a-z0-9-]*", command)
        unknown += [(page, command, option) for option in options if not re.search(rf"{option}\b(?!-)", known)]
    assert unknown == []


def help_text(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit):
        _parser(words).parse_args([*words, "--help"])
    printed = capsys.readouterr()
    return printed.out


def with_part(site: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """A site with the keys of a part; keys inside `server` and the like are added to what is there."""
    merged = dict(site)
    for key, value in part.items():
        there = merged.get(key)
        merged[key] = with_part(there, value) if isinstance(there, dict) and isinstance(value, dict) else value
    return merged


def faults_of_site(text: str, folder: Path) -> list[str]:
    """The faults of a site file, or of the small site with a part of one."""
    part = yaml.safe_load(text)
    assert isinstance(part, dict)
    around = small({"server.events_db": "events.sqlite"})
    if "nodes" in part:
        around["nodes"] = {}
        names = [name for node in part["nodes"].values() for name in node["arrays"]]
        tetrahedron = {"geometry": {"tetrahedron": {"edge_m": 0.3}}}
        around["arrays"] = {name: tetrahedron | {"position_m": [1.0 + at, 1.0, 1.5]} for at, name in enumerate(names)}
    whole = part if {"site", "room", "arrays"} <= set(part) else with_part(around, part)
    try:
        parse_site(yaml.safe_dump(whole, sort_keys=False), "site.yaml", directory=folder)
    except ConfigError as error:
        return [f"{fault.where}: {fault.what}" for fault in error.faults]
    return []


def is_site(block: Block) -> bool:
    return block.text.splitlines()[0] not in NO_SITE_FILES


def test_yaml_blocks_are_valid_parts_of_site_files(tmp_path: Path) -> None:
    (tmp_path / "plan.svg").write_text(PLAN, encoding="utf-8")
    checked = [block for block in blocks("yaml") if is_site(block)]
    assert len(checked) > 5
    faults = {block.where: faults_of_site(block.text, tmp_path) for block in checked}
    assert {where: found for where, found in faults.items() if found} == {}


def has(module: str, name: str) -> bool:
    """Return whether a module has a name, or a package has a module of that name."""
    found = import_module(module)
    return hasattr(found, name) or (hasattr(found, "__path__") and find_spec(f"{module}.{name}") is not None)


def unresolved(code: str) -> list[str]:
    """Imports, and names after `livessl.`, that do not exist."""
    wrong = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            wrong += [alias.name for alias in node.names if find_spec(alias.name) is None]
        elif isinstance(node, ast.ImportFrom):
            wrong += [f"{node.module}.{one.name}" for one in node.names if not has(node.module or "", one.name)]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "livessl":
            wrong += [] if has("livessl", node.attr) else [f"livessl.{node.attr}"]
    return wrong


def test_python_blocks_compile_and_name_what_exists() -> None:
    found = blocks("python")
    assert len(found) > 5
    for block in found:
        compile(block.text, block.where, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    assert [(block.where, unresolved(block.text)) for block in found if unresolved(block.text)] == []


def test_json_blocks_parse() -> None:
    for block in blocks("json"):
        json.loads(block.text)


def test_what_is_not_checked_is_still_there() -> None:
    first_lines = {block.text.splitlines()[0] for block in blocks("yaml")}
    assert set(NO_SITE_FILES) - first_lines == set()
    words = {word for block in blocks("sh") for arguments in commands(block.text) for word in arguments}
    assert set(PLACEHOLDERS) - words == set()


def test_wrong_blocks_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "1. Step\n\n   ```sh\n   cd x && sudo livessl chek site.yaml  # comment\n"
        "   A=1; livessl serve --cite s | head\n"
        "   livessl replay a \\\n     --speed fast\n   echo livessl\n   ```\n\n"
        "```python\nimport livessl\nfrom livessl import Event, Events\nlivessl.lokate(1)\n```\n",
        encoding="utf-8",
    )
    shell, python = blocks_of(page)
    assert (shell.where, python.line) == ("page.md:3", 11)
    faults = [fault_of(arguments, capsys) for arguments in commands(shell.text)]
    assert [fault is not None for fault in faults] == [True, True, True]
    assert unresolved(python.text) == ["livessl.Events", "livessl.lokate"]
    assert faults_of_site("server: {htp: {port: 1}}", tmp_path)
    assert faults_of_site("fusion: {method: onset}", tmp_path) == []
