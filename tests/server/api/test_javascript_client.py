"""The JavaScript client, in Chromium, on a page of another origin, of a server that is killed and comes back."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser

from browser import faultless_page, running_browser
from livessl.site.tokens import add_token
from other_origin import other_server
from publishing_lives import FINAL, free_port, server_lives
from small_site import HANG_S, wait_until, write_site

SHARE = 20
KILLS = 2


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


PAGE = """<!doctype html><title>another page</title><script type="module">
import { follow } from "URL/static/client.js";
globalThis.got = [];
globalThis.states = [];
follow("URL", {
  kinds: ["event"],
  token: "TOKEN",
  onMessage: (event) => got.push([event.id, event.confidence]),
  onState: (state) => states.push(state),
});
</script>"""

ALL_ARE_FINAL = "([ids, sure]) => ids.every((id) => got.some(([other, c]) => other === id && c === sure))"
"""A final answer may come by the log, after the one of a later event that came live."""


@pytest.mark.browser
@pytest.mark.processes
def test_page_gets_every_event_once_over_killed_servers(browser: Browser, tmp_path: Path) -> None:
    port, pages = free_port(), tmp_path / "pages"
    pages.mkdir()
    token = add_token(tmp_path / "tokens.yaml", "page", "viewer")
    with other_server(pages) as origin, faultless_page(browser) as page:
        changes = {
            "server.events_db": "events.sqlite",
            "server.http.port": port,
            "server.http.tokens": "tokens.yaml",
            "server.http.allowed_origins": [origin],
        }
        url = f"http://127.0.0.1:{port}"
        text = PAGE.replace("URL", url).replace("TOKEN", token)
        (pages / "index.html").write_text(text, encoding="utf-8")
        with server_lives(write_site(tmp_path, changes), followers=1) as begin:
            process = begin(SHARE)
            wait_until(lambda: answers(url), "the server")
            page.goto(origin)
            wait = partial(page.wait_for_function, timeout=1000 * HANG_S)
            wait("globalThis.got?.length > 0")
            first = page.evaluate("Math.min(...got.map(([id]) => Number(id.split('-')[1])))")
            for life in range(KILLS):
                os.kill(process, signal.SIGKILL)
                process = begin(SHARE * (life + 2))
                wait(ALL_ARE_FINAL, arg=[names_of(first, life + 2), FINAL])
            os.kill(process, signal.SIGKILL)
        got = [(name, confidence) for name, confidence in page.evaluate("got")]
        assert page.evaluate("states.filter((state) => state === 'live').length") >= KILLS + 1
    assert {answer: times for answer, times in Counter(got).items() if times > 1} == {}
    names = names_of(first, KILLS + 1)
    assert {name: confidence for name, confidence in got if name in names} == dict.fromkeys(names, FINAL)


def names_of(first: int, lives: int) -> list[str]:
    """Ids of the events of these lives, from the first one on that the page has got."""
    return [f"small-{number}" for number in range(first, SHARE * lives)]


def answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/api/v1/health").status_code == 200
    except httpx.TransportError:
        return False
