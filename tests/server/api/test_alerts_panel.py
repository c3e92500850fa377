"""The alerts panel of the dashboard in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Dialog, Page, expect

from alert_desk import after, alert_site, sound
from browser import faultless_page, running_browser, visit
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event
from livessl.server.api.encode import Messages
from livessl.server.app import Server
from small_site import HANG_S, running_server, site_of, wait_until

pytestmark = [pytest.mark.browser]

LONG = "sounds-at-the-loading-dock-behind-the-second-hall"
RULES: dict[str, Any] = {
    "door": {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["run"]},
    LONG: {"events": {"min_level_dbfs": 0}, "armed": False},
}
CLIPPED = """
() => [...document.querySelectorAll(".alerts *")]
  .filter((e) => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1).map((e) => e.outerHTML)
"""
"""Script that finds elements of the panel whose text is wider than they are."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    actions = {"run": {"command": ["false"], "attempts": 1}}
    with running_server(alert_site(tmp_path, actions=actions, rules=RULES)) as server:
        yield server


def finish(server: Server, *events: Event) -> None:
    messages = Messages(server.parts.site, 0, utc=True)
    server.parts.event_log.add_final(FinalResults(events, after(*events)), messages, {})


def state(page: Page, rule: str, expected: str) -> None:
    expect(page.get_by_test_id(f"rule-{rule}")).to_have_attribute("data-state", expected, timeout=1000 * HANG_S)


def test_page_lists_rules_and_alerts_and_asks_before_it_disarms(browser: Browser, server: Server) -> None:
    with faultless_page(browser) as page:
        visit(page, server.url)
        state(page, "door", "armed")
        state(page, LONG, "disarmed")
        finish(server, sound(1))
        panel = page.get_by_test_id("alerts")
        expect(panel).to_contain_text("in zone 'door' with probability 1.00", timeout=1000 * HANG_S)
        expect(panel).to_contain_text("not delivered by run", timeout=1000 * HANG_S)
        asked: list[str] = []

        def refuse(dialog: Dialog) -> None:
            asked.append(dialog.message)
            dialog.dismiss()

        page.once("dialog", refuse)
        page.get_by_role("button", name="Disarm door").click()
        assert asked == ['Disarm "door"? It alerts nobody until it is armed again.']
        assert server.parts.alerts.states["door"].armed
        page.once("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Disarm door").click()
        state(page, "door", "disarmed")
        page.get_by_role("button", name="Arm door", exact=True).press("Enter")
        state(page, "door", "armed")
        expect(page.get_by_role("button", name="Disarm door")).to_be_focused()


def test_link_of_an_alert_opens_its_event_though_the_list_does_not_reach_so_far(
    browser: Browser, server: Server
) -> None:
    first = sound(0, power=0.02)
    finish(server, first, *(sound(number) for number in range(1, 60)))
    wait_until(lambda: server.parts.alerts.states["door"].alerts == 60, "all alerts")
    alerts = [alert for _, alert in server.parts.alerts.outbox.recent(60)]
    with faultless_page(browser) as page:
        for alert in (alerts[-1], alerts[0]):
            visit(page, alert["link"])
            row = page.locator(f'[data-event-id="{alert["event"]["id"]}"]')
            expect(row.locator(".details")).to_be_visible(timeout=1000 * HANG_S)
            expect(page.locator(".event.selected")).to_have_count(1)
        expect(page.get_by_test_id("event")).to_have_count(51)
        assert page.get_by_test_id("event").last.get_attribute("data-event-id") == first.id


def test_no_text_of_the_panel_is_clipped_at_any_width(browser: Browser, server: Server) -> None:
    finish(server, sound(1), sound(2))
    with faultless_page(browser) as page:
        visit(page, server.url)
        state(page, "door", "armed")
        expect(page.locator(".alert")).to_have_count(2, timeout=1000 * HANG_S)
        for width in (1440, 1280, 820, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.clientWidth") <= width
            assert page.evaluate(CLIPPED) == [], width
            assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_site_without_rules_has_no_panel(browser: Browser) -> None:
    with running_server(site_of()) as server, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("array-north")).to_have_attribute("data-state", "starting", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("alerts")).to_be_hidden()
