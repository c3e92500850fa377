"""Several sources at once, and the error of the set-up in what fusion reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_steps import (
    NORTH,
    SOURCE_M,
    SOUTH,
    START,
    THREE,
    FrontEnd,
    Scripted,
    fusion_of,
    node,
    only_event,
    play,
    sound_at,
    state_of,
)
from livessl.core.locate.confidence import NEAR_M, ConfidenceFeatures
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.set_up_error import half_axis_m, probability_within, set_up_covariance_m2
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.stream.site_state import SiteState
from livessl.core.types import (
    Estimate,
    Event,
    Status,
    Track,
    Uncertainty,
    Update,
)

OTHER_M = SOURCE_M - np.array([0.0, 1.5, 0.0])


class Duet(Scripted):
    """An estimator that finds two places where it may."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        if not all(sound.sources > 1 for sound in sounds.values()):
            return found
        return replace(found, others=(replace(found, position_m=OTHER_M, confidence=0.7),))

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        return FrontEnd([])


def test_each_of_two_sources_gives_an_event() -> None:
    fusion = Fusion(state_of(Duet(), THREE))
    outputs = sound_at(fusion, 0, ("north", "south"))
    one, other = (output for output in outputs if isinstance(output, Event))
    assert (one.id, one.source) == (f"site-{(START + 5) * 50}", 1)
    assert (other.id, other.source) == (f"{one.id}-2", 2)
    assert other.estimate is not None
    np.testing.assert_array_equal(other.estimate.position_m, OTHER_M)
    assert (other.start_ns, other.end_ns, other.status) == (one.start_ns, one.end_ns, Status.LOCATED)
    assert other.estimate.confidence == 0.7
    assert other.contributions[0].azimuth_deg != one.contributions[0].azimuth_deg
    assert all(output.others == () for output in outputs if isinstance(output, Update))  # unless it is asked for
    alone = Fusion(state_of(Duet(), THREE, sources=1))
    assert [event.source for event in sound_at(alone, 0, ("north", "south")) if isinstance(event, Event)] == [1]


def test_updates_hold_a_second_source_where_the_site_asks_for_it() -> None:
    fusion = Fusion(state_of(Duet(), THREE, live_sources=2))
    outputs = sound_at(fusion, 0, ("north", "south"))
    (update,) = (output for output in outputs if isinstance(output, Update))
    (other,) = update.others
    np.testing.assert_array_equal(other.position_m, OTHER_M)
    assert {output.id for output in outputs if isinstance(output, Track)} == {1, 2}


@pytest.mark.parametrize(("position", "variance"), [(1.0, np.nan), (np.nan, 0.01), (1.0, np.inf)])
def test_an_answer_that_is_not_finite_is_refused(position: float, variance: float) -> None:
    class Odd(Scripted):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            found = super().locate(sounds)
            return replace(found, position_m=np.full(3, position), covariance_m2=np.full((3, 3), variance))

    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    event = only_event(play(fusion_of(Odd(), updates=True), arrivals, 50))
    assert event.status is Status.REFUSED
    assert event.reason == "method 'scripted' answered with a position or covariance that is not finite"


@pytest.mark.parametrize("powers", [(None, None), (4e-3, 1e-3), (4e-3, None)])
def test_each_source_has_the_level_that_the_estimator_found(powers: tuple[float | None, float | None]) -> None:
    """The first has all power unless it was divided; the second has none but its own."""

    class Divided(Duet):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            found = super().locate(sounds)
            others = tuple(replace(other, power=powers[1]) for other in found.others)
            return replace(found, power=powers[0], others=others)

    outputs = sound_at(Fusion(state_of(Divided(), THREE)), 0, ("north", "south"))
    first, second = (output for output in outputs if isinstance(output, Event))
    alone = Fusion(state_of(Duet(), THREE, sources=1))
    (whole,) = (output for output in sound_at(alone, 0, ("north", "south")) if isinstance(output, Event))
    assert (first.power, second.power) == (powers[0] or whole.power, powers[1])


@pytest.mark.parametrize("free_axes", [(0, 1, 2), (0, 1)])
def test_a_position_without_covariance_has_the_error_of_the_set_up(free_axes: tuple[int, ...]) -> None:
    class Certain(Scripted):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            return replace(super().locate(sounds), covariance_m2=np.zeros((3, 3)))

    state = SiteState("site", (NORTH, SOUTH), Certain(), free_axes=free_axes)
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    estimate = only_event(play(Fusion(state, Role(updates=False)), arrivals, 50)).estimate
    assert estimate is not None
    assert tuple(np.flatnonzero(np.diag(estimate.covariance_m2))) == free_axes
    np.testing.assert_array_equal(estimate.sound_covariance_m2, np.zeros((3, 3)))
    expected_m2 = set_up_covariance_m2((NORTH, SOUTH), SOURCE_M, free_axes)
    np.testing.assert_allclose(estimate.covariance_m2, expected_m2)


class Sure(Scripted):
    """An estimator whose confidence is a probability."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        return replace(found, covariance_m2=1e-4 * np.eye(3), confidence=0.95, features=ConfidenceFeatures(0.5, 9.0))


def located_with(estimator: Scripted, orientation_deg: float) -> tuple[Event, Estimate]:
    """An event, and its estimate, of arrays whose orientation is known so well."""
    known = Uncertainty(0.01, orientation_deg, 0.0, 0.0)
    arrays = [replace(spec, uncertainty=known) for spec in (NORTH, SOUTH)]
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    event = only_event(play(Fusion(state_of(estimator, arrays), Role(updates=False)), arrivals, 50))
    assert event.estimate is not None
    return event, event.estimate


@settings(max_examples=15)
@given(orientation_deg=st.floats(0.1, 30.0), further_deg=st.floats(1.0, 20.0))
def test_confidence_falls_with_the_error_of_the_set_up_and_the_reason_says_so(
    orientation_deg: float, further_deg: float
) -> None:
    """A position stays a position: the sound determines it, and measuring the poses is what helps."""
    event, estimate = located_with(Sure(), orientation_deg)
    _, worse = located_with(Sure(), orientation_deg + further_deg)
    assert event.status is Status.LOCATED
    assert worse.confidence <= estimate.confidence <= 0.95
    assert estimate.sound_confidence == worse.sound_confidence == 0.95
    within = probability_within(NEAR_M, estimate.covariance_m2)
    assert estimate.confidence == pytest.approx(0.95 * within, rel=1e-6)
    is_limited = half_axis_m(estimate.set_up_covariance_m2) > NEAR_M
    assert is_limited == (event.reason is not None)
    assert not is_limited or "the set-up alone allows an error of" in str(event.reason)


def test_confidence_that_is_no_probability_stays() -> None:
    assert located_with(Scripted(), 20.0)[1].confidence == 0.5
