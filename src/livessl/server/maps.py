"""Draws power maps on demand, on a thread of its own, and packs them as binary pictures for those who watch.

`newest` returns one map once; `watching` delivers the maps of every window. A window holds the evidence from which maps
are drawn, not the maps, so it costs nothing until it is drawn.
"""

from __future__ import annotations

import logging
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.clock import Clock
from livessl.core.locate.estimator import PowerMaps
from livessl.core.types import Float32Array, Window

FUSED: Final = "fused"
"""Name of the map of all arrays together; the API accepts it in place of an array's name."""

VIEWS: Final = {"floor": 2, "side": 0, "front": 1}
"""Axis along which each view takes the maximum of the map."""

INTERVAL_NS: Final = 100_000_000
"""Shortest interval, in nanoseconds, between two drawings: ten per second are enough for people."""

PATIENCE_S: Final = 5.0
"""Longest wait for a drawing, in seconds; the first drawing of a fine grid also computes the tables of the grid."""

HEADER: Final = struct.Struct("<4sBBHq7f2H")
"""Header of a picture in bytes: magic, version, view, length of this header, time_ns, age in seconds, least and
greatest power, bounds of rows and columns in metres, numbers of rows and columns; docs/api.md describes it."""

_MAGIC: Final = b"LMAP"
_VERSION: Final = 1

_log = logging.getLogger(__name__)

Draw = Callable[[Window, frozenset[str]], PowerMaps]
"""A function that draws the fused map of a window, and the maps of the named arrays."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A projection of a power map, quantised to 256 levels for watchers.

    Parameters
    ----------
    view : str
    time_ns : int
        Site time of the window's middle.
    rows, columns : int
    least, greatest : float
        Powers that the levels 0 and 255 represent.
    bounds_m : (float, float, float, float)
        Lowest and highest coordinate of the rows, then of the columns.
    levels : bytes
        One level for each grid point, row by row; the first row has the lowest coordinate.
    """

    view: str
    time_ns: int
    rows: int
    columns: int
    least: float
    greatest: float
    bounds_m: tuple[float, float, float, float]
    levels: bytes

    def packed(self, now_ns: int) -> bytes:
        """Return header and levels; the header holds the picture's age at site time `now_ns`."""
        age_s = (now_ns - self.time_ns) / 1e9
        shape = (self.rows, self.columns)
        return (
            HEADER.pack(
                _MAGIC,
                _VERSION,
                list(VIEWS).index(self.view),
                HEADER.size,
                self.time_ns,
                age_s,
                self.least,
                self.greatest,
                *self.bounds_m,
                *shape,
            )
            + self.levels
        )


@dataclass(frozen=True, slots=True)
class Drawn:
    """The maps of a window, and its pictures by array and view; None for an array that did not detect the sound."""

    window: Window
    maps: PowerMaps
    pictures: Mapping[tuple[str, str], Picture | None]
    arrays: frozenset[str]
    """Arrays whose maps were requested; those that did not detect the sound have none."""

    def power(self, array: str) -> Float32Array | None:
        """Return the map (G,) of an array, or the fused one; None if the array did not detect the window's sound."""
        return self.maps.fused if array == FUSED else self.maps.arrays.get(array)


@dataclass(frozen=True, slots=True, eq=False)
class _Watcher:
    array: str
    views: tuple[str, ...]
    notify: Callable[[], None]


def projection(power: Float32Array, shape: tuple[int, int, int], view: str) -> Float32Array:
    """Return the largest values (rows, columns) along the axis of a view; y or z increases with the rows."""
    return np.asarray(power.reshape(shape).max(axis=VIEWS[view]).T)


def bounds_of_view_m(maps: PowerMaps, view: str) -> tuple[float, float, float, float]:
    """Return the lowest and highest coordinate of a projection's rows, then of its columns."""
    columns, rows = (bounds for axis, bounds in enumerate(maps.grid.bounds_m) if axis != VIEWS[view])
    return (*rows, *columns)


class Maps:
    """The newest window, and the thread that draws it on demand. Every thread may call it.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._newest: tuple[Window, Draw] | None = None
        self._drawn: Drawn | None = None
        self._drawn_ns = -INTERVAL_NS
        self._requested: set[str] = set()
        self._watchers: set[_Watcher] = set()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="maps", daemon=True)
        self.failure: BaseException | None = None
        """The error that has ended the thread, if it has ended."""
        self.drawings = 0
        """Number of drawings since the start."""

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=PATIENCE_S)

    def show(self, window: Window, draw: Draw) -> None:
        """Set the newest window; the thread calls `draw` if a reader or watcher has requested a map."""
        with self._changed:
            self._newest = (window, draw)
            if self._watchers:
                self._changed.notify_all()

    def clear(self) -> None:
        """Drop the newest window and its drawing, because another run begins."""
        with self._changed:
            self._newest = self._drawn = None

    @property
    def drawn(self) -> Drawn | None:
        """The last drawing."""
        return self._drawn

    @property
    def watchers(self) -> int:
        """Number of watchers."""
        return len(self._watchers)

    def newest(self, array: str) -> Drawn | None:
        """Wait for the maps of the newest window and return them, including an array's own if it detected the sound.

        Return None before the first window, and the last drawing if there is no new one within `PATIENCE_S`.
        """
        with self._changed:
            if self._is_missing({array}, set()):
                self._requested.add(array)
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._newest is None or array not in self._requested, PATIENCE_S)
            return self._drawn

    @contextmanager
    def watching(self, array: str, views: tuple[str, ...], notify: Callable[[], None]) -> Iterator[None]:
        """Draw the pictures of every window while the context lasts; the thread calls `notify` after each drawing."""
        watcher = _Watcher(array, views, notify)
        with self._changed:
            self._watchers.add(watcher)
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._watchers.discard(watcher)

    def _run(self) -> None:
        try:
            while self._wait_until_wanted():
                self._draw()
        except BaseException as error:
            self.failure = error
            _log.exception("the thread that draws the maps has failed; the server ends")
            raise

    def _wait_until_wanted(self) -> bool:
        """Wait until a drawing is requested and due; return False if the thread must end."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or self._is_missing(*self._wanted()))
            pause_s = (self._drawn_ns + INTERVAL_NS - self._clock.monotonic_ns()) / 1e9
            if pause_s > 0:
                self._changed.wait_for(lambda: self._stopping, pause_s)
            return not self._stopping

    def _wanted(self) -> tuple[set[str], set[tuple[str, str]]]:
        """Return the arrays whose maps are requested, and the requested pictures."""
        pictures = {(watcher.array, view) for watcher in self._watchers for view in watcher.views}
        return self._requested | {array for array, _ in pictures}, pictures

    def _is_missing(self, arrays: set[str], pictures: set[tuple[str, str]]) -> bool:
        """Return whether any requested map or picture could be drawn but is not yet drawn."""
        if self._newest is None or not arrays:
            return False
        drawn = self._drawn
        if drawn is None or drawn.window is not self._newest[0]:
            return True
        return not (arrays <= drawn.arrays and pictures <= drawn.pictures.keys())

    def _draw(self) -> None:
        with self._changed:
            if self._newest is None:
                return
            window, draw = self._newest
            arrays, pictures = self._wanted()
        self._drawn_ns = self._clock.monotonic_ns()
        maps = draw(window, frozenset(arrays))
        drawn = Drawn(window, maps, _pictures(window, maps, pictures), frozenset(arrays))
        with self._changed:
            if self._newest is None or self._newest[1] != draw:
                return  # another run has begun meanwhile
            self._drawn = drawn
            self._requested -= arrays
            self.drawings += 1
            for watcher in self._watchers:
                watcher.notify()
            self._changed.notify_all()


def _pictures(window: Window, maps: PowerMaps, wanted: set[tuple[str, str]]) -> dict[tuple[str, str], Picture | None]:
    powers = {FUSED: maps.fused, **maps.arrays}
    return {
        (array, view): _picture(window, maps, powers[array], view) if array in powers else None
        for array, view in wanted
    }


def _picture(window: Window, maps: PowerMaps, power: Float32Array, view: str) -> Picture:
    image = projection(power, maps.grid.shape, view)
    least, greatest = float(image.min()), float(image.max())
    levels = np.rint((image - least) * (255.0 / max(greatest - least, 1e-30))).astype(np.uint8)
    rows, columns = image.shape
    return Picture(view, window.time_ns, rows, columns, least, greatest, bounds_of_view_m(maps, view), levels.tobytes())
