"""Maps are drawn for readers and watchers, and not without them."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from livessl.clock import SystemClock
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import PowerMaps
from livessl.core.types import GCC, ArraySpec, Evidence, Window
from livessl.server.maps import HEADER, INTERVAL_NS, Maps
from small_site import HANG_S, wait_until

CLOCK = SystemClock()
GRID = Grid(((0.0, 1.0), (2.0, 4.0), (0.0, 1.5)), 0.5)
SPEC = ArraySpec("north", np.array([[0.0, 0, 0], [0.1, 0, 0]]), (100.0, 6000.0))
GCC_OF_NOTHING = GCC(np.array([[0, 1]]), np.array([0.0, 1e-4]), np.zeros((1, 2)))


class Artist:
    """Draws maps whose powers count the grid points; remembers what it drew."""

    def __init__(self) -> None:
        self.drew: list[tuple[int, frozenset[str]]] = []
        self.may_go_on = threading.Event()
        self.may_go_on.set()
        self.begun = threading.Event()

    def draw(self, window: Window, arrays: frozenset[str]) -> PowerMaps:
        self.begun.set()
        assert self.may_go_on.wait(timeout=HANG_S)
        self.drew.append((window.time_ns, arrays))
        power = (np.arange(GRID.size) + 0.25).astype(np.float32)
        return PowerMaps(GRID, power, {"north": 2 * power} if "north" in arrays else {})


def window(time_ns: int) -> Window:
    return Window(time_ns, (Evidence(SPEC, GCC_OF_NOTHING),))


@pytest.fixture
def artist() -> Artist:
    return Artist()


@pytest.fixture
def maps() -> Iterator[Maps]:
    maps = Maps(CLOCK)
    maps.start()
    yield maps
    maps.stop()
    assert not any(thread.name == "maps" for thread in threading.enumerate())


def test_nothing_is_drawn_without_a_reader(maps: Maps, artist: Artist) -> None:
    assert maps.newest("fused") is None
    for time_ns in range(3):
        maps.show(window(time_ns), artist.draw)
    drawn = maps.newest("fused")
    assert drawn is not None
    assert artist.drew == [(2, frozenset({"fused"}))]  # the newest alone, and only once asked for
    assert drawn.window.time_ns == 2


def test_drawing_is_not_repeated(maps: Maps, artist: Artist) -> None:
    maps.show(window(1), artist.draw)
    first = maps.newest("fused")
    assert maps.newest("fused") is first
    assert len(artist.drew) == 1
    alone = maps.newest("north")
    assert alone is not None
    power = alone.power("north")
    assert power is not None
    np.testing.assert_array_equal(power, 2 * alone.maps.fused)
    assert len(artist.drew) == 2
    maps.show(window(2), artist.draw)
    assert maps.newest("fused") is not first


def test_array_that_detected_nothing_has_no_map(maps: Maps, artist: Artist) -> None:
    maps.show(window(1), artist.draw)
    drawn = maps.newest("south")
    assert drawn is not None
    assert drawn.power("south") is None
    assert maps.newest("south") is drawn


def test_watchers_get_the_newest_pictures_until_they_leave(maps: Maps, artist: Artist) -> None:
    news = threading.Event()
    began_ns = CLOCK.monotonic_ns()
    with maps.watching("fused", ("floor", "side"), news.set):
        assert maps.watchers == 1
        for time_ns in range(1, 100):
            maps.show(window(time_ns), artist.draw)
        wait_until(lambda: maps.drawn is not None and maps.drawn.window.time_ns == 99, "the newest window")
        assert news.is_set()
        assert maps.drawn is not None
        assert maps.drawn.pictures.keys() == {("fused", "floor"), ("fused", "side")}
        assert len(artist.drew) <= 1 + (CLOCK.monotonic_ns() - began_ns) / INTERVAL_NS
    assert maps.watchers == 0
    before = len(artist.drew)
    maps.show(window(100), artist.draw)
    assert maps.newest("north") is not None
    assert artist.drew[before:] == [(100, frozenset({"north"}))]  # nobody watches the fused one any more


def test_watcher_that_comes_late_gets_the_newest_window(maps: Maps, artist: Artist) -> None:
    maps.show(window(1), artist.draw)
    assert maps.newest("fused") is not None
    with maps.watching("north", ("front",), lambda: None), maps.watching("south", ("floor",), lambda: None):
        wait_until(lambda: maps.drawn is not None and len(maps.drawn.pictures) == 2, "both pictures")
        assert maps.drawn is not None
        assert maps.drawn.pictures["south", "floor"] is None
        assert maps.drawn.pictures["north", "front"] is not None


def test_packed_picture_follows_its_description(maps: Maps, artist: Artist) -> None:
    maps.show(window(10**9), artist.draw)
    with maps.watching("fused", ("floor",), lambda: None):
        wait_until(lambda: maps.drawn is not None, "a picture")
        assert maps.drawn is not None
        picture = maps.drawn.pictures["fused", "floor"]
        image = maps.drawn.maps.fused.reshape(2, 4, 3).max(axis=2).T
    assert picture is not None
    packed = picture.packed(now_ns=3 * 10**9)
    magic, version, view, size, time_ns, age_s, least, greatest, *rest = HEADER.unpack_from(packed)
    assert (magic, version, view, size, time_ns, age_s) == (b"LMAP", 1, 0, HEADER.size, 10**9, 2.0)
    assert (least, greatest) == (image.min(), image.max())
    assert rest == [2.0, 4.0, 0.0, 1.0, 4, 2]  # rows along y, columns along x
    levels = np.frombuffer(packed, dtype=np.uint8, offset=size).reshape(4, 2)
    half_a_level = (greatest - least) / 255 / 2
    np.testing.assert_allclose(least + levels / 255 * (greatest - least), image, atol=half_a_level, rtol=1e-6)
    assert len(np.unique(levels)) == 8


def test_map_of_another_run_is_never_shown(maps: Maps, artist: Artist) -> None:
    artist.may_go_on.clear()
    maps.show(window(1), artist.draw)
    asking = threading.Thread(target=maps.newest, args=("fused",))
    asking.start()
    assert artist.begun.wait(timeout=HANG_S)
    maps.clear()
    artist.may_go_on.set()
    wait_until(lambda: artist.drew, "the drawing")
    asking.join(timeout=HANG_S)
    assert not asking.is_alive()
    assert maps.newest("fused") is None
    other = Artist()
    maps.show(window(2), other.draw)
    drawn = maps.newest("fused")
    assert drawn is not None
    assert drawn.window.time_ns == 2


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_failure_is_reported(maps: Maps) -> None:
    def fail(window: Window, arrays: frozenset[str]) -> PowerMaps:
        raise MemoryError("no room for a map")

    maps.show(window(1), fail)
    with maps.watching("fused", ("floor",), lambda: None):
        wait_until(lambda: maps.failure is not None, "the failure")
    assert isinstance(maps.failure, MemoryError)
