"""Power maps for people: one thread draws the newest window's, and only while somebody looks.

Whoever looks says which array's map: a reader once, by `newest`; a watcher until he leaves, by `watching`. The windows
themselves cost nothing to show: they hold what was heard, not maps.
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
from livessl.core.locate.estimators import PowerMaps
from livessl.core.types import Float32Array, Window

FUSED: Final = "fused"
"""The map of all arrays; no array's name in the API."""

VIEWS: Final = {"floor": 2, "side": 0, "front": 1}
"""A view and the axis that its projection takes the maximum over."""

INTERVAL_NS: Final = 100_000_000
"""Between two drawings: people see no more than ten a second, and the sound comes first."""

PATIENCE_S: Final = 5.0
"""How long a reader waits for a drawing, tables of a fine grid included."""

HEADER: Final = struct.Struct("<4sBBHq7f2H")
"""Of a picture in bytes: magic, version, view, length of this header, time_ns, age in seconds, least and greatest
power, bounds of rows and columns in metres, numbers of rows and columns. docs/api.md tells it to clients."""

_MAGIC: Final = b"LMAP"
_VERSION: Final = 1

_log = logging.getLogger(__name__)

Draw = Callable[[Window, frozenset[str]], PowerMaps]
"""Maps of a window, with those of the arrays named."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A projection of a power map, quantised: what a watcher is sent.

    Parameters
    ----------
    view : str
    time_ns : int
        Site time of the window's middle.
    rows, columns : int
    least, greatest : float
        The powers that 0 and 255 stand for.
    bounds_m : (float, float, float, float)
        Lowest and highest coordinate of the rows, then of the columns.
    levels : bytes
        One each node, row by row, the first row at the lowest coordinate.
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
        """Header and levels, as old as it is at site time `now_ns`."""
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
    """A window's maps, and its pictures by array and view: None where the array did not hear it."""

    window: Window
    maps: PowerMaps
    pictures: Mapping[tuple[str, str], Picture | None]
    arrays: frozenset[str]
    """What was asked for; of them those that heard nothing have no map."""

    def power(self, array: str) -> Float32Array | None:
        """The map (G,) of an array, or the fused one; None where the array did not hear the window."""
        return self.maps.fused if array == FUSED else self.maps.arrays.get(array)


@dataclass(frozen=True, slots=True, eq=False)
class _Watcher:
    array: str
    views: tuple[str, ...]
    notify: Callable[[], None]


def projection(power: Float32Array, shape: tuple[int, int, int], view: str) -> Float32Array:
    """The largest values along the axis that a view leaves out, (rows, columns): y or z upwards."""
    return np.asarray(power.reshape(shape).max(axis=VIEWS[view]).T)


def bounds_of_view_m(maps: PowerMaps, view: str) -> tuple[float, float, float, float]:
    """Lowest and highest coordinate of a projection's rows, then of its columns."""
    columns, rows = (bounds for axis, bounds in enumerate(maps.grid.bounds_m) if axis != VIEWS[view])
    return (*rows, *columns)


class Maps:
    """The newest window, and the thread that draws it for whoever looks.

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
        self._asked: set[str] = set()
        self._watchers: set[_Watcher] = set()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="maps", daemon=True)
        self.failure: BaseException | None = None
        self.drawings = 0

    def start(self) -> None:
        """Begin to draw when asked."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=PATIENCE_S)

    def show(self, window: Window, draw: Draw) -> None:
        """There is a newer window, and this draws it."""
        with self._changed:
            self._newest = (window, draw)
            if self._watchers:
                self._changed.notify_all()

    def clear(self) -> None:
        """What was heard belongs to another time."""
        with self._changed:
            self._newest = self._drawn = None

    @property
    def drawn(self) -> Drawn | None:
        """What was drawn last."""
        return self._drawn

    @property
    def watchers(self) -> int:
        """How many watch."""
        return len(self._watchers)

    def newest(self, array: str) -> Drawn | None:
        """Maps of the newest window, an array's own among them if it heard anything: waits for the drawing.

        None before the first window, and where the drawing does not come.
        """
        with self._changed:
            if self._is_missing({array}, set()):
                self._asked.add(array)
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._newest is None or array not in self._asked, PATIENCE_S)
            return self._drawn

    @contextmanager
    def watching(self, array: str, views: tuple[str, ...], notify: Callable[[], None]) -> Iterator[None]:
        """While the context lasts, every window's pictures are drawn, and `notify` called on the drawing thread."""
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
        """Return when there is something to draw and it is time; whether to go on at all."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or self._is_missing(*self._wanted()))
            pause_s = (self._drawn_ns + INTERVAL_NS - self._clock.monotonic_ns()) / 1e9
            if pause_s > 0:
                self._changed.wait_for(lambda: self._stopping, pause_s)
            return not self._stopping

    def _wanted(self) -> tuple[set[str], set[tuple[str, str]]]:
        """Arrays whose maps, and pictures that somebody waits for or watches."""
        pictures = {(watcher.array, view) for watcher in self._watchers for view in watcher.views}
        return self._asked | {array for array, _ in pictures}, pictures

    def _is_missing(self, arrays: set[str], pictures: set[tuple[str, str]]) -> bool:
        """Whether any of these is not drawn yet, though it could be."""
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
                return  # another time has begun meanwhile
            self._drawn = drawn
            self._asked -= arrays
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
