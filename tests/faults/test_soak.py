"""A quarter of an hour of four arrays, as `benchmarks/faults.py soak` does a day; and a leak, to show that it shows."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import pytest
from soak import GROWTH, soak

from livessl.core.settling import Settling
from livessl.core.types import Message

pytestmark = [pytest.mark.processes, pytest.mark.timeout(120)]

HOURS, REFERENCE_HOURS = 0.25, 0.1


def test_memory_stays_as_it_was(tmp_path: Path) -> None:
    outcome = soak(tmp_path, HOURS, REFERENCE_HOURS)
    assert outcome.growth < GROWTH
    assert (outcome.sounds, outcome.unheard) == (45, 0)
    assert outcome.clients["event"] >= 3 * outcome.sounds  # each of three that read
    assert outcome.clients["map"] > 0
    assert outcome.clients["answers"] > 0


def test_memory_that_grows_is_seen(tmp_path: Path) -> None:
    kept: list[Message] = []
    take = Settling._take

    def hoard(self: Settling, message: Message, now_ns: int) -> bool:
        kept.append(message)
        return take(self, message, now_ns)

    with patch.object(Settling, "_take", hoard):
        assert soak(tmp_path, HOURS, REFERENCE_HOURS).growth > GROWTH
