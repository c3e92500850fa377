"""Refusals: every one is counted, a bounded number is remembered, and each is logged once."""

from __future__ import annotations

import logging

import pytest

from livessl.clock import SystemClock
from livessl.server.refusals import MAX_KNOWN, Refusals


def test_each_refusal_is_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    refusals = Refusals(SystemClock())
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            refusals.note("http", "192.0.2.1", "no token")
        refusals.note("http", "192.0.2.1", "too long")
        refusals.note("nodes", "192.0.2.1", "no token")
    assert refusals.counts() == {("http", "no token"): 3, ("http", "too long"): 1, ("nodes", "no token"): 1}
    assert (refusals.count("http"), refusals.count("nodes"), refusals.count("cellar")) == (4, 1, 0)
    assert [record.getMessage() for record in caplog.records] == [
        f"{door}: 192.0.2.1 was refused: {reason} (logged once, counted in /metrics)"
        for door, reason in (("http", "no token"), ("http", "too long"), ("nodes", "no token"))
    ]
    newest = refusals.known()[0]
    assert (newest.door, newest.count) == ("nodes", 1)
    assert max(refusals.known(), key=lambda refused: refused.count).count == 3


def test_log_has_the_full_reason_and_the_count_its_cause(caplog: pytest.LogCaptureFixture) -> None:
    refusals = Refusals(SystemClock())
    refusals.note("nodes", "node 'pi'", "other version", "the node is older; install the same version")
    assert refusals.counts() == {("nodes", "other version"): 1}
    assert "node 'pi' was refused: the node is older; install the same version (logged once" in caplog.text


def test_many_addresses_cost_bounded_memory_and_log_lines(caplog: pytest.LogCaptureFixture) -> None:
    refusals = Refusals(SystemClock())
    with caplog.at_level(logging.WARNING):
        for number in range(10 * MAX_KNOWN):
            refusals.note("http", f"2001:db8::{number:x}", "no token")
    assert refusals.counts() == {("http", "no token"): 10 * MAX_KNOWN}
    assert len(refusals.known()) == len(caplog.records) == MAX_KNOWN
