"""The examination of the set-up in a server: its state is one value, and findings do not flap."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from world_parts import HandClock

from alert_desk import sound
from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.finding import LEAST_SOUNDS, Finding, Severity
from livessl.core.commission.steady import MOST_CONFIRMING
from livessl.core.types import Observation
from livessl.server import heard_sounds
from livessl.server.overload import Overload
from livessl.server.set_up_watch import KEPT_SOUNDS, SetUpWatch
from livessl.site.build import set_up
from small_site import site_of

TURNED = Finding("turned", "south", None, Severity.ERROR, 0.9, "'south' is turned", "turn it back")
CONTRADICTION = Finding("moved", None, None, Severity.ERROR, 0.5, "the arrays contradict each other", "clap")
WEAK = Finding("level", "north", 2, Severity.WARNING, 0.9, "channel 2 of 'north' is weaker", "set the gains alike")
HIDDEN = BlindSpot("moved", ("north", "south"), 0.8, (1.0, 0.0, 0.0))


def observed(array: str) -> Observation:
    """What an array of two channels observed of a sound."""
    zeros = np.zeros(2)
    return Observation(array, zeros, zeros > 0.0, zeros + 1.0, zeros + 1.0, 9.0, 0.0)


SOUND = replace(sound(), received=cast(Any, (observed("north"), observed("south"))))


class Desk:
    """A watch whose examinations find what a test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.found: Sequence[Finding] = ()
        self.hidden: tuple[BlindSpot, ...] = ()
        self.examined: list[int] = []
        self.arrays: list[list[set[str]]] = []
        monkeypatch.setattr(heard_sounds, "observe", lambda received: received)
        monkeypatch.setattr(set_up, "find_set_up_faults", self._find)
        monkeypatch.setattr(set_up, "hidden_by", lambda _site, _sounds: self.hidden)
        self.watch = SetUpWatch(site_of(), Overload(HandClock()))

    def hear(self, found: Sequence[Finding], sounds: int = 1) -> None:
        """Some sounds come, and examinations find this from now on."""
        self.found = found
        for _ in range(sounds):
            self.watch.take(SOUND)
            self.watch.examine()

    def said(self) -> tuple[list[Finding], list[BlindSpot]]:
        """The findings, and what the sounds hide."""
        state = self.watch.state
        return list(state.findings), list(state.blind_spots)

    def _find(self, _site: object, sounds: Sequence[Sequence[Observation]]) -> list[Finding]:
        self.examined.append(len(sounds))
        self.arrays.append([{one.array for one in each} for each in sounds])
        return list(self.found)


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(monkeypatch)


def test_fault_of_a_new_server_is_published_with_the_third_sound(desk: Desk) -> None:
    desk.hear([TURNED], LEAST_SOUNDS - 1)
    assert (desk.watch.state.findings, desk.examined) == ((), [])
    desk.hear([TURNED])
    assert (desk.watch.state.sounds, desk.watch.state.findings) == (LEAST_SOUNDS, (TURNED,))
    assert desk.watch.finding_of("south") == "'south' is turned; turn it back"
    assert desk.watch.finding_of("north") is None


def test_at_most_the_last_sounds_are_examined(desk: Desk) -> None:
    desk.hear([], KEPT_SOUNDS + 5)
    assert max(desk.examined) == desk.watch.state.sounds == KEPT_SOUNDS


def test_finding_that_comes_and_goes_is_published_and_logged_once(desk: Desk, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        desk.hear([TURNED], KEPT_SOUNDS)
        states = []
        for _ in range(10):
            desk.hear([])
            states.append(desk.watch.state.findings)
            desk.hear([TURNED])
            states.append(desk.watch.state.findings)
    assert set(states) == {(TURNED,)}
    assert caplog.text.count("'south' is turned") == 1


def test_finding_ends_when_the_set_up_is_mended(desk: Desk) -> None:
    desk.hear([TURNED], KEPT_SOUNDS)
    desk.hear([], MOST_CONFIRMING - 1)
    assert desk.watch.state.findings == (TURNED,)
    desk.hear([])
    assert not desk.watch.state.findings
    assert not desk.watch.state.errors


def test_contradiction_without_a_culprit_concerns_all_arrays_and_a_warning_none(desk: Desk) -> None:
    desk.hear([CONTRADICTION, WEAK], LEAST_SOUNDS)
    assert list(desk.watch.state.findings) == [WEAK]  # of so few sounds, a single one may contradict
    desk.hear([CONTRADICTION, WEAK], 1)
    assert list(desk.watch.state.findings) == [CONTRADICTION, WEAK]
    assert set(desk.watch.state.errors) == {"north", "south"}


def test_array_with_a_wrong_clock_has_no_part_in_the_examination(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such an array receives another sound at the time of an event, which looks as if it were turned."""
    both = replace(SOUND, received=cast(Any, (observed("north"), observed("south"))))
    examined: list[set[str]] = []

    def hear(sounds: int = 1) -> None:
        for _ in range(sounds):
            desk.watch.take(both)
            desk.watch.examine()

    def found() -> list[Finding]:
        return list(desk.watch.state.findings)

    def find(_site: object, sounds: Sequence[Sequence[Observation]]) -> list[Finding]:
        examined.append({one.array for sound in sounds for one in sound})
        return [TURNED] if "south" in examined[-1] else []

    monkeypatch.setattr(set_up, "find_set_up_faults", find)
    hear(LEAST_SOUNDS)
    assert found() == [TURNED]
    desk.watch.note_clocks(["south"])
    assert found() == []
    hear()
    assert (examined[-1], found()) == ({"north"}, [])
    desk.watch.note_clocks([])
    hear(KEPT_SOUNDS)
    assert (examined[-1], found()) == ({"north", "south"}, [TURNED])


def test_what_the_sounds_hide_is_published_while_no_finding_is_about_poses(desk: Desk) -> None:
    desk.hidden = (HIDDEN,)
    desk.hear([WEAK], LEAST_SOUNDS - 1)
    assert desk.said() == ([], [])
    desk.hear([WEAK])
    assert desk.said() == ([WEAK], [HIDDEN])
    desk.hear([WEAK, TURNED], KEPT_SOUNDS)
    assert desk.said() == ([TURNED, WEAK], [])
    desk.hear([WEAK])
    assert desk.said() == ([TURNED, WEAK], [])  # TURNED has not ended yet
    desk.hear([], KEPT_SOUNDS)
    assert desk.said() == ([], [HIDDEN])


@pytest.mark.parametrize("ends", ["another run", "other poses", "a clock that is off"])
def test_what_the_sounds_hide_ends_with_what_it_was_said_of(desk: Desk, ends: str) -> None:
    desk.hidden = (HIDDEN,)
    desk.hear([], LEAST_SOUNDS)
    assert desk.said() == ([], [HIDDEN])
    if ends == "another run":
        desk.watch.forget()
    elif ends == "other poses":
        desk.watch.prepare(site_of())()
    else:
        desk.watch.note_clocks(["south"])
    assert desk.said() == ([], [])


def test_another_run_begins_without_findings(desk: Desk) -> None:
    desk.hear([TURNED], KEPT_SOUNDS)
    desk.watch.forget()
    assert (desk.watch.state.sounds, desk.watch.state.findings, desk.watch.state.errors) == (0, (), {})
    desk.hear([], LEAST_SOUNDS)
    assert desk.watch.state.findings == ()


def test_what_an_array_received_before_its_node_restarted_is_not_examined(desk: Desk) -> None:
    desk.hear([TURNED], KEPT_SOUNDS)
    desk.watch.take(SOUND)  # and one that is not examined yet
    desk.watch.forget_arrays({"south"})
    assert desk.said() == ([], [])
    desk.hear([])
    assert desk.arrays[-1] == [{"north"}] * (KEPT_SOUNDS - 1) + [{"north", "south"}]
    assert len(desk.watch.heard.after(0)) == KEPT_SOUNDS + 2  # calibration may use all


def test_what_all_arrays_of_a_site_received_is_forgotten_with_the_sounds(desk: Desk) -> None:
    desk.hear([TURNED], KEPT_SOUNDS)
    desk.watch.forget_arrays({"north", "south"})
    desk.hear([TURNED], LEAST_SOUNDS - 1)
    assert desk.said() == ([], [])
    desk.hear([TURNED])
    assert desk.said() == ([TURNED], [])


def test_what_the_site_file_alone_shows_is_there_from_the_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = {f"arrays.{name}.geometry": {"circle": {"radius_m": 0.2, "count": 4}} for name in ("north", "south")}
    heights = {"arrays.north.position_m": [1.9, 1.3, 1.5], "arrays.south.position_m": [2.2, 3.8, 1.5]}
    watch = SetUpWatch(site_of(flat | heights), Overload(HandClock()))
    assert [one.fault for one in watch.state.findings] == ["ambiguous_geometry"]
    watch.forget()
    assert [one.fault for one in watch.state.findings] == ["ambiguous_geometry"]


def test_reader_never_sees_the_findings_of_one_state_with_the_sounds_of_another(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def numbered(_site: object, sounds: Sequence[object]) -> list[Finding]:
        return [Finding("turned", "south", None, Severity.ERROR, 0.9, f"{len(sounds)}", "")]

    monkeypatch.setattr(set_up, "find_set_up_faults", numbered)
    torn, done = [], threading.Event()

    def read() -> None:
        while not done.is_set():
            state = desk.watch.state
            if any(one.message != f"{state.sounds}" for one in state.findings):
                torn.append(state)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        for _ in range(20):
            desk.hear([], KEPT_SOUNDS)
            desk.watch.forget()
    finally:
        done.set()
    reader.join()
    assert torn == []


def test_examination_is_urgent_while_a_finding_waits_to_be_confirmed_or_withdrawn(desk: Desk) -> None:
    desk.hear([], LEAST_SOUNDS)
    assert not desk.watch.is_urgent
    desk.hear([TURNED])
    assert desk.watch.is_urgent
    desk.hear([TURNED])
    assert desk.watch.state.findings == (TURNED,)
    assert not desk.watch.is_urgent
    desk.hear([])
    assert desk.watch.is_urgent
    desk.hear([], MOST_CONFIRMING)
    assert (desk.watch.state.findings, desk.watch.is_urgent) == ((), False)
