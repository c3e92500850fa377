"""`livessl simulate`: simulates a scene in the site's room, and writes the arrays' recordings as a session."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from livessl.cli import argument, progress
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.options import add_older_name, add_site, each_once, make_folder
from livessl.cli.output import complain
from livessl.cli.own_work import refuse_foreign
from livessl.errors import ConfigError, Fault, UseError, did_you_mean

if TYPE_CHECKING:
    from livessl.simulation.scene import Scene
    from livessl.site.models import Site

COUNT: Final = 8
"""Number of sounds, if neither --count nor --at is given."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    sounds = parser.add_argument(
        "--sounds",
        type=Path,
        metavar="DIR",
        help="folder of sound files, WAV or FLAC, to place in the room (default: built-in sounds); "
        "--count of them are used",
    )
    add_older_name(parser, "--events", sounds)
    parser.add_argument(
        "--rt60",
        type=argument.rt60,
        default=0.7,
        metavar="S",
        help=f"reverberation time in seconds, 0 to {argument.MAX_RT60_S:g} (default: 0.7)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for the session; it must be new, empty, or contain a simulated session, which is replaced",
    )
    parser.add_argument(
        "--clap", action="store_true", help="make claps of two hands instead of doors, keys, telephones and voices"
    )
    _add_places(parser)
    rate = parser.add_argument(
        "--rate",
        dest="sample_rate",
        type=argument.sample_rate,
        metavar="HZ",
        help="sampling rate of the recordings (default: the rate of each node's device, otherwise 44100)",
    )
    add_older_name(parser, "--sample-rate", rate)
    parser.add_argument(
        "--seed", type=argument.seed, default=0, help="random seed; the same seed gives the same session (default: 0)"
    )
    parser.add_argument(
        "--inverted",
        action="append",
        type=argument.channels,
        default=[],
        metavar="ARRAY=2",
        help="microphones of ARRAY, counted from 1, whose cables invert the signal: a fault made on purpose, for "
        "exercises and tests; repeat the option for each array",
    )


def _add_places(parser: Any) -> None:
    parser.add_argument(
        "--count",
        type=argument.positive,
        metavar="N",
        help="number of sounds in the scene, at random places (default: 8)",
    )
    parser.add_argument(
        "--at",
        action="append",
        type=argument.place,
        default=[],
        metavar="X,Y,Z",
        help="place of a sound in metres, instead of random ones; repeat the option for each, in their order",
    )
    parser.add_argument(
        "--pause",
        type=argument.not_negative,
        metavar="S",
        help="least pause between the reverberation of a sound and the next sound, seconds (default: 0.8)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.recordings.session import SESSION_FILE
    from livessl.simulation.export import TRUTH_FILE, scene_files, simulated_files, write_scene
    from livessl.simulation.of_site import DEFAULT_RATE_HZ, device_rates_hz
    from livessl.site.load import load_site

    _refuse_both(arguments)
    site = load_site(arguments.site)
    inverted = _inverted(arguments, site)
    if (arguments.out / SESSION_FILE).exists() and not (arguments.out / TRUTH_FILE).exists():
        raise ConfigError([Fault(f"--out {arguments.out}", "holds a recorded session; choose another folder")])
    option, own = f"--out {arguments.out}", simulated_files(arguments.out)
    foreign = "which does not belong to a complete simulated session"
    refuse_foreign(option, scene_files(arguments.out, site), own.__contains__, arguments.site, foreign)
    rates = {} if arguments.sample_rate else device_rates_hz(site)
    rate = float(arguments.sample_rate or max(rates.values(), default=DEFAULT_RATE_HZ))
    try:
        scene = _scene(arguments, site, rate)
        make_folder(arguments.out, "--out")
        with progress.counted("simulating the room", "source") as bar:
            seed = arguments.seed
            write_scene(arguments.out, site, scene, seed=seed, rates_hz=rates, inverted=inverted, progress=bar)
    except ValueError as error:
        complain(str(error))
        return WRONG_USE
    logging.info("%d sounds in %.1f s written to %s", len(scene.sources), scene.duration_s, arguments.out)
    return OK


def _refuse_both(arguments: argparse.Namespace) -> None:
    """Raise an error if options are given that say the same in two ways."""
    for first, second, both in (
        ("--clap", "--sounds", arguments.clap and arguments.sounds),
        ("--at", "--count", arguments.at and arguments.count),
    ):
        if both:
            raise UseError(f"simulate: expected {first} or {second}, got both; remove one of them")


def _scene(arguments: argparse.Namespace, site: Site, rate_hz: float) -> Scene:
    """Return the scene that the arguments describe.

    Raises
    ------
    ValueError
        If there is no such scene, or sound files cannot be used.
    """
    from livessl.simulation.of_site import at_places, scene_of
    from livessl.simulation.scene import GAP_S, read_sounds, synthesised_claps

    count = len(arguments.at) or arguments.count or COUNT
    sounds = None
    if arguments.sounds:
        sounds = read_sounds(arguments.sounds, rate_hz)
    elif arguments.clap:
        sounds = synthesised_claps(rate_hz, arguments.seed, count)
    scene = scene_of(
        site,
        rt60_s=arguments.rt60,
        sounds=sounds,
        count=count,
        sample_rate_hz=rate_hz,
        seed=arguments.seed,
        gap_s=GAP_S if arguments.pause is None else arguments.pause,
    )
    return at_places(scene, arguments.at) if arguments.at else scene


def _inverted(arguments: argparse.Namespace, site: Site) -> dict[str, list[int]]:
    """Return the inverted channels by array.

    Raises
    ------
    ConfigError
        If an array is unknown or named twice, or has no such microphone.
    """
    inverted = each_once(arguments.inverted, "--inverted")
    faults = []
    for name, numbers in inverted.items():
        option = f"--inverted {name}={','.join(map(str, numbers))}"
        if name not in site.arrays:
            known = ", ".join(site.arrays)
            faults.append(
                Fault(option, f"expected one of the arrays {known}, got {name!r}{did_you_mean(name, site.arrays)}")
            )
            continue
        microphones = len(site.array(name).microphones_m)
        if min(numbers) < 1 or max(numbers) > microphones:
            faults.append(Fault(option, f"expected microphones from 1 to {microphones}; correct the number"))
    if faults:
        raise ConfigError(faults)
    return inverted
