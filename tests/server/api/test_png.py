"""Pictures of maps are valid PNG, have the first row at the bottom, and are dark at low power."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from livessl.server.api.png import encode_png, map_png


def decode_png(data: bytes) -> NDArray[np.uint8]:
    """Pixels (rows, columns, 3) of an RGB picture without filters; every chunk's checksum is checked."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks: dict[bytes, bytes] = {}
    at = 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        (checksum,) = struct.unpack(">I", data[at + 8 + length : at + 12 + length])
        assert checksum == zlib.crc32(kind + body)
        chunks[kind] = body
        at += 12 + length
    assert list(chunks) == [b"IHDR", b"IDAT", b"IEND"]
    assert chunks[b"IEND"] == b""
    columns, rows, depth, colour, compression, filtering, interlace = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert (depth, colour, compression, filtering, interlace) == (8, 2, 0, 0, 0)
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(rows, 1 + 3 * columns)
    assert not lines[:, 0].any()
    return lines[:, 1:].reshape(rows, columns, 3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (20, 16)])
def test_pixels_come_back(shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (*shape, 3), dtype=np.uint8)
    assert_array_equal(decode_png(encode_png(pixels)), pixels)


def brightness(image: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.asarray(decode_png(map_png(image)).sum(axis=2, dtype=np.int64))


def test_first_row_is_at_the_bottom() -> None:
    image = np.zeros((5, 4), dtype=np.float32)
    image[0, 3] = 1.0  # small y, large x: bottom right
    picture = brightness(image)
    assert picture.shape == (5, 4)
    assert np.argwhere(picture == picture.max()).tolist() == [[4, 3]]


def test_more_power_is_brighter() -> None:
    image = np.linspace(0, 1, 101, dtype=np.float32)[None, :]
    picture = brightness(image)[0]
    assert (np.diff(picture) >= 0).all()
    assert picture[-1] > 600 > 100 > picture[0]
    assert (picture[:51] == picture[0]).all()  # everything up to the median is dark


@pytest.mark.parametrize("value", [0.0, 1.0, -3e30])
def test_map_without_contrast_is_dark(value: float) -> None:
    assert (brightness(np.full((3, 4), value, dtype=np.float32)) == 48).all()


def test_scale_does_not_matter() -> None:
    image = np.random.default_rng(2).random((6, 5)).astype(np.float32)
    assert map_png(image) != map_png(image[::-1])
    assert_array_equal(brightness(image), brightness(image * np.float32(2.0**-20)))
