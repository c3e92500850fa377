"""Recordings through the whole pipeline in one process, without sockets, as fast as the clock given allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from livessl import wire
from livessl.capture.line import played_messages
from livessl.capture.recorded import Part, lines_of
from livessl.clock import Clock
from livessl.config import Site
from livessl.core.types import Frame, Mark, Message, Output


def run(
    site: Site,
    parts: Sequence[Part],
    clock: Clock,
    *,
    method: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Output]:
    """Localize everything in the recordings, without sockets: events in order of time.

    Raises
    ------
    DeviceError
        Where recordings of arrays that the site joins do not belong together.
    """
    fusion = site.make_fusion(method, updates=False)
    now_ns = 0
    for now_ns, batch in played_messages(*lines_of(site, parts), clock):
        yield from fusion.step(_over_the_wire(batch), now_ns)
        if progress is not None:
            progress(now_ns)
    yield from fusion.flush(now_ns)


def _over_the_wire(batch: Iterable[Message]) -> list[Message]:
    """Each message to bytes and back: every step of the live path but the socket."""
    decoded = (wire.decode(wire.encode(message)) for message in batch)
    return [message for message in decoded if isinstance(message, Frame | Mark)]
