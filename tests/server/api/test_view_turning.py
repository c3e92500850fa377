"""The 3-D view in a browser: turned, zoomed and moved by mouse, touch, keys and buttons."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from browser import box_of, faultless_page, running_browser, visit
from livessl.server.app import Server
from room_views import (
    AT,
    HALF_PIXEL,
    NORTH,
    PLAN,
    camera,
    directions,
    opened,
    room_server,
    shown,
)
from small_site import wait_until

pytestmark = [pytest.mark.browser]

STEP_DEG: Final = 15
"""Degrees that a key turns the room."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with room_server() as server:
        yield server


def test_room_is_turned_zoomed_and_reset_by_mouse(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "3d")
        before, box = camera(page), box_of(page.locator("#side"))
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 50, y + 20)
        page.mouse.up()
        page.mouse.move(x + 90, y + 70)  # nothing is held any more
        after = camera(page)
        assert after["azimuthDeg"] == pytest.approx(before["azimuthDeg"] - 20)
        assert after["elevationDeg"] == pytest.approx(before["elevationDeg"] + 8)
        expect(page.locator("#side-pointer")).to_have_text("azimuth −82°  elevation 32°  zoom 1.0")
        page.mouse.move(x + 60, y - 30)
        under = page.evaluate(AT, ["side", [3.0, 4.0, 1.0]])
        page.mouse.move(box["x"] + under[0], box["y"] + under[1])
        page.mouse.wheel(0, -400)
        wait_until(lambda: camera(page)["zoom"] > 1.5, "the zoom")
        wait_until(lambda: page.evaluate(PLAN, "side")["scale"] > 0, "the drawing")
        page.get_by_role("button", name="Reset view").click()
        wait_until(lambda: camera(page) == before, "the start")


def test_what_is_under_the_pointer_stays_there_while_zooming(browser: Browser, server: Server) -> None:
    """The point lies in the plane of the middle of the room: what is nearer or farther moves in the view, too."""
    with faultless_page(browser) as page:
        opened(page, server, "3d")
        seen = page.evaluate(PLAN, "side")
        right, up, _ = directions(seen["camera"]["azimuthDeg"], seen["camera"]["elevationDeg"])
        point_m = np.array(seen["size"]) / 2 + 0.8 * right - 0.4 * up
        x, y = page.evaluate(AT, ["side", point_m.tolist()])
        box = box_of(page.locator("#side"))
        page.mouse.move(box["x"] + x, box["y"] + y)
        page.mouse.wheel(0, -300)
        wait_until(lambda: page.evaluate(PLAN, "side")["scale"] > 1.4 * seen["scale"], "the zoom")
        assert page.evaluate(AT, ["side", point_m.tolist()]) == pytest.approx([x, y], abs=2 * HALF_PIXEL)


def test_room_is_turned_by_keys_and_buttons(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "3d")
        start = camera(page)
        page.locator("#side").focus()
        for key, what, change in (
            ("ArrowRight", "azimuthDeg", STEP_DEG),
            ("ArrowLeft", "azimuthDeg", -STEP_DEG),
            ("ArrowUp", "elevationDeg", STEP_DEG),
            ("ArrowDown", "elevationDeg", -STEP_DEG),
        ):
            before = camera(page)[what]
            page.keyboard.press(key)
            assert camera(page)[what] == pytest.approx(before + change), key
        for _ in range(8):
            page.keyboard.press("ArrowDown")
        assert camera(page)["elevationDeg"] == 0  # never from below the floor
        page.keyboard.press("+")
        assert camera(page)["zoom"] == pytest.approx(1.3)
        page.keyboard.press("Shift+ArrowRight")
        assert camera(page)["target"] != start["target"]
        page.keyboard.press("Home")
        assert camera(page) == start
        page.get_by_role("button", name="Look from higher").press("Enter")
        assert camera(page)["elevationDeg"] == pytest.approx(start["elevationDeg"] + STEP_DEG)


def test_step_is_shown_as_motion_unless_the_reader_wants_less(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "3d")
        page.emulate_media(reduced_motion="no-preference")
        start = camera(page)
        page.locator("#side").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        wait_until(
            lambda: camera(page)["azimuthDeg"] == pytest.approx(start["azimuthDeg"] + 2 * STEP_DEG), "both steps"
        )


def test_two_fingers_zoom_and_one_turns(browser: Browser, server: Server) -> None:
    context = browser.new_context(has_touch=True, viewport={"width": 390, "height": 844}, reduced_motion="reduce")
    page = context.new_page()
    visit(page, f"{server.url}/#view=3d")
    before = shown(page, "3d")["camera"]
    page.locator("#side").scroll_into_view_if_needed()
    box = box_of(page.locator("#side"))
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    devtools = context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        fingers = [{"x": px, "y": py, "id": index} for index, (px, py) in enumerate(points)]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    touch("touchStart", (x, y))
    for across in range(0, 61, 10):
        touch("touchMove", (x + across, y))
    touch("touchEnd")
    wait_until(lambda: camera(page)["azimuthDeg"] < before["azimuthDeg"] - 10, "the turn")
    assert camera(page)["zoom"] == 1
    touch("touchStart", (x - 30, y), (x + 30, y))
    for away in range(30, 91, 10):
        touch("touchMove", (x - away, y), (x + away, y))
    touch("touchEnd")
    wait_until(lambda: camera(page)["zoom"] > 2, "the zoom")
    context.close()


def test_microphones_are_numbered_when_an_array_is_large_enough(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "3d")
        numbers = {"1", "2", "3", "4"}
        page.locator("#side").focus()
        x, y = page.evaluate(AT, ["side", NORTH["position_m"]])
        page.locator("#side").hover(position={"x": x, "y": y})
        page.mouse.wheel(0, -1200)

        def has_numbers() -> bool:
            written = page.evaluate(PLAN, "side")["written"]
            return {label["text"] for label in written} >= numbers

        wait_until(has_numbers, "the numbers of the microphones")


def test_wheel_and_keys_are_the_page_s_in_an_elevation(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server, "side", width=820)
        scale = page.evaluate(PLAN, "side")["scale"]
        page.locator("#side").hover()
        top = page.evaluate("scrollY")
        page.mouse.wheel(0, -200)
        wait_until(lambda: page.evaluate("scrollY") < top, "the page's scrolling")
        assert page.evaluate(PLAN, "side")["scale"] == scale
