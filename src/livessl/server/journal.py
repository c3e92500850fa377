"""Makes the entries of the journal: alerts, tracks that ended, changes of the configuration and of arrays' states.

Its table is in `history/journal.py`, its route in `api/journal_routes.py`.

No caller waits for the database: entries go through the backlog of the store, as events do.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import orjson

from livessl import __version__
from livessl.clock import Clock, utc_ns
from livessl.server.api.encode import JsonObject
from livessl.server.history.backlog import Write
from livessl.server.history.journal import Entry, EntryKind, JournalQuery
from livessl.server.store import Store, StoreError
from livessl.site.models import Site

SITE_FILE: Final = "site file"
"""Name of the entries about changes of the site file."""

_log = logging.getLogger(__name__)


class Journal:
    """Keeps what happens besides events; every thread may call it.

    Parameters
    ----------
    store : Store
    clock : Clock
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store = store
        self._clock = clock
        self._states: dict[str, str] = {}

    def alert(self, alert: JsonObject, done: Callable[[], None] | None = None) -> None:
        """Keep an alert that a rule has raised; one that is kept already stays as it is.

        `done` is called when it is stored, on any thread.
        """
        time_ns = utc_ns(alert["time_utc"] or alert["raised_utc"])
        self._put(Entry(EntryKind.ALERT, alert["rule"], alert["key"], time_ns, alert["text"], alert), done)

    def arrays(self, message: JsonObject) -> None:
        """Keep which arrays have changed their state since the last message `arrays`; those of a replay do not count.

        What an array begins with is no change.
        """
        if message["mode"] != "live":
            self._states = {}
            return
        time_ns = utc_ns(message["now_utc"])
        before, self._states = self._states, {array["name"]: array["state"] for array in message["arrays"]}
        for array in message["arrays"]:
            name, state, reason = array["name"], array["state"], array["reason"]
            former = before.get(name, state)
            if former != state:
                text = f"array {name!r} is {state} after {former}" + (f": {reason}" if reason else "")
                detail = {"state": state, "before": former, "reason": reason}
                self._put(Entry(EntryKind.ARRAY, name, f"array {name} {state} {time_ns}", time_ns, text, detail))

    def track(self, number: int, start_ns: int, text: str, detail: JsonObject) -> None:
        """Keep a track that has ended."""
        self._put(Entry(EntryKind.TRACK, str(number), f"track {number} {start_ns}", start_ns, text, detail))

    def configuration(self, name: str, who: str, text: str, detail: Mapping[str, Any] | None = None) -> None:
        """Keep a change of the configuration.

        Parameters
        ----------
        name : str
            What was changed, such as `zone door`.
        who : str
            Name of the client that did it.
        text : str
            What was done, in a sentence.
        detail : mapping or None
            The new setting.
        """
        time_ns = self._clock.now_ns()
        key = f"configuration {name} {time_ns}"
        self._put(Entry(EntryKind.CONFIGURATION, name, key, time_ns, text, {"client": who, **(detail or {})}))

    def site(self, site: Site) -> None:
        """Keep that the site file has changed since the server last ran, and in which sections."""
        compare = partial(self._compare_site, _sections(site))
        try:
            compare()
        except StoreError as error:
            _log.warning("%s; changes of the site file are looked for later", error)
            self._store.when_ready(compare)

    def _compare_site(self, sections: dict[str, str]) -> None:
        query = JournalQuery(EntryKind.CONFIGURATION, SITE_FILE, limit=1)
        entries = self._store.journal(query).entries
        if not entries:
            self.configuration(SITE_FILE, "livessl", f"livessl {__version__} runs", _of_site(sections, []))
            return
        known = entries[0].detail
        before = known["sections"]
        changed = sorted(name for name in {*before, *sections} if before.get(name) != sections.get(name))
        if changed:
            text = f"the site file has changed: {', '.join(changed)}"
        elif known["version"] != __version__:
            text = f"livessl {__version__} runs after {known['version']}"
        else:
            return
        self.configuration(SITE_FILE, "livessl", text, _of_site(sections, changed))

    def _put(self, entry: Entry, done: Callable[[], None] | None = None) -> None:
        detail = orjson.dumps(entry.detail)  # as bytes: thousands may wait for a database
        bare = replace(entry, detail={})

        def store() -> None:
            self._store.note(replace(bare, detail=orjson.loads(detail)))
            if done is not None:
                done()

        write = Write(store, 0, is_final=False, others=1, nbytes=len(detail))
        self._store.backlog.put(write, self._clock.monotonic_ns())


def _of_site(sections: dict[str, str], changed: list[str]) -> JsonObject:
    return {"version": __version__, "changed": changed, "sections": sections}


def _sections(site: Site) -> dict[str, str]:
    """Return a digest of each section of a site file: it may name hosts and files, which are not repeated."""
    return {
        name: hashlib.sha256(orjson.dumps(value, option=orjson.OPT_SORT_KEYS)).hexdigest()[:16]
        for name, value in site.model_dump(mode="json").items()
    }
