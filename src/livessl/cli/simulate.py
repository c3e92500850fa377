"""`livessl simulate`: simulates a scene in the site's room, and writes the arrays' recordings as a session."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from livessl.cli import argument, progress
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.options import add_older_name, add_site, make_folder
from livessl.cli.output import complain
from livessl.cli.own_work import refuse_foreign
from livessl.errors import ConfigError, Fault


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    sounds = parser.add_argument(
        "--sounds",
        type=Path,
        metavar="DIR",
        help="folder of sound files, WAV or FLAC, to place in the room (default: built-in sounds); --count is the "
        "number of sounds",
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
    parser.add_argument("--count", type=argument.positive, default=8, help="number of sounds in the scene (default: 8)")
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


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.recordings.session import SESSION_FILE
    from livessl.simulation.export import TRUTH_FILE, scene_files, simulated_files, write_scene
    from livessl.simulation.of_site import DEFAULT_RATE_HZ, device_rates_hz, scene_of
    from livessl.simulation.scene import read_sounds
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    if (arguments.out / SESSION_FILE).exists() and not (arguments.out / TRUTH_FILE).exists():
        raise ConfigError([Fault(f"--out {arguments.out}", "holds a recorded session; choose another folder")])
    option, own = f"--out {arguments.out}", simulated_files(arguments.out)
    foreign = "which does not belong to a complete simulated session"
    refuse_foreign(option, scene_files(arguments.out, site), own.__contains__, arguments.site, foreign)
    rates = {} if arguments.sample_rate else device_rates_hz(site)
    rate = float(arguments.sample_rate or max(rates.values(), default=DEFAULT_RATE_HZ))
    try:
        sounds = read_sounds(arguments.sounds, rate) if arguments.sounds else None
        scene = scene_of(
            site,
            rt60_s=arguments.rt60,
            sounds=sounds,
            count=arguments.count,
            sample_rate_hz=rate,
            seed=arguments.seed,
        )
        make_folder(arguments.out, "--out")
        with progress.counted("simulating the room", "source") as bar:
            write_scene(arguments.out, site, scene, seed=arguments.seed, rates_hz=rates, progress=bar)
    except ValueError as error:
        complain(str(error))
        return WRONG_USE
    logging.info("%d sounds in %.1f s written to %s", len(scene.sources), scene.duration_s, arguments.out)
    return OK
