"""Encodes power maps as PNG with their colour scale; that of the dashboard is in `static/colour-map.js`."""

from __future__ import annotations

import struct
import zlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

from livessl.core.types import Float32Array, RealArray

_ANCHORS: Final = np.array(
    [[10, 8, 30], [66, 20, 108], [140, 42, 115], [214, 72, 82], [248, 142, 60], [252, 246, 176]], dtype=np.float64
)
"""Colours (RGB) of the scale from low to high power, evenly spaced: dark, purple, red, orange, light."""

_COLOURS: Final = np.stack(
    [np.interp(np.linspace(0.0, 1.0, 256), np.linspace(0.0, 1.0, len(_ANCHORS)), each) for each in _ANCHORS.T], axis=-1
).astype(np.uint8)
"""Colours (RGB) of 256 levels, (256, 3)."""


def map_png(image: Float32Array) -> bytes:
    """Draw a map (rows, columns) as a PNG with the first row at the bottom, dark up to the median, light at the top."""
    low, high = float(np.median(image)), float(image.max())
    return encode_png(map_colours(np.clip((image - low) / max(high - low, 1e-12), 0.0, 1.0)[::-1]))


def map_colours(level: RealArray) -> NDArray[np.uint8]:
    """Return the colours (RGB) of levels from 0 to 1, (..., 3)."""
    return _COLOURS[np.rint(level * (len(_COLOURS) - 1)).astype(np.uint8)]


def encode_png(pixels: NDArray[np.uint8]) -> bytes:
    """Encode an RGB picture (rows, columns, 3) as PNG (RFC 2083): signature, header, one compressed block, end."""
    rows, columns, _ = pixels.shape
    lines = np.concatenate([np.zeros((rows, 1), dtype=np.uint8), pixels.reshape(rows, -1)], axis=1)
    header = struct.pack(">IIBBBBB", columns, rows, 8, 2, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
