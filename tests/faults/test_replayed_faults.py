"""Whatever is killed, cut or delayed, and when: one stored event for each sound, the same as undisturbed."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from world import Event, World

SEEDS = range(12)


@cache
def undisturbed(seed: int) -> tuple[Event, ...]:
    world = World(seed)
    world.recover()
    return tuple(world.events())


def assert_as_undisturbed(world: World, seed: int) -> None:
    world.recover()
    assert world.events() == list(undisturbed(seed))
    for node in world.nodes.values():
        assert node.link.kept <= 30  # what the next sound may begin with
        assert node.link.dropped == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_undisturbed_each_sound_is_one_event(seed: int) -> None:
    world = World(seed)
    world.recover()
    assert len(world.events()) == len(world.groups()) == 8
    assert len(world.published_events) == 8
    assert not any(event["late"] for event in world.published_events)
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_server_killed_again_and_again(seed: int) -> None:
    world = World(seed)
    while world.raster < world.end:
        world.run(world.rng.randint(1, 40))
        how = world.rng.choice(["between", "before", "after"])
        if how == "between":
            world.kill_server()
        else:
            world.store.dies = how
            while world.server is not None and world.raster < world.end:
                world.tick()
        world.run(world.rng.randint(0, 60))
        world.start_server()
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_links_cut_for_up_to_a_minute(seed: int) -> None:
    world = World(seed)
    while world.raster < world.end:
        world.run(world.rng.randint(1, 100))
        names = world.rng.choice([["a"], ["b"], ["a", "b"]])
        for name in names:
            world.cut.add(name)
        world.run(world.rng.choice([5, 30, 60, 300, 1200]))
        for name in names:
            world.heal(name)
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_connections_reset(seed: int) -> None:
    world = World(seed)
    while world.raster < world.end:
        world.run(world.rng.randint(1, 30))
        world.reset(world.rng.choice("ab"))
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_stalls_of_a_second(seed: int) -> None:
    """Loss on a TCP connection: nothing arrives, then all of it."""
    world = World(seed, delay_ticks=(0, 20))
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_everything_at_once(seed: int) -> None:
    world = World(seed, delay_ticks=(0, 6))
    while world.raster < world.end:
        world.run(world.rng.randint(1, 50))
        match world.rng.randint(0, 3):
            case 0:
                world.kill_server()
                world.run(world.rng.randint(0, 100))
                world.start_server()
            case 1:
                name = world.rng.choice("ab")
                world.cut.add(name)
                world.run(world.rng.randint(1, 200))
                world.heal(name)
            case 2:
                world.reset(world.rng.choice("ab"))
            case 3:
                world.store.dies = world.rng.choice(["before", "after"])
        if world.server is None:
            world.start_server()
    assert_as_undisturbed(world, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_nodes_killed(seed: int, tmp_path: Path) -> None:
    """What a dead node does not hear nobody can give back; but no sound is told twice, and what was heard is told."""
    world = World(seed, spools=tmp_path)
    while world.raster < world.end:
        world.run(world.rng.randint(1, 100))
        name = world.rng.choice("ab")
        world.kill_node(name)
        if world.rng.random() < 0.5:
            world.kill_server()
        world.run(world.rng.randint(1, 60))
        world.start_node(name)
        if world.server is None:
            world.start_server()
    world.recover()
    found = world.found()
    for sound, events in found:
        if world.was_up(sound):
            assert len(events) == 1
            assert [event for event in undisturbed(seed) if event["id"] == events[0]["id"]] == events
    for event in world.events():
        assert sum(event in events for _, events in found) == 1
