"""A quarter of an hour of four arrays, as `benchmarks/faults.py soak` does a day; and a leak, to show that it shows."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Final
from unittest.mock import patch

import pytest
from crowd import READERS
from soak import GROWTH, Outcome, soak

from livessl.core.stream.final_pass import FinalResults, TwoPassFusion
from livessl.core.types import Message, Output

pytestmark = pytest.mark.processes

HOURS, REFERENCE_HOURS, SAMPLE_S = 0.25, 0.1, 180.0

SOON: Final = 1.6 * GROWTH
"""After six minutes not everything has been used for the first time yet."""

MARK_BYTES: Final = 1000
"""Of memory that each message takes for ever: 45 MB from the reference on, an eighth of all."""


def steady(directory: Path) -> Outcome:
    return soak(directory, HOURS, REFERENCE_HOURS, sample_s=SAMPLE_S, absence_first=False)


def leaking(directory: Path) -> Outcome:
    kept: list[Message | bytes] = []
    step = TwoPassFusion.step

    def hoard(self: TwoPassFusion, messages: Sequence[Message], now_ns: int) -> list[Output | FinalResults]:
        kept.extend(messages)
        kept.extend(bytes(MARK_BYTES) for _ in messages)
        return step(self, messages, now_ns)

    with patch.object(TwoPassFusion, "step", hoard):
        return steady(directory)


def alone(run: Callable[[Path], Outcome], directory: Path) -> Outcome:
    """In a process of its own: what other tests have left in this one's memory would hide a leak."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as processes:
        return processes.submit(run, directory).result()


def test_memory_stays_as_it_was(tmp_path: Path) -> None:
    outcome = alone(steady, tmp_path)
    assert outcome.growth < SOON
    assert (outcome.sounds, outcome.unheard) == (15, 0)
    assert outcome.clients["events"] == READERS * outcome.events
    assert outcome.clients["maps"] > 0
    assert outcome.clients["answers"] > 0


def test_memory_that_grows_is_seen(tmp_path: Path) -> None:
    assert alone(leaking, tmp_path).growth > SOON
