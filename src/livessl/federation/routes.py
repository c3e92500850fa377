"""The REST routes of a hub: its sites, and the events, arrays, tracks and alerts of all sites."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from difflib import get_close_matches
from typing import Annotated, Any, Final

import orjson
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response

from livessl import __version__
from livessl.core.types import Status
from livessl.federation import schema
from livessl.federation.archive import Archive
from livessl.federation.intake import Intake
from livessl.schema.answers import errors
from livessl.server.api.auth import HEALTH
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.paging import cached, page_answer, paged
from livessl.server.api.queries import Time, instant, require_no_nul
from livessl.server.api.routes import as_json
from livessl.server.history.database import StoreError
from livessl.server.history.query import Query as EventQuery

_NO_SITE_TEXT: Final = "There is no site of that name: nothing has come from it yet."
_NO_SITE: Final = errors(404, 503, texts={404: _NO_SITE_TEXT})
_NO_EVENT: Final = errors(404, 503, texts={404: f"The site has no event of that id. {_NO_SITE_TEXT}"})


def hub_routes(name: str, archive: Archive, intake: Intake) -> APIRouter:
    """All routes of the API but the metrics."""
    router, chosen = APIRouter(), Depends(_chosen_site(archive))
    _add_state(router, archive, chosen)
    _add_health(router, name, archive, intake)
    _add_events(router, archive, chosen)
    _add_alerts(router, archive, chosen)
    return router


def _chosen_site(archive: Archive) -> Callable[..., str | None]:
    """The query parameter `site`.

    The answer about a site without results is an empty list. The answer about a name that is no site's is 404, as a
    server answers about a zone that it does not have. The hub has no list of sites but those that have sent a message
    or a report, so that a new site gets 404 until its first report arrives.
    """

    def chosen_site(
        site: Annotated[
            str | None,
            Query(
                max_length=64,
                description="only what comes from this site; 404 if nothing has ever come from it, see `GET sites`",
            ),
        ] = None,
    ) -> str | None:
        require_no_nul(site=site)
        if site is not None and not archive.has_site(site):
            raise _no_site(archive, site)
        return site

    return chosen_site


def _no_site(archive: Archive, name: str) -> HTTPException:
    close = get_close_matches(name, archive.site_names(), n=1)
    guess = f"did you mean {close[0]!r}? " if close else ""
    return HTTPException(404, f"no site {name!r}; {guess}GET sites lists them, each from its first message on")


def _add_state(router: APIRouter, archive: Archive, chosen: Any) -> None:
    @router.get("/api/v1/sites", tags=["state"], response_model=schema.Sites, responses=errors(503))
    def get_sites() -> Response:
        """All sites, with their condition and the time of their last contact."""
        return as_json({"v": API_VERSION, "sites": archive.sites()})

    @router.get("/api/v1/arrays", tags=["state"], response_model=schema.SiteArrays, responses=_NO_SITE)
    def get_arrays(site: str | None = chosen) -> Response:
        """The last change of each array's state."""
        return as_json({"v": API_VERSION, "arrays": archive.arrays(site)})

    @router.get("/api/v1/tracks", tags=["estimates"], response_model=schema.SiteTracks, responses=_NO_SITE)
    def get_tracks(site: str | None = chosen) -> Response:
        """The tracks that have begun and not ended, as they began."""
        return as_json({"v": API_VERSION, "tracks": archive.tracks(site)})


def _add_health(router: APIRouter, name: str, archive: Archive, intake: Intake) -> None:
    @router.get(HEALTH, tags=["state"], response_model=schema.HubHealth | schema.HubHealthStatus)
    def get_health(request: Request) -> Response:
        """Condition of the hub; without a token the status alone."""
        reasons = [] if intake.problem is None else [intake.problem]
        conditions: dict[str, int] = {}
        try:
            conditions = dict(Counter(site["status"] for site in archive.sites()))
        except StoreError as error:
            reasons.append(str(error))
        found: JsonObject = {"v": API_VERSION, "status": "degraded" if reasons else "ok"}
        if request.scope["client_role"] is not None:
            found |= {
                "hub": name,
                "version": __version__,
                "takes_in": intake.has_turn,
                "taken": intake.taken,
                "rejected": intake.rejected,
                "sites": conditions,
                "reasons": reasons,
            }
        return as_json(found)


def _filters(chosen: Any) -> Callable[..., EventQuery]:
    """The query parameters of searches: those of a site's history, and the site.

    Zones and arrays are compared by name with what the events say: each site has its own, and they change.
    """

    def filters(
        since: Annotated[Time | None, Query(description="only events that began then or later; RFC 3339")] = None,
        until: Annotated[Time | None, Query(description="only events that began then or earlier; RFC 3339")] = None,
        site: str | None = chosen,
        zone: Annotated[
            str | None,
            Query(description="only events inside a zone of this name; the sites have the lists of their zones"),
        ] = None,
        status: Annotated[Status | None, Query(description="only events of this status")] = None,
        min_confidence: Annotated[
            float | None, Query(ge=0, le=1, description="only events of at least this confidence")
        ] = None,
        array: Annotated[
            str | None,
            Query(description="only events that an array of this name detected or contributed to, at any site"),
        ] = None,
        copies: Annotated[
            bool,
            Query(description="also events for whose sound the event of a neighbouring server in the hall is shown"),
        ] = False,
    ) -> EventQuery:
        require_no_nul(zone=zone, array=array)
        return EventQuery(
            since_ns=instant("since", since),
            until_ns=instant("until", until),
            site=site,
            zone=zone,
            status=None if status is None else str(status),
            min_confidence=min_confidence,
            array=array,
            copies=copies,
        )

    return filters


def _add_events(router: APIRouter, archive: Archive, chosen: Any) -> None:
    listed: Any = paged(Depends(_filters(chosen)))

    @router.get("/api/v1/events", tags=["estimates"], response_model=schema.SiteEventPage, responses=_NO_SITE)
    def get_events(request: Request, query: EventQuery = listed) -> Response:
        """Final events of all sites, the latest start first."""
        return page_answer(request, archive.store.page(query))

    @router.get(
        "/api/v1/sites/{site}/events/{event_id}",
        tags=["estimates"],
        response_model=schema.OneSiteEvent,
        responses=_NO_EVENT,
    )
    def get_event(site: str, event_id: str, request: Request) -> Response:
        """One event of a site."""
        event = archive.event(site, event_id)
        if event is None:
            known = archive.has_site(site)
            raise HTTPException(404, f"site {site!r} has no event {event_id!r}") if known else _no_site(archive, site)
        return cached(request, orjson.dumps({"v": API_VERSION, **event}))


def _add_alerts(router: APIRouter, archive: Archive, chosen: Any) -> None:
    @router.get("/api/v1/alerts", tags=["alerts"], response_model=schema.SiteAlertPage, responses=_NO_SITE)
    def get_alerts(
        site: str | None = chosen,
        limit: Annotated[int, Query(ge=1, le=1000, description="most alerts on a page")] = 50,
        before: Annotated[int | None, Query(ge=0, lt=2**63, description="`next_before` of a page")] = None,
    ) -> Response:
        """Alerts of all sites, those that the hub received last first."""
        found = archive.alerts(site, limit, before)
        following = found[-1][0] if len(found) == limit else None
        return as_json({"v": API_VERSION, "alerts": [alert for _, alert in found], "next_before": following})
