"""End-to-end tests: real commands as processes, real sockets, a real browser."""

from __future__ import annotations

import json
import math
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import yaml
from playwright.sync_api import ConsoleMessage, Page, sync_playwright
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from browser import INTERFACES_CHANGED, browser_program, visit
from conftest import require
from livessl.clock import utc_text
from livessl.lab import demo
from livessl.lab.processes import free_port
from small_site import HANG_S, wait_until

ROOT = Path(__file__).parents[1]
LIVESSL = [sys.executable, "-m", "livessl"]
QUIET_BROWSER = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
COUNT = 4
SEED = 3
LIVE_TOLERANCE_M = 0.05
NEAR_M = 0.5
LEAD_NS = 8_000_000_000
"""Time in which both nodes start, even on a busy machine; later ones would begin late."""

pytestmark = pytest.mark.processes


@dataclass
class Session:
    """A simulated session, and a site file that plays it through two nodes."""

    directory: Path
    site: Path
    url: str
    truth: list[dict[str, Any]]

    def wavs(self) -> list[str]:
        return [part for name in ("north", "south") for part in ("--wav", f"{name}={self.directory / name}.wav")]


@dataclass
class LiveRun:
    """Everything that subscribers and the browser received in one live run."""

    messages: list[dict[str, Any]] = field(default_factory=list)
    page: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    readme_client: str = ""
    javascript_client: list[list[Any]] = field(default_factory=list)
    curl_clients: dict[str, str] = field(default_factory=dict)
    after_the_end: str = ""

    def note_error(self, message: ConsoleMessage) -> None:
        """Note what the browser's console calls an error, but for interfaces that tests of cables take away."""
        if message.type == "error" and INTERFACES_CHANGED not in message.text:
            self.problems.append(message.text)

    @property
    def events(self) -> list[dict[str, Any]]:
        return [message for message in self.messages if message["kind"] == "event"]

    @property
    def final_events(self) -> list[dict[str, Any]]:
        """The events that no later one has replaced, in order of time."""
        latest = {event["id"]: event for event in self.events}
        replaced = {old for event in latest.values() for old in event["replaces"]}
        return sorted((e for e in latest.values() if e["id"] not in replaced), key=lambda event: str(event["time_utc"]))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*LIVESSL, *arguments], capture_output=True, text=True, timeout=120, check=False)


def events_of(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    directory = tmp_path_factory.mktemp("session")
    site = yaml.safe_load(demo.SITE_FILE.read_text(encoding="utf-8"))
    endpoint, port = f"tcp://127.0.0.1:{free_port()}", free_port()
    site["server"] = {"bind": endpoint, "http": {"port": port}}
    for node in site["nodes"].values():
        node["server"] = endpoint
    path = directory / "live.yaml"
    path.write_text(yaml.safe_dump(site), encoding="utf-8")
    made = run("simulate", "--site", str(path), "--out", str(directory), "--count", str(COUNT), "--seed", str(SEED))
    assert made.returncode == 0, made.stderr
    truth = [json.loads(line) for line in (directory / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    return Session(directory, path, f"http://127.0.0.1:{port}", truth)


@pytest.fixture(scope="module")
def located(session: Session) -> str:
    done = run("locate", "--site", str(session.site), *session.wavs(), "--json")
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def live(session: Session) -> LiveRun:
    """Run a server, two nodes, a subscriber, the documented clients and a browser while the session plays once."""
    browser_program()
    seen = LiveRun()
    server = subprocess.Popen([*LIVESSL, "serve", "--site", str(session.site)])
    nodes: list[subprocess.Popen[bytes]] = []
    clients: list[subprocess.Popen[str]] = []
    try:
        wait_until(lambda: answers(session.url), "the server to answer")
        listener = Thread(target=listen, args=(session.url, seen.messages), daemon=True)
        listener.start()
        code = readme_block("python").replace("127.0.0.1:8000", session.url.removeprefix("http://"))
        reader = [sys.executable, "-u", "-c", code]
        clients.append(subprocess.Popen(reader, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        with browser_page(session, seen) as page:
            begin = utc_text(time.time_ns() + LEAD_NS)
            for node, array in (("north-pc", "north"), ("south-pc", "south")):
                wav = f"{array}={session.directory / array}.wav"
                command = [*LIVESSL, "capture", "--site", str(session.site), "--node", node]
                command += ["--wav", wav, "--start-at", begin]
                nodes.append(subprocess.Popen(command))
            watch(page, seen, nodes)
        assert [process.wait(timeout=HANG_S) for process in nodes] == [0, 0]
        seen.curl_clients = curl_examples(session)
    finally:
        for service in [*nodes, server]:
            if service.poll() is None:
                service.send_signal(signal.SIGTERM)
        assert server.wait(timeout=HANG_S) == 0
        for client in clients:
            client.send_signal(signal.SIGTERM)
            seen.readme_client, _ = client.communicate(timeout=HANG_S)
    return seen


@contextmanager
def browser_page(session: Session, seen: LiveRun) -> Iterator[Page]:
    """The dashboard in a browser, with the documented JavaScript client in it."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_program(), args=QUIET_BROWSER)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.on("console", seen.note_error)
        page.on("pageerror", lambda error: seen.problems.append(str(error)))
        visit(page, session.url)
        start_javascript_client(page, session)
        yield page
        browser.close()


def watch(page: Page, seen: LiveRun, nodes: list[subprocess.Popen[bytes]]) -> None:
    while any(node.poll() is None for node in nodes):
        seen.page.append(look(page))
        if seen.page[-1]["kind"] == "update":
            save_screenshot(page)
        time.sleep(0.2)
    wait_until(lambda: len(seen.final_events) >= COUNT, "all events")
    page.wait_for_selector('[data-testid="array-north"][data-state="lost"]', timeout=1000 * HANG_S)
    rows = {event["id"] for event in seen.final_events}
    wait_until(lambda: set(look(page)["rows"]) == rows, "all events on the page")
    seen.page.append(look(page))
    seen.javascript_client = page.evaluate("window.seenEvents")
    seen.after_the_end = page.get_by_test_id("array-south").get_attribute("data-state") or ""


def look(page: Page) -> dict[str, Any]:
    """Read the values that the page shows at this moment."""
    seen: dict[str, Any] = page.evaluate(
        """() => {
          const the = name => document.querySelector(`[data-testid="${name}"]`);
          const estimate = the("estimate");
          return {
            connection: the("connection").dataset.state,
            kind: estimate.dataset.kind,
            position_m: ["x", "y", "z"].map(axis => estimate.dataset[axis]).filter(Boolean).map(Number),
            rows: [...the("events").querySelectorAll("[data-event-id]")].map(row => row.dataset.eventId),
            north: the("array-north")?.dataset.state,
            map_time: the("map").dataset.mapTime,
          };
        }"""
    )
    return seen


def save_screenshot(page: Page) -> None:
    folder = ROOT / "test-output"
    folder.mkdir(exist_ok=True)
    page.screenshot(path=folder / "dashboard.png")


def start_javascript_client(page: Page, session: Session) -> None:
    """Run the JavaScript of the documentation in the page, and collect what it prints."""
    code = doc_block(ROOT / "docs" / "clients.md", "javascript").replace(
        "127.0.0.1:8000", session.url.removeprefix("http://")
    )
    page.evaluate(
        "code => { window.seenEvents = []; const console = {log: (...a) => window.seenEvents.push(a)};"
        " new Function('console', code)(console); }",
        code,
    )


def curl_examples(session: Session) -> dict[str, str]:
    """Run every curl line of the documentation, the one that never ends for 2 s; return its output by line."""
    require(shutil.which("curl") is not None, "curl is not installed")
    answers_of = {}
    for line in (ROOT / "docs" / "clients.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("curl "):
            command = line.replace("http://127.0.0.1:8000", session.url)
            is_endless = "/stream" in line
            if is_endless:
                command += " --max-time 2"
            done = subprocess.run(
                ["sh", "-c", command],
                cwd=session.directory,
                capture_output=True,
                text=True,
                timeout=HANG_S,
                check=False,
            )
            assert done.returncode == (28 if is_endless else 0), (line, done.stderr)
            answers_of[line] = done.stdout
    return answers_of


def doc_block(path: Path, language: str) -> str:
    block = re.search(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None, f"{path.name} has no {language} example"
    return block[1]


def readme_block(language: str) -> str:
    return doc_block(ROOT / "README.md", language)


def listen(url: str, messages: list[dict[str, Any]]) -> None:
    with connect(f"ws{url.removeprefix('http')}/api/v1/live") as live_:
        try:
            messages.extend(json.loads(text) for text in live_)
        except ConnectionClosed:
            return


def answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/api/v1/health", timeout=1):
            return True
    except OSError:
        return False


def test_locate_finds_every_sound_near_its_true_position(session: Session, located: str) -> None:
    events = events_of(located)
    assert len(events) == len(session.truth)
    for event, source in zip(events, session.truth, strict=True):
        assert event["status"] == "located"
        assert event["arrays"] == ["north", "south"]
        assert math.dist(event["position_m"], source["position_m"]) <= NEAR_M
        assert abs(event["start_s"] - source["start_s"]) <= 0.15


def test_locate_twice_gives_the_same_bytes(session: Session, located: str) -> None:
    again = run("locate", "--site", str(session.site), *session.wavs(), "--json")
    assert again.stdout == located


def test_replay_gives_the_same_events_as_locate(session: Session, located: str) -> None:
    replayed = run("replay", str(session.directory), "--site", str(session.site), "--once", "--speed", "max", "--json")
    assert replayed.returncode == 0, replayed.stderr
    offline, again = events_of(located), events_of(replayed.stdout)
    same = ("start_s", "duration_s", "position_m", "covariance_m2", "confidence", "arrays", "status", "level_dbfs")
    assert [{key: event[key] for key in same} for event in again] == [
        {key: event[key] for key in same} for event in offline
    ]
    assert again[0]["time_utc"].startswith("2026-01-01T00:00:0")


def test_live_gives_the_events_of_locate(located: str, live: LiveRun) -> None:
    offline = events_of(located)
    assert len(live.final_events) == len(offline)
    for event, expected in zip(live.final_events, offline, strict=True):
        assert event["arrays"] == expected["arrays"]
        assert math.dist(event["position_m"], expected["position_m"]) <= LIVE_TOLERANCE_M


def test_subscriber_receives_numbered_messages_of_every_kind(live: LiveRun) -> None:
    kinds = {message["kind"] for message in live.messages}
    assert kinds >= {"hello", "arrays", "update", "event", "track"}
    numbers = [message["seq"] for message in live.messages[1:]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert {message["v"] for message in live.messages} == {1}


def test_latency_of_an_event_is_the_sum_of_its_stages(live: LiveRun) -> None:
    """It includes the hang-over of 0.3 s, which ends an event; `livessl bench --live` measures how small it is."""
    staged = [event for event in live.events if event["latency_stages_s"] is not None]
    assert staged
    for event in staged:
        assert event["latency_s"] == pytest.approx(sum(event["latency_stages_s"].values()), abs=1e-3)
        assert event["latency_stages_s"]["waited"] >= 0.3


def test_page_shows_the_estimates_that_are_published(live: LiveRun) -> None:
    for kind in ("update", "event"):
        shown = [look["position_m"] for look in live.page if look["kind"] == kind and look["position_m"]]
        assert shown, f"the page never showed an {kind}"
        published = [message["position_m"] for message in live.messages if message["kind"] == kind]
        places = [position for position in published if position]
        for position in shown:
            assert min(math.dist(position, place) for place in places) <= 0.01
    assert set(live.page[-1]["rows"]) == {event["id"] for event in live.final_events}
    assert live.page[-1]["connection"] == "live"
    assert any(look["north"] == "healthy" for look in live.page)
    assert any(look["map_time"] for look in live.page)


def test_page_runs_without_errors(live: LiveRun) -> None:
    assert live.problems == []


def test_page_shows_arrays_of_ended_nodes_as_lost(live: LiveRun) -> None:
    assert live.after_the_end == "lost"


def test_client_in_the_readme_receives_the_events(live: LiveRun) -> None:
    assert len(readme_block("python").strip().splitlines()) <= 10
    lines = live.readme_client.splitlines()
    assert len(lines) == len(live.events)
    for line, event in zip(lines, live.events, strict=True):
        assert str(event["position_m"]) in line


def test_documented_javascript_receives_the_events(live: LiveRun) -> None:
    assert [entry[-1] for entry in live.javascript_client] == [event["position_m"] for event in live.events]


def test_documented_curl_lines_succeed(live: LiveRun) -> None:
    assert len(live.curl_clients) == 5
    stream = next(text for line, text in live.curl_clients.items() if "/stream" in line)
    assert '"kind":"hello"' in stream
    listed = next(json.loads(text) for line, text in live.curl_clients.items() if "/events?" in line)
    assert {event["id"] for event in listed["events"]} <= {event["id"] for event in live.events}


def test_demo_once_locates_every_sound() -> None:
    shown = run("demo", "--once", "--port", str(free_port()), "--json")
    assert shown.returncode == 0, shown.stderr
    events = {event["id"]: event for event in events_of(shown.stdout)}
    for replaced in [old for event in events.values() for old in event["replaces"]]:
        events.pop(replaced, None)
    assert len(events) == 8
    assert max(event["error_m"] for event in events.values()) <= NEAR_M
    assert "8 of 8 sounds located" in shown.stderr
