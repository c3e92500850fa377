"""The history's page in a browser: filters, list, heat map, exports, and its layout on screens of several sizes."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from browser import faultless_page, running_browser, visit
from livessl.clock import utc_text
from livessl.server.app import Server
from livessl.site.tokens import add_token
from messages import event_message
from small_site import HANG_S, running_server, site_of

pytestmark = [pytest.mark.browser]

COUNT = 120
START_NS = 1_767_225_600_000_000_000
ZONES = {"zones.door": {"bounds_m": [[0, 1], [0, 5], [0, 3]]}}
OVERFLOWING = """
() => [...document.querySelectorAll("body *")].filter((e) => {
  const style = getComputedStyle(e);
  const isCut = e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 1 && style.overflowX !== "auto";
  const box = e.getBoundingClientRect();
  return !e.closest(".visually-hidden, .skip, select, option") && (isCut || box.right > innerWidth + 1);
}).map((e) => e.outerHTML.slice(0, 200))
"""
"""Script that finds elements whose content is wider than they are, or that reach beyond the window."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A server with a history: event k began k minutes after the start, every third one near the door."""
    with running_server(site_of(ZONES)) as server:
        fill(server)
        yield server


def fill(server: Server) -> None:
    events = []
    for k in range(COUNT):
        at_ns, door = START_NS + 60_000_000_000 * k, k % 3 == 0
        event = event_message(
            id=f"small-{k}",
            time_utc=utc_text(at_ns),
            confidence=k / COUNT,
            position_m=[0.6, 1.1, 1.0] if door else [3.1, 4.2, 1.0],
            zones=["door"] if door else [],
            status="refused" if k == 1 else "located",
            reason="no direction stands out in the sound" if k == 1 else None,
        )
        events.append((event, at_ns))
    server.parts.store.add_all(events)


def first_event(page: Page, event_id: str) -> None:
    """Expect an event at the head of the list."""
    row = page.get_by_test_id("event").first
    expect(row).to_have_attribute("data-event-id", event_id, timeout=1000 * HANG_S)


def test_filters_change_list_heat_map_and_address(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history")
        first_event(page, "small-119")
        expect(page.get_by_test_id("heat-text")).to_have_text("120 events", timeout=1000 * HANG_S)
        expect(page.locator("#ramp-text")).to_have_text("events: 1 → 80")
        page.get_by_label("Zone").select_option("door")
        first_event(page, "small-117")
        expect(page.get_by_test_id("heat-text")).to_have_text("40 events", timeout=1000 * HANG_S)
        page.get_by_label("Confidence at least").select_option("0.8")
        expect(page.get_by_test_id("event")).to_have_count(8, timeout=1000 * HANG_S)  # 96, 99, ... 117
        assert re.search(r"/history\?zone=door&min_confidence=0\.8$", page.url)
        page.reload()  # the address has the filters
        expect(page.get_by_test_id("event")).to_have_count(8, timeout=1000 * HANG_S)
        expect(page.get_by_label("Zone")).to_have_value("door")
        page.get_by_role("button", name="Clear").click()
        first_event(page, "small-119")
        page.get_by_label("Text").fill("STANDS out")
        first_event(page, "small-1")
        expect(page.get_by_test_id("event")).to_contain_text("refused: no direction stands out in the sound")
        page.get_by_label("Text").fill("nothing of that kind")
        expect(page.locator("#events-empty")).to_have_text("No event matches these filters", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("heat-text")).to_have_text("0 events", timeout=1000 * HANG_S)


def test_time_span_is_in_the_browsers_time_zone(browser: Browser, server: Server) -> None:
    context = browser.new_context(timezone_id="Asia/Tokyo")
    page = context.new_page()
    visit(page, f"{server.url}/history")
    first_event(page, "small-119")
    page.get_by_label("To", exact=True).fill("2026-01-01T09:10:00")  # ten minutes after midnight in UTC
    first_event(page, "small-10")
    assert "until=2026-01-01T00%3A10%3A00.000Z" in page.url
    page.get_by_role("button", name="Last hour").click()
    expect(page.get_by_test_id("event")).to_have_count(0, timeout=1000 * HANG_S)
    context.close()


def test_pages_go_to_older_events_and_back(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history")
        older, newer = (page.get_by_role("button", name=name) for name in ("Older", "Newer"))
        first_event(page, "small-119")
        expect(newer).to_be_disabled()
        older.click()
        first_event(page, "small-69")
        older.click()
        first_event(page, "small-19")
        expect(page.get_by_test_id("event")).to_have_count(20)
        expect(older).to_be_disabled()
        newer.click()
        first_event(page, "small-69")
        newer.click()
        first_event(page, "small-119")


def test_selected_event_is_marked_on_the_plan(browser: Browser, server: Server) -> None:
    """The marker changes the picture where the event was, and the address can name the event."""
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history#event=small-117")
        expect(page.locator("#details-small-117")).to_be_visible(timeout=1000 * HANG_S)
        expect(page.locator("#details-small-117")).to_contain_text("small-117")
        expect(page.get_by_test_id("heat-text")).to_have_text("120 events", timeout=1000 * HANG_S)
        picture = "() => document.getElementById('floor').toDataURL()"
        marked = page.evaluate(picture)
        page.get_by_test_id("event").nth(2).get_by_role("button").press("Enter")  # closes it
        page.get_by_label("Text").focus()
        page.wait_for_function(f"before => ({picture})() !== before", arg=marked, timeout=1000 * HANG_S)


def test_refused_export_says_what_is_wrong_with_each_part(browser: Browser, server: Server) -> None:
    faults = [
        {"loc": ["query", name], "msg": f"Value error, {name} is wrong", "type": "x"} for name in ("since", "zone")
    ]
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history")
        page.route("**/events.csv*", lambda route: route.fulfill(status=422, json={"detail": faults}))
        page.get_by_role("button", name="CSV").click()
        expect(page.get_by_test_id("banner")).to_have_text(
            "The history could not be read: since is wrong; zone is wrong", timeout=1000 * HANG_S
        )


def test_export_is_saved_as_a_file(browser: Browser, server: Server, tmp_path: Path) -> None:
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history?zone=door")
        first_event(page, "small-117")
        with page.expect_download() as saved:
            page.get_by_role("button", name="CSV").click()
        assert saved.value.suggested_filename == "small-events.csv"
        saved.value.save_as(tmp_path / "events.csv")
    with (tmp_path / "events.csv").open(newline="") as file:
        assert [row["id"] for row in csv.DictReader(file)] == [f"small-{k}" for k in range(117, -1, -3)]


def test_error_of_the_server_is_told(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, f"{server.url}/history?text={'x' * 300}")  # the control holds 200
        page.route("**/api/v1/events?*", lambda route: route.fulfill(status=503, json={"detail": "it is away"}))
        page.get_by_label("Text").fill("abc")
        expect(page.get_by_test_id("banner")).to_have_text(
            "The history could not be read: it is away", timeout=1000 * HANG_S
        )
        page.unroute("**/api/v1/events?*")
        page.get_by_role("button", name="Clear").click()
        first_event(page, "small-119")
        expect(page.get_by_test_id("banner")).to_be_hidden()


def test_page_asks_for_a_token(browser: Browser, tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    http = {"host": "127.0.0.1", "port": 0, "tokens": "tokens.yaml"}
    with running_server(site_of({**ZONES, "server.http": http}, tmp_path)) as server, faultless_page(browser) as page:
        fill(server)
        visit(page, f"{server.url}/history")
        dialog = page.get_by_test_id("token-dialog")
        expect(dialog).to_be_visible(timeout=1000 * HANG_S)
        dialog.get_by_label("Access token").fill(token)
        dialog.get_by_role("button", name="Sign in").click()
        first_event(page, "small-119")
        expect(page.get_by_test_id("banner")).to_be_hidden()
        with page.expect_download() as saved:
            page.get_by_role("button", name="JSON Lines").click()
        assert len(Path(saved.value.path()).read_text().splitlines()) == COUNT


@pytest.mark.parametrize("width", [1440, 1280, 820, 390])
def test_nothing_is_cut_off(browser: Browser, server: Server, width: int) -> None:
    with faultless_page(browser) as page:
        page.set_viewport_size({"width": width, "height": 900})
        visit(page, f"{server.url}/history#event=small-117")
        expect(page.locator("#details-small-117")).to_be_visible(timeout=1000 * HANG_S)
        expect(page.get_by_test_id("heat-text")).to_have_text("120 events", timeout=1000 * HANG_S)
        assert page.evaluate(OVERFLOWING) == []


def test_dashboard_leads_to_the_history_and_back(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, server.url)
        page.get_by_role("link", name="History").click()
        first_event(page, "small-119")
        page.get_by_role("link", name="Live").click()
        expect(page.get_by_test_id("connection")).to_be_visible(timeout=1000 * HANG_S)
        assert page.url.rstrip("/") == server.url
