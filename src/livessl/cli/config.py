"""`livessl config show`: every setting of a site file with its value, and where that value comes from."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from livessl.cli.exits import OK
from livessl.cli.options import add_json


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    text = "print every setting with its value, and the line or default that it comes from"
    sub = actions.add_parser(
        "show",
        help=text,
        description=f"{text[0].upper()}{text[1:]}. Without --json the output is a valid site file.",
        epilog="example: livessl config show site.yaml",
    )
    sub.add_argument("site", type=Path, help="site file")
    sub.add_argument("--given", action="store_true", help="only what the file gives, without defaults")
    add_json(sub, "print one JSON object per setting")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.site.effective import DEFAULT, as_yaml, effective_settings

    settings = effective_settings(arguments.site)
    if arguments.given:
        settings = [setting for setting in settings if setting.line is not None]
    if arguments.json:
        for one in settings:
            file = None if one.line is None else str(arguments.site)
            found = {"key": one.key, "value": one.value, "source": one.source, "file": file, "line": one.line}
            print(json.dumps({**found, "default": one.source == DEFAULT}))
    else:
        print(as_yaml(settings), end="")
    return OK
