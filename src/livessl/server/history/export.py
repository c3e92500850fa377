"""Exports events as CSV, JSON Lines or Parquet: their columns, a page at a time."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final

from livessl.server.history.query import JsonObject, Row

Pages = Iterable[Sequence[Row]]

COLUMNS: Final = (
    "id",
    "time_utc",
    "start_s",
    "duration_s",
    "status",
    "x_m",
    "y_m",
    "z_m",
    "confidence",
    "level_dbfs",
    "arrays",
    "heard_by",
    "zones",
    "method",
    "source",
    "reason",
    "variance_x_m2",
    "variance_y_m2",
    "variance_z_m2",
    "covariance_xy_m2",
    "covariance_xz_m2",
    "covariance_yz_m2",
)
"""Columns of CSV and Parquet."""

_TEXTS: Final = frozenset({"id", "status", "method", "reason"})
_LISTS: Final = frozenset({"arrays", "heard_by", "zones"})


def json_lines(pages: Pages) -> Iterator[bytes]:
    """Yield one line for each event: a JSON object as in the list of `GET events`, without the `v` of an answer."""
    for rows in pages:
        yield b"".join(row.body.encode() + b"\n" for row in rows)


def csv_lines(pages: Pages) -> Iterator[bytes]:
    """Yield CSV (RFC 4180) with a header row. Names in a list are separated by spaces, and a null is an empty cell."""
    yield _csv([COLUMNS])
    for rows in pages:
        yield _csv([_cell(value) for value in flat(row.event).values()] for row in rows)


def parquet(pages: Pages) -> Iterator[bytes]:
    """Yield a Parquet file with one row group for each page.

    Raises
    ------
    ImportError
        If pyarrow is not installed.
    """
    import pyarrow as pa
    from pyarrow import parquet as pq

    def kind(name: str) -> Any:
        if name == "time_utc":
            return pa.timestamp("us", tz="UTC")
        if name == "source":
            return pa.int64()
        return pa.string() if name in _TEXTS else pa.list_(pa.string()) if name in _LISTS else pa.float64()

    schema = pa.schema([(name, kind(name)) for name in COLUMNS])
    out = _Drain()
    with pq.ParquetWriter(out, schema) as writer:
        for rows in pages:
            listed: dict[str, list[Any]] = {name: [] for name in COLUMNS}
            for row in rows:
                for name, value in flat(row.event).items():
                    listed[name].append(value)
            columns = [pa.array(listed[name], pa.string() if name == "time_utc" else kind(name)) for name in COLUMNS]
            columns[COLUMNS.index("time_utc")] = columns[COLUMNS.index("time_utc")].cast(kind("time_utc"))
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))
            yield out.take()
    yield out.take()


def flat(event: JsonObject) -> JsonObject:
    """Return the value of each of the `COLUMNS` for an event."""
    found = {name: event.get(name) for name in COLUMNS}
    position = event.get("position_m")
    if position is not None:
        found["x_m"], found["y_m"], found["z_m"] = position
    c = event.get("covariance_m2")
    if c is not None:
        found["variance_x_m2"], found["variance_y_m2"], found["variance_z_m2"] = c[0][0], c[1][1], c[2][2]
        found["covariance_xy_m2"], found["covariance_xz_m2"], found["covariance_yz_m2"] = c[0][1], c[0][2], c[1][2]
    return found


FORMATS: Final[dict[str, tuple[str, Callable[[Pages], Iterator[bytes]]]]] = {
    "csv": ("text/csv; charset=utf-8", csv_lines),
    "jsonl": ("application/octet-stream", json_lines),
    "parquet": ("application/octet-stream", parquet),
}
"""Media type and encoder of each format. JSON Lines and Parquet are `application/octet-stream`, because generators of
clients do not know the media types of these two formats."""


def _cell(value: Any) -> Any:
    return " ".join(value) if isinstance(value, list) else value


def _csv(rows: Iterable[Iterable[Any]]) -> bytes:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


class _Drain(io.RawIOBase):
    """A file that can only be written; `take` returns what was written since the last call."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: list[bytes] = []
        self._length = 0

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._length

    def write(self, data: Any) -> int:
        piece = bytes(data)
        self._pieces.append(piece)
        self._length += len(piece)
        return len(piece)

    def take(self) -> bytes:
        found = b"".join(self._pieces)
        self._pieces.clear()
        return found
