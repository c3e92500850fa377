"""Thresholds of Python's garbage collector: high while a program loads, the usual ones once a server or node runs."""

from __future__ import annotations

import gc
from typing import Final

LOADING: Final = 50_000
"""New objects after which the collector looks for unused ones while a program loads. Modules make hundreds of thousands
and hardly any of them becomes unused; by Python's default of 700 the collector takes a tenth of the time of a start."""

_USUAL: Final = gc.get_threshold()


def collect_seldom() -> None:
    """Begin to load, in a command that ends it by `collect_as_usual`: until then hardly any unused memory is found."""
    gc.set_threshold(LOADING, *_USUAL[1:])


def collect_as_usual() -> None:
    """End to load: what exists now stays, and the collector need not look through it again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_USUAL)
