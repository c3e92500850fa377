"""Fuzzing by coverage, for a moment: it comes to every line that decodes, and finds what is wrong."""

from __future__ import annotations

import pytest
from fuzz import fuzz, lines_missed

from livessl import wire
from livessl.core.types import Frame


@pytest.mark.parametrize("seed", range(2))
def test_nothing_but_messages_and_refusals(seed: int) -> None:
    found = fuzz(20_000, seed)
    assert found.outcomes["refused"] > 5000
    assert {"Frame", "Mark", "Hello", "Ack", "Bye"} <= found.outcomes.keys()
    assert lines_missed(found) == []


def test_lines_that_nothing_reached_are_told() -> None:
    assert len(lines_missed(fuzz(5, 0))) > 10


def test_an_exception_that_is_no_refusal_ends_it() -> None:
    def careless(data: bytes) -> wire.WireMessage:
        message = wire.decode(data)
        if isinstance(message, Frame) and not message.active:
            raise KeyError(message.array)
        return message

    with pytest.raises(KeyError):
        fuzz(10_000, 0, careless)
