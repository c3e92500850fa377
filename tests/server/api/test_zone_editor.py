"""Zones on the dashboard in a browser: drawn, changed, deleted, and seen by another page at once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from browser import box_of, faultless_page, running_browser, visit
from livessl.server.app import Server
from livessl.site.tokens import add_token
from small_site import HANG_S, running_server, site_of, wait_until

pytestmark = [pytest.mark.browser]

RED = '<rect width="200" height="250" fill="#f00"/>'
SVG = f'<svg xmlns="http://www.w3.org/2000/svg" width="200" height="250">{RED}</svg>'
PICKED = """
([id, x, y]) => {
  const canvas = document.getElementById(id);
  return [...canvas.getContext("2d").getImageData(x * devicePixelRatio, y * devicePixelRatio, 1, 1).data];
}
"""
"""Script that reads the colour of a pixel of a canvas."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "plan.svg").write_text(SVG, encoding="utf-8")
    plan = {"image": "plan.svg", "m_per_pixel": 0.02}
    with running_server(site_of({"zones_file": "zones.yaml", "floor_plan": plan}, tmp_path)) as server:
        yield server


def zones(server: Server) -> list[str]:
    return list(server.parts.zone_book.current.zones)


def opened(page: Page, server: Server) -> None:
    visit(page, server.url)
    button = page.get_by_role("button", name="Zones")
    expect(button).to_be_visible(timeout=1000 * HANG_S)
    button.click()
    expect(page.get_by_test_id("zone-editor")).to_be_visible()


def test_operator_draws_changes_and_deletes_a_zone_and_other_pages_see_it(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page, faultless_page(browser) as other:
        opened(other, server)
        opened(page, server)
        page.get_by_label("Name").fill("desk")
        box = box_of(page.get_by_test_id("map"))
        for across, down in ((0.45, 0.45), (0.55, 0.45), (0.55, 0.55), (0.45, 0.55)):
            page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
        corners = page.get_by_label("Corners").input_value().splitlines()
        assert len(corners) == 4
        page.get_by_role("button", name="Save").click()
        wait_until(lambda: "desk" in zones(server), "the zone")
        drawn = server.parts.zone_book.current.zones["desk"]
        assert [f"{x:g}, {y:g}" for x, y in drawn.outline_m] == corners
        assert drawn.contains([*map(float, corners[0].split(",")), 1.0])
        expect(other.locator("#zone-choice option")).to_have_text(["new zone", "desk"], timeout=1000 * HANG_S)
        page.get_by_role("button", name="Zones").click()
        page.get_by_label("Zone", exact=True).select_option("desk")
        page.get_by_label("Corners").fill("1, 1\n3, 1\n2, 3")
        page.get_by_label("From z (m)").fill("0")
        page.get_by_label("To z (m)").fill("2")
        page.get_by_label("excluded").check()
        page.get_by_role("button", name="Save").press("Enter")
        wait_until(lambda: server.parts.zone_book.current.zones["desk"].exclude, "the change")
        assert server.parts.zone_book.current.zones["desk"].z_m == (0.0, 2.0)
        page.get_by_role("button", name="Zones").click()
        page.get_by_label("Zone", exact=True).select_option("desk")
        page.once("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Delete").click()
        wait_until(lambda: zones(server) == ["door"], "the end of the zone")


def test_fault_of_a_polygon_is_shown_and_the_form_stays(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        page.get_by_label("Name").fill("desk")
        page.get_by_label("Corners").fill("0, 0\n2, 2\n2, 0\n0, 2")
        page.get_by_role("button", name="Save").click()
        fault = page.get_by_role("alert").filter(has_text="crosses")
        expect(fault).to_contain_text("no edges that cross, 1-2 crosses 3-4", timeout=1000 * HANG_S)
        page.get_by_label("Corners").fill("zero, 0")
        page.get_by_role("button", name="Save").click()
        expect(page.get_by_test_id("zone-editor")).to_contain_text("expected two numbers a line")
        page.keyboard.press("Escape")
        expect(page.get_by_test_id("zone-editor")).to_be_hidden()
    assert zones(server) == ["door"]


def test_picture_lies_under_the_plan(browser: Browser, server: Server) -> None:
    """It is red and half transparent, in the middle of the room where nothing else is drawn."""
    with faultless_page(browser) as page:
        visit(page, server.url)
        box = box_of(page.get_by_test_id("map"))
        place = ["floor", box["width"] / 2 + 7, box["height"] / 2 + 7]

        def is_red() -> bool:
            red, green, blue, _ = page.evaluate(PICKED, place)
            return bool(red > green + 60 and red > blue + 60)

        wait_until(is_red, "the picture")


def test_viewer_has_no_button_to_draw(browser: Browser, tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    site = site_of({"zones_file": "zones.yaml", "server.http.tokens": "tokens.yaml"}, tmp_path)
    with running_server(site) as server, faultless_page(browser) as page:
        page.add_init_script(f"sessionStorage.setItem('livessl-token', '{token}')")
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(page.locator("#site-name")).not_to_be_empty()
        expect(page.get_by_role("button", name="Zones")).to_be_hidden()
