"""Subscribers: messages are numbered and filtered, and a slow reader gets a gap for what it missed."""

from __future__ import annotations

import asyncio
import json
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.fanout import BACKLOG, LAGGING, PAST, Fanout, Filter, Numbered, Pace, Subscription


def update(n: int = 0, confidence: float = 0.5, zones: tuple[str, ...] = (), sound: int | None = None) -> JsonObject:
    """Return an update of a sound, by default of a sound of its own."""
    event_id = f"lab-{n if sound is None else sound}"
    return {"kind": "update", "n": n, "event_id": event_id, "confidence": confidence, "zones": list(zones)}


def event(n: int = 0, confidence: float = 0.5, zones: tuple[str, ...] = ()) -> JsonObject:
    return {"kind": "event", "id": f"lab-{n}", "n": n, "confidence": confidence, "zones": list(zones)}


async def waiting(subscription: Subscription) -> list[JsonObject]:
    """Return all messages that wait for a subscriber."""
    messages: list[JsonObject] = []
    while True:
        try:
            messages.append(json.loads((await asyncio.wait_for(subscription.next(), 0.02)).text))
        except TimeoutError:
            return messages


def drained(subscription: Subscription) -> list[JsonObject]:
    """Return the same in an event loop of its own, to which the subscription then belongs."""
    return asyncio.run(waiting(subscription))


def test_messages_are_numbered_without_holes() -> None:
    fanout = Fanout()
    fanout.publish(update())  # before anyone listens
    one, two = fanout.subscribe(Filter()), fanout.subscribe(Filter())
    for k in range(5):
        fanout.publish(update(k))
    for subscription in (one, two):
        got = drained(subscription)
        assert [message["seq"] for message in got] == [2, 3, 4, 5, 6]
        assert [message["n"] for message in got] == [0, 1, 2, 3, 4]
        assert {message["v"] for message in got} == {API_VERSION}
    assert fanout.last_seq == 6


def test_filter_by_track_admits_its_states_and_changes_only() -> None:
    messages: list[JsonObject] = [
        {"kind": "track", "id": 7},
        {"kind": "track", "id": 8},
        {"kind": "zone", "track_id": 7},
        {"kind": "zone", "track_id": 8},
        {"kind": "event", "id": "lab-7"},
        {"kind": "arrays"},
    ]
    wanted = Filter(track=7)
    assert [wanted.passes(message) for message in messages] == [True, False, True, False, True, True]
    fanout = Fanout()
    for message in messages:
        fanout.publish(message)
    assert [message["seq"] for message in drained(fanout.subscribe(wanted, since_seq=0))] == [1, 3, 5, 6]


STATES = st.lists(
    st.tuples(
        st.floats(0.0, 0.2),
        st.sampled_from(["event", "update 1", "update 2", "track new", "track update", "track end", "arrays", "alert"]),
    ),
    max_size=60,
)


@given(steps=STATES, rate_hz=st.sampled_from([0.5, 2.0, 5.0, 30.0]))
def test_pace_limits_states_and_nothing_else(steps: list[tuple[float, str]], rate_hz: float) -> None:
    pace, now_s = Pace(rate_hz), 0.0
    passed: dict[str, list[float]] = {}
    for wait_s, name in steps:
        now_s += wait_s
        kind, _, which = name.partition(" ")
        fields = {"event_id": which} if kind == "update" else {"id": 3, "state": which}
        limited = kind in ("update", "arrays") or name == "track update"
        admitted = pace.admits(Numbered({"kind": kind, **fields}), now_s)
        before = passed.get(name, [])
        if not limited:
            assert admitted
        elif admitted:
            assert not before or now_s - before[-1] >= 1 / rate_hz
            passed[name] = [*before, now_s]
        else:  # nothing is left out without need
            assert before
            assert now_s - before[-1] < 1 / rate_hz


def test_rate_of_a_subscriber_is_its_own() -> None:
    async def received() -> list[list[int]]:
        fanout = Fanout()
        subscriptions = [fanout.subscribe(Filter(max_rate_hz=rate_hz)) for rate_hz in (None, 0.001)]
        for k in range(5):
            fanout.publish(update(k, sound=1))
        fanout.publish(event(5))
        return [[message["n"] for message in await waiting(one)] for one in subscriptions]

    assert asyncio.run(received()) == [[0, 1, 2, 3, 4, 5], [0, 5]]


def test_nothing_arrives_after_unsubscribing() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    assert fanout.clients == 1
    fanout.unsubscribe(subscription)
    fanout.unsubscribe(subscription)
    assert fanout.clients == 0
    fanout.publish(update())
    assert drained(subscription) == []


TRACK: JsonObject = {"kind": "track", "zones": ["door"]}
ARRAYS: JsonObject = {"kind": "arrays", "arrays": []}


@pytest.mark.parametrize(
    ("wanted", "passing"),
    [
        ({}, "all"),
        ({"kinds": frozenset({"event"})}, "event sure, event unsure at the door"),
        ({"kinds": frozenset({"event", "arrays"})}, "event sure, event unsure at the door, arrays"),
        ({"kinds": frozenset()}, ""),
        ({"min_confidence": 0.5}, "event sure, update, track, arrays"),
        ({"zone": "door"}, "event unsure at the door, track, arrays"),
        ({"zone": "door", "min_confidence": 0.5}, "track, arrays"),
        ({"zone": "window"}, "arrays"),
    ],
)
def test_filter_passes_what_the_client_chose(wanted: dict[str, Any], passing: str) -> None:
    messages = {
        "event sure": event(confidence=0.9),
        "event unsure at the door": event(confidence=0.1, zones=("door", "hall")),
        "update": update(confidence=0.5),
        "track": TRACK,
        "arrays": ARRAYS,
    }
    names = [name for name, message in messages.items() if Filter(**wanted).passes(message)]
    assert names == (list(messages) if passing == "all" else [name for name in passing.split(", ") if name])


def test_filtered_messages_keep_their_numbers() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter(kinds=frozenset({"event"})))
    for k in range(6):
        fanout.publish(event(k) if k % 3 == 0 else update(k))
    assert [message["seq"] for message in drained(subscription)] == [1, 4]


def test_slow_reader_loses_the_oldest_states_first_and_gets_a_gap() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    events = [3, 50, 100]
    total = BACKLOG + 120
    for k in range(total):
        fanout.publish(event(k) if k in events else update(k))

    async def read_twice() -> tuple[list[JsonObject], list[JsonObject]]:
        first = await waiting(subscription)
        fanout.publish(update(total))
        return first, await waiting(subscription)

    (gap, *rest), later = asyncio.run(read_twice())
    assert gap["kind"] == "gap"
    assert gap["missed"] == 120
    assert "reads too slowly; 120 messages were dropped" in gap["reason"]
    assert len(rest) == BACKLOG
    numbers = [message["n"] for message in rest]
    assert numbers == sorted(numbers)
    assert numbers == [*events, *range(120 + len(events), total)]
    assert [message["n"] for message in later] == [total]  # told once


def test_backlog_of_events_alone_is_bounded_too() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    for k in range(BACKLOG + 10):
        fanout.publish(event(k))
    gap, *rest = drained(subscription)
    assert gap["missed"] == 10
    assert [message["n"] for message in rest] == list(range(10, BACKLOG + 10))


def test_full_queue_without_loss_gives_no_gap() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    for k in range(BACKLOG):
        fanout.publish(update(k))
    assert [message["n"] for message in drained(subscription)] == list(range(BACKLOG))


def test_slow_reader_does_not_hinder_others() -> None:
    fanout = Fanout()
    fanout.subscribe(Filter())
    quick = fanout.subscribe(Filter())

    async def both() -> list[int]:
        got = []
        for k in range(3 * BACKLOG):
            fanout.publish(update(k))
            got.append((await quick.next()).message["n"])
        return got

    assert asyncio.run(both()) == list(range(3 * BACKLOG))


def test_next_waits_for_a_message() -> None:
    fanout = Fanout()

    async def wait() -> JsonObject:
        subscription = fanout.subscribe(Filter())
        reading = asyncio.create_task(subscription.next())
        await asyncio.sleep(0)
        assert not reading.done()
        fanout.publish(update(7))
        return (await asyncio.wait_for(reading, 1.0)).message

    assert asyncio.run(wait())["n"] == 7


def test_slow_reader_gets_every_event_and_the_newest_state_of_each_subject() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    events = [5, 700, 701, 2000]
    for k in range(3000):
        fanout.publish(event(k) if k in events else update(k, sound=k % 3))
        if k % 10 == 0:
            fanout.publish({"kind": "track", "id": 1, "n": k})
            fanout.publish({"kind": "arrays", "n": k})
    got = drained(subscription)
    assert len(got) < BACKLOG
    assert [message["n"] for message in got if message["kind"] == "event"] == events
    numbers = [message["seq"] for message in got]
    assert numbers == sorted(numbers)
    by_sound = {message["event_id"]: message["n"] for message in got if message["kind"] == "update"}
    assert by_sound == {"lab-0": 2997, "lab-1": 2998, "lab-2": 2999}
    assert [message["n"] for message in got if message["kind"] in ("track", "arrays")][-2:] == [2990, 2990]
    assert "gap" not in {message["kind"] for message in got}  # nothing is missing that is not told again
    assert fanout.superseded == 3000 + 600 - len(got)


def test_reader_that_keeps_up_gets_everything() -> None:
    fanout = Fanout()
    subscription = fanout.subscribe(Filter())
    for k in range(LAGGING):
        fanout.publish(update(k, sound=0))
    assert [message["n"] for message in drained(subscription)] == list(range(LAGGING))
    late = fanout.subscribe(Filter())
    for k in range(LAGGING + 1):
        fanout.publish(update(k, sound=0))
    assert [message["n"] for message in drained(late)] == [*range(LAGGING - 1), LAGGING]


def test_text_is_made_once_for_all_subscribers() -> None:
    fanout = Fanout()
    one, two = fanout.subscribe(Filter()), fanout.subscribe(Filter())
    fanout.publish(event(1))

    async def texts() -> list[str]:
        return [(await subscription.next()).text for subscription in (one, two)]

    first, second = asyncio.run(texts())
    assert first is second


def numbers(subscription: Subscription) -> list[Any]:
    return [message.get("seq", message) for message in drained(subscription)]


def test_client_that_reconnects_gets_what_it_missed_in_order() -> None:
    fanout = Fanout(first_seq=100)
    for k in range(10):
        fanout.publish(update(k) if k % 2 else event(k))
    back = fanout.subscribe(Filter(), since_seq=104)
    events_only = fanout.subscribe(Filter(frozenset({"event"})), since_seq=104)
    fanout.publish(event(11))
    assert numbers(back) == [105, 106, 107, 108, 109, 110, 111]
    assert numbers(events_only) == [105, 107, 109, 111]
    assert numbers(fanout.subscribe(Filter(), since_seq=111)) == []
    assert numbers(fanout.subscribe(Filter())) == []


def test_client_that_reconnects_gets_a_gap_for_what_is_no_longer_kept() -> None:
    fanout = Fanout(first_seq=100)
    for k in range(PAST + 50):
        fanout.publish(event(k))
    gap, *rest = drained(fanout.subscribe(Filter(), since_seq=110))
    assert (gap["kind"], gap["missed"]) == ("gap", 40)
    assert "after number 110 are gone, up to 150; GET events" in gap["reason"]
    assert [message["seq"] for message in rest] == list(range(151, 101 + PAST + 50))
    gap, *rest = drained(fanout.subscribe(Filter(), since_seq=7))  # of the server's life before
    assert (gap["kind"], gap["missed"], len(rest)) == ("gap", None, PAST)
    (gap,) = drained(fanout.subscribe(Filter(), since_seq=10**6))
    assert gap["missed"] is None
    assert "number 1000000 was not published" in gap["reason"]


def test_kept_messages_of_many_arrays_are_small_and_unchanged() -> None:
    fanout = Fanout()
    live = fanout.subscribe(Filter())
    texts = []
    tracemalloc.start()
    try:
        for n in range(PAST):
            contributions = [{"array": f"a{k}", "power_dbfs": -0.1 * k * n, "agrees": None} for k in range(64)]
            fanout.publish({**update(n), "contributions": contributions})
            if n >= PAST - 5:
                texts += asyncio.run(_texts(live))
            else:
                asyncio.run(_texts(live))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 6e6  # as objects more than 30 MB
    assert asyncio.run(_texts(fanout.subscribe(Filter(), since_seq=PAST - 5))) == texts


async def _texts(subscription: Subscription) -> list[str]:
    texts = []
    while subscription.lags or subscription.past:
        texts.append((await subscription.next()).text)
    return texts
