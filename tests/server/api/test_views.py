"""The views of the room in a browser: side, front and 3-D, drawn to scale, with labels that never overlap."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Final

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from browser import box_of, faultless_page, running_browser
from livessl.server.app import Server
from messages import event_message, update_message
from room_views import (
    AT,
    COLOUR,
    HALF_PIXEL,
    MS,
    NORTH,
    PLAN,
    choice,
    directions,
    leaves,
    opened,
    overlap,
    publish,
    room_server,
    shown,
)
from small_site import wait_until

pytestmark = [pytest.mark.browser]

WIDTHS: Final = (1440, 1280, 820, 390)
VIEWS: Final = ("side", "front", "3d")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with room_server() as server:
        yield server


# --- choosing a view -------------------------------------------------------------------------------------------


def test_view_is_chosen_by_keyboard_and_kept_in_the_browser(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        choice(page, "Side").focus()
        page.keyboard.press("ArrowRight")
        shown(page, "front")
        expect(page.get_by_role("img", name="Front elevation of the room")).to_be_visible()
        page.keyboard.press("ArrowRight")
        shown(page, "3d")
        expect(page.get_by_role("application", name="The room in 3-D")).to_be_visible()
        page.reload()
        shown(page, "3d")
        expect(choice(page, "3-D")).to_be_checked()


def test_address_names_a_view_and_an_event(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        event = page.get_by_test_id("event").last.get_attribute("data-event-id")
        page.evaluate(f"location.hash = 'event={event}&view=front'")
        shown(page, "front")
        expect(page.get_by_test_id("event").last.locator(".details")).to_be_visible(timeout=MS)
        page.evaluate("location.hash = 'view=nothing'")
        shown(page, "front")
        page.reload()
        shown(page, "side")  # an address is for once; nobody has chosen the front


def test_power_maps_of_the_view_are_received_and_no_others(browser: Browser, server: Server) -> None:
    asked: list[str] = []
    with faultless_page(browser) as page:
        page.on("websocket", lambda socket: asked.append(socket.url))
        opened(page, server)
        for name in ("Front", "3-D"):
            with page.expect_websocket(lambda socket: "/map?" in socket.url):
                choice(page, name).check()
    maps = [url.rpartition("views=")[2].split("%2C") for url in asked if "/map?" in url]
    assert maps == [["floor", "side"], ["floor", "front"], ["floor", "side", "front"]]


def test_code_of_the_3d_view_is_loaded_when_it_is_chosen(browser: Browser, server: Server) -> None:
    asked: list[str] = []
    with faultless_page(browser) as page:
        page.on("request", lambda request: asked.append(request.url.rpartition("/")[2]))
        page.route("**/static/plan-solid.js", lambda route: route.abort(), times=1)
        opened(page, server)
        lazy = {"plan-solid.js", "plan-turn.js", "camera.js"}
        assert not lazy & set(asked)
        choice(page, "3-D").click()
        expect(page.locator("#side-pointer")).to_have_text("The 3-D view did not load; load the page again", timeout=MS)
        expect(choice(page, "Side")).to_be_checked()
        shown(page, "side")
        page.reload()
        shown(page, "3d")
        assert lazy <= set(asked)


# --- where things are drawn ------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["floor", *VIEWS])
def test_sound_is_drawn_where_it_is(browser: Browser, server: Server, view: str) -> None:
    """The mark has the estimate's colour at the place that the directions of the view and its scale give."""
    position_m = np.array([2.83, 3.37, 0.71])
    looks = {"floor": (-90, 90), "side": (0, 0), "front": (-90, 0)}
    with faultless_page(browser) as page:
        page.emulate_media(color_scheme="dark")
        opened(page, server, "" if view == "floor" else view)
        name = "floor" if view == "floor" else "side"
        seen = page.evaluate(PLAN, name)
        look = looks.get(view) or (seen["camera"]["azimuthDeg"], seen["camera"]["elevationDeg"])
        right, up, _ = directions(*look)
        canvas = box_of(page.locator(f"#{name}"))
        margins = (44, 18, 26, 40) if view != "3d" else (40, 40 + 92, 14, 36)
        middle = [(margins[0] + canvas["width"] - margins[1]) / 2, (margins[2] + canvas["height"] - margins[3]) / 2]
        away_m = position_m - np.array(seen["size"]) / 2
        expected = np.array([middle[0] + seen["scale"] * right @ away_m, middle[1] - seen["scale"] * up @ away_m])
        assert page.evaluate(AT, [name, position_m.tolist()]) == pytest.approx(expected, abs=HALF_PIXEL)

        update = update_message(position_m=position_m.tolist(), covariance_m2=(np.eye(3) * 1e-4).tolist())

        def is_there() -> bool:
            publish(server, update)
            red, green, blue = page.evaluate(COLOUR, [name, *expected])
            return bool(red < 140 and green > 190 and blue > 190)  # of #4fe3ea, in dark

        wait_until(is_there, "the mark")


@pytest.mark.parametrize(("view", "words"), [("side", "y 2.50  z 1.50"), ("front", "x 2.00  z 1.50")])
def test_pointer_reads_the_coordinates_of_an_elevation(browser: Browser, server: Server, view: str, words: str) -> None:
    with faultless_page(browser) as page:
        opened(page, server, view)
        x, y = page.evaluate(AT, ["side", [2.0, 2.5, 1.5]])
        page.locator("#side").hover(position={"x": x, "y": y})
        expect(page.locator("#side-pointer")).to_have_text(words)


def test_arrays_that_coincide_share_a_label_and_others_have_their_own(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "side")
        texts = [label["text"] for label in shown(page, "side")["written"]]
        assert any("north" in text and "east" in text for text in texts)
        page.evaluate("location.hash = 'view=front'")
        written = shown(page, "front")["written"]
        for name in ("north", "east", "south"):
            (label,) = [each for each in written if name in each["text"]]
            others = {"north", "east", "south"} - {name}
            assert not any(other in label["text"] for other in others)
        apart = np.subtract(
            page.evaluate(AT, ["side", [3.2, 1.3, 1.4]]), page.evaluate(AT, ["side", NORTH["position_m"]])
        )
        assert apart == pytest.approx([page.evaluate(PLAN, "side")["scale"] * 1.3, 0.0], abs=HALF_PIXEL)


def test_3d_view_names_zones_and_directions(browser: Browser, server: Server) -> None:
    ray = {"array": "south", "asked": False, "active_s": 0.4, "level_dbfs": -30.0, "distance_m": 2.0, "off_deg": 0.0}
    ray = {**ray, "azimuth_deg": -120.0, "elevation_deg": 10.0, "agrees": True}
    event = event_message(status="direction-only", reason="one array", position_m=None, covariance_m2=None)
    with faultless_page(browser) as page:
        opened(page, server, "3d")

        def are_named() -> bool:
            publish(server, {**event, "id": "small-ray", "kind": "event", "contributions": [ray]})
            texts = {label["text"] for label in page.evaluate(PLAN, "side")["written"]}
            return {"door", "desk", "fan (excluded)", "direction only"} <= texts

        wait_until(are_named, "the names")


@pytest.mark.parametrize("width", WIDTHS)
def test_no_text_overlaps_or_is_cut_off(browser: Browser, server: Server, width: int) -> None:
    with faultless_page(browser) as page:
        opened(page, server, width=width)
        publish(server, update_message(position_m=[2.0, 1.3, 1.3], covariance_m2=(np.eye(3) * 0.05).tolist()))
        for view in VIEWS:
            page.evaluate(f"location.hash = 'view={view}'")
            shown(page, view)
            for turn in range(6 if view == "3d" else 1):
                for name in ("floor", "side"):
                    _check_texts(page, name, f"{view}, {name}, turned {turn} times")
                if view == "3d":
                    page.get_by_role("button", name="Go round to the right").click()
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            cut = """() => [...document.querySelectorAll("#side-panel :is(h2, label, button, output)")]
                .filter(({ scrollWidth, clientWidth, checkVisibility }) => scrollWidth > clientWidth + 1)
                .filter((each) => each.checkVisibility() && getComputedStyle(each).display !== "inline")
                .map(({ textContent }) => textContent)"""
            assert page.evaluate(cut) == []


def _check_texts(page: Page, name: str, what: str) -> None:
    """No text of a canvas covers another one, or leaves the canvas."""
    box = box_of(page.locator(f"#{name}"))
    written = page.evaluate(PLAN, name)["written"]
    for label in written:
        assert not leaves(label, box["width"], box["height"]), f"{what}: {label} leaves {box}"
    for a, b in combinations(written, 2):
        assert not overlap(a, b), f"{what}: {a} covers {b}"
    for array in ("north", "south", "east"):
        assert any(array in label["text"] for label in written), f"{what}: {array} has no name"
