"""Sites and hubs over real NATS servers: what arrives, in which order, and what is shown of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest

from conftest import require
from hub_desk import hub_site, ids_at, make_hub, running_hub, running_site, sounds
from hub_world import running_world
from livessl.federation.schema import OneSiteEvent, SiteArrays, SiteEventPage, Sites
from nats_servers import NATS_SERVER, NatsServer, running_nats
from small_site import wait_until

if TYPE_CHECKING:
    from postgresql import PostgreSQL


@pytest.fixture(scope="module")
def nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsServer]:
    with running_nats(tmp_path_factory.mktemp("nats")) as server:
        yield server


def names(site: str, count: int) -> list[str]:
    return [f"{site}-{number}" for number in range(count)]


def wait_for(url: str, site: str, count: int) -> None:
    wait_until(lambda: len(ids_at(url, site)) >= count, f"{count} events of {site}")


def test_what_was_found_before_a_hub_existed_arrives_once_it_does(nats: NatsServer, tmp_path: Path) -> None:
    """The site starts first, restarts meanwhile, and its messages wait in its database."""
    site = hub_site(tmp_path, "lab.1", [nats.url])
    with running_site(site) as desk:
        desk.finish(*sounds("lab.1", 0, 3))
        desk.report_arrays()
        wait_until(lambda: desk.link.problem is not None and "no stream" in desk.link.problem, "the link's complaint")
    with running_hub(make_hub("hub.sqlite", [nats.url], tmp_path)) as hub, running_site(site) as desk:
        desk.finish(*sounds("lab.1", 3, 2))
        wait_for(hub.url, "lab.1", 5)
        assert ids_at(hub.url, "lab.1") == names("lab.1", 5)
        wait_until(lambda: desk.link.problem is None and not desk.outbox.unsent(1), "an empty outbox")

        def report() -> dict[str, object]:
            sites = httpx.get(f"{hub.url}/api/v1/sites").json()
            Sites.model_validate(sites)
            return next(each for each in sites["sites"] if each["site"] == "lab.1")

        wait_until(lambda: report()["status"] == "ok", "the site's report")
        assert report()["arrays"] == {"north": "healthy", "south": "healthy"}
        page = httpx.get(f"{hub.url}/api/v1/events?site=lab.1&limit=2").json()
        SiteEventPage.model_validate(page)
        assert {event["site"] for event in page["events"]} == {"lab.1"}
        one = httpx.get(f"{hub.url}/api/v1/sites/lab.1/events/lab.1-4").json()
        OneSiteEvent.model_validate(one)
        assert (one["id"], one["site"]) == ("lab.1-4", "lab.1")
        SiteArrays.model_validate(httpx.get(f"{hub.url}/api/v1/arrays").json())
        assert httpx.get(f"{hub.url}/api/v1/sites/lab.1/events/none").status_code == 404
        assert httpx.get(f"{hub.url}/api/v1/events?sit=lab").status_code == 422
        assert httpx.get(f"{hub.url}/api/v1/alerts?site=lab.1").json()["alerts"] == []  # known, and without any
        refused = httpx.get(f"{hub.url}/api/v1/events?site=lab1")
        assert (refused.status_code, "did you mean 'lab.1'?" in refused.json()["detail"]) == (404, True)
        metrics = httpx.get(f"{hub.url}/metrics").text
        assert 'livessl_site_up{site="lab.1"} 1.0' in metrics
        assert "livessl hub" in httpx.get(hub.url).text


@pytest.mark.processes
def test_each_event_arrives_once_and_in_order_through_cuts_and_deaths(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Three sites, three NATS servers and two hubs: a link is cut, a server and the hub at work are killed."""
    require(NATS_SERVER is not None, "NATS is not installed (Debian: apt install nats-server)")
    postgresql: PostgreSQL = request.getfixturevalue("postgresql")
    with running_world(tmp_path, postgresql.url()) as world:
        world.finish(20)
        world.wait_until_shown()

        world.links["lab"].cut()
        world.finish(30)
        world.wait_until_shown(("yard", "hall"))
        assert len(ids_at(world.hubs[0].url, "lab")) == 20
        assert len(world.desks["lab"].outbox.unsent(100)) >= 30
        world.links["lab"].mend()
        world.wait_until_shown()

        world.finish(10)
        world.cluster[0].kill()
        world.finish(20)
        world.wait_until_shown()
        world.cluster[0].start()

        world.finish(10)
        world.kill_the_hub_at_work()
        world.finish(10)
        world.wait_until_shown()
        assert world.stored() == world.wanted()
