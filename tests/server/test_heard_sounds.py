"""The server keeps the last sounds with their delays."""

from __future__ import annotations

import pytest

from known_sounds import events
from livessl.server import heard_sounds
from livessl.server.heard_sounds import KEPT, HeardSounds


@pytest.fixture
def heard() -> HeardSounds:
    return HeardSounds()


def test_sounds_have_numbers_and_delays_and_are_read_from_any_number_on(heard: HeardSounds) -> None:
    for event in events()[:3]:
        heard.take(event)
    assert [sound.number for sound in heard.after(0)] == [1, 2, 3]
    assert [sound.number for sound in heard.after(2)] == [3]
    (third,) = heard.numbered([3])
    assert {one.array for one in third.observations} == {"north", "south"}
    assert third.event == events()[2]
    assert third.event.received == ()


def test_numbers_continue_when_the_sounds_are_forgotten(heard: HeardSounds) -> None:
    heard.take(events()[0])
    heard.forget()
    assert (heard.after(0), heard.last) == ([], 1)
    heard.take(events()[1])
    assert [sound.number for sound in heard.after(0)] == [2]


def test_numbers_begin_where_the_server_says() -> None:
    heard = HeardSounds(1000)
    assert heard.read(0) == ([], 1000)
    heard.take(events()[0])
    assert [sound.number for sound in heard.after(1000)] == [1001]


def test_sound_that_comes_while_others_are_measured_is_not_skipped(
    heard: HeardSounds, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(_: object) -> tuple[()]:
        if heard.last == 1:
            heard.take(events()[1])
        return ()

    monkeypatch.setattr(heard_sounds, "observe", measured)
    heard.take(events()[0])
    sounds, last = heard.read(0)
    assert ([sound.number for sound in sounds], last) == ([1], 1)
    sounds, last = heard.read(last)
    assert ([sound.number for sound in sounds], last) == ([2], 2)


def test_the_oldest_sounds_go(heard: HeardSounds) -> None:
    for _ in range(KEPT + 2):
        heard.take(events()[0])
    assert [sound.number for sound in heard.after(0)] == list(range(3, KEPT + 3))
    with pytest.raises(LookupError, match="2"):
        heard.numbered([3, 2])
