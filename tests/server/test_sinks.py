"""Events in a file, one JSON object a line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from livessl.server.sinks import SinkError, Sinks
from livessl.site.server_models import SinkConfig

EVENT = {"kind": "event", "id": "lab-1", "position_m": [1.0, 2.0, 3.0], "reason": "für immer"}


def test_events_are_appended_line_by_line(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text('{"id": "older"}\n', encoding="utf-8")
    sinks = Sinks([SinkConfig(type="jsonl", path=str(path))])
    sinks.take(EVENT)
    sinks.take({**EVENT, "id": "lab-2"})
    seen_while_open = path.read_text(encoding="utf-8").splitlines()
    sinks.close()
    assert [json.loads(line)["id"] for line in seen_while_open] == ["older", "lab-1", "lab-2"]
    assert json.loads(seen_while_open[1]) == EVENT


def test_sink_that_cannot_be_opened_is_an_error_with_its_key(tmp_path: Path) -> None:
    with pytest.raises(SinkError, match=r"server\.sinks: cannot append to .*missing"):
        Sinks([SinkConfig(type="jsonl", path=str(tmp_path / "missing" / "events.jsonl"))])


def test_full_disk_hinders_neither_the_other_sinks_nor_the_server(tmp_path: Path) -> None:
    full, good = Path("/dev/full"), tmp_path / "events.jsonl"
    if not full.exists():
        pytest.skip("there is no /dev/full on this system")
    sinks = Sinks([SinkConfig(type="jsonl", path=str(full)), SinkConfig(type="jsonl", path=str(good))])
    sinks.take(EVENT)
    assert sinks.failures == 1
    assert json.loads(good.read_text(encoding="utf-8")) == EVENT
    sinks.close()
