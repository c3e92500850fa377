"""The work of `livessl init`: asks for room, arrays and interfaces, or takes defaults, and writes the site file.

The YAML text is made in `site/draft.py`.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from livessl.cli import argument, draft_arguments
from livessl.cli.draft_arguments import ArrayWish
from livessl.cli.exits import OK
from livessl.cli.options import each_once
from livessl.cli.output import complain
from livessl.cli.questions import Questions, one_of
from livessl.errors import ConfigError, DeviceError, Fault
from livessl.site.draft import order, proposed_pose, searchable, shape_m, site_text
from livessl.site.draft_nodes import nodes_of
from livessl.site.draft_parts import SIZE_M, Draft, DraftArray, DraftNode
from livessl.site.fields import Position
from livessl.site.interfaces import INTERFACES, known_interface
from livessl.site.load import parse_site
from livessl.site.models import Site

T = TypeVar("T")

ROOM_M: Final = (6.0, 5.0, 2.7)
"""Size of the room, in metres, where nothing is given: one to be replaced."""

USUAL_C: Final = 20.0
"""Temperature of the air, in degrees Celsius, where nothing is given."""

INTERFACE: Final = "UMC1820"
"""Interface where nothing is given and none is connected: the paper's, with eight inputs for microphones."""


def write(arguments: argparse.Namespace) -> int:
    """Write the site file, or the drawing, that the arguments and the answers describe; return the exit code.

    Raises
    ------
    ConfigError
        If the file exists, or if what is described is no valid site; nothing is written then.
    """
    path = arguments.site if arguments.drawing is None else arguments.drawing
    _refuse_to_overwrite(path, arguments.force)
    questions = Questions(ask=not arguments.yes and sys.stdin.isatty())
    if not (questions.asks or arguments.yes):
        logging.info("stdin is not a terminal, so defaults are used, as with --yes")
    draft = _draft(arguments, questions)
    text = site_text(draft)
    warnings = _parsed(draft).warnings
    if arguments.drawing is not None:
        from livessl.lab.frame_drawing import drawing

        array = draft.arrays[0]
        title = f"{array.kind}, {draft_arguments.SIZES[array.kind]} {1000 * array.size_m:g} mm"
        path.write_text(drawing(title.capitalize(), order(array), shape_m(array)), encoding="utf-8")
        print(f"{path}: drawing of a {title}; print it at 100 % and measure the scale")
        return OK
    path.write_text(text, encoding="utf-8")
    for warning in warnings:
        complain(warning, kind="note")
    _print_next(path, draft)
    return OK


def _refuse_to_overwrite(path: Path, force: bool) -> None:
    """Raise an error if the file cannot be written, before anything is asked."""
    what = None
    if path.is_dir():
        what = "expected the name of a file, got a folder; give a name in it, such as site.yaml"
    elif not path.parent.is_dir():
        what = f"expected a folder that exists, got {path.parent}; make it, or give another name"
    elif path.exists() and not force:
        what = "expected a new file, but it exists; give another name, or add --force"
    if what is not None:
        raise ConfigError([Fault(str(path), what)])


def _parsed(draft: Draft) -> Site:
    """Return the site of a draft.

    Raises
    ------
    ConfigError
        With every fault, by its place in the site, since there is no file with lines yet.
    """
    try:
        return parse_site(site_text(draft), "")
    except ConfigError as error:
        raise ConfigError([Fault(fault.where.partition(": ")[2], fault.what) for fault in error.faults]) from error


def _valid(questions: Questions, ask: Callable[[], T], draft_of: Callable[[T], Draft]) -> T:
    """Return what `ask` returns, once a draft with it is a valid site; faults are explained and asked about again.

    Raises
    ------
    ConfigError
        If it is no valid site, and nothing is asked.
    """
    while True:
        answered = ask()
        try:
            _parsed(draft_of(answered))
        except ConfigError as error:
            if not questions.asks:
                raise
            for fault in error.faults:
                questions.say(f"  {fault.what}")
            continue
        return answered


def _print_next(path: Path, draft: Draft) -> None:
    nodes = ", ".join(f"{node.name} ({node.interface})" for node in draft.nodes)
    print(f"{path}: site {draft.site!r} with arrays {', '.join(array.name for array in draft.arrays)}; nodes {nodes}")
    print(f"next: livessl check {path}")
    print(f"      livessl serve --site {path}")
    for node in draft.nodes:
        print(f"      livessl capture --site {path} --node {node.name}")


def _draft(arguments: argparse.Namespace, questions: Questions) -> Draft:
    site = arguments.name or questions.answer("Name of the site", "lab", draft_arguments.name)
    room_m, celsius = _valid(
        questions if arguments.room is None or arguments.temperature is None else Questions(ask=False),
        lambda: _room(arguments, questions),
        lambda answered: Draft(site, *answered, (_in_the_middle(answered[0]),), ()),
    )
    arrays = _arrays(arguments, questions, Draft(site, room_m, celsius, (), ()))
    draft = Draft(site, room_m, celsius, arrays, ())
    channels = each_once(arguments.channels, "--channels")
    known = bool(arguments.interface) and all(map(known_interface, arguments.interface))
    connected = {} if known else _connected()
    interfaces = arguments.interface or [_interface(questions, connected)]
    nodes = nodes_of(arrays, interfaces, connected, arguments.rate, channels)
    if not channels:
        nodes = _valid(questions, lambda: _wired(nodes, questions), lambda wired: replace(draft, nodes=wired))
    return searchable(replace(draft, nodes=nodes))


def _room(arguments: argparse.Namespace, questions: Questions) -> tuple[Position, float]:
    """Return the size of the room in metres and its temperature in degrees Celsius."""
    room_m = arguments.room or questions.answer(
        "Length, width and height of the room in metres", ROOM_M, draft_arguments.room, ",".join(map(str, ROOM_M))
    )
    celsius = arguments.temperature
    if celsius is None:
        celsius = questions.answer("Temperature in degrees Celsius", USUAL_C, draft_arguments.finite, f"{USUAL_C:g}")
    return room_m, celsius


def _in_the_middle(room_m: Position) -> DraftArray:
    """Return a small array as a placeholder, so that the room can be checked alone."""
    x, y, z = room_m
    return DraftArray("array", "tetrahedron", min(room_m) / 10.0, 4, (x / 2.0, y / 2.0, z / 2.0), 0.0)


def _wired(nodes: Sequence[DraftNode], questions: Questions) -> tuple[DraftNode, ...]:
    """Return the nodes with the inputs that are asked for."""
    return tuple(
        replace(
            node,
            channels={
                name: questions.answer(
                    f"Inputs of {name} on {node.interface}, in the order of its microphones",
                    given,
                    draft_arguments.inputs,
                    ",".join(map(str, given)),
                )
                for name, given in node.channels.items()
            },
        )
        for node in nodes
    )


def _arrays(arguments: argparse.Namespace, questions: Questions, room: Draft) -> tuple[DraftArray, ...]:
    """Return the arrays, each valid in the room beside those before it."""
    wishes: list[ArrayWish] = list(arguments.array)
    count = arguments.arrays or len(wishes)
    if not count:
        count = questions.answer("Number of arrays", 2, draft_arguments.array_count)
    if len(wishes) > count:
        what = f"expected at least the {len(wishes)} arrays of --array, got {count}; correct one of them"
        raise ConfigError([Fault("--arrays", what)])
    given = len(wishes)
    wishes += [ArrayWish(name) for name in _free_names([wish.name for wish in wishes], count - given)]
    each_once([(wish.name, None) for wish in wishes], "--array")
    arrays: list[DraftArray] = []
    for index, wish in enumerate(wishes):
        asks = questions if index >= given else Questions(ask=False)
        array = _valid(
            asks,
            partial(_array, wish, room.room_m, (index, count), asks),
            lambda array: replace(room, arrays=(*arrays, array)),
        )
        arrays.append(array)
    return tuple(arrays)


def _array(wish: ArrayWish, room_m: Position, place: tuple[int, int], questions: Questions) -> DraftArray:
    """Return one array; `place` is its index and the number of arrays."""
    name = questions.answer("Name of an array", wish.name, draft_arguments.name)
    kind = questions.answer(f"  kind of {name}: {', '.join(SIZE_M)}", wish.kind, one_of(list(SIZE_M)))
    size_m = wish.size_m or questions.answer(
        f"  its {draft_arguments.SIZES[kind]} in metres", SIZE_M[kind], argument.above_zero
    )
    count = wish.count
    if kind in draft_arguments.COUNTED:
        count = questions.answer("  number of microphones", count, argument.positive)
    centre_m, yaw_deg = proposed_pose(room_m, kind, *place)
    centre_m = wish.centre_m or questions.answer(
        "  its centre x,y,z in metres from one corner of the floor",
        centre_m,
        argument.place,
        ",".join(f"{length:g}" for length in centre_m),
    )
    if wish.yaw_deg is not None:
        yaw_deg = wish.yaw_deg
    else:
        yaw_deg = questions.answer("  its yaw in degrees, 0 along x", yaw_deg, draft_arguments.finite, f"{yaw_deg:g}")
    return DraftArray(name, kind, size_m, count, centre_m, yaw_deg)


def _free_names(taken: Sequence[str], count: int) -> list[str]:
    """Return names for further arrays, which no other array has."""
    names = (f"array-{number}" for number in range(1, len(taken) + count + 1))
    return [name for name in names if name not in taken][:count]


def _connected() -> dict[str, int]:
    """Return the interfaces that are connected, with their number of inputs; none without PortAudio."""
    from livessl.capture.input_search import list_inputs

    try:
        return {device.name: device.channels for device in list_inputs() if device.is_hardware}
    except DeviceError:
        return {}


def _interface(questions: Questions, connected: Mapping[str, int]) -> str:
    """Return the interface to use: by default the connected one with most inputs."""
    best = max(connected, key=lambda name: connected[name], default=INTERFACE)
    known = known_interface(best)
    default = best.partition(" (hw:")[0] if known is None else known.name
    for name, inputs in connected.items():
        questions.say(f"  connected: {name}, {inputs} inputs")
    questions.say(f"  known: {', '.join(one.name for one in INTERFACES)}; others work, too")
    chosen = questions.answer("Audio interface, by a part of its name", default, str)
    if not connected and not questions.asks:
        logging.info("no interface is connected; %r is written in its place: see `livessl devices`", chosen)
    return chosen
