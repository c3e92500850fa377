"""Another set-up of the arrays comes into force while sounds go on: both passes locate a sound with the same one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from test_final_pass import both, play, provisional, settled_events, two_passes

from fusion_steps import NORTH, SOUTH, Scripted, mark, node, now_ns
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.stream.site_state import ArraySetUp
from livessl.core.types import FRAME_NS, Event, Frame

FIRST, SECOND = range(20, 40), range(60, 70)
"""Two sounds."""

LAST = 90


class At(Scripted):
    """An estimator that returns the same position for every sound."""

    def __init__(self, x_m: float) -> None:
        super().__init__()
        self.x_m = x_m

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        return Localization(np.array([self.x_m, 1.0, 1.0]), found.covariance_m2, found.confidence, found.evidence)


def other_poses(x_m: float = 5.0) -> ArraySetUp:
    return ArraySetUp.of((NORTH, SOUTH), At(x_m))


def located_at(events: list[Event]) -> dict[int, float]:
    """The first coordinate of each event by its start, in frame indices after START."""
    start_ns = now_ns(0)
    found = {}
    for event in events:
        assert event.estimate is not None
        found[(event.start_ns - start_ns) // FRAME_NS] = float(event.estimate.position_m[0])
    return found


@pytest.mark.parametrize("moment", [5, 20, 30, 44, 50, 59, 65, 80])
def test_a_sound_that_has_begun_is_finished_with_the_poses_before(moment: int) -> None:
    into = two_passes()
    arrivals = both(FIRST, range(55)) + [one for one in both(SECOND, range(LAST)) if one[0] > 55]
    said = play(into, arrivals, moment)
    into.take_over(other_poses())
    said += play(into, arrivals, LAST, moment + 1)
    found = located_at(settled_events(said))
    old_x_m = located_at(settled_events(play(two_passes(), arrivals, LAST)))
    assert found.keys() == old_x_m.keys() == {FIRST.start, SECOND.start}
    for start, x_m in found.items():
        assert x_m == (5.0 if moment <= start else old_x_m[start])


def test_the_final_pass_locates_a_late_sound_with_the_poses_of_its_time() -> None:
    into = two_passes()
    arrivals = node("north", FIRST, range(LAST)) + node("south", FIRST, range(10))  # south is away from then on
    said = play(into, arrivals, 50)
    (early,) = provisional(said)
    into.take_over(other_poses())
    into.greet("south", (18 + now_ns(0) // FRAME_NS, 51 + now_ns(0) // FRAME_NS), now_ns(51))
    kept = [(51.0, message) for _, message in node("south", FIRST, range(18, 51)) if isinstance(message, Frame)]
    said = play(into, [*arrivals, *kept, (51.0, mark("south", 50))], 55, 51)
    into.greet("south", None, now_ns(55))
    said += play(into, [*arrivals, (56.0, mark("south", 55))], 60, 56)
    (late,) = settled_events(said)
    assert late.heard_by == ("north", "south")
    assert located_at([late]) == located_at([early])


def test_several_changes_during_a_sound_leave_the_last_one() -> None:
    into = two_passes()
    arrivals = both(FIRST, range(55)) + [one for one in both(SECOND, range(LAST)) if one[0] > 55]
    said = play(into, arrivals, 25)
    into.take_over(other_poses(5.0))
    into.take_over(other_poses(6.0))
    said += play(into, arrivals, LAST, 26)
    assert located_at(settled_events(said))[SECOND.start] == 6.0


def test_poses_that_come_before_any_sound_hold_at_once_and_are_prepared() -> None:
    into, poses = two_passes(), other_poses()
    into.take_over(poses)
    into.prepare("north", 48000.0)
    assert isinstance(poses.estimator, At)
    assert poses.estimator.prepared == [("north", 48000.0)]
    (event,) = settled_events(play(into, both(FIRST, range(LAST)), LAST))
    assert located_at([event]) == {FIRST.start: 5.0}
