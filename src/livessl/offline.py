"""Recordings through the whole pipeline in one process, without sockets, as fast as the clock given allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from livessl import wire
from livessl.clock import Clock
from livessl.core.types import BackfillRequest, Frame, Mark, Message, Output
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.site.build.fusion import make_fusion
from livessl.site.models import Site


def run(
    site: Site,
    recordings: Sequence[AssignedRecording],
    clock: Clock,
    *,
    method: str | None = None,
    ask: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Output]:
    """Localize everything in the recordings, without sockets: events in order of time.

    With `ask`, arrays that did not find a sound are asked for it, as live.

    Raises
    ------
    DeviceError
        Where recordings of arrays that the site joins do not belong together.
    """
    fusion = make_fusion(site, method, updates=False)
    pipelines, inputs = make_pipelines(site, recordings)
    if ask:
        fusion.can_backfill.update(array for pipeline in pipelines for array in pipeline.arrays)
    now_ns = 0
    for now_ns, batch in paced_messages(pipelines, inputs, clock):
        outputs = fusion.step(_over_the_wire(batch), now_ns)
        while asks := [output for output in outputs if isinstance(output, BackfillRequest)]:
            yield from (output for output in outputs if not isinstance(output, BackfillRequest))
            answers = [message for ask in asks for pipeline in pipelines for message in pipeline.backfill(ask)]
            outputs = fusion.step(_over_the_wire(answers), now_ns)
        yield from outputs
        if progress is not None:
            progress(now_ns)
    yield from fusion.flush(now_ns)


def _over_the_wire(batch: Iterable[Message]) -> list[Message]:
    """Each message to bytes and back: every step of the live path but the socket."""
    decoded = (wire.decode(wire.encode(message)) for message in batch)
    return [message for message in decoded if isinstance(message, Frame | Mark)]
