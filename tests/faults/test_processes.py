"""Real processes over real sockets, killed with -9: the same events as if nothing had happened."""

from __future__ import annotations

import math
import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from namespaces import why_not
from processes import Event, Playing, make_recordings, play, wait_for

from livessl.core.stream.array_health import LOST_NS
from livessl.server.array_states import WATCH_NS
from livessl.server.engine import WAIT_S
from small_site import HANG_S

pytestmark = pytest.mark.processes

COUNT = 4


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("recordings")
    make_recordings(directory, COUNT, gap_s=2.0)
    return directory


@pytest.fixture(scope="module")
def undisturbed(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Event]:
    def nothing(site: Playing, rng: random.Random, end_s: float) -> None:
        site.sleep_until(end_s)

    events = play(recordings, tmp_path_factory.mktemp("undisturbed"), nothing)
    assert len(events) == COUNT
    return events


def assert_same(events: list[Event], expected: list[Event]) -> None:
    assert [event["arrays"] for event in events] == [event["arrays"] for event in expected]
    for event, other in zip(events, expected, strict=True):
        assert event["at_s"] == pytest.approx(other["at_s"], abs=1e-6)
        assert math.dist(event["position_m"], other["position_m"]) < 1e-6
    assert all(one["at_s"] + one["duration_s"] <= other["at_s"] for one, other in pairwise(events))


def test_server_killed_amid_sounds(recordings: Path, undisturbed: list[Event], tmp_path: Path) -> None:
    def kills(site: Playing, rng: random.Random, end_s: float) -> None:
        for event in undisturbed[:3]:
            site.sleep_until(event["at_s"] + rng.uniform(0.0, event["duration_s"] + 0.5))
            site.kill("server")
            site.start_server()

    assert_same(play(recordings, tmp_path, kills), undisturbed)


def test_link_cut_and_torn(recordings: Path, undisturbed: list[Event], tmp_path: Path) -> None:
    def cuts(site: Playing, rng: random.Random, end_s: float) -> None:
        site.sleep_until(undisturbed[0]["at_s"] + 0.1)
        site.proxies["a"].weather.cut = True
        site.sleep_until(undisturbed[2]["at_s"] + 0.1)
        site.proxies["a"].weather.cut = False
        site.proxies["b"].tear()

    events = play(recordings, tmp_path, cuts)
    assert_same(events, undisturbed)
    assert events[1]["late"]


def test_cables_pulled(recordings: Path, undisturbed: list[Event], tmp_path: Path) -> None:
    """Nodes with keys in network namespaces: the kernel's own TCP over a loose contact, then over nothing."""
    reason = why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")

    def pulls(site: Playing, rng: random.Random, end_s: float) -> None:
        site.sleep_until(undisturbed[0]["at_s"] - 0.5)
        site.cables["b"].loosen(rng, 3.0)
        site.sleep_until(undisturbed[1]["at_s"] + 0.1)
        site.cables["a"].pull()
        site.sleep_until(undisturbed[3]["at_s"] + 0.1)
        site.cables["a"].plug()

    events = play(recordings, tmp_path, pulls, cabled=True)
    assert_same(events, undisturbed)
    assert events[2]["late"]


def test_cable_pulled_and_then_narrow(recordings: Path, undisturbed: list[Event], tmp_path: Path) -> None:
    """A third of the bandwidth that sound needs: what was kept is on its way for long after the last sound."""
    reason = why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")

    def pulls(site: Playing, rng: random.Random, end_s: float) -> None:
        site.sleep_until(undisturbed[0]["at_s"] + 0.5)
        site.cables["a"].pull()
        site.sleep_until(undisturbed[1]["at_s"] + 1.0)
        for cable in site.cables.values():
            cable.narrow(700)
        site.cables["a"].plug()
        site.sleep_until(end_s)

    events = play(recordings, tmp_path, pulls, cabled=True)
    assert_same(events, undisturbed)
    assert events[1]["late"]


def array_state(site: Playing, name: str) -> dict[str, Any]:
    answer = site.get("arrays")
    found: dict[str, Any] = next((a for a in answer["arrays"] if a["name"] == name), {}) if answer else {}
    return found


def wait_for_states(site: Playing, **states: str) -> None:
    """Wait until each array is in its state, from the time on at which the nodes play."""
    site.sleep_until(0.0)
    wait_for(lambda: states == {name: array_state(site, name).get("state") for name in states}, f"{states}", HANG_S)


def test_silence_shows_within_two_seconds_where_the_machine_is_free() -> None:
    """The longest silence that counts as none, the look that finds it, and the wait of the thread that looks."""
    assert LOST_NS + WATCH_NS + WAIT_S * 1e9 < 2e9


def test_dead_node_and_cut_cable_show_and_their_end_too(recordings: Path, tmp_path: Path) -> None:
    with Playing(recordings, tmp_path) as site:
        site.start()
        wait_for_states(site, north="healthy", south="healthy")
        site.proxies["b"].weather.cut = True
        wait_for_states(site, north="healthy", south="lost")
        site.kill("a")
        wait_for_states(site, north="lost", south="lost")
        site.start_node("a")
        site.proxies["b"].weather.cut = False
        wait_for_states(site, north="healthy", south="healthy")
