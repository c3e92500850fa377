"""The common parts of all figures: colours, panels and the PNG file."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any, Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Distinct for colour-blind readers (Okabe and Ito)."""

PALETTE: Final = 128
"""Colours of a PNG. A palette makes the file a third as large, and no pixel changes by more than a twentieth of the way
from black to white."""


def panels(rows: int = 1, columns: int = 1, size_inches: tuple[float, float] = (7.0, 4.5)) -> tuple[Figure, Any]:
    """Return an empty figure and its axes, (rows, columns)."""
    figure = Figure(figsize=size_inches, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def save(figure: Figure, path: Path, dpi: int = 130) -> None:
    """Write a figure as a PNG with a palette; the same figure gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=dpi)
    image = Image.open(buffer).convert("RGB")
    with_palette = image.quantize(PALETTE, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    with_palette.save(path, optimize=True)
