"""A headless browser for tests of the dashboard."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, Error, FloatRect, Locator, Page, Request, expect, sync_playwright

from conftest import require
from small_site import HANG_S, wait_until

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""Programs that can be used, the best first: the first one has no windows, and takes half the processor time."""

INTERFACES_CHANGED = "ERR_NETWORK_CHANGED"
"""Chromium's error of requests under way when a network interface comes or goes, as it does in tests of cables."""

expect.set_options(timeout=1000 * HANG_S)


def browser_program() -> str:
    """Return the path of Chromium; skip the test, or fail it, where there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    require(found is not None, "Chromium is not installed (Debian: apt install chromium-headless-shell)")
    assert found is not None
    return found


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Start Chromium, and end it with the context."""
    program = browser_program()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@contextmanager
def faultless_page(browser: Browser) -> Iterator[Page]:
    """Open a page; the test fails if the page's code has raised an error, and then also says which requests failed."""
    page = browser.new_page()
    page.set_default_timeout(1000 * HANG_S)
    page.set_default_navigation_timeout(1000 * HANG_S)
    faults: list[str] = []
    failed: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("requestfailed", lambda request: failed.append(f"{request.url}: {request.failure}"))
    try:
        yield page
    except AssertionError as error:
        error.add_note(f"errors of the page: {faults}; requests that failed: {failed}")
        raise
    assert faults == []


def box_of(locator: Locator) -> FloatRect:
    """Wait until an element stands still, and return where: a page that draws itself anew has none in between."""
    boxes: list[FloatRect | None] = [None]

    def stands() -> bool:
        boxes.append(locator.bounding_box())
        return boxes[-1] is not None and boxes[-1] == boxes[-2]

    wait_until(stands, "an element that stands still")
    box = boxes[-1]
    assert box is not None
    return box


def visit(page: Page, url: str) -> None:
    """Open a page; again if a network interface of this machine came or went meanwhile."""
    broken = True
    while broken:
        broken = False

        def note(request: Request) -> None:
            nonlocal broken
            broken = broken or INTERFACES_CHANGED in (request.failure or "")

        page.on("requestfailed", note)
        try:
            page.goto(url)
        except Error as error:
            if INTERFACES_CHANGED not in str(error):
                raise
            broken = True
        page.remove_listener("requestfailed", note)
