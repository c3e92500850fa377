"""Three sites, a cluster of NATS servers and some hubs as processes, with links that can be cut."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
from proxy import Proxy

from hub_desk import SiteDesk, hub_site, hub_text, newest_at, sounds
from livessl.clock import SystemClock
from livessl.federation.archive import Archive
from livessl.lab.processes import end, free_port, wait_until_ready
from livessl.server.history.query import Query
from nats_servers import NatsServer, running_cluster
from small_site import HANG_S, wait_until


class Link:
    """The link of one site to all servers of a cluster, which can be cut."""

    def __init__(self, stack: ExitStack, cluster: Sequence[NatsServer]) -> None:
        self._proxies = [stack.enter_context(Proxy(("127.0.0.1", server.port))) for server in cluster]
        self.urls = [f"nats://127.0.0.1:{proxy.port}" for proxy in self._proxies]

    def cut(self) -> None:
        """Let nothing pass, and end all connections."""
        for proxy in self._proxies:
            proxy.weather.cut = True
            proxy.tear()

    def mend(self) -> None:
        """Let everything pass again."""
        for proxy in self._proxies:
            proxy.weather.cut = False


class HubProcess:
    """A hub as a process."""

    def __init__(self, folder: Path, number: int, database: str, urls: Sequence[str], replicas: int = 3) -> None:
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        path = folder / f"hub{number}.yaml"
        path.write_text(hub_text(database, urls, http={"port": port}, stream={"replicas": replicas}), encoding="utf-8")
        command = [sys.executable, "-m", "livessl", "hub", "--config", str(path)]
        with (folder / f"hub{number}.log").open("wb") as log:
            self.process = subprocess.Popen(command, stderr=log)

    def takes_in(self) -> bool:
        """Whether it is the one that takes messages in."""
        return bool(httpx.get(f"{self.url}/api/v1/health", timeout=HANG_S).json()["takes_in"])

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.wait(timeout=HANG_S)


class HubWorld:
    """Sites in this process, and the servers and hubs that they send to."""

    def __init__(self, folder: Path, stack: ExitStack, database: str, names: Sequence[str], hubs: int = 2) -> None:
        self.cluster = stack.enter_context(running_cluster(folder / "nats"))
        self.database = database
        urls = [server.url for server in self.cluster]
        self.hubs = [HubProcess(folder, number, database, urls) for number in range(hubs)]
        stack.callback(lambda: end([hub.process for hub in self.hubs]))
        self.links = {name: Link(stack, self.cluster) for name in names}
        self.desks = {name: SiteDesk(hub_site(folder, name, link.urls)) for name, link in self.links.items()}
        for desk in self.desks.values():
            desk.start()
            stack.callback(desk.close)
        for hub in self.hubs:
            wait_until_ready(hub.url, [hub.process], SystemClock())
        self.sent = dict.fromkeys(names, 0)

    def finish(self, count: int, names: Sequence[str] = ()) -> None:
        """Let events become final, one at a time, at all sites or at some."""
        for name in names or self.desks:
            for event in sounds(name, self.sent[name], count):
                self.desks[name].finish(event)
            self.sent[name] += count

    def shown(self, names: Sequence[str] = ()) -> bool:
        """Whether every hub shows the last event of each site, or of some of them."""
        return all(
            newest_at(hub.url, name) == f"{name}-{self.sent[name] - 1}"
            for hub in self.hubs
            for name in names or self.desks
        )

    def wait_until_shown(self, names: Sequence[str] = ()) -> None:
        """Return when every hub shows the last event of each site."""
        wait_until(lambda: self.shown(names), f"the last events of {', '.join(names or self.desks)}")

    def kill_the_hub_at_work(self) -> None:
        """Kill the hub that takes messages in."""
        wait_until(lambda: any(hub.takes_in() for hub in self.hubs), "a hub at work")
        hub = next(hub for hub in self.hubs if hub.takes_in())
        self.hubs.remove(hub)
        hub.kill()

    def stored(self) -> dict[str, list[str]]:
        """The ids of each site's events, in the order in which they were stored."""
        archive = Archive(self.database, SystemClock())
        try:
            assert {site["missing"] for site in archive.sites()} == {0}
            found = {}
            for name in self.desks:
                rows = [row for page in archive.store.scan(Query(site=name)) for row in page]
                found[name] = [row.event["id"] for row in sorted(rows, key=lambda row: row.number)]
            return found
        finally:
            archive.close()

    def wanted(self) -> dict[str, list[str]]:
        """The ids of all events that the sites have sent, in order."""
        return {name: [f"{name}-{number}" for number in range(count)] for name, count in self.sent.items()}


@contextmanager
def running_world(folder: Path, database: str, names: Sequence[str] = ("lab", "yard", "hall")) -> Iterator[HubWorld]:
    """Run everything until the context ends."""
    with ExitStack() as stack:
        yield HubWorld(folder, stack, database, names)
