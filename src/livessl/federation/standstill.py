"""Decides whether any hub takes messages in, by the state of the stream's consumer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from nats.js.api import ConsumerInfo

STANDSTILL_S: Final = 5.0
"""Time, in seconds, without any request for messages, after which no hub takes them in."""


class Standstill:
    """Compares the states of the consumer that a hub sees while it waits to take over."""

    def __init__(self) -> None:
        self._delivered = -1
        self._asked_ns: int | None = None

    def holds(self, consumer: ConsumerInfo, now_ns: int) -> bool:
        """Return whether no hub has asked for messages for `STANDSTILL_S`.

        Parameters
        ----------
        consumer : ConsumerInfo
            State of the consumer now.
        now_ns : int
            Monotonic time, in nanoseconds.
        """
        delivered = 0 if consumer.delivered is None else consumer.delivered.consumer_seq
        if consumer.num_waiting or delivered != self._delivered or self._asked_ns is None:
            self._delivered, self._asked_ns = delivered, now_ns
        return now_ns - self._asked_ns > 1e9 * STANDSTILL_S
