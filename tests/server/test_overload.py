"""The server's load: its figures, its words, and what is shed, by a clock that the test moves."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import httpx
import pytest

from livessl.core.stream.load_policy import LEVELS, NOTHING_SHED, PROMPT_S
from livessl.server.inlet import Inlet
from livessl.server.overload import CURE, Overload
from small_site import running_server, site_of


@dataclass
class HandClock:
    """Time that the test moves."""

    time_ns: int = 1_767_225_600_000_000_000

    def now_ns(self) -> int:
        return self.time_ns

    def monotonic_ns(self) -> int:
        return self.time_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        raise AssertionError("nobody sleeps here")


class Load:
    """Turns of a fusion thread, each of a tenth of a second."""

    def __init__(self) -> None:
        self.clock = HandClock()
        self.overload = Overload(self.clock)

    def turns(self, count: int, delay_s: float, *, waited: float = 0.0, sheds: bool = True) -> None:
        for _ in range(count):
            self.clock.time_ns += 100_000_000
            self.overload.note(delay_s, 40, round(waited * 1e8), sheds=sheds)


def test_without_load_nothing_is_shed_and_nothing_said() -> None:
    load = Load()
    load.turns(100, 0.0, waited=0.75)
    assert load.overload.relief == NOTHING_SHED
    assert load.overload.describe() == {
        "state": "normal",
        "level": 0,
        "since_utc": None,
        "delay_s": 0.0,
        "busy": 0.25,
        "messages_per_s": 400.0,
        "shed": [],
        "updates_shed": 0,
        "message": None,
    }


def test_overload_is_reported_with_figures_and_cure_and_its_end_too(caplog: pytest.LogCaptureFixture) -> None:
    load = Load()
    caplog.set_level(logging.INFO)
    load.turns(1, 0.0)
    begin_ns = load.clock.time_ns
    load.turns(400, 0.2)
    figures = load.overload.describe()
    assert figures["state"] == "overloaded"
    assert figures["since_utc"].startswith("2026-01-01T00:00:")
    assert figures["shed"] == ["updates", "second_looks", "maps", "arrays", "quiet"]
    assert figures["delay_s"] == pytest.approx(0.2)
    assert figures["message"] == (
        "overloaded: sound waited up to 0.20 s, and the fusion works 100 % of the time on 400 messages a second; it "
        "sheds some updates, second looks at unsure events, power maps, arrays with the least evidence and the "
        f"correlation of quiet frames. {CURE}"
    )
    load.turns(3000, 0.0, waited=0.9)
    assert load.overload.message is None
    assert load.overload.describe()["since_utc"] is None
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    assert "overloaded" in caplog.records[0].message
    assert load.clock.time_ns > begin_ns


def test_updates_that_would_come_too_late_are_left_out_under_overload_only() -> None:
    load = Load()
    load.turns(1, 2.0 * PROMPT_S)
    assert load.overload.relief == NOTHING_SHED
    load.turns(40, 2.0 * PROMPT_S)
    assert load.overload.relief.update_every is None
    assert not load.overload.relief.second_looks
    load.turns(1, 0.0)
    level = load.overload.describe()["level"]
    assert level > 0
    assert load.overload.relief == LEVELS[level]


def test_a_replay_is_never_shed() -> None:
    load = Load()
    load.turns(400, 3.0, sheds=False)
    assert load.overload.relief == NOTHING_SHED
    assert load.overload.message is None


def test_health_and_metrics_have_the_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    with running_server(site_of()) as server:
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert (health["status"], health["load"]["state"], health["load"]["shed"]) == ("starting", "normal", [])
        load = Load()
        load.turns(40, 0.2)
        level = load.overload.describe()["level"]
        monkeypatch.setattr(server.parts.overload, "describe", load.overload.describe)
        monkeypatch.setattr(Overload, "message", property(lambda _: "overloaded: by a test"))
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert health["status"] == "overloaded"
        assert health["reasons"][0] == "overloaded: by a test"
        assert health["load"]["level"] == level > 0
        lines = httpx.get(f"{server.url}/metrics").text.splitlines()
        assert f"livessl_overload_level {level:.1f}" in lines
        assert "livessl_fusion_delay_seconds 0.2" in lines


# --- the queue in front of the fusion


def test_the_queue_is_bounded_in_messages_and_in_bytes() -> None:
    inlet: Inlet[str] = Inlet(HandClock(), messages=3, nbytes=100)
    assert inlet.put([(10, "a"), (10, "b"), (10, "c"), (10, "d")], 0.0) == 3
    assert inlet.put([(10, "d")], 0.0) == 0
    assert inlet.take(10, 0.0) == ["a", "b", "c"]
    assert inlet.put([(500, "large"), (1, "small")], 0.0) == 1  # nothing is too large for an empty queue
    assert (len(inlet), inlet.nbytes) == (1, 500)
    assert inlet.take(10, 0.0) == ["large"]
    assert inlet.nbytes == 0


def test_the_queue_knows_how_long_its_first_item_has_waited() -> None:
    clock = HandClock()
    inlet: Inlet[int] = Inlet(clock)
    inlet.put([(0, 1)], 0.0)
    clock.time_ns += 2_000_000_000
    inlet.put([(0, 2)], 0.0)
    clock.time_ns += 1_000_000_000
    assert inlet.take(1, 0.0) == [1]
    assert inlet.delay_s == pytest.approx(3.0)
    assert inlet.take(5, 0.0) == [2]
    assert inlet.delay_s == pytest.approx(1.0)
    assert inlet.take(5, 0.0) == []
    assert inlet.delay_s == 0.0
