"""The dashboard of a server that requires access tokens: it asks for one, and then works like any other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from browser import faultless_page, running_browser, visit
from livessl.site.tokens import RoleName, add_token
from small_site import HANG_S, Changes, running_server, site_of

SECURED: Changes = {
    "server.http.tokens": "tokens.yaml",
    "privacy": "positions-only",
    "store": {"retention_days": 7},
}

pytestmark = [pytest.mark.browser]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


def test_dashboard_asks_once_for_the_token(browser: Browser, tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(SECURED, tmp_path)) as server, faultless_page(browser) as page:
        visit(page, server.url)
        dialog, connection = page.get_by_test_id("token-dialog"), page.get_by_test_id("connection")
        field = page.get_by_role("textbox", name="Access token")

        expect(dialog).to_be_visible()
        expect(dialog).to_contain_text("Enter your access token.")
        expect(connection).to_have_attribute("data-state", "down")

        field.fill("livessl_wrong")
        page.keyboard.press("Enter")
        expect(dialog).to_contain_text("This token is not valid.", timeout=1000 * HANG_S)

        field.fill(f" {token} ")
        page.get_by_role("button", name="Sign in").click()
        expect(connection).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(dialog).to_be_hidden()
        expect(page.get_by_test_id("array-north")).to_be_visible()
        expect(page.get_by_test_id("privacy")).to_have_text("positions only · kept 7 d")

        page.reload()
        expect(connection).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(dialog).to_be_hidden()

        with faultless_page(browser) as other_tab:  # each tab needs the token itself
            visit(other_tab, server.url)
            expect(other_tab.get_by_test_id("token-dialog")).to_be_visible()


def test_dashboard_of_an_open_server_asks_for_no_token(browser: Browser) -> None:
    with running_server(site_of()) as server, faultless_page(browser) as page:
        visit(page, server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=1000 * HANG_S)
        expect(page.get_by_test_id("token-dialog")).to_be_hidden()
        expect(page.get_by_test_id("privacy")).to_be_hidden()


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_only_operators_can_disable_an_array(browser: Browser, tmp_path: Path, role: RoleName) -> None:
    token = add_token(tmp_path / "tokens.yaml", "desk", role)
    with running_server(site_of(SECURED, tmp_path)) as server, faultless_page(browser) as page:
        visit(page, server.url)
        page.get_by_role("textbox", name="Access token").fill(token)
        page.keyboard.press("Enter")
        card, switch = page.get_by_test_id("array-north"), page.get_by_test_id("switch-north")
        expect(card).to_be_visible()
        if role == "viewer":
            expect(switch).to_be_hidden()
            return
        switch.click()
        expect(card).to_have_attribute("data-state", "disabled", timeout=1000 * HANG_S)
        answer = httpx.get(f"{server.url}/api/v1/arrays", headers={"Authorization": f"Bearer {token}"}).json()
        [reason] = [array["reason"] for array in answer["arrays"] if array["name"] == "north"]
        assert "operator" in reason
        expect(card).to_contain_text(reason)
        expect(switch).to_have_text("Enable")
        switch.click()
        expect(card).to_have_attribute("data-state", "starting", timeout=1000 * HANG_S)
