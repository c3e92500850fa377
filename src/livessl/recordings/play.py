"""Recordings through pipelines, in the order in which devices would have delivered them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from livessl.clock import Clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import Message
from livessl.recordings.recording import Placed, played


def played_messages(
    pipelines: Sequence[Pipeline], placed: Sequence[Placed], clock: Clock
) -> Iterator[tuple[int, list[Message]]]:
    """What pipelines make of their recordings, block by block: the site time at which it is known, and the messages."""
    end_ns = 0
    for end_ns, index, block in played(placed, clock):
        yield end_ns, pipelines[index].push(block)
    yield end_ns, [message for line in pipelines for message in line.flush()]
