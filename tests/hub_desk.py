"""A site without sound that sends what it finds to a hub, and a hub in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import yaml

from alert_desk import after, sound
from livessl.clock import Clock, SystemClock
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event
from livessl.federation.app import HubServer
from livessl.federation.config import Hub, parse_hub
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.event_log import EventLog
from livessl.server.forwarding.link import HubLink
from livessl.server.forwarding.outbox import Outbox
from livessl.server.latency import Arrivals, Latency
from livessl.server.store import Store
from livessl.service_manager import ServiceManager
from livessl.site.models import Site
from small_site import HANG_S, Changes, site_of


def hub_site(directory: Path, name: str, urls: Sequence[str], changes: Changes | None = None) -> Site:
    """The small site under another name, with a hub."""
    wanted = {"site": name, "server.events_db": f"{name}.sqlite", "server.hub.servers": list(urls)}
    return site_of({**wanted, **(changes or {})}, directory)


class SiteDesk:
    """The parts of a site's server from the final pass to the hub."""

    def __init__(self, site: Site, clock: Clock | None = None) -> None:
        self.clock = SystemClock() if clock is None else clock
        self.site = site
        self.store = Store.of(site)
        outbox = self.store.outbox
        assert outbox is not None
        self.outbox: Outbox = outbox
        self.log = EventLog(site.site, self.clock, self.store, Latency(self.clock, Arrivals()), lambda _: None, None)
        self.log.begin_live()
        self.messages = Messages(site, 0, utc=True)
        self.link = HubLink(site, self.clock, outbox, self.store.backlog, self.arrays)
        self.states = {"north": "healthy", "south": "healthy"}

    def arrays(self) -> list[JsonObject]:
        fields = {"reason": None, "node": "lab-pc", "enabled": True}
        return [{"name": name, "state": state, **fields} for name, state in self.states.items()]

    def start(self) -> None:
        self.store.backlog.start()
        self.link.start()

    def close(self) -> None:
        self.link.stop()
        self.store.close()

    def finish(self, *events: Event) -> None:
        """Let events become final."""
        self.log.add_final(FinalResults(tuple(events), after(*events)), self.messages, {})

    def report_arrays(self) -> None:
        """Publish the states of the arrays."""
        self.link.messages.take({"kind": "arrays", "now_utc": "2026-01-01T00:00:00Z", "arrays": self.arrays()})


@contextmanager
def running_site(site: Site) -> Iterator[SiteDesk]:
    """A site that sends."""
    desk = SiteDesk(site)
    desk.start()
    try:
        yield desk
    finally:
        desk.close()


def sounds(site: str, first: int, count: int) -> list[Event]:
    """Events of a site, one a second, each with a name of its own."""
    return [sound(number, event_id=f"{site}-{number}") for number in range(first, first + count)]


def hub_text(database: Path | str, urls: Sequence[str], **changes: Any) -> str:
    """A hub's file."""
    http = {"host": "127.0.0.1", "port": 0}
    return yaml.safe_dump(
        {"nats": {"servers": list(urls)}, "database": str(database), "http": http, **changes}, sort_keys=False
    )


def make_hub(database: Path | str, urls: Sequence[str], directory: Path, **changes: Any) -> Hub:
    """A hub's settings."""
    return parse_hub(hub_text(database, urls, **changes), "hub.yaml", directory)


@contextmanager
def running_hub(hub: Hub, service: ServiceManager | None = None) -> Iterator[HubServer]:
    """A hub in a thread."""
    server = HubServer(hub, SystemClock(), service)
    thread = Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(timeout=HANG_S)
        assert not thread.is_alive(), "the hub does not end"


def newest_at(url: str, site: str) -> str | None:
    """The id of a site's newest event at a hub; None if there is none."""
    return next((str(event["id"]) for event in _page(url, {"site": site, "limit": 1})["events"]), None)


def ids_at(url: str, site: str) -> list[str]:
    """The ids of a site's events at a hub, oldest first, through all pages."""
    found: list[str] = []
    cursor: str | None = None
    while True:
        page = _page(url, {"site": site, "limit": 1000, **({} if cursor is None else {"cursor": cursor})})
        found += [event["id"] for event in page["events"]]
        cursor = page["next_cursor"]
        if cursor is None:
            return found[::-1]


def _page(url: str, query: dict[str, str | int]) -> JsonObject:
    """One page of a site's events; an empty one while the hub does not know the site."""
    answer = httpx.get(f"{url}/api/v1/events", params=query, timeout=HANG_S)
    if answer.status_code == 404:
        return {"events": [], "next_cursor": None}
    page: JsonObject = answer.raise_for_status().json()
    return page
