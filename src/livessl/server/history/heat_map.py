"""Counts events in each cell of the floor plan (heat map), in the database."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, and_, case, func, text

from livessl.server.history.query import Query
from livessl.server.history.search import matching
from livessl.server.history.tables import events


class Cells(NamedTuple):
    """Square cells of a floor plan, in millimetres.

    Parameters
    ----------
    low_mm : (int, int)
        Lowest x and y.
    high_mm : (int, int)
        Highest x and y; the last cells may reach beyond.
    spacing_mm : int
        Edge of a cell.
    """

    low_mm: tuple[int, int]
    high_mm: tuple[int, int]
    spacing_mm: int

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells in x and y."""
        nx, ny = (
            max(1, -((low - high) // self.spacing_mm)) for low, high in zip(self.low_mm, self.high_mm, strict=True)
        )
        return nx, ny


class HeatMap(NamedTuple):
    """Counts of events.

    Parameters
    ----------
    counts : ndarray of int, shape (nx, ny)
    elsewhere : int
        Events outside the cells, or without a position.
    """

    counts: NDArray[np.int64]
    elsewhere: int


def count_by_cell(connection: Connection, query: Query, cells: Cells) -> HeatMap:
    """Return how many of the events that a query admits lie in each cell.

    Those on the last edges are in the last cells. The pages of the query do not matter.
    """
    places, (nx, ny) = (events.c.x_mm, events.c.y_mm), cells.shape
    limits = zip(places, cells.low_mm, cells.high_mm, strict=True)
    is_inside = and_(*(place.between(low, high) for place, low, high in limits))
    i, k = ((place - low) // cells.spacing_mm for place, low in zip(places, cells.low_mm, strict=True))
    # one number for row and column: most of the time goes into sorting by it
    cell = case((is_inside, i * (ny + 1) + k), else_=None)
    statement, _ = matching(query, cell, func.count())
    counts, elsewhere = np.zeros(cells.shape, dtype=np.int64), 0
    for number, count in connection.execute(statement.group_by(text("1"))):
        if number is None:
            elsewhere += count
        else:
            row, column = divmod(number, ny + 1)
            counts[min(row, nx - 1), min(column, ny - 1)] += count
    return HeatMap(counts, elsewhere)
