"""Copies alerts at a start from the outbox into the journal and to the hub, where these lack them."""

from __future__ import annotations

import logging
from functools import partial
from typing import Final

from livessl.server.alerts.outbox import OutboxError
from livessl.server.parts import Parts

RESTORED: Final = 10_000
"""Largest number of alerts, about 20 MB, that one start copies from the outbox into the journal. The next start copies
further ones."""

RESTORED_AGAIN: Final = 100
"""Newest alerts of the outbox that are put at each start into the messages for the hub, and into a
journal in memory."""

_log = logging.getLogger(__name__)


def restore_alerts(parts: Parts) -> None:
    """Copy alerts into the journal that are only in the outbox, for example after an outage of the database.

    The newest alerts are also sent to the hub again, because they may not have been among its messages. The hub ignores
    alerts that it already has.
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
