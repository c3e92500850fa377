"""What a hub keeps of its sites, in one database that several hubs may share: each message is taken in once, in order.

The number of the last message that was taken in from each outbox is in the database, and is raised in the transaction
that stores the message. So it does not matter how often a message comes, and to which hub.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import orjson
from sqlalchemy import Connection, bindparam, case, delete, insert, select, text, tuple_, update

from livessl.clock import Clock, utc_ns, utc_text
from livessl.federation.received import RECEIVED
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import Place
from livessl.server.forwarding.tables import alerts, arrays, received, sites, tracks
from livessl.server.history import tables as history
from livessl.server.history.database import RejectedError
from livessl.server.store import Store

LOCK: Final = 0x11_7E_55_2
"""Number of the PostgreSQL lock of the hub that takes messages in, so that the others wait."""

AWAY_S: Final = 30.0
"""Silence, in seconds, after which a site counts as away; it reports on itself every 5 s."""

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

_log = logging.getLogger(__name__)


class Delivery(NamedTuple):
    """A message from the stream.

    Parameters
    ----------
    site : str
        Site, by the subject that its credentials permit, whatever the message says.
    kind : str
    place : Place
        Name of the outbox, and number there.
    body : bytes
        JSON.
    tries : int
        How often it was delivered, this time included.
    """

    site: str
    kind: str
    place: Place
    body: bytes
    tries: int


class Taken(NamedTuple):
    """What became of some deliveries: which are done with, which wait for earlier ones, and which are of no use."""

    done: list[Delivery]
    early: list[Delivery]
    rejected: list[Delivery]


class Archive:
    """The hub's database; every thread may call it.

    Every method raises `StoreError` if the database cannot be used.

    Parameters
    ----------
    place : Path or str
        SQLite file, or URL of a PostgreSQL database.
    clock : Clock
    """

    def __init__(self, place: Path | str, clock: Clock) -> None:
        self.store = Store(place, forwards=True)
        """The history of events; the id of an event is `SITE/ID` there."""
        self._database = self.store.database
        self._clock = clock

    def expire(self, before_ns: int, end: threading.Event | None = None) -> int:
        """Delete events and alerts of before a time; return the number of events."""
        gone = self.store.expire(before_ns, end)
        with self._database.writing("delete old alerts") as connection:
            connection.execute(delete(alerts).where(alerts.c.time_ns < max(before_ns, 0)))
        return gone

    def close(self) -> None:
        """Release the database."""
        self.store.close()

    # --- what comes in

    def take(self, deliveries: Sequence[Delivery], patience: int) -> Taken:
        """Store messages that are next in their outbox.

        Parameters
        ----------
        deliveries : sequence of Delivery
        patience : int
            Tries after which a message no longer waits for earlier ones: these are counted as missing.

        Returns
        -------
        Taken
            `early` are messages whose predecessors have not come yet.
        """
        try:
            return self._take(deliveries, patience)
        except RejectedError as error:
            if len(deliveries) == 1:
                _log.error("site %r: %s", deliveries[0].site, error)
                return self._skip(deliveries[0])
        together = Taken([], [], [])
        for delivery in _in_order(deliveries):
            for all_of_them, some in zip(together, self.take([delivery], patience), strict=True):
                all_of_them += some
        return together

    def _take(self, deliveries: Sequence[Delivery], patience: int) -> Taken:
        taken = Taken([], [], [])
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
                if gap > 0 and delivery.tries < patience:
                    taken.early.append(delivery)
                    continue
                message = _read(delivery)
                if message is None:
                    taken.rejected.append(delivery)
                else:
                    batch.append((delivery.site, delivery.kind, message))
                    taken.done.append(delivery)
                missing[delivery.site] = missing.get(delivery.site, 0) + gap
                last[key] = delivery.place.number
            _put(connection, batch)
            raised = [{"of_site": site, "of_outbox": box, "number": number} for (site, box), number in last.items()]
            connection.execute(_RAISE, raised)
            newest: dict[str, int] = {}
            for site, kind, message in batch:
                if kind == "event":
                    newest[site] = max(newest.get(site, 0), utc_ns(message["time_utc"]))
            self._touch(connection, {site for site, _ in places}, missing, newest)
        return taken

    def _skip(self, delivery: Delivery) -> Taken:
        """Note that a message cannot be stored, so that its successors do not wait for it."""
        with self._database.writing("skip a message") as connection:
            key = delivery.site, delivery.place.outbox
            _locked(connection, {key})
            mine = (received.c.site == key[0]) & (received.c.outbox == key[1])
            number = delivery.place.number
            connection.execute(update(received).where(mine, received.c.last < number).values(last=number))
        return Taken([], [], [delivery])

    def note_report(self, site: str, report: JsonObject) -> None:
        """Keep a site's newest report on itself."""
        with self._database.writing(f"store the report of site {site!r}") as connection:
            self._touch(connection, {site}, {}, {})
            body = orjson.dumps(report).decode()
            connection.execute(update(sites).where(sites.c.site == site).values(report=body))

    def _touch(
        self, connection: Connection, names: set[str], missing: Mapping[str, int], newest: Mapping[str, int]
    ) -> None:
        """Note that sites were heard of now, how many messages are missing, and the starts of their newest events."""
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
        """Return all sites, by name, with their condition and the time of their last contact."""
        with self._database.reading() as connection:
            rows = connection.execute(select(sites).order_by(sites.c.site)).all()
            states: dict[str, dict[str, str]] = {row.site: {} for row in rows}
            for row in connection.execute(select(arrays.c.site, arrays.c.body)):
                array = orjson.loads(row.body)
                states.setdefault(row.site, {})[array["name"]] = array["state"]
        return [self._described(row, states[row.site]) for row in rows]

    def _described(self, row: Any, states: Mapping[str, str]) -> JsonObject:
        report = orjson.loads(row.report)
        age_s = (self._clock.now_ns() - row.contact_ns) / 1e9
        current = {**states, **report.get("arrays", {})}
        return {
            "site": row.site,
            "status": _status(age_s, current),
            "contact_utc": utc_text(row.contact_ns),
            "age_s": round(max(0.0, age_s), 3),
            "version": report.get("version"),
            "location_deg": report.get("location_deg"),
            "arrays": current,
            "waiting": report.get("waiting", 0),
            "missing": row.missing,
            "newest_event_utc": utc_text(row.newest_ns) if row.newest_ns else None,
        }

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
        connection.execute(insert(received), [{"site": site, "outbox": box, "last": 0} for site, box in new])
    return last | dict.fromkeys(new, 0)


def _read(delivery: Delivery) -> JsonObject | None:
    """Return a message with its site; None if it is not what its kind has to be."""
    try:
        message = orjson.loads(delivery.body)
        RECEIVED[delivery.kind].model_validate(message)
    except (ValueError, KeyError) as error:  # pydantic's and orjson's errors are ValueErrors
        what = " ".join(str(error).split())
        _log.error("site %r: message %d is left out: %s", delivery.site, delivery.place.number, what)
        return None
    return {**message, "site": delivery.site}


def _put(connection: Connection, batch: Sequence[tuple[str, str, JsonObject]]) -> None:
    """Store messages in their order: events at once, as their order is that of their time, and the rest one by one."""
    for is_event, group in groupby(batch, key=lambda each: each[1] == "event"):
        if is_event:
            _put_events(connection, [message for _, _, message in group])
        else:
            for site, kind, message in group:
                _PUT[kind](connection, site, message)


def _put_events(connection: Connection, messages: Sequence[JsonObject]) -> None:
    rows: dict[str, dict[str, Any]] = {}
    known_as = {f"{message['site']}/{message['id']}": message for message in messages}
    for key, message in known_as.items():
        rows[key] = {**history.event_row(message, utc_ns(message["time_utc"])), "id": key}
    query = select(history.events.c.id).where(history.events.c.id.in_(list(rows)))
    for known in connection.execute(query).scalars().all():
        del rows[known]
    if not rows:
        return
    connection.execute(insert(history.events), list(rows.values()))
    columns = history.events.c.number, history.events.c.id
    numbers = connection.execute(select(*columns).where(history.events.c.id.in_(list(rows)))).all()
    tags: list[dict[str, Any]] = []
    for number, key in numbers:
        message, row = known_as[key], rows[key]
        tags += history.tag_rows(message, row, number)
        compared = {name: row[name] for name in ("time_ns", "confidence", "status", "level_dbfs")}
        tags.append({"kind": "site", "name": message["site"], "number": number, **compared})
    connection.execute(insert(history.tags), tags)


def _put_start(connection: Connection, site: str, _message: JsonObject) -> None:
    """A server that starts follows no track of before."""
    connection.execute(delete(tracks).where(tracks.c.site == site))


def _put_array(connection: Connection, site: str, message: JsonObject) -> None:
    connection.execute(delete(arrays).where(arrays.c.site == site, arrays.c.name == message["name"]))
    connection.execute(insert(arrays), {"site": site, "name": message["name"], "body": orjson.dumps(message).decode()})


def _put_track(connection: Connection, site: str, message: JsonObject) -> None:
    connection.execute(delete(tracks).where(tracks.c.site == site, tracks.c.id == message["id"]))
    if message["state"] != "end":
        connection.execute(insert(tracks), {"site": site, "id": message["id"], "body": orjson.dumps(message).decode()})


def _put_alert(connection: Connection, site: str, message: JsonObject) -> None:
    mine = (alerts.c.site == site) & (alerts.c.key == message["key"])
    if connection.execute(select(alerts.c.number).where(mine)).first() is None:
        row = {
            "site": site,
            "key": message["key"],
            "time_ns": utc_ns(message["raised_utc"]),
            "body": orjson.dumps(message).decode(),
        }
        connection.execute(insert(alerts), row)


_PUT: Final = {"start": _put_start, "array": _put_array, "track": _put_track, "alert": _put_alert}


def _status(age_s: float, states: Mapping[str, str]) -> str:
    """Return the condition of a site: `away` if nothing comes from it, else by its arrays as its own health has it."""
    if age_s > AWAY_S:
        return "away"
    enabled = {state for state in states.values() if state != "disabled"}
    return "ok" if enabled == {"healthy"} else "starting" if enabled <= {"starting", "healthy"} else "degraded"
