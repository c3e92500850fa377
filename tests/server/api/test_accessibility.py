"""Every page and panel against the rules of WCAG 2 at the levels A and AA, as axe-core checks them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest
from axe_playwright_python.base import AXE_FILE_PATH
from playwright.sync_api import Browser, Page, expect

from alert_desk import after, alert_site, sound
from browser import faultless_page, running_browser, visit
from clip_desk import recordings
from hub_desk import make_hub, running_hub
from livessl.clock import utc_text
from livessl.core.stream.final_pass import FinalResults
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.app import Server
from livessl.server.array_states import ArrayStates
from livessl.server.clips.folder import ClipFolder
from livessl.server.overload import Overload
from livessl.site.tokens import Role, add_token
from messages import START_NS, event_message, update_message
from scene_server import replay_scene
from small_site import HANG_S, SMALL, running_server, site_of, wait_until

pytestmark = [pytest.mark.browser]

MS: Final = 1000 * HANG_S
RULES: Final = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]
OF_COLOURS: Final = ["color-contrast"]
"""The rules on colours: in the other colours, the page is the same to all others."""

BLOCKING: Final = {"serious", "critical"}
LOOKS: Final = [("light", 1440), ("dark", 1440), ("dark", 390), ("light", 390)]

VIOLATIONS: Final = """
async (rules) => {
  const { violations } = await axe.run(document, {
    runOnly: rules, resultTypes: ["violations"], iframes: false, preload: false,
  });
  return violations.flatMap(({ id, impact, nodes }) => nodes.map(({ target, html, any, all, none }) => ({
    id, impact, target: target.join(" "), html: html.slice(0, 160),
    why: [...any, ...all, ...none].map(({ message }) => message).join("; "),
  })));
}
"""
"""Script that returns each element that violates a rule."""

STATES: Final = {"north": "healthy", "south": "degraded", "east": "lost", "west": "disabled"}
"""State that each array of the site is given: one of each colour."""

FINDINGS: Final = [
    {
        "kind": "finding",
        "fault": fault,
        "array": "south",
        "channel": 2,
        "input": 6,
        "severity": severity,
        "confidence": 0.9,
        "message": "channels 2 and 3 of 'south' are swapped",
        "cure": "exchange the plugs of inputs 6 and 7",
    }
    for fault, severity in (("swapped", "error"), ("hum", "warning"), ("aliasing", "info"))
]
BLIND_SPOTS: Final = [
    {
        "kind": "blind_spot",
        "fault": "moved",
        "arrays": ["north", "south"],
        "least_m": 0.8,
        "least_deg": None,
        "along": [1.0, 0.0, 0.0],
        "message": "these sounds cannot show whether 'north' or 'south' is moved by less than 0.8 m along (1.00, …)",
        "cure": "clap at places that you know, and run livessl calibrate verify",
    }
]


@dataclass(frozen=True)
class Desk:
    """A server with something in every panel, and the token of each role."""

    server: Server
    tokens: dict[str, str]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    folder = tmp_path_factory.mktemp("site")
    tokens = {str(role): add_token(folder / "tokens.yaml", str(role), str(role)) for role in Role}  # type: ignore[arg-type]
    site = alert_site(
        folder,
        {
            "arrays": {
                **SMALL["arrays"],
                "east": {**SMALL["arrays"]["north"], "position_m": [3.2, 1.0, 1.4]},
                "west": {**SMALL["arrays"]["north"], "position_m": [0.8, 4.1, 1.4]},
            },
            "nodes.lab-pc.arrays": {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]},
            "zones_file": "zones.yaml",
            "zones.fan": {"bounds_m": [[3, 4], [0, 1], [0, 3]], "exclude": True},
            "privacy": "recording",
            "store": {"retention_days": 30000},
            "server.clips": {"folder": "clips", "max_age_days": None},
            "server.http.tokens": "tokens.yaml",
        },
        actions={"run": {"command": ["false"], "attempts": 1}},
        rules={
            "door": {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["run"]},
            "loud": {"events": {"min_level_dbfs": 0}, "armed": False},
        },
    )
    ClipFolder(folder / "clips").put(
        "small-past-3", recordings(START_NS, {"enhanced.flac": b"", "array-north.flac": b""})
    )
    with pytest.MonkeyPatch.context() as patch, running_server(site) as server:
        patch.setattr(ArrayStates, "describe", _in_chosen_states(ArrayStates.describe))
        patch.setattr(Overload, "message", property(lambda _: "overloaded: it sheds some updates"))
        _fill(server)
        yield Desk(server, tokens)


def _in_chosen_states(describe: Any) -> Any:
    """Describe the arrays as they are, but for their states."""

    def described(self: ArrayStates, *, levels: bool = True) -> list[JsonObject]:
        arrays: list[JsonObject] = describe(self, levels=levels)
        for array in arrays:
            state = STATES[array["name"]]
            array.update(state=state, enabled=state != "disabled")
            array["reason"] = None if state == "healthy" else "no data for 3.1 s; check its cable"
            if levels:
                array.update(level_dbfs=-31.0, noise_floor_dbfs=-62.0, activity_threshold_dbfs=-50.0)
                array.update(channel_levels_dbfs=[-31.0, -33.0, -30.0, None], active=state == "healthy")
                array["counters"] = {**array["counters"], "lost_frames": 3}
        return arrays

    return described


def _fill(server: Server) -> None:
    """Give a server past events of each status, one with recordings, and an alert that was not delivered."""
    messages = Messages(server.parts.site, 0, utc=True)
    kinds: list[dict[str, Any]] = [
        {"status": "refused", "reason": "no direction stands out in the sound", "position_m": None},
        {"status": "direction-only", "reason": "one array detected it"},
        {"zones": ["door", "fan"], "excluded_by": ["fan"], "confidence": 0.93},
        {"confidence": 0.4},
    ]
    past = []
    for number, kind in enumerate(kinds):
        at_ns = START_NS + number * 60_000_000_000
        contributions = [
            {"array": name, "asked": name == "south", "active_s": 0.4, "level_dbfs": -30.0, "azimuth_deg": 12.0}
            | {"elevation_deg": 3.0, "distance_m": 2.0, "agrees": name == "north", "off_deg": 4.0}
            for name in ("north", "south")
        ]
        event = {"id": f"small-past-{number}", "time_utc": utc_text(at_ns), "contributions": contributions, **kind}
        past.append((event_message(**event), at_ns))
    server.parts.store.add_all(past)
    alerting = sound(1)
    server.parts.event_log.add_final(FinalResults((alerting,), after(alerting)), messages, {})
    wait_until(lambda: server.parts.alerts.outbox.dead(1), "the alert that was not delivered")


def opened(page: Page, url: str, token: str | None = None) -> None:
    """Open a page on which axe-core is loaded, with a token."""
    page.add_init_script(path=AXE_FILE_PATH)
    if token is not None:
        page.add_init_script(f"sessionStorage.setItem('livessl-token', '{token}')")
    visit(page, url)


def violations(page: Page, what: str) -> list[str]:
    """What blocks people on the page as it is, at each look."""
    found = []
    for scheme, width in LOOKS:
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
        faults = page.evaluate(VIOLATIONS, RULES if scheme == "light" else OF_COLOURS)
        found += [f"{what}, {scheme}, {width} px: {fault}" for fault in faults if fault["impact"] in BLOCKING]
    return found


def test_axe_finds_what_blocks_people(browser: Browser) -> None:
    """The check itself can fail: pale text on white, a control without a name, a picture without a text."""
    with faultless_page(browser) as page:
        page.add_init_script(path=AXE_FILE_PATH)
        page.goto(
            "data:text/html,<html lang=en><title>t</title><main><p style='color:%23aaa;background:%23fff'>pale</p>"
            "<button></button><img src=''></main>"
        )
        found = {fault["id"] for fault in page.evaluate(VIOLATIONS, RULES) if fault["impact"] in BLOCKING}
    assert found == {"color-contrast", "button-name", "image-alt"}


@pytest.mark.parametrize("role", ["operator", "viewer", "admin"])
def test_live_page_of_each_role(browser: Browser, desk: Desk, role: str) -> None:
    server = desk.server
    with faultless_page(browser) as page:
        opened(page, f"{server.url}/#event=small-past-3", desk.tokens[role])
        row = page.locator("[data-event-id=small-past-3]")
        expect(row.locator(".details")).to_contain_text("Contribution of each array", timeout=MS)
        expect(row.get_by_test_id("clips")).to_have_attribute("data-state", "stored", timeout=MS)
        expect(page.get_by_test_id("array-east")).to_have_attribute("data-state", "lost", timeout=MS)
        expect(page.get_by_test_id("alerts")).to_contain_text("not delivered by run", timeout=MS)
        expect(page.get_by_test_id("overload")).to_be_visible(timeout=MS)
        zones = page.get_by_role("button", name="Zones")
        if role == "viewer":
            expect(zones).to_be_hidden()
        else:
            zones.click()
            expect(page.get_by_test_id("zone-editor")).to_be_visible()
            row.get_by_role("button", name="Listen: Array north").click()
            expect(row.get_by_test_id("clip-audio")).to_be_visible(timeout=MS)
        assert server.loop is not None
        server.loop.call_soon_threadsafe(server.parts.fanout.publish, update_message())
        expect(page.get_by_test_id("estimate")).to_have_attribute("data-x", "2", timeout=MS)
        assert violations(page, f"live page of the {role}") == []


@pytest.mark.parametrize("view", ["front", "3d"])
def test_other_views_of_the_room(browser: Browser, desk: Desk, view: str) -> None:
    with faultless_page(browser) as page:
        opened(page, f"{desk.server.url}/#view={view}", desk.tokens["viewer"])
        expect(page.locator("#side-panel")).to_have_attribute("data-view", view, timeout=MS)
        expect(page.get_by_test_id("array-east")).to_have_attribute("data-state", "lost", timeout=MS)
        if view == "3d":
            page.locator("#side").focus()
            page.keyboard.press("ArrowRight")
            expect(page.locator("#side-pointer")).to_contain_text("azimuth")
        assert violations(page, f"view {view}") == []


def answer_with(page: Page, path: str, **answer: Any) -> None:
    """Have requests of a page answered without the server."""
    page.route(f"**/api/v1/{path}", lambda route: route.fulfill(json={"v": 1, **answer}))


@pytest.mark.parametrize("role", ["operator", "viewer"])
def test_set_up_view_of_each_role(browser: Browser, desk: Desk, role: str) -> None:
    with faultless_page(browser) as page:
        answer_with(page, "findings", sounds=3, least_sounds=3, findings=FINDINGS, blind_spots=BLIND_SPOTS)
        opened(page, f"{desk.server.url}/#set-up", desk.tokens[role])
        expect(page.get_by_test_id("findings")).to_contain_text("exchange the plugs", timeout=MS)
        expect(page.get_by_test_id("blind-spots")).to_contain_text("note these sounds cannot show", timeout=MS)
        expect(page.get_by_test_id("set-up-east")).to_have_attribute("data-state", "lost", timeout=MS)
        expect(page.locator("#move-array")).to_contain_text("south", timeout=MS)
        if role == "operator":
            _clap(page)
            page.locator("#move-array").select_option("south")
            page.locator("#move-x").fill("2.5")
            page.get_by_role("button", name="Propose").click()
            expect(page.get_by_test_id("proposal")).to_be_visible(timeout=MS)
        assert violations(page, f"set-up view of the {role}") == []


def _clap(page: Page) -> None:
    """Clap once at a place; the server's answers are those to a clap that was found elsewhere."""
    place_m = [1.0, 1.0, 1.2]
    place = {"place_m": place_m, "position_m": [2.0, 1.0, 1.2], "error_m": 1.0, "reason": None}
    clap = {"number": 2, "time_utc": "2999-01-01T00:00:00Z", "observations": [{"sharpness": 9.0}], **place}
    answer_with(page, "sounds?*", last=2, now_utc="2026-01-01T00:00:00Z", sounds=[clap])
    verdict = {"verdict": "wrong", "claps": [place], "findings": FINDINGS, "next_place_m": [3.0, 3.0, 1.2]}
    answer_with(page, "set-up/verify", **verdict)
    for axis, metres in zip("xyz", place_m, strict=True):
        page.locator(f"#clap-{axis}").fill(str(metres))
    page.get_by_role("button", name="Clap here").click()
    expect(page.get_by_test_id("clap-verdict")).to_be_visible(timeout=MS)


def test_history(browser: Browser, desk: Desk) -> None:
    with faultless_page(browser) as page:
        opened(page, f"{desk.server.url}/history#event=small-past-3", desk.tokens["viewer"])
        expect(page.locator("#details-small-past-3")).to_contain_text("Contribution of each array", timeout=MS)
        expect(page.get_by_test_id("heat-text")).to_contain_text("events", timeout=MS)
        found = violations(page, "history")
        page.route("**/api/v1/events?*", lambda route: route.fulfill(status=503, json={"detail": "it is away"}))
        page.get_by_label("Text").fill("nothing")
        expect(page.get_by_test_id("banner")).to_be_visible(timeout=MS)
        page.locator("[name=min_level_dbfs]").fill("300")
        assert found + violations(page, "history that could not be read") == []


def test_map_for_other_pages(browser: Browser, desk: Desk) -> None:
    with faultless_page(browser) as page:
        opened(page, f"{desk.server.url}/embed")
        expect(page.get_by_test_id("notice")).to_contain_text("needs a valid token", timeout=MS)
        found = violations(page, "embedded map without a token")
        page.goto("about:blank")
        page.goto(f"{desk.server.url}/embed#token={desk.tokens['viewer']}")
        expect(page.locator("body")).to_have_attribute("data-state", "live", timeout=MS)
        expect(page.locator("[data-array]")).to_have_count(4, timeout=MS)
        assert found + violations(page, "embedded map") == []


def test_dialog_for_the_token_and_pages_without_a_server(browser: Browser, desk: Desk) -> None:
    with faultless_page(browser) as page:
        opened(page, desk.server.url)
        expect(page.get_by_test_id("token-dialog")).to_be_visible(timeout=MS)
        found = violations(page, "dialog for the token")
        with running_server(site_of()) as server:
            visit(page, server.url)
            replay_scene(server)
            expect(page.get_by_test_id("event")).to_have_count(2, timeout=MS)
        expect(page.get_by_test_id("banner")).to_contain_text("Server unreachable", timeout=MS)
        expect(page.get_by_test_id("array-north")).to_have_attribute("data-state", "unknown")
        assert found + violations(page, "live page without its server") == []


def test_page_of_a_hub(browser: Browser, tmp_path: Path) -> None:
    """The hub has no NATS server: what it would show of its sites stands in its answers."""
    states = ["ok", "starting", "degraded", "away"]
    sites = [
        {"site": name, "status": status, "arrays": {"north": "healthy", "south": "lost"}, "age_s": 3.0}
        | {"newest_event_utc": utc_text(START_NS), "location_deg": [52.5, 13.4]}
        for name, status in zip(("lab", "yard", "hall", "a-site-with-a-long-name-in-the-north"), states, strict=True)
    ]
    copy = {"site": "hall", "id": "hall-1"}
    with running_hub(make_hub("hub.sqlite", ["nats://127.0.0.1:9"], tmp_path)) as hub, faultless_page(browser) as page:
        answer_with(page, "sites", sites=sites)
        answer_with(
            page,
            "events?*",
            events=[event_message(site="lab", copies=[copy]), event_message(site="yard", id="small-2")],
        )
        opened(page, hub.url)
        expect(page.get_by_test_id("sites").get_by_role("row")).to_have_count(4, timeout=MS)
        expect(page.get_by_test_id("events").get_by_role("row")).to_have_count(2, timeout=MS)
        expect(page.get_by_test_id("events").get_by_text("lab, also hall")).to_be_visible(timeout=MS)
        assert violations(page, "hub") == []
