"""Chooses the kernels in use: compiled where numba is installed, otherwise on NumPy, with the same names."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any


class Kernels:
    """Has every attribute of the module of kernels that is in use: numba's, where it is installed, until `use`.

    Both modules do the same with the same arrays, so they may be exchanged between any two calls. Only the tables of
    the search and those of `look_up_table` are for the module that made them: who keeps such a table keeps `in_use`
    beside it.
    """

    def __init__(self) -> None:
        self._in_use: ModuleType | None = None

    @property
    def in_use(self) -> ModuleType:
        """The module in use."""
        if self._in_use is None:
            try:
                self._in_use = import_module("livessl.core.kernels.with_numba")
            except ImportError:  # without numba
                self._in_use = import_module("livessl.core.kernels.with_numpy")
        return self._in_use

    def use(self, module: ModuleType) -> None:
        """Use the kernels of `module` from the next call on."""
        self._in_use = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self.in_use, name)


kernels = Kernels()
