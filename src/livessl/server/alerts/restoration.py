"""Alerts at the start of a server: what the journal and the hub lack is taken from the outbox."""

from __future__ import annotations

import logging
from functools import partial
from typing import Final

from livessl.server.alerts.outbox import OutboxError
from livessl.server.parts import Parts

RESTORED: Final = 10_000
"""Most alerts of the outbox, about 20 MB, that a start puts into the journal because it lacks them; the next start goes
on with the others."""

RESTORED_AGAIN: Final = 100
"""Newest alerts of the outbox that are put at each start into the messages for the hub, and into a
journal in memory."""

_log = logging.getLogger(__name__)


def restore_alerts(parts: Parts) -> None:
    """Put into the journal the alerts that are in the outbox only, as after an outage of the database.

    The hub gets the newest ones again, and knows which it has: they may not have been among its messages yet.
    """
    alerts, is_durable = parts.alerts, parts.store.is_durable
    try:
        newest = [alert for _, alert in reversed(alerts.outbox.recent(RESTORED_AGAIN))]
        missing = alerts.outbox.not_in_journal(RESTORED) if is_durable else newest
    except OutboxError as error:
        _log.error("%s", error)
        return
    for alert in missing:
        parts.journal.alert(alert, partial(alerts.note_in_journal, alert) if is_durable else None)
    if parts.hub_link is not None:
        parts.hub_link.messages.take_alerts(newest)
