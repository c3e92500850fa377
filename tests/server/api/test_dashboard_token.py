"""The dashboard of a server with tokens asks for one once per tab, and then works as without."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from playwright.sync_api import expect, sync_playwright

from conftest import require
from livessl.site.keys import RoleName, add_token
from small_site import Changes, running_server, site_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SECURED: Changes = {
    "server.http.tokens": "tokens.yaml",
    "privacy": "positions-only",
    "store": {"retention_days": 7},
}

pytestmark = [pytest.mark.browser]


def test_dashboard_asks_once_for_the_token(tmp_path: Path) -> None:
    require(CHROMIUM is not None, "Chromium is not installed (Debian: apt install chromium)")
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(SECURED, tmp_path)) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        faults: list[str] = []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(server.url)
        dialog, connection = page.get_by_test_id("token-dialog"), page.get_by_test_id("connection")

        expect(dialog).to_be_visible()
        expect(dialog).to_contain_text("This server tells only those who have a token.")
        expect(connection).to_have_attribute("data-state", "down")

        page.get_by_role("textbox", name="Token").fill("livessl_wrong")
        page.keyboard.press("Enter")
        expect(dialog).to_contain_text("The server does not know this token.", timeout=10_000)

        page.get_by_role("textbox", name="Token").fill(f" {token} ")
        page.get_by_role("button", name="Show me").click()
        expect(connection).to_have_attribute("data-state", "live", timeout=10_000)
        expect(dialog).to_be_hidden()
        expect(page.get_by_test_id("array-north")).to_be_visible()
        expect(page.get_by_test_id("privacy")).to_have_text("positions only · kept 7 d")

        page.reload()
        expect(connection).to_have_attribute("data-state", "live", timeout=10_000)
        expect(dialog).to_be_hidden()

        stranger = browser.new_context().new_page()  # another tab has a session and needs a token of its own
        stranger.goto(server.url)
        expect(stranger.get_by_test_id("token-dialog")).to_be_visible()
        browser.close()
    assert faults == []


def test_dashboard_of_an_open_server_asks_for_nothing() -> None:
    require(CHROMIUM is not None, "Chromium is not installed (Debian: apt install chromium)")
    with running_server(site_of()) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        page.goto(server.url)
        expect(page.get_by_test_id("connection")).to_have_attribute("data-state", "live", timeout=10_000)
        expect(page.get_by_test_id("token-dialog")).to_be_hidden()
        expect(page.get_by_test_id("privacy")).to_be_hidden()
        browser.close()


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_operators_disable_an_array_with_one_click(tmp_path: Path, role: RoleName) -> None:
    require(CHROMIUM is not None, "Chromium is not installed (Debian: apt install chromium)")
    token = add_token(tmp_path / "tokens.yaml", "desk", role)
    with running_server(site_of(SECURED, tmp_path)) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        page.goto(server.url)
        page.get_by_role("textbox", name="Token").fill(token)
        page.keyboard.press("Enter")
        card, switch = page.get_by_test_id("array-north"), page.get_by_test_id("switch-north")
        expect(card).to_be_visible()
        if role == "viewer":
            expect(switch).to_be_hidden()
        else:
            switch.click()
            expect(card).to_have_attribute("data-state", "disabled", timeout=10_000)
            expect(card).to_contain_text("an operator has disabled it, and its sound is not used")
            expect(switch).to_have_text("Enable")
            switch.click()
            expect(card).to_have_attribute("data-state", "starting", timeout=10_000)
        browser.close()
