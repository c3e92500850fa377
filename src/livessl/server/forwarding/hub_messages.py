"""Chooses which alerts, tracks and changes of arrays go to the hub, and puts them into the outbox.

Final events come from `store.py`, which writes them into history and outbox in one transaction.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Final

import orjson

from livessl import __version__
from livessl.clock import Clock, utc_ns, utc_text
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.outbox import Outbox, Outgoing
from livessl.server.history.backlog import Backlog, Write

ARRAY_FIELDS: Final = ("name", "state", "reason", "node", "enabled")
"""Fields of an array that the hub gets whenever its state or the reason for it has changed."""


class HubMessages:
    """Chooses the messages for the hub. Every thread may call it; messages of replays are to be kept from it.

    Final events are not among them: the store puts these into the outbox in the transaction that stores them.

    Parameters
    ----------
    clock : Clock
    outbox : Outbox
    backlog : Backlog
        Writes into the outbox, in order with the events, without anyone waiting for it.
    """

    def __init__(self, clock: Clock, outbox: Outbox, backlog: Backlog) -> None:
        self._clock = clock
        self._outbox = outbox
        self._backlog = backlog
        self._states: dict[str, tuple[str, str | None]] = {}
        self._comparing = threading.Lock()

    def take(self, message: JsonObject) -> None:
        """Take in a message for subscribers.

        The hub gets alerts, the beginning and the end of each track, and the changes of the arrays' states.
        """
        match message["kind"]:
            case "alert":
                self.take_alerts([message])
            case "track" if message["state"] != "update" and message["time_utc"] is not None:
                self._put([Outgoing("track", utc_ns(message["time_utc"]), message)])
            case "arrays":
                self._take_arrays(message)

    def take_alerts(self, messages: Sequence[JsonObject]) -> None:
        """Take in alerts; those that the hub already has do no harm."""
        if messages:
            self._put([Outgoing("alert", utc_ns(message["raised_utc"]), message) for message in messages])

    def note_start(self) -> None:
        """Report that the server has started, with its version."""
        now_ns = self._clock.now_ns()
        self._put([Outgoing("start", now_ns, {"kind": "start", "time_utc": utc_text(now_ns), "version": __version__})])

    def _take_arrays(self, message: JsonObject) -> None:
        changed = []
        with self._comparing:
            for array in message["arrays"]:
                state = array["state"], array["reason"]
                if self._states.get(array["name"]) != state:
                    self._states[array["name"]] = state
                    changed.append({name: array[name] for name in ARRAY_FIELDS})
        if changed:
            when, time_ns = {"time_utc": message["now_utc"]}, utc_ns(message["now_utc"])
            self._put([Outgoing("array", time_ns, {"kind": "array", **when, **array}) for array in changed])

    def _put(self, messages: Sequence[Outgoing]) -> None:
        # bytes need less memory than the values, and thousands may wait for a database
        rows = [(kind, time_ns, orjson.dumps(message)) for kind, time_ns, message in messages]

        def store() -> None:
            self._outbox.put([Outgoing(kind, time_ns, orjson.loads(body)) for kind, time_ns, body in rows])

        nbytes = sum(len(body) for *_, body in rows)
        write = Write(store, 0, is_final=False, others=len(rows), nbytes=nbytes)
        self._backlog.put(write, self._clock.monotonic_ns())
