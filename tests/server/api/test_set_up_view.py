"""The set-up view of the dashboard in a browser: inputs, findings, and the clap test."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

from browser import box_of, faultless_page, running_browser, visit
from known_sounds import events, finish, places_m
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.types import Event
from livessl.server.app import Server
from scene_server import replay_scene
from small_site import HANG_S, running_server, site_of

pytestmark = [pytest.mark.browser]

MS = 1000 * HANG_S


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


def opened(page: Page, server: Server) -> None:
    visit(page, server.url)
    page.get_by_role("link", name="Set-up").click()
    expect(page.get_by_test_id("set-up")).to_be_visible()
    expect(page.get_by_test_id("set-up-north")).to_have_attribute("data-state", "starting", timeout=MS)


def clap(page: Page, server: Server, number: int, event: Event) -> None:
    """Type the place of a sound, press the button, and have the server finish the sound once the page waits for it."""
    for axis, metres in zip("xyz", places_m()[number], strict=True):
        page.locator(f"#clap-{axis}").fill(f"{metres:.2f}")
    with page.expect_response(lambda response: "/sounds?after=" in response.url, timeout=MS):
        page.get_by_role("button", name="Clap here").click()
    expect(page.get_by_test_id("clap-say")).to_contain_text("Clap once at", timeout=MS)
    finish(server, event)
    expect(page.get_by_test_id(f"clap-{number + 1}")).to_contain_text(re.compile("m away|not located"), timeout=MS)


def test_claps_at_measured_places_verify_the_set_up(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        for number in range(2):
            clap(page, server, number, events()[number])
            error_m = float(page.get_by_test_id(f"clap-{number + 1}").get_attribute("data-error") or "nan")
            assert error_m < 0.15
        expect(page.get_by_test_id("clap-verdict")).to_have_attribute("data-verdict", "ok")
        expect(page.get_by_test_id("clap-verdict")).to_contain_text("Clap at 2 more places")
        page.get_by_role("button", name="Start again").click()
        expect(page.get_by_test_id("clap-1")).to_have_count(0)
        expect(page.get_by_test_id("clap-verdict")).to_be_hidden()


def test_four_claps_name_what_is_wrong_and_its_cure(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        for number in range(4):
            clap(page, server, number, events((0, 2, 1, 3))[number])
        expect(page.get_by_test_id("clap-verdict")).to_have_attribute("data-verdict", "wrong")
        findings = page.get_by_test_id("clap-findings")
        expect(findings).to_contain_text("channels 2 and 3 of 'south' are swapped")
        expect(findings).to_contain_text("exchange the plugs")
        # the same sounds have been examined by the server itself
        expect(page.get_by_test_id("findings")).to_contain_text("channels 2 and 3 of 'south' are swapped", timeout=MS)


def test_a_click_on_the_plan_chooses_the_place(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        plan = page.get_by_test_id("map")
        expect(page.locator("#floor-empty")).to_be_hidden(timeout=MS)
        box = box_of(plan)
        page.wait_for_function("document.getElementById('floor').width > 300")
        plan.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        room_m = site_of().room.size_m
        for axis, size_m in zip("xy", room_m, strict=False):
            assert float(page.locator(f"#clap-{axis}").input_value()) == pytest.approx(size_m / 2, abs=0.5)
        expect(page.locator(".clap-chosen")).to_be_visible()
        page.get_by_role("button", name="Clap here").click()
        page.get_by_role("button", name="Cancel").click()
        expect(page.get_by_role("button", name="Clap here")).to_be_visible()


def test_verification_beside_another_one_is_told_and_the_next_clap_counts_both(
    browser: Browser, server: Server
) -> None:
    told = "another verification is running; try again in some seconds"
    with faultless_page(browser) as page:
        opened(page, server)
        page.route("**/set-up/verify", lambda route: route.fulfill(status=409, json={"detail": told}), times=1)
        for axis, metres in zip("xyz", places_m()[0], strict=True):
            page.locator(f"#clap-{axis}").fill(f"{metres:.2f}")
        with page.expect_response(lambda response: "/sounds?after=" in response.url, timeout=MS):
            page.get_by_role("button", name="Clap here").click()
        finish(server, events()[0])
        expect(page.get_by_test_id("clap-say")).to_have_text(told, timeout=MS)
        clap(page, server, 1, events()[1])
        expect(page.get_by_test_id("clap-1")).to_be_visible()


def test_inputs_show_their_levels_and_the_live_view_comes_back(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        expect(page.get_by_test_id("no-finding")).to_contain_text(f"Clap {LEAST_SOUNDS} times")
        replay_scene(server)
        row = page.get_by_test_id("set-up-south")
        expect(row).to_have_attribute("data-state", "healthy", timeout=MS)
        expect(row.locator(".set-up-input")).to_have_count(4)
        expect(row.locator(".set-up-dbfs").first).to_contain_text("dBFS")
        expect(page.get_by_test_id("events")).to_be_hidden()
        page.get_by_role("link", name="Live").click()
        expect(page.get_by_test_id("set-up")).to_be_hidden()
        expect(page.get_by_test_id("events")).to_be_visible()


def test_nothing_of_the_view_is_wider_than_the_window(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        clap(page, server, 0, events()[0])
        for width in (1440, 1280, 820, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth") <= width, width
