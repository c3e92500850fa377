"""Plays recordings through pipelines in the order in which devices would deliver them, paced or as fast as possible."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

from livessl.clock import Clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import Message
from livessl.recordings.recording import TimedRecording, paced_blocks, timed_blocks

BLOCKS_TOGETHER: Final = 20
"""Blocks of a recording that are passed at once if results need not come in real time: 0.4 s. That is a thirtieth of
the sound that a node keeps for backfill requests, so that no request comes too late for the frames that it names."""


def paced_messages(
    pipelines: Sequence[Pipeline], recordings: Sequence[TimedRecording], clock: Clock
) -> Iterator[tuple[int, list[Message]]]:
    """Pass recordings through their pipelines, block by block, at the pace of `clock`.

    Yields
    ------
    end_ns : int
        Site time at which a device would have delivered the block.
    messages : list of Message
        Messages that the block completes. The last item has the messages that the pipelines still held.
    """
    end_ns = 0
    for end_ns, index, block in paced_blocks(recordings, clock):
        yield end_ns, pipelines[index].push(block)
    yield end_ns, [message for pipeline in pipelines for message in pipeline.flush()]


def unpaced_messages(
    pipelines: Sequence[Pipeline], recordings: Sequence[TimedRecording]
) -> Iterator[tuple[int, list[Message]]]:
    """Yield the same as `paced_messages` with a clock that never waits, but pass many blocks of a recording at once."""
    each = (_in_batches(index, *one) for index, one in enumerate(zip(pipelines, recordings, strict=True)))
    end_ns = 0
    for end_ns, _, messages in heapq.merge(*each, key=lambda entry: entry[:2]):
        yield end_ns, messages
    yield end_ns, [message for pipeline in pipelines for message in pipeline.flush()]


def _in_batches(index: int, pipeline: Pipeline, timed: TimedRecording) -> Iterator[tuple[int, int, list[Message]]]:
    blocks = timed_blocks(timed)
    while some := list(islice(blocks, BLOCKS_TOGETHER)):
        ends_ns, together = zip(*some, strict=True)
        for end_ns, messages in zip(ends_ns, pipeline.push_several(together), strict=True):
            yield end_ns, index, messages
