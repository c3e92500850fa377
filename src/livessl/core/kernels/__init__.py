"""The kernels in use: compiled where numba is installed, else on NumPy. Same names, same arguments, same answers."""

from __future__ import annotations

from types import ModuleType

from livessl.core.kernels import with_numpy

kernels: ModuleType
try:
    from livessl.core.kernels import with_numba as kernels
except ImportError:  # without numba
    kernels = with_numpy
