"""A quarter of an hour of four arrays, as `benchmarks/faults.py soak` does a day; and a leak, to show that it shows."""

from __future__ import annotations

from pathlib import Path
from typing import Final
from unittest.mock import patch

import pytest
from soak import GROWTH, READERS, soak

from livessl.core.settling import Settling
from livessl.core.types import Message

pytestmark = [pytest.mark.processes, pytest.mark.timeout(120)]

HOURS, REFERENCE_HOURS, SAMPLE_S = 0.25, 0.1, 180.0

SOON: Final = 1.6 * GROWTH
"""After six minutes not everything has been used for the first time yet."""

MARK_BYTES: Final = 1000
"""Of memory that each message takes for ever: 45 MB from the reference on, an eighth of all."""


def test_memory_stays_as_it_was(tmp_path: Path) -> None:
    outcome = soak(tmp_path, HOURS, REFERENCE_HOURS, sample_s=SAMPLE_S, absence_first=False)
    assert outcome.growth < SOON
    assert (outcome.sounds, outcome.unheard) == (15, 0)
    assert outcome.clients["events"] == READERS * outcome.events
    assert outcome.clients["maps"] > 0
    assert outcome.clients["answers"] > 0


def test_memory_that_grows_is_seen(tmp_path: Path) -> None:
    kept: list[Message | bytes] = []
    take = Settling._take

    def hoard(self: Settling, message: Message, now_ns: int) -> bool:
        kept.append(message)
        kept.append(bytes(MARK_BYTES))
        return take(self, message, now_ns)

    with patch.object(Settling, "_take", hoard):
        assert soak(tmp_path, HOURS, REFERENCE_HOURS, sample_s=SAMPLE_S, absence_first=False).growth > SOON
