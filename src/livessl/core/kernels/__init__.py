"""The kernels in use: compiled where numba is installed, otherwise on NumPy, with the same names and arguments."""

from __future__ import annotations

from types import ModuleType

from livessl.core.kernels import with_numpy

kernels: ModuleType
try:
    from livessl.core.kernels import with_numba as kernels
except ImportError:  # without numba
    kernels = with_numpy
