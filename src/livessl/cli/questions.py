"""Questions in a terminal, each with a default; a wrong answer is explained, and the question repeated."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from livessl.errors import UseError

T = TypeVar("T")


class Questions:
    """Asks questions, or takes the default of each.

    Parameters
    ----------
    ask : bool
        False takes all defaults and reads nothing.
    """

    def __init__(self, *, ask: bool) -> None:
        self.asks = ask

    def answer(self, question: str, default: T, read: Callable[[str], T], shown: str | None = None) -> T:
        """Return the answer to a question; an empty line means the default.

        Parameters
        ----------
        question : str
        default : T
        read : callable
            Turns a text into a value; raises `argparse.ArgumentTypeError` with what it expected.
        shown : str or None
            The default as text; None for `str(default)`.

        Raises
        ------
        UseError
            If the input ends.
        """
        while self.asks:
            print(f"{question} [{default if shown is None else shown}]: ", end="", file=sys.stderr, flush=True)
            line = sys.stdin.readline()
            if not line:
                raise UseError(
                    "the input ended before the last question, and nothing was written; use --yes for defaults"
                )
            if not line.strip():
                break
            try:
                return read(line.strip())
            except argparse.ArgumentTypeError as error:
                print(f"  {error}", file=sys.stderr)
        return default

    def say(self, text: str) -> None:
        """Print something that helps to answer the next question."""
        if self.asks:
            print(text, file=sys.stderr)


def one_of(choices: Sequence[str]) -> Callable[[str], str]:
    """Return a function that accepts one of some words, or the beginning of one."""

    def read(text: str) -> str:
        found = [choice for choice in choices if choice.startswith(text.lower())]
        if len(found) != 1:
            raise argparse.ArgumentTypeError(f"expected one of {', '.join(choices)}, got {text!r}")
        return found[0]

    return read
