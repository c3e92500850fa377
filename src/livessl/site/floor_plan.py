"""Reads the picture of the floor plan (PNG or SVG): its kind, its size, and the largest file."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from livessl.errors import ConfigError, Fault

if TYPE_CHECKING:
    from livessl.site.models import Site

MAX_BYTES: Final = 20_000_000
"""Largest file that is accepted, in bytes: browsers load it whole."""

PNG: Final = "image/png"
SVG: Final = "image/svg+xml"

_PNG_HEAD: Final = b"\x89PNG\r\n\x1a\n"
_SVG_TAG: Final = re.compile(rb"<svg\b[^>]*>", re.DOTALL)
_LENGTH: Final = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(px)?\s*", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class FloorPicture:
    """The picture with its place in the room.

    Parameters
    ----------
    data : bytes
        The file.
    media_type : str
        `PNG` or `SVG`.
    bounds_m : ((float, float), (float, float))
        Lowest and highest x and y of the picture, in metres.
    """

    data: bytes
    media_type: str
    bounds_m: tuple[tuple[float, float], tuple[float, float]]


def read_floor_plan(site: Site) -> FloorPicture | None:
    """Return the picture that a site file names; None if it names none.

    Raises
    ------
    ConfigError
        If the file cannot be read, is no PNG or SVG, or has no size.
    """
    config = site.floor_plan
    if config is None:
        return None
    path = site.file(config.image)
    try:
        size_bytes = path.stat().st_size
        data = path.read_bytes() if size_bytes <= MAX_BYTES else b""
    except OSError as error:
        raise _fault(f"{path} cannot be read: {error.strerror}; correct the name") from error
    if size_bytes > MAX_BYTES:
        raise _fault(f"expected a file of at most {MAX_BYTES // 1_000_000} MB, {path} has {size_bytes / 1e6:.0f}")
    size = _png_size(data) or _svg_size(data)
    if size is None:
        raise _fault(f"expected a PNG, or an SVG with width and height or a viewBox; {path} is something else")
    (x0, y0), (width, height) = config.origin_m, (pixels * config.m_per_pixel for pixels in size)
    kind = PNG if data.startswith(_PNG_HEAD) else SVG
    return FloorPicture(data, kind, ((x0, x0 + width), (y0, y0 + height)))


def _png_size(data: bytes) -> tuple[float, float] | None:
    """Return width and height of a PNG in pixels."""
    if not data.startswith(_PNG_HEAD) or len(data) < 24:
        return None
    width, height = struct.unpack(">II", data[16:24])
    return (width, height) if width and height else None


def _svg_size(data: bytes) -> tuple[float, float] | None:
    """Return width and height of an SVG in pixels: those that it gives, or otherwise those of its viewBox."""
    tag = _SVG_TAG.search(data)
    if tag is None:
        return None
    text = tag[0].decode("utf-8", "replace")
    given = [_attribute(text, name) for name in ("width", "height")]
    sizes = [None if value is None else _LENGTH.fullmatch(value) for value in given]
    if all(sizes):
        width, height = (float(size[1]) for size in sizes if size is not None)
    else:
        box = (_attribute(text, "viewBox") or "").replace(",", " ").split()
        try:
            _, _, width, height = map(float, box)
        except ValueError:
            return None
    return (width, height) if width > 0 and height > 0 else None


def _attribute(tag: str, name: str) -> str | None:
    found = re.search(rf"""\s{name}\s*=\s*(?:"([^"]*)"|'([^']*)')""", tag)
    return None if found is None else found[1] if found[1] is not None else found[2]


def _fault(what: str) -> ConfigError:
    return ConfigError([Fault("floor_plan.image", what)])
