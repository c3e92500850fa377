"""The dashboard in a browser: it shows what the server reports, and derives no state of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Route, expect

from browser import faultless_page, running_browser, visit
from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.server.app import Server
from livessl.server.overload import Overload
from small_site import HANG_S, running_server, scene_recordings, site_of

pytestmark = [pytest.mark.browser]

LEVEL_BAR_DBFS = -96.0
"""Level at the left end of the page's level bars; the right end is 0 dBFS."""

ADD_AFTER_HELLO = """
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    const add = ({ data }) => {
      if (typeof data !== "string" || JSON.parse(data).kind !== "hello") return;
      this.removeEventListener("message", add);
      setTimeout(() => this.dispatchEvent(new MessageEvent("message", { data: %s })));
    };
    this.addEventListener("message", add);
  }
};
"""
"""Script that hands the page one more message behind the server's greeting."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def replayed() -> Iterator[Server]:
    """A server that has replayed the small scene."""
    with running_server(site_of()) as server:
        replay_scene(server)
        yield server


def replay_scene(server: Server) -> None:
    """Replay the small scene through a running server, to its end."""
    send_session(site_of(), server.endpoint, scene_recordings(0), UnpacedClock(), SystemClock(), "run-1", lambda: False)
    server.wait_idle()


def arrays_of(server: Server) -> list[dict[str, Any]]:
    arrays: list[dict[str, Any]] = httpx.get(f"{server.url}/api/v1/arrays").json()["arrays"]
    return arrays


@pytest.mark.parametrize("floor_factor", [4.0, 100.0])
def test_page_draws_the_threshold_that_the_server_reports(browser: Browser, floor_factor: float) -> None:
    with (
        running_server(site_of({"activity.floor_factor": floor_factor})) as server,
        faultless_page(browser) as page,
    ):
        replay_scene(server)
        visit(page, server.url)
        for array in arrays_of(server):
            threshold_dbfs = array["activity_threshold_dbfs"]
            line = page.get_by_test_id(f"threshold-{array['name']}")
            expect(line).to_have_attribute("data-dbfs", str(threshold_dbfs), timeout=1000 * HANG_S)
            left_percent = float(line.evaluate("line => line.style.left").removesuffix("%"))
            assert left_percent == pytest.approx(100 * (1 - threshold_dbfs / LEVEL_BAR_DBFS), abs=0.01)
            expect(page.get_by_test_id(f"array-{array['name']}")).to_contain_text(f"threshold −{-threshold_dbfs:.0f}")


def test_page_draws_no_threshold_before_the_noise_is_known(browser: Browser) -> None:
    with running_server(site_of()) as server, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("array-north")).to_have_attribute("data-state", "starting", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("threshold-north")).to_be_hidden()
        expect(page.get_by_test_id("array-north")).to_contain_text("no data yet")


def test_page_shows_the_server_s_states_after_a_replay_has_ended(browser: Browser) -> None:
    """The server keeps a replay's end for inspection, so the arrays do not age after it."""
    with running_server(site_of()) as server, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        replay_scene(server)
        cards = [page.get_by_test_id(f"array-{array['name']}") for array in arrays_of(server)]
        for card in cards:
            expect(card).to_have_attribute("data-state", "healthy", timeout=1000 * HANG_S)
        page.wait_for_timeout(2_500)  # longer than the silence of 1.5 s after which an array is lost
        assert [array["state"] for array in arrays_of(server)] == ["healthy", "healthy"]
        for card in cards:
            expect(card).to_have_attribute("data-state", "healthy")
            expect(card).to_contain_text("0.")  # seconds since its last data
        expect(page.locator("#vital-arrays")).to_have_text("2 of 2 healthy")
        expect(page.locator("#vital-clock-label")).to_have_text("recording time")


def test_page_tells_an_overload_and_its_end(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_server(site_of()) as server, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("array-north")).to_have_attribute("data-state", "starting", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("overload")).to_be_hidden()
        with monkeypatch.context() as patch:
            patch.setattr(Overload, "message", property(lambda _: "overloaded: it sheds some updates"))
            expect(page.get_by_test_id("overload")).to_have_text(
                "Server overloaded: it sheds some updates", timeout=1000 * HANG_S
            )
        expect(page.get_by_test_id("overload")).to_be_hidden(timeout=1000 * HANG_S)


def test_page_claims_no_state_while_the_server_is_unreachable(browser: Browser) -> None:
    with faultless_page(browser) as page:
        with running_server(site_of()) as server:
            visit(page, server.url)
            expect(page.get_by_test_id("array-north")).to_have_attribute(
                "data-state", "starting", timeout=1000 * HANG_S
            )
        expect(page.get_by_test_id("banner")).to_contain_text("Server unreachable; reconnecting", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("connection")).to_have_text("offline")
        expect(page.get_by_test_id("array-north")).to_have_attribute("data-state", "unknown")
        expect(page.get_by_test_id("array-north")).to_contain_text("was starting")


@pytest.mark.parametrize("name", ["app.js", "model.js", "base.css"])
def test_page_loads_again_if_a_file_of_it_did_not_arrive(browser: Browser, replayed: Server, name: str) -> None:
    """A browser may ask for a style sheet again by itself; for a module the page must be loaded again."""
    failed: list[str] = []

    def fail(route: Route) -> None:
        failed.append(route.request.url)
        route.abort()

    with faultless_page(browser) as page:
        page.route(f"**/static/{name}", fail, times=1)
        visit(page, replayed.url)
        page.wait_for_function(
            "count => document.querySelectorAll('[data-testid=event]').length === count"
            " && document.styleSheets.length > 5"
            " && document.styleSheets.length === document.querySelectorAll('link[rel=stylesheet]').length",
            arg=2,
            timeout=1000 * HANG_S,
        )
        expect(page.get_by_test_id("incomplete")).to_be_hidden()
    assert len(failed) == 1


@pytest.mark.parametrize(
    ("missed", "notice"),
    [
        (37, "37 messages skipped (the client was too slow); event list reloaded"),
        (1, "1 message skipped (the client was too slow); event list reloaded"),
        (None, "Some messages skipped (the client was too slow); event list reloaded"),
    ],
)
def test_page_reports_skipped_messages(browser: Browser, replayed: Server, missed: int | None, notice: str) -> None:
    gap = {"kind": "gap", "missed": missed, "reason": "the client was too slow"}
    with faultless_page(browser) as page:
        page.add_init_script(ADD_AFTER_HELLO % json.dumps(json.dumps(gap)))
        visit(page, replayed.url)
        expect(page.get_by_test_id("gap")).to_contain_text(notice, timeout=1000 * HANG_S)
        expect(page.get_by_test_id("event")).to_have_count(2)
        page.get_by_role("button", name="Dismiss").click()
        expect(page.get_by_test_id("gap")).to_be_hidden()


def test_page_opens_an_event_s_details(browser: Browser, replayed: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, replayed.url)
        rows = page.get_by_test_id("event")
        expect(rows).to_have_count(2, timeout=1000 * HANG_S)
        expect(rows.first.locator(".details")).to_be_hidden()
        rows.first.get_by_role("button").click()
        details = rows.first.locator(".details")
        expect(details).to_contain_text("detected by")
        expect(details).to_contain_text("Contribution of each array")
        expect(details.get_by_role("row")).to_have_count(3)  # the heads and two arrays
        page.keyboard.press("Escape")
        expect(details).to_be_hidden()


@pytest.mark.parametrize("width", [360, 390, 900, 1280, 1440])
def test_page_fits_its_window(browser: Browser, replayed: Server, width: int) -> None:
    with faultless_page(browser) as page:
        page.set_viewport_size({"width": width, "height": 800})
        visit(page, replayed.url)
        expect(page.get_by_test_id("event")).to_have_count(2, timeout=1000 * HANG_S)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
