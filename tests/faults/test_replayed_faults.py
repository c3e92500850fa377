"""Whatever is killed, cut or delayed, and when: one stored event for each sound, the same as undisturbed."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from scenarios import HARMLESS, difference, links_narrow, nodes_killed, undisturbed
from world import World
from world_parts import Event

SEEDS = range(2)  # `benchmarks/faults.py` plays hundreds


@cache
def expected(seed: int) -> list[Event]:
    return undisturbed(seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_undisturbed_each_sound_is_one_event_and_none_is_late(seed: int) -> None:
    world = World(seed)
    world.recover()
    assert len(world.events()) == len(world.groups()) == 8
    assert len(world.published_events) == 8
    assert not any(event["late"] or event["replaces"] for event in world.published_events)
    assert max(event["latency_s"] for event in world.published_events) < 0.6


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", HARMLESS)
def test_fault_changes_no_event(name: str, seed: int) -> None:
    assert difference(seed, HARMLESS[name], expected(seed)) is None


@pytest.mark.parametrize(("name", "seed"), [("everything", 2061)])
def test_fault_that_changed_an_event_once_does_so_no_more(name: str, seed: int) -> None:
    """2061: a connection broke with kept frames on their way, and the next began with the word that all were sent."""
    assert difference(seed, HARMLESS[name], expected(seed)) is None


@pytest.mark.parametrize("seed", SEEDS)
def test_dead_node_costs_what_it_did_not_hear(seed: int, tmp_path: Path) -> None:
    assert nodes_killed(seed, tmp_path, expected(seed)) is None


def test_lost_frames_would_be_seen() -> None:
    """The comparison can fail: a spool that forgets the first half of what it holds changes events."""

    def forgets(world: World) -> None:
        world.cut.add("a")
        world.run(100)
        spool = world.nodes["a"].spool
        kept = [frame.frame_index for frame in spool.frames() if frame.array == "north"]
        spool.forget("north", kept[len(kept) // 2])
        world.heal("a")

    assert difference(0, forgets, expected(0)) is not None


def test_a_narrow_link_carries_nothing_twice() -> None:
    """Where nothing breaks nothing is lost: the server misses no frame, and gets none again."""
    world = World(1)
    links_narrow(world)
    world.recover()
    assert world.server is not None
    arrays = world.server.array_states.describe()
    assert sum(array["counters"]["backfilled"] for array in arrays) > 200
    assert [array["counters"][what] for array in arrays for what in ("sequence_gaps", "duplicates")] == [0] * 4


def test_late_events_are_marked_and_name_what_they_replace() -> None:
    world = World(1)
    both = next(sound for sound in world.groups() if sum(bool(sound & a) for _, a in world.sounds) == 2)
    world.run(min(both) - world.frame_index - 20)
    world.cut.add("a")
    world.run(max(both) - min(both) + 50)
    provisional = world.published_events[-1]
    assert (provisional["heard_by"], provisional["late"]) == (["south"], False)
    world.heal("a")
    world.run(40)
    (late,) = [event for event in world.published_events if event["late"]]
    assert late["heard_by"] == ["north", "south"]
    assert (late["replaces"], late["id"]) == ([], provisional["id"])
    stored = [event for event in world.events() if event["id"] == late["id"]]
    assert [event["heard_by"] for event in stored] == [["north", "south"]]


def test_late_event_of_another_id_takes_the_place_of_what_was_told() -> None:
    """Where the array that was away heard the sound first, the event begins earlier, and is named after that."""
    world, first, after = next(
        (world, min(a), min(b))
        for world in map(World, range(20))
        for (north, a), (south, b) in pairwise(world.sounds)
        if (north, south) == ("north", "south") and 0 < min(b) - min(a) < 3 and max(b) - min(a) < 30
    )
    world.run(first - world.frame_index - 20)
    world.cut.add("a")
    world.run(20 + 70)
    provisional = world.published_events[-1]
    assert provisional["id"] == f"small-{after * 50}"
    world.heal("a")
    world.run(40)
    late = next(event for event in world.published_events if event["late"])
    assert late["id"] == f"small-{first * 50}"
    assert late["replaces"] == [provisional["id"]]
    assert provisional["id"] not in [event["id"] for event in world.events()]


def test_dead_array_delays_nobody() -> None:
    """An array that is gone costs the others the deadline once; their later events are as prompt as ever."""
    world = World(2)
    world.run(20)
    world.kill_node("b")
    world.run(world.end - world.frame_index + 20)
    heard = [e for e in world.published_events if e["heard_by"] == ["north"]]
    assert len(heard) == len([1 for array, _ in world.sounds if array == "north"])
    assert max(event["latency_s"] for event in heard) < 0.6
