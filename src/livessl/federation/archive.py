"""Stores what a hub keeps of its sites (events, tracks, arrays, alerts): each message exactly once and in order.

The number of the last message that was taken in from each outbox is in the database, and is raised in the transaction
that stores the message. So it does not matter how often a message comes, and to which hub.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import orjson
from sqlalchemy import Connection, bindparam, case, delete, insert, select, text, tuple_, update

from livessl.clock import Clock, utc_ns
from livessl.federation.gaps import Gaps
from livessl.federation.halls import Halls
from livessl.federation.overview import Contact, describe
from livessl.federation.storing import Delivery, Taken, put, read
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import first_number
from livessl.server.forwarding.tables import alerts, arrays, received, sites, tracks
from livessl.server.history.database import RejectedError, StoreError
from livessl.server.store import Store

LOCK: Final = 0x11_7E_55_2
"""Number of the PostgreSQL lock of the hub that takes messages in, so that the others wait."""

_RAISE: Final = (
    update(received)
    .where(received.c.site == bindparam("of_site"), received.c.outbox == bindparam("of_outbox"))
    .where(received.c.last < bindparam("number"))
    .values(last=bindparam("number"))
)
_HEARD: Final = (
    update(sites)
    .where(sites.c.site == bindparam("of_site"))
    .values(
        contact_ns=bindparam("now_ns"),
        missing=sites.c.missing + bindparam("more"),
        newest_ns=case((sites.c.newest_ns < bindparam("newest"), bindparam("newest")), else_=sites.c.newest_ns),
    )
)

_REPORTED: Final = update(sites).where(sites.c.site == bindparam("of_site")).values(report=bindparam("body"))

_log = logging.getLogger(__name__)


class Archive:
    """The hub's database; every thread may call it.

    Every method raises `StoreError` if the database cannot be used.

    Parameters
    ----------
    place : Path or str
        SQLite file, or URL of a PostgreSQL database.
    clock : Clock
    halls : Halls or None
        Decides which sites are in which hall; None for no halls.
    """

    def __init__(self, place: Path | str, clock: Clock, halls: Halls | None = None) -> None:
        self.store = Store(place, forwards=True)
        """The history of events; the id of an event is `SITE/ID` there."""
        self._database = self.store.database
        self._clock = clock
        self._gaps = Gaps()
        self.halls = Halls({}) if halls is None else halls

    def expire(self, before_ns: int, end: threading.Event | None = None) -> int:
        """Delete events and alerts from before a time; return the number of events."""
        gone = self.store.expire(before_ns, end)
        with self._database.writing("delete old alerts") as connection:
            connection.execute(delete(alerts).where(alerts.c.time_ns < max(before_ns, 0)))
        return gone

    def close(self) -> None:
        """Release the database."""
        self.store.close()

    # --- what comes in

    def take(self, deliveries: Sequence[Delivery], patience_s: float) -> Taken:
        """Store messages that are next in their outbox.

        Parameters
        ----------
        deliveries : sequence of Delivery
        patience_s : float
            Time, in seconds, for which messages of an outbox wait for earlier ones; then these are counted as missing.
            Only the time in which messages could be stored counts (`Gaps`).

        Returns
        -------
        Taken
            `early` are messages whose predecessors have not come yet.
        """
        try:
            return self._take(deliveries, patience_s)
        except RejectedError as error:
            if len(deliveries) == 1:
                return self._skip(deliveries[0], str(error))
        except StoreError:
            raise
        except Exception as error:  # noqa: BLE001 - no message may hold up the others
            if len(deliveries) == 1:
                _log.debug("a message that cannot be taken in", exc_info=True)
                return self._skip(deliveries[0], f"{type(error).__name__}: {error}")
        together = Taken([], [], [])
        for delivery in _in_order(deliveries):
            for all_of_them, some in zip(together, self.take([delivery], patience_s), strict=True):
                all_of_them += some
        return together

    def _take(self, deliveries: Sequence[Delivery], patience_s: float) -> Taken:
        taken = Taken([], [], [])
        now_ns = self._clock.monotonic_ns()
        with self._database.writing(f"store {len(deliveries)} messages of sites") as connection:
            places = {(each.site, each.place.outbox) for each in deliveries}
            last = _locked(connection, places)
            missing: dict[str, int] = {}
            batch: list[tuple[str, str, JsonObject]] = []
            for delivery in _in_order(deliveries):
                key = delivery.site, delivery.place.outbox
                gap = delivery.place.number - last[key] - 1
                if gap < 0:
                    taken.done.append(delivery)
                    continue
                if gap > 0 and self._gaps.seen_s(key, last[key], now_ns) < patience_s:
                    taken.early.append(delivery)
                    continue
                message = read(delivery, self.halls)
                if message is None:
                    taken.rejected.append(delivery)
                else:
                    batch.append((delivery.site, delivery.kind, message))
                    taken.done.append(delivery)
                missing[delivery.site] = missing.get(delivery.site, 0) + gap
                last[key] = delivery.place.number
            put(connection, batch, self.halls)
            raised = [{"of_site": site, "of_outbox": box, "number": number} for (site, box), number in last.items()]
            connection.execute(_RAISE, raised)
            newest: dict[str, int] = {}
            for site, kind, message in batch:
                if kind == "event":
                    newest[site] = max(newest.get(site, 0), utc_ns(message["time_utc"]))
            self._touch(connection, {site for site, _ in places}, missing, newest)
        self._gaps.note(last, {(each.site, each.place.outbox) for each in taken.early}, now_ns)
        return taken

    def _skip(self, delivery: Delivery, reason: str) -> Taken:
        """Note that a message cannot be stored, so that its successors do not wait for it."""
        number, key = delivery.place.number, (delivery.site, delivery.place.outbox)
        _log.error("site %r: message %d is left out: %s", delivery.site, number, " ".join(reason.split()))
        try:
            with self._database.writing("skip a message") as connection:
                gap = number - _locked(connection, {key})[key] - 1
                raised = {"of_site": delivery.site, "of_outbox": delivery.place.outbox, "number": number}
                connection.execute(_RAISE, [raised])
                self._touch(connection, {delivery.site}, {delivery.site: max(0, gap)}, {})
        except RejectedError:  # not even the name of its site or outbox can be stored
            _log.debug("a message whose place cannot be stored", exc_info=True)
        return Taken([], [], [delivery])

    def note_reports(self, reports: Mapping[str, JsonObject]) -> None:
        """Keep the newest reports of sites on themselves; one that is refused holds up no other."""
        if not reports:
            return
        try:
            with self._database.writing(f"store the reports of {', '.join(sorted(reports)[:3])}") as connection:
                self._touch(connection, set(reports), {}, {})
                bodies = [{"of_site": site, "body": orjson.dumps(reports[site]).decode()} for site in sorted(reports)]
                connection.execute(_REPORTED, bodies)
        except Exception as error:  # whatever a report does to the code, it holds up no other
            if isinstance(error, StoreError) and not isinstance(error, RejectedError):
                raise
            if len(reports) == 1:
                _log.error("a report is left out: %s", error)
                return
            for site, report in reports.items():
                self.note_reports({site: report})

    def _touch(
        self, connection: Connection, names: set[str], missing: Mapping[str, int], newest: Mapping[str, int]
    ) -> None:
        """Note for sites that messages came now, how many are missing, and when their newest events began."""
        known = set(connection.execute(select(sites.c.site).where(sites.c.site.in_(names))).scalars())
        now_ns = self._clock.now_ns()
        rows = [
            {
                "site": site,
                "contact_ns": now_ns,
                "missing": missing.get(site, 0),
                "newest_ns": newest.get(site, 0),
            }
            for site in sorted(names)
        ]
        new = [{**row, "report": "{}"} for row in rows if row["site"] not in known]
        if new:
            connection.execute(insert(sites), new)
        if known:
            heard = [
                {"of_site": row["site"], "now_ns": now_ns, "more": row["missing"], "newest": row["newest_ns"]}
                for row in rows
            ]
            connection.execute(_HEARD, [row for row in heard if row["of_site"] in known])

    # --- which hub takes messages in

    @contextmanager
    def turn(self) -> Iterator[Turn | None]:
        """Try to be the one hub that takes messages in, while the context lasts; yield None if another one is.

        The hubs of an SQLite file are not kept apart; there should be one only.
        """
        if not self._database.is_remote:
            yield Turn(None)
            return
        with self._database.session() as connection:
            if connection.execute(text("SELECT pg_try_advisory_lock(:number)"), {"number": LOCK}).scalar():
                try:
                    yield Turn(connection)
                finally:
                    connection.execute(text("SELECT pg_advisory_unlock(:number)"), {"number": LOCK})
            else:
                yield None

    # --- what is asked for

    def sites(self) -> list[JsonObject]:
        """Return all sites, by name, with their condition and the time of their last contact.

        The states of a site's arrays are those of its last report, which names all of them; before the first one they
        are those of the messages. So one row is read for each site, and not one for each array as well.
        """
        with self._database.reading() as connection:
            contacts = self._contacts(connection)
            silent = [contact.site for contact in contacts if not contact.states]
            states = _array_states(connection, silent) if silent else {}
        return [describe(contact, contact.states or states.get(contact.site, {})) for contact in contacts]

    def has_site(self, name: str) -> bool:
        """Return whether a message or a report of the site has ever come."""
        if "\0" in name:  # PostgreSQL cannot compare it
            return False
        with self._database.reading() as connection:
            return connection.execute(select(sites.c.site).where(sites.c.site == name)).scalar() is not None

    def site_names(self) -> list[str]:
        """Return the names of all sites, in order."""
        with self._database.reading() as connection:
            return list(connection.execute(select(sites.c.site).order_by(sites.c.site)).scalars())

    def contacts(self) -> list[Contact]:
        """Return all sites, by name, without the messages about their arrays."""
        with self._database.reading() as connection:
            return self._contacts(connection)

    def _contacts(self, connection: Connection) -> list[Contact]:
        columns = sites.c.site, sites.c.contact_ns, sites.c.missing, sites.c.newest_ns, sites.c.report
        rows = connection.execute(select(*columns).order_by(sites.c.site)).all()
        now_ns = self._clock.now_ns()
        return [
            Contact(site, max(0.0, (now_ns - contact_ns) / 1e9), contact_ns, missing, newest_ns, orjson.loads(report))
            for site, contact_ns, missing, newest_ns, report in rows
        ]

    def event(self, site: str, event_id: str) -> JsonObject | None:
        """Return an event of a site, None if there is none of that id."""
        return self.store.get(f"{site}/{event_id}")

    def arrays(self, site: str | None) -> list[JsonObject]:
        """Return the last states of the arrays, of all sites or of one."""
        return self._bodies(arrays, site, arrays.c.name)

    def tracks(self, site: str | None) -> list[JsonObject]:
        """Return the tracks that have begun and not ended, of all sites or of one."""
        return self._bodies(tracks, site, tracks.c.id)

    def _bodies(self, table: Any, site: str | None, order: Any) -> list[JsonObject]:
        query = select(table.c.body).order_by(table.c.site, order)
        if site is not None:
            query = query.where(table.c.site == site)
        with self._database.reading() as connection:
            return [orjson.loads(body) for body in connection.execute(query).scalars()]

    def alerts(self, site: str | None, limit: int, before: int | None) -> list[tuple[int, JsonObject]]:
        """Return alerts, the newest first, each with its number; those before a number, if one is given."""
        query = select(alerts.c.number, alerts.c.body).order_by(alerts.c.number.desc()).limit(limit)
        if site is not None:
            query = query.where(alerts.c.site == site)
        if before is not None:
            query = query.where(alerts.c.number < before)
        with self._database.reading() as connection:
            return [(number, orjson.loads(body)) for number, body in connection.execute(query)]


class Turn:
    """The right of one hub to take messages in; it ends with the connection that holds it."""

    def __init__(self, connection: Connection | None) -> None:
        self._connection = connection

    def check(self) -> None:
        """Raise an error of SQLAlchemy if the connection is gone, and the right with it."""
        if self._connection is not None:
            self._connection.execute(text("SELECT 1"))


def _in_order(deliveries: Sequence[Delivery]) -> list[Delivery]:
    return sorted(deliveries, key=lambda each: (each.site, each.place))


def _locked(connection: Connection, places: set[tuple[str, str]]) -> dict[tuple[str, str], int]:
    """Return the number of the last message of each outbox, which no other hub changes until the transaction ends."""
    columns = received.c.site, received.c.outbox
    query = select(*columns, received.c.last).where(tuple_(*columns).in_(sorted(places))).order_by(*columns)
    last = {(row.site, row.outbox): int(row.last) for row in connection.execute(query.with_for_update())}
    new = sorted(places - last.keys())
    if new:  # another hub that does the same at this moment makes this one fail, and try again
        begins = {(site, box): first_number(box) - 1 for site, box in new}
        rows = [{"site": site, "outbox": box, "last": before} for (site, box), before in begins.items()]
        connection.execute(insert(received), rows)
        last |= begins
    return last


def _array_states(connection: Connection, names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the last state of each array by site and name, for the sites of these names."""
    states: dict[str, dict[str, str]] = {}
    for site, body in connection.execute(select(arrays.c.site, arrays.c.body).where(arrays.c.site.in_(names))):
        array = orjson.loads(body)
        states.setdefault(site, {})[array["name"]] = array["state"]
    return states
