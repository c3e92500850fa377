"""Run livessl commands with the code of either tree, all in one process, and write what they print as JSON.

    python benchmarks/unchanged_commands.py [COMMANDS]

COMMANDS is a JSON list of commands, each a list of words; the exit code and stdout of each are written. Without it, the
help of every command is written, by the command's words. One start of Python takes longer than all of these commands.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout

from livessl.cli.main import main as livessl


def run(*command: str) -> tuple[int, str]:
    """Return the exit code and stdout of a command."""
    shown = io.StringIO()
    with redirect_stdout(shown):
        try:
            code = livessl(command)
        except SystemExit as end:  # as argparse ends after a help or wrong use
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return code, shown.getvalue()


def helps(*command: str) -> dict[str, str]:
    """Return the help of a command and of all commands below it, each by the command's words.

    Raises
    ------
    RuntimeError
        If a command does not print its help and end with exit code 0.
    """
    code, text = run(*command, "--help")
    if code != 0:
        raise RuntimeError(f"livessl {' '.join((*command, '--help'))}: expected exit code 0, got {code}")
    found = {" ".join(command): text}
    for name in commands_of(text):
        found |= helps(*command, name)
    return found


def commands_of(text: str) -> Sequence[str]:
    """Return the commands that argparse's help lists: below a line with nothing but their name for all or their choice.

    Choices of an option, such as `--log {text,json}`, are no commands.
    """
    lists = re.findall(r"^ {2}(?:[A-Z]+|\{[^}\s]+\})\n((?:^ {4}.*\n?)+)", text, re.MULTILINE)
    return [name for listed in lists for name in re.findall(r"^ {4}([a-z][a-z0-9-]*)(?:  |$)", listed, re.MULTILINE)]


if __name__ == "__main__":
    given = sys.argv[1:]
    found = [run(*command) for command in json.loads(given[0])] if given else helps()
    json.dump(found, sys.stdout)
