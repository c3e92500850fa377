"""Findings do not come and go with single sounds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from livessl.core.commission.finding import Finding, Severity
from livessl.core.commission.steady import CONFIRMING_SOUNDS, MOST_CONFIRMING, SteadyFindings


def finding(fault: str, array: str | None = "north", channel: int | None = None, message: str = "") -> Finding:
    return Finding(fault, array, channel, Severity.ERROR, 0.9, message, "")


TURNED, MOVED = finding("turned"), finding("moved", "south")
DEAD, LEVEL = finding("dead", "north", 2), finding("level", "north", 2)


def published(*steps: tuple[list[Finding], int]) -> tuple[Finding, ...]:
    steady = SteadyFindings()
    found: tuple[Finding, ...] = ()
    for findings, sounds in steps:
        found = steady.note(findings, sounds)
    return found


def test_finding_of_several_sounds_is_published_at_once_and_that_of_one_sound_is_not() -> None:
    assert published(([TURNED], CONFIRMING_SOUNDS)) == (TURNED,)
    assert published(([TURNED], 1)) == ()
    assert published(([TURNED], 1), ([], 1), ([TURNED], 1)) == ()


@given(support=st.integers(CONFIRMING_SOUNDS, 12))
def test_finding_ends_after_as_many_sounds_without_it(support: int) -> None:
    steady = SteadyFindings()
    for _ in range(support):
        steady.note([TURNED], 1)
    kept = [steady.note([], 1) for _ in range(MOST_CONFIRMING)]
    assert sum(one == (TURNED,) for one in kept) == min(support, MOST_CONFIRMING) - 1
    assert kept[-1] == ()


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_publications_are_further_apart_than_the_confirming_sounds(shown: list[bool]) -> None:
    steady = SteadyFindings()
    states = [bool(steady.note([TURNED] if one else [], 1)) for one in shown]
    begins = [index for index, (before, now) in enumerate(pairwise([False, *states])) if now and not before]
    assert all(later - earlier >= 2 * CONFIRMING_SOUNDS for earlier, later in pairwise(begins))
    changes = sum(before != now for before, now in pairwise([False, *states]))
    assert changes <= 1 + len(shown) // CONFIRMING_SOUNDS


@given(sounds=st.integers(4, 64), rounds=st.integers(2, 20))
def test_finding_of_every_other_examination_of_many_sounds_is_published_once(sounds: int, rounds: int) -> None:
    steady = SteadyFindings()
    for _ in range(rounds):
        assert steady.note([TURNED], sounds) == (TURNED,)
        assert steady.note([], sounds) == (TURNED,)
    ended = [steady.note([], sounds) for _ in range(2)]
    assert ended[-1] == ()  # at most three examinations without it end it


def test_latest_words_of_a_finding_are_published() -> None:
    newer = finding("turned", message="misfit 30 -> 12 us")
    assert published(([TURNED], 3), ([newer], 1)) == (newer,)


def test_another_explanation_replaces_the_first_after_it_has_ended() -> None:
    assert published(([TURNED], 3), ([MOVED], 1), ([MOVED], 1)) == (TURNED,)
    assert published(([TURNED], 3), ([MOVED], 1), ([MOVED], 1), ([MOVED], 1)) == (MOVED,)


def test_faults_of_channels_are_independent_of_the_set_up() -> None:
    assert published(([TURNED, DEAD], 3), ([MOVED, DEAD], 3)) == (DEAD, MOVED)
    assert published(([TURNED, DEAD], 3), ([TURNED, LEVEL], 1)) == (TURNED, DEAD)
    assert published(([TURNED, DEAD], 3), ([TURNED, LEVEL], 3)) == (TURNED, LEVEL)


def test_unsure_finding_of_several_sounds_must_come_again() -> None:
    unsure = replace(TURNED, confidence=0.5)
    assert published(([unsure], 3)) == ()
    assert published(([unsure], 3), ([], 1), ([unsure], 1)) == ()
    assert published(([unsure], 3), ([unsure], 1)) == (unsure,)
