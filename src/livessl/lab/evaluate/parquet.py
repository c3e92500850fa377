"""Results as Parquet files that are small enough to commit."""

from __future__ import annotations

from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

NAME: Final = pa.dictionary(pa.int32(), pa.string())
"""Column type of names that repeat."""

PAGE_BYTES: Final = 1 << 28
"""Largest page, in bytes: each column is compressed as a whole."""


def write_smallest(table: pa.Table, path: Path) -> None:
    """Write a table with the encoding of each column that takes the fewest bytes.

    The encodings are a dictionary, plain values and, for floating-point numbers, byte streams that are stored apart.
    The same table always gives the same bytes.
    """
    dictionaries, streams = [], []
    for name in table.column_names:
        column = table.select([name])
        sizes = {"dictionary": _size(column, dictionaries=[name]), "plain": _size(column)}
        if pa.types.is_floating(table.schema.field(name).type):
            sizes["streams"] = _size(column, streams=[name])
        smallest = min(sizes, key=lambda encoding: sizes[encoding])
        dictionaries += [name] if smallest == "dictionary" else []
        streams += [name] if smallest == "streams" else []
    _write(table, path, dictionaries, streams)


def _size(column: pa.Table, dictionaries: Collection[str] = (), streams: Collection[str] = ()) -> int:
    buffer = BytesIO()
    _write(column, buffer, dictionaries, streams)
    return buffer.tell()


def _write(table: pa.Table, where: Any, dictionaries: Collection[str], streams: Collection[str]) -> None:
    pq.write_table(
        table,
        where,
        compression="zstd",
        compression_level=19,
        data_page_size=PAGE_BYTES,
        dictionary_pagesize_limit=PAGE_BYTES,
        use_dictionary=list(dictionaries),
        use_byte_stream_split=list(streams),
    )
