"""Dead letters: deliveries that were given up; they can be listed, delivered again, or dismissed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from livessl.clock import Clock
from livessl.server.alerts.in_force import AlertsInForce
from livessl.server.alerts.outbox import Delivery
from livessl.server.api.encode import JsonObject


class DeadLetters:
    """The dead letters of a site; every thread may call it.

    Every method raises `OutboxError` if the outbox cannot be used.

    Parameters
    ----------
    in_force : callable
        Returns the rules and actions that are in force, with their outbox.
    clock : Clock
    wake_deliverers : callable
        Has the deliverers look for new deliveries.
    """

    def __init__(
        self, in_force: Callable[[], AlertsInForce], clock: Clock, wake_deliverers: Callable[[], None]
    ) -> None:
        self._in_force = in_force
        self._clock = clock
        self._wake_deliverers = wake_deliverers

    def page(self, limit: int, before: int | None = None) -> Sequence[tuple[Delivery, JsonObject]]:
        """Return dead letters with their alerts, newest first; those before a number, if one is given."""
        return self._in_force().outbox.dead(limit, before)

    def dismiss(self, number: int | None = None, *, action: str | None = None) -> int:
        """Delete the dead letter of a number, those of an action, or all; return how many there were."""
        return self._in_force().outbox.dismiss(number, action=action)

    def resend(self, number: int) -> None:
        """Have a dead letter delivered again.

        Raises
        ------
        LookupError
            If there is none of that number, or the site file no longer has its action.
        """
        in_force = self._in_force()
        action = in_force.outbox.action_of_dead(number)
        if action is None:
            raise LookupError(f"no dead letter {number}; GET alerts/dead-letters lists them")
        if action not in in_force.deliverers:
            cure = "add it to alerts.actions, or dismiss the dead letter with DELETE"
            raise LookupError(
                f"dead letter {number} is for action {action!r}, which the site file does not have; {cure}"
            )
        in_force.outbox.resend(number, self._clock.now_ns())
        self._wake_deliverers()
