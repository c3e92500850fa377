"""Compiles functions by numba and caches the machine code from one start to the next. Needs numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def jit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call, to run without Python's global lock.

    The machine code is kept in `NUMBA_CACHE_DIR`, beside the source, or in the user's cache: the first of them that can
    be written. If none can, each process compiles anew.

    Parameters
    ----------
    **options
        Options of `numba.njit`.
    """

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            made = numba.njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba finds no folder to write to
            made = numba.njit(nogil=True, **options)(function)
        return made  # type: ignore[no-any-return]

    return compiled
