"""Words mistakes on the command line: an unknown option or value in one line, with "did you mean …?"."""

from __future__ import annotations

import argparse
import sys
from typing import Any, NoReturn

from livessl.cli.exits import WRONG_USE
from livessl.cli.output import complain
from livessl.errors import did_you_mean


class Parser(argparse.ArgumentParser):
    """A parser that reports a mistake in one line, without the usage of all options."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to find help, and exit with 2."""
        complain(f"{message}{'' if message.endswith('?') else ';'} see {self.prog} --help")
        sys.exit(WRONG_USE)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; the parser of a command, which knows its options, refuses those that it does not know."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            unknown = next((word for word in rest if word.startswith("--")), None)
            name = "" if unknown is None else unknown.partition("=")[0]
            known = [option for option in self._option_string_actions if option.startswith("--")]
            meant = did_you_mean(name, known) if name else ""
            self.error(f"unrecognized arguments: {' '.join(rest)}{meant}")
        return found, rest

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise an error for a value that is no choice, with the choice that is most like it."""
        if action.choices is None or value in action.choices:
            return
        choices = [str(choice) for choice in action.choices]
        meant = did_you_mean(str(value), choices) or f" (choose from {', '.join(choices)})"
        raise argparse.ArgumentError(action, f"invalid choice: {str(value)!r}{meant}")
