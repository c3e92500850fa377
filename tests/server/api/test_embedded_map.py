"""The embedded map in a page of another origin, with a token that may only read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from browser import faultless_page, running_browser
from livessl.site.tokens import add_token
from messages import event_message, update_message
from other_origin import other_server
from small_site import HANG_S, running_server, site_of, wait_until

PATIENCE_MS = 1000 * HANG_S


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.mark.browser
def test_map_is_shown_in_a_page_that_the_site_file_permits(browser: Browser, tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "page", "viewer")
    pages = tmp_path / "pages"
    pages.mkdir()
    with other_server(pages) as origin:
        changes = {"server.http.tokens": "tokens.yaml", "server.http.frame_ancestors": [origin]}
        with running_server(site_of(changes, tmp_path)) as server, faultless_page(browser) as page:
            for name, address in (("index", f"{server.url}/embed#token={token}"), ("bare", f"{server.url}/embed")):
                frame = (
                    f'<!doctype html><title>another</title><iframe src="{address}" width="400" height="300"></iframe>'
                )
                (pages / f"{name}.html").write_text(frame, encoding="utf-8")
            page.goto(origin)
            embedded = page.frame_locator("iframe")
            expect(embedded.locator("body")).to_have_attribute("data-state", "live", timeout=PATIENCE_MS)
            expect(embedded.locator("[data-array]")).to_have_count(2)
            expect(embedded.locator(".zone")).to_have_count(1)
            assert token not in page.frames[1].url
            wait_until(lambda: server.parts.fanout.clients == 1, "the map")
            assert server.loop is not None
            update = update_message(event_id="a")
            server.loop.call_soon_threadsafe(server.parts.fanout.publish, update)
            expect(embedded.locator(".update")).to_have_attribute("cx", "2", timeout=PATIENCE_MS)
            for name in ("a", "b"):
                event = event_message(id=name, replaces=["a"] if name == "b" else [])
                server.loop.call_soon_threadsafe(server.parts.fanout.publish, event)
            expect(embedded.locator("[data-event=b]")).to_have_attribute("cy", "2", timeout=PATIENCE_MS)
            expect(embedded.locator(".event")).to_have_count(1)
            expect(embedded.locator(".update")).to_have_count(0)
            page.goto(f"{origin}/bare.html")
            expect(embedded.get_by_test_id("notice")).to_contain_text("needs a valid token", timeout=PATIENCE_MS)


@pytest.mark.browser
def test_map_is_shown_in_no_other_page(browser: Browser, tmp_path: Path) -> None:
    with other_server(tmp_path) as origin, running_server(site_of()) as server:
        (tmp_path / "index.html").write_text(f'<iframe src="{server.url}/embed"></iframe>', encoding="utf-8")
        page = browser.new_page()
        refused: list[str] = []
        page.on("console", lambda message: refused.append(message.text))
        page.goto(origin)
        wait_until(lambda: page.evaluate("1") and any("frame-ancestors" in text for text in refused), "the refusal")
        page.close()
