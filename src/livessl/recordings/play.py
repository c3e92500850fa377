"""Recordings passed through pipelines, in the order in which devices would have delivered their blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from livessl.clock import Clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import Message
from livessl.recordings.recording import TimedRecording, paced_blocks


def paced_messages(
    pipelines: Sequence[Pipeline], recordings: Sequence[TimedRecording], clock: Clock
) -> Iterator[tuple[int, list[Message]]]:
    """Pass recordings through their pipelines, block by block, at the pace of `clock`.

    Yields
    ------
    end_ns : int
        Site time at which a device would have delivered the block.
    messages : list of Message
        Messages that the block completes; last of all, those that the pipelines still held.
    """
    end_ns = 0
    for end_ns, index, block in paced_blocks(recordings, clock):
        yield end_ns, pipelines[index].push(block)
    yield end_ns, [message for pipeline in pipelines for message in pipeline.flush()]
