"""Damaged messages: refused, or messages all the same; never a crash."""

from __future__ import annotations

import logging

import pytest
from mutation import campaign


@pytest.mark.parametrize("seed", range(3))
def test_damaged_messages_are_refused(seed: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    outcomes = campaign(3000, seed)
    assert outcomes["refused"] > 2000
    assert outcomes["Frame"] > 20  # a flipped bit in a sample is sound too
    assert sum(outcomes.values()) == 3000
