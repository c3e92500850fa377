"""Damaged messages: refused, or messages all the same; never a crash."""

from __future__ import annotations

import logging

import pytest
from mutation import campaign


@pytest.mark.parametrize("seed", range(3))
def test_damaged_messages_are_refused(seed: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    outcomes = campaign(5000, seed)
    assert outcomes["refused"] > 3400
    assert outcomes["Frame"] > 30  # a flipped bit in a sample is sound too
    assert sum(outcomes.values()) == 5000
