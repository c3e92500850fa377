"""What can befall a site in simulated time, by name; and what must be so afterwards."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from pathlib import Path

from world import World
from world_parts import Event

Fault = Callable[[World], None]


def nothing(world: World) -> None:
    """Undisturbed."""


def server_killed(world: World) -> None:
    """With -9 at any moment: between two turns, just before events are stored, or just after."""
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 40))
        _kill_server(world)
        world.run(world.rng.randint(0, 60))
        world.start_server()


def links_cut(world: World) -> None:
    """One node's or both, for up to a minute."""
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 100))
        names = world.rng.choice([["a"], ["b"], ["a", "b"]])
        world.cut.update(names)
        world.run(world.rng.choice([5, 30, 60, 300, 1200]))
        for name in names:
            world.heal(name)


def connections_reset(world: World) -> None:
    """What was on its way is gone, in both directions."""
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 30))
        world.reset(world.rng.choice("ab"))


def stalls(world: World) -> None:
    """Packets lost under TCP: for up to a second nothing comes, then everything."""
    world.delay_ticks = (0, 20)


def links_narrow(world: World) -> None:
    """Room for a frame in each interval, for less, or for hardly one in a second; marks take some of it too."""
    while world.frame_index < world.end:
        world.bytes_per_tick = world.rng.choice([40, 80, 150, 300, 600])
        world.run(world.rng.choice([20, 100, 400, 800]))


def cut_then_narrow(world: World) -> None:
    """What was kept while a link was cut has to follow over one that hardly carries what is heard."""
    while world.frame_index < world.end:
        world.bytes_per_tick = inf
        world.run(world.rng.randint(1, 60))
        names = world.rng.choice([["a"], ["b"], ["a", "b"]])
        world.cut.update(names)
        world.run(world.rng.choice([5, 20, 45, 60, 120, 300]))
        world.bytes_per_tick = world.rng.choice([40, 80, 150, 300, 600])
        for name in names:
            world.heal(name)
        world.run(world.rng.choice([20, 60, 100, 200, 400]))


def nodes_stopped(world: World) -> None:
    """With SIGSTOP for up to two seconds; the device's buffer holds what is heard meanwhile."""
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 60))
        node = world.nodes[world.rng.choice("ab")]
        node.stopped = True
        world.run(world.rng.randint(1, 40))
        node.stopped = False


def disk_full(world: World) -> None:
    """The database takes nothing for a while, and the server is killed meanwhile or not."""
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 60))
        world.store.full = True
        world.run(world.rng.randint(1, 100))
        if world.rng.random() < 0.3:
            world.kill_server()
            world.start_server()
        world.store.full = False


def everything(world: World) -> None:
    """All of it, and messages that take up to 0.3 s."""
    world.delay_ticks = (0, 6)
    while world.frame_index < world.end:
        world.run(world.rng.randint(1, 50))
        match world.rng.randint(0, 4):
            case 0:
                _kill_server(world)
                world.run(world.rng.randint(0, 100))
            case 1:
                name = world.rng.choice("ab")
                world.cut.add(name)
                world.run(world.rng.randint(1, 200))
                world.heal(name)
            case 2:
                world.reset(world.rng.choice("ab"))
            case 3:
                world.store.full = True
                world.run(world.rng.randint(1, 40))
                world.store.full = False
            case 4:
                node = world.nodes[world.rng.choice("ab")]
                node.stopped = True
                world.run(world.rng.randint(1, 40))
                node.stopped = False
        if world.server is None:
            world.start_server()


def _kill_server(world: World) -> None:
    how = world.rng.choice(["between", "before", "after"])
    world.store.dies = None if how == "between" else how
    while world.store.dies is not None and world.frame_index < world.end:
        world.tick()
    world.kill_server()


HARMLESS: dict[str, Fault] = {
    "nothing": nothing,
    "server killed": server_killed,
    "links cut": links_cut,
    "connections reset": connections_reset,
    "stalls": stalls,
    "links narrow": links_narrow,
    "links cut, then narrow": cut_then_narrow,
    "nodes stopped": nodes_stopped,
    "disk full": disk_full,
    "everything": everything,
}
"""Faults that no sound is lost by: the events must be those of the undisturbed run, to the last sample."""


def undisturbed(seed: int) -> list[Event]:
    """The events of a world in which nothing happens."""
    world = World(seed)
    world.recover()
    return world.events()


def difference(seed: int, fault: Fault, expected: list[Event]) -> str | None:
    """What a fault has changed; None where all is as undisturbed, and the spools are empty again."""
    world = World(seed)
    fault(world)
    world.recover()
    got = world.events()
    if got != expected:
        wrong = [e["id"] for e in expected if e not in got], [e["id"] for e in got if e not in expected]
        return f"missing or changed: {wrong[0]}; there instead: {wrong[1]}"
    for node in world.nodes.values():
        if node.link.dropped or node.link.kept > 60:  # what the next sound may begin with, and what is on its way
            return f"node {node.name} keeps {node.link.kept} frames and has dropped {node.link.dropped}"
    return None


def nodes_killed(seed: int, spools: Path, expected: list[Event]) -> str | None:
    """Nodes die too, and only their spools outlive them.

    What a dead node did not hear nobody can give back; but no sound is told twice, and each that all nodes lived
    through is told as undisturbed. Returns what is wrong.
    """
    world = World(seed, spools=spools)
    while world.frame_index < world.end:
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
        if world.was_up(sound) and (len(events) != 1 or events[0] not in expected):
            return f"sound at {min(sound)}: expected one event as undisturbed, got {[e['id'] for e in events]}"
    for event in world.events():
        if sum(event in events for _, events in found) != 1:
            return f"event {event['id']} belongs to no sound, or to two"
    return None
