"""The page `/docs`: it shows the API in a browser without any request to another server."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from browser import running_browser, visit
from livessl.server.api import documentation
from livessl.site.tokens import add_token
from small_site import HANG_S, Changes, running_server, site_of


@pytest.mark.browser
@pytest.mark.parametrize("tokens", [False, True])
def test_page_shows_the_api_and_asks_no_other_server(tmp_path: Path, tokens: bool) -> None:
    changes: Changes = {"server.http.tokens": "tokens.yaml"} if tokens else {}
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of(changes, tmp_path)) as server, running_browser() as browser:
        page = browser.new_page()
        requests: list[str] = []
        faults: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        if tokens:
            page.add_init_script(f"sessionStorage.setItem('livessl-token', '{token}')")
        visit(page, f"{server.url}/docs")
        expect(page.locator("#operations-estimates-get_events_api_v1_events_get")).to_be_visible(timeout=1000 * HANG_S)
        page.locator("#operations-estimates-get_tracks_api_v1_tracks_get .opblock-summary-control").click()
        page.get_by_role("button", name="Try it out").click()
        page.get_by_role("button", name="Execute").click()
        expect(page.locator(".live-responses-table tbody .response-col_status").first).to_contain_text("200")
        assert faults == []
        assert len(requests) >= 5
        outside = [url for url in requests if not url.startswith((f"{server.url}/", "data:"))]
        assert outside == []


def test_page_may_be_loaded_without_a_token_but_the_description_may_not(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of({"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        for path in ("/docs", "/docs/start.js", "/docs/swagger-ui.css", "/docs/swagger-ui-bundle.js"):
            response = httpx.get(f"{server.url}{path}")
            assert response.status_code == 200, path
            assert "unsafe" not in response.headers["Content-Security-Policy"]
        assert httpx.get(f"{server.url}/api/v1/openapi.json").status_code == 401


def test_nothing_else_is_served_there() -> None:
    with running_server(site_of()) as server:
        for name in ("index.html", "redoc.standalone.js", "..%2fapp.py", "../app.py", "favicon.png"):
            assert httpx.get(f"{server.url}/docs/{name}").status_code == 404, name


def test_without_the_viewer_the_page_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documentation, "viewer_files", lambda: None)
    with running_server(site_of()) as server:
        response = httpx.get(f"{server.url}/docs")
        assert response.status_code == 404
        assert "pip install 'livessl[api-docs]'" in response.json()["detail"]
        assert httpx.get(f"{server.url}/docs/swagger-ui.css").status_code == 404
