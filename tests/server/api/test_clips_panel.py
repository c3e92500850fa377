"""The recordings in an event's details, in a browser that plays them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Dialog, Page, expect

from browser import faultless_page, running_browser, visit
from livessl.server.app import Server
from livessl.server.store import Query
from livessl.site.tokens import add_token
from scene_server import capture, capture_scene
from small_site import HANG_S, Changes, running_server, site_of, wait_until
from voice_scene import voiced

pytestmark = [pytest.mark.browser, pytest.mark.usefixtures("nothing_is_shed")]

CLIPS: Changes = {"server.clips": {"folder": "clips"}, "server.http.tokens": "tokens.yaml"}
CLIPPED = """
() => [...document.querySelectorAll(".clips *")]
  .filter((e) => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1).map((e) => e.outerHTML)
"""
"""Script that finds elements of the recordings whose text is wider than they are."""

DRAWN = """
const usual = CanvasRenderingContext2D.prototype.fillText;
window.drawn = [];
CanvasRenderingContext2D.prototype.fillText = function (text, ...more) {
  window.drawn = [...window.drawn.slice(-999), text];
  usual.call(this, text, ...more);
};
"""
"""Script that notes the texts that are drawn on canvases."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def tokens(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    directory = tmp_path_factory.mktemp("site")
    return directory, {role: add_token(directory / "tokens.yaml", role, role) for role in ("viewer", "operator")}


@pytest.fixture(scope="module")
def server(tokens: tuple[Path, dict[str, str]]) -> Iterator[Server]:
    with running_server(site_of(CLIPS, tokens[0])) as server:
        capture_scene(server)
        clips = server.parts.clips
        assert clips is not None
        wait_until(lambda: clips.counts.written == 2, "both clips")
        yield server


def sign_in(page: Page, server: Server, token: str) -> None:
    visit(page, server.url)
    page.get_by_label("Access token").fill(token)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_test_id("event")).to_have_count(2, timeout=1000 * HANG_S)
    page.get_by_test_id("event").first.locator(".summary").click()
    expect(page.get_by_test_id("clips").first).to_have_attribute("data-state", "stored", timeout=1000 * HANG_S)


def test_operator_listens_keeps_and_deletes(
    browser: Browser, server: Server, tokens: tuple[Path, dict[str, str]]
) -> None:
    with faultless_page(browser) as page:
        sign_in(page, server, tokens[1]["operator"])
        enhanced = page.get_by_test_id("clip-enhanced.flac")
        expect(enhanced).to_contain_text("Enhanced, at the place found")
        enhanced.get_by_role("button", name="Listen").click()
        audio = enhanced.get_by_test_id("clip-audio")
        expect(audio).to_be_visible(timeout=1000 * HANG_S)
        page.wait_for_function(
            "e => e.readyState >= 3 && e.duration > 0.5 && e.error === null",
            arg=audio.element_handle(),
            timeout=1000 * HANG_S,
        )
        with page.expect_download(timeout=1000 * HANG_S) as saved:
            page.get_by_test_id("clip-array-north.flac").get_by_role("button", name="Save").click()
        assert saved.value.suggested_filename.endswith("-array-north.flac")
        assert saved.value.path().read_bytes()[:4] == b"fLaC"
        for width in (1440, 1280, 820, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate(CLIPPED) == [], width
        page.get_by_role("button", name="Keep for ever").click()
        kept = page.get_by_role("button", name="Keep no longer")
        expect(kept).to_have_attribute("aria-pressed", "true", timeout=1000 * HANG_S)
        asked: list[str] = []

        def refuse(dialog: Dialog) -> None:
            asked.append(dialog.message)
            dialog.dismiss()

        page.once("dialog", refuse)
        page.get_by_role("button", name="Delete the recordings").click()
        assert asked == ["Delete the recordings of this event? The event itself stays."]
        expect(kept).to_be_visible()
        page.once("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Delete the recordings").click()
        expect(page.get_by_test_id("clips").first).to_have_attribute("data-state", "none", timeout=1000 * HANG_S)
        assert server.parts.clips is not None
        assert server.parts.clips.folder.figures.count == 1


def test_viewer_sees_what_there_is_and_gets_no_button(
    browser: Browser, server: Server, tokens: tuple[Path, dict[str, str]]
) -> None:
    with faultless_page(browser) as page:
        visit(page, server.url)
        page.get_by_label("Access token").fill(tokens[1]["viewer"])
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_test_id("event")).to_have_count(2, timeout=1000 * HANG_S)
        page.get_by_test_id("event").last.locator(".summary").click()
        clips = page.get_by_test_id("clips").last
        expect(clips).to_contain_text("Sign in as an operator to listen.", timeout=1000 * HANG_S)
        expect(clips.get_by_role("button")).to_have_count(0)
        assert server.parts.clips is not None
        event_id = server.parts.clips.folder.ids()[0]  # of the oldest event, which is the last of the list
        about = tokens[0] / "clips" / event_id / "clip.json"
        whole = about.read_bytes()
        about.write_bytes(whole[:100])
        page.reload()
        expect(page.get_by_test_id("event")).to_have_count(2, timeout=1000 * HANG_S)
        page.get_by_test_id("event").last.locator(".summary").click()
        problem = page.get_by_test_id("clip-problem")
        expect(problem).to_contain_text("cannot be read. event", timeout=1000 * HANG_S)
        expect(problem).to_contain_text("it is not JSON")
        for width in (1440, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate(CLIPPED) == [], width
        about.write_bytes(whole)  # for the other tests


def test_operator_locates_an_event_again_and_sees_both_answers(
    browser: Browser, server: Server, tokens: tuple[Path, dict[str, str]]
) -> None:
    with faultless_page(browser) as page:
        page.add_init_script(DRAWN)
        visit(page, server.url)
        page.get_by_label("Access token").fill(tokens[1]["operator"])
        page.get_by_role("button", name="Sign in").click()
        event = page.get_by_test_id("event").last
        event.locator(".summary").click(timeout=1000 * HANG_S)
        form = event.get_by_role("form", name="Locate again")
        expect(form).to_be_visible(timeout=1000 * HANG_S)
        method = form.get_by_label("Method")
        expect(method.get_by_role("option")).to_have_text(["onset", "srp-phat", "cepstral", "averaged"])
        expect(method).to_have_value("srp-phat")
        form.get_by_role("button", name="Locate").click()
        rows = form.get_by_role("row")
        expect(rows.nth(1)).to_have_text("methodonsetsrp-phat", timeout=1000 * HANG_S)
        expect(rows.nth(2)).to_have_text("statuslocatedlocated")
        expect(form.get_by_role("status")).to_contain_text("The positions are 0.")
        page.wait_for_function("() => window.drawn.includes('again: srp-phat')", timeout=1000 * HANG_S)
        for width in (1440, 1280, 820, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate(CLIPPED) == [], width
        event.locator(".summary").click()  # closes it: its marks go
        page.locator("h1").hover()
        page.wait_for_function(
            "() => { const before = window.drawn; window.drawn = []; return before.length && "
            "!before.includes('again: srp-phat'); }",
            timeout=1000 * HANG_S,
        )
        page.route("**/relocate", lambda route: route.fulfill(status=503, json={"detail": "the server is overloaded"}))
        event.locator(".summary").click()
        form.get_by_role("button", name="Locate").click()
        expect(form.get_by_role("status")).to_have_text("Not located: the server is overloaded", timeout=1000 * HANG_S)
        expect(form.get_by_role("table")).to_have_count(0)


def test_event_with_speech_says_in_words_why_it_has_no_recordings(browser: Browser, tmp_path: Path) -> None:
    site = site_of({"server.clips": {"folder": "clips"}, "privacy": "no-speech"}, tmp_path)
    with running_server(site) as server, faultless_page(browser) as page:
        capture(server, voiced)
        clips = server.parts.clips
        assert clips is not None
        wait_until(lambda: clips.counts.with_speech, "the examination for speech")
        visit(page, server.url)
        expect(page.get_by_test_id("privacy")).to_have_text("no speech", timeout=1000 * HANG_S)
        page.get_by_test_id("event").first.locator(".summary").click(timeout=1000 * HANG_S)
        missing = page.get_by_test_id("clip-missing").first
        expect(missing).to_have_text(
            "There are no recordings: speech was detected, and privacy: no-speech stores no recordings of it.",
            timeout=1000 * HANG_S,
        )
        event_id = server.parts.store.find(Query())[0][0]["id"]
        answer = httpx.get(f"{server.url}/api/v1/events/{event_id}/clips/best", timeout=HANG_S)
        assert (answer.status_code, "speech was detected" in answer.text) == (404, True)
        for width in (1440, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate(CLIPPED) == [], width
