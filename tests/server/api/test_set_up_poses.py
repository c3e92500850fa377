"""The set-up view of the dashboard in a browser: poses that are measured, accepted, undone and moved by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from test_set_up_view import MS, clap, opened

from browser import box_of, faultless_page, running_browser
from known_sounds import events
from livessl.core.types import FloatArray
from livessl.server.app import Server
from livessl.site.load import load_site
from small_site import running_server, site_of, write_site

pytestmark = [pytest.mark.browser]

WRONG = {"arrays.south.orientation_deg": {"yaw": 25.0}, "arrays.south.position_m": [2.35, 3.7, 1.55]}
"""A site file whose array south is elsewhere than the sounds were recorded at."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with running_server(load_site(write_site(tmp_path, WRONG))) as server:
        yield server


def south_m(server: Server) -> FloatArray:
    return server.parts.set_up.site.array("south").microphones_m


def answer_yes(page: Page) -> list[str]:
    """Say yes to every question from now on; the questions."""
    asked: list[str] = []

    def yes(dialog: object) -> None:
        asked.append(dialog.message)  # type: ignore[attr-defined]
        dialog.accept()  # type: ignore[attr-defined]

    page.on("dialog", yes)
    return asked


def test_an_operator_is_guided_from_the_first_clap_to_accepted_poses_and_back(browser: Browser, server: Server) -> None:
    true_m, filed_m = site_of().array("south").microphones_m, south_m(server)
    with faultless_page(browser) as page:
        opened(page, server)
        asked = answer_yes(page)
        expect(page.get_by_test_id("calibration")).to_contain_text("nothing is calibrated", timeout=MS)
        expect(page.get_by_test_id("clap-suggest")).to_contain_text("Next place that helps most", timeout=MS)
        page.get_by_role("button", name="Guide me").click()
        suggested = [float(page.locator(f"#clap-{axis}").input_value()) for axis in "xyz"]
        assert all(0.0 < at < size for at, size in zip(suggested, site_of().room.size_m, strict=True))
        page.locator("#clap-std").fill("1")
        for number in range(8):
            clap(page, server, number, events()[number])
        south = page.get_by_test_id("pose-south")
        expect(south).to_have_attribute("data-determined", "true", timeout=MS)
        expect(south).to_contain_text("µs before")
        expect(page.get_by_test_id("proposal").locator("tbody tr")).to_have_count(8)
        expect(page.locator(".pose-outline")).to_have_count(2)
        assert np.array_equal(south_m(server), filed_m), "nothing is applied without a yes"

        page.get_by_role("button", name="Accept").click()
        expect(page.get_by_test_id("poses-say")).to_have_text("The new poses are in force.", timeout=MS)
        expect(page.get_by_test_id("calibration")).to_contain_text("from calibration/small.yaml, changed by claps")
        expect(page.get_by_test_id("proposal")).to_be_hidden()
        assert south_m(server) == pytest.approx(true_m, abs=0.06)
        page.get_by_role("button", name="Undo").click()
        expect(page.get_by_test_id("calibration")).to_contain_text("nothing is calibrated", timeout=MS)
        assert np.array_equal(south_m(server), filed_m)
        assert [question.split(" ")[0] for question in asked] == ["Locate", "Go"]


def test_a_proposal_that_is_not_confirmed_changes_nothing(browser: Browser, server: Server) -> None:
    before_m = south_m(server)
    with faultless_page(browser) as page:
        opened(page, server)
        page.locator("#move-array").select_option("south", timeout=MS)
        page.locator("#move-z").fill("1.2")
        page.get_by_role("button", name="Propose").click()
        expect(page.get_by_test_id("pose-south")).to_be_visible(timeout=MS)
        page.on("dialog", lambda dialog: dialog.dismiss())
        page.get_by_role("button", name="Accept").click()
        page.get_by_role("button", name="Discard").click()
        expect(page.get_by_test_id("proposal")).to_be_hidden()
    assert np.array_equal(south_m(server), before_m)


@pytest.mark.parametrize("width", [1440, 390])
def test_an_array_is_dragged_and_turned_on_the_plan(browser: Browser, server: Server, width: int) -> None:
    before_m = south_m(server)
    with faultless_page(browser) as page:
        page.set_viewport_size({"width": width, "height": 900})
        opened(page, server)
        answer_yes(page)
        page.locator("#move-array").select_option("south", timeout=MS)
        plan = page.get_by_test_id("map")
        plan.scroll_into_view_if_needed()
        handle = page.get_by_test_id("turn-handle")
        expect(handle).to_be_visible()
        outline = box_of(page.locator(".pose-outline"))
        x, y = outline["x"] + outline["width"] / 2, outline["y"] + outline["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 40, y + 40, steps=4)
        page.mouse.up()
        knob = box_of(handle)
        page.mouse.move(knob["x"] + knob["width"] / 2, knob["y"] + knob["height"] / 2)
        page.mouse.down()
        page.mouse.move(x - 40, y - 20, steps=4)  # straight above the centre: a quarter of a turn
        page.mouse.up()
        assert float(page.locator("#move-turn").input_value()) == pytest.approx(90.0, abs=5.0)
        moved_m = [float(page.locator(f"#move-{axis}").input_value()) for axis in "xyz"]
        assert all(moved_m[axis] < before_m[:, axis].mean() for axis in (0, 1))
        page.get_by_role("button", name="Propose").click()
        expect(page.get_by_test_id("pose-south")).to_contain_text("turned by", timeout=MS)
        page.get_by_role("button", name="Accept").click()
        expect(page.get_by_test_id("poses-say")).to_have_text("The new poses are in force.", timeout=MS)
        assert south_m(server).mean(axis=0) == pytest.approx(moved_m, abs=2e-3)
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_pose_outside_the_room_cannot_be_accepted_and_says_why(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        opened(page, server)
        page.locator("#move-array").select_option("south", timeout=MS)
        page.locator("#move-z").fill("7")
        page.get_by_role("button", name="Propose").click()
        expect(page.get_by_test_id("proposal-refusal")).to_contain_text("cannot be accepted", timeout=MS)
        expect(page.get_by_role("button", name="Accept")).to_be_disabled()
