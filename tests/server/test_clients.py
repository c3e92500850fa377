"""Many WebSocket clients, some of them stalled: a small case of `benchmarks/clients.py`."""

from __future__ import annotations

import pytest

from clients import measure


@pytest.mark.processes
def test_stalled_clients_delay_nobody_and_cost_little() -> None:
    outcome = measure(clients=30, stalled=10, updates_per_s=200.0, seconds=5.0)
    assert outcome.received == pytest.approx(outcome.expected, rel=0.1)
    assert outcome.delay_p95_ms < 100.0
    # each stalled client may hold 256 messages of some 2 kB as Python objects, shared, and 64 kB on their way out
    assert outcome.rss_peak_mb - outcome.rss_connected_mb < 10.0
