"""Sets when Python collects garbage: seldom while a program loads, as usual once a server or node runs."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

LOADING: Final = 50_000
"""New objects after which the collector looks for unused ones while a program loads. Modules make hundreds of thousands
and hardly any of them becomes unused; by Python's default of 700 the collector takes a tenth of the time of a start."""

_USUAL: Final = gc.get_threshold()


def collect_seldom() -> None:
    """Begin to load, in a command that ends it by `collect_as_usual`: until then hardly any unused memory is found."""
    gc.set_threshold(LOADING, *_USUAL[1:])


@contextmanager
def collected_seldom() -> Iterator[None]:
    """Run a command that ends by itself, and loads most of its modules while it works, with the threshold of loading.

    What becomes unused is found after so many new objects all the same, so that memory does not grow with the work.
    """
    before = gc.get_threshold()
    collect_seldom()
    try:
        yield
    finally:
        gc.set_threshold(*before)


def collect_as_usual() -> None:
    """End to load: what exists now stays, and the collector need not look through it again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_USUAL)
