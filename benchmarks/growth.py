"""How a cost grows with a demand: a line or a power that is fitted to measured costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Fit:
    """The growth of a cost: `factor * x ** exponent`, or `factor * x + offset`, and the largest deviation.

    Parameters
    ----------
    factor, exponent, offset : float
    worst : float
        Largest deviation of a measurement from the fit, relative to the fit.
    """

    factor: float
    exponent: float
    offset: float
    worst: float

    def __call__(self, x: float) -> float:
        """Return the cost at x."""
        return self.offset + self.factor * float(x**self.exponent)

    @classmethod
    def power(cls, x: Sequence[float], y: Sequence[float]) -> Fit:
        """Fit a power by least squares of the logarithms."""
        exponent, logarithm = np.polyfit(np.log(x), np.log(y), 1)
        return cls._judged(math.exp(logarithm), float(exponent), 0.0, x, y)

    @classmethod
    def line(cls, x: Sequence[float], y: Sequence[float]) -> Fit:
        """Fit a line by least squares of the relative deviations, so that small costs count as much as large ones."""
        factor, offset = np.polyfit(x, y, 1, w=1.0 / np.asarray(y))
        return cls._judged(float(factor), 1.0, float(offset), x, y)

    @classmethod
    def _judged(cls, factor: float, exponent: float, offset: float, x: Sequence[float], y: Sequence[float]) -> Fit:
        fitted = factor * np.asarray(x, dtype=np.float64) ** exponent + offset
        return cls(factor, exponent, offset, float(np.abs(np.asarray(y) / fitted - 1.0).max()))
