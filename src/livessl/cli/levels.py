"""`livessl levels`: a live meter of every input of an audio device, without a server."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from livessl.cli import argument
from livessl.cli.options import add_json, add_older_name
from livessl.errors import ConfigError, Fault

if TYPE_CHECKING:
    from livessl.site.models import Site


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "--device", metavar="NAME", help="name of the device as `livessl devices` prints it, or a part of it"
    )
    parser.add_argument("--site", type=Path, help="site file; meters the device of the node given by --node")
    parser.add_argument("--node", help="name of the node in the site file")
    parser.add_argument("--wav", type=Path, metavar="FILE", help="meter a WAV or FLAC file instead of a device")
    parser.add_argument(
        "--inputs",
        type=argument.positive,
        metavar="N",
        help="number of inputs (default: all of an interface; 8 if the device is a sound server or a plug-in)",
    )
    rate = parser.add_argument(
        "--rate",
        dest="sample_rate",
        type=argument.sample_rate,
        metavar="HZ",
        help="sampling rate in hertz, with --device (default: the device's)",
    )
    add_older_name(parser, "--sample-rate", rate)
    parser.add_argument(
        "--seconds", type=argument.above_zero, metavar="N", help="end after N s (default: run until Ctrl-C)"
    )
    parser.add_argument("--tap", action="store_true", help="report which microphone you tap")
    parser.add_argument(
        "--listen", type=argument.positive, metavar="CH", help="write input CH to a WAV file, to listen to it"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="new WAV file that --listen writes (default: input-CH.wav in this folder)",
    )
    add_json(parser, "print one JSON object for each input every second, each tap and each problem")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    if arguments.listen is not None and arguments.out is None:
        arguments.out = Path(f"input-{arguments.listen}.wav")
    site = _check(arguments)
    from livessl.cli.metering import meter_device, meter_file

    return meter_file(arguments) if arguments.wav is not None else meter_device(arguments, site)


def _check(arguments: argparse.Namespace) -> Site | None:
    """Return the site, if one is given, after checking that the options go together."""
    from livessl.site.load import load_site

    faults = []
    ways = [
        name
        for name, value in (("--device", arguments.device), ("--site", arguments.site), ("--wav", arguments.wav))
        if value is not None
    ]
    if len(ways) != 1:
        got = " and ".join(ways) or "none"
        faults.append(Fault("levels", f"expected one of --device, --site with --node, or --wav, got {got}"))
    if (arguments.node is None) != (arguments.site is None):
        faults.append(Fault("--node", "expected --site and --node together; add the other one, or use --device"))
    if arguments.sample_rate is not None and arguments.device is None:
        faults.append(Fault("--rate", "applies to --device only; remove it"))
    if arguments.inputs is not None and arguments.wav is not None:
        faults.append(Fault("--inputs", "applies to a device only; remove it"))
    if arguments.out is not None and arguments.listen is None:
        faults.append(Fault("--out", "needs --listen; add --listen CH, or remove --out"))
    if arguments.listen is not None and arguments.out.exists():
        faults.append(Fault(f"--out {arguments.out}", "expected a new file, but it exists; choose another name"))
    if faults:
        raise ConfigError(faults)
    if arguments.site is None:
        return None
    site = load_site(arguments.site)
    if arguments.listen is not None and not site.may_record:
        raise ConfigError(
            [
                Fault(
                    f"{arguments.site}: privacy",
                    f"{site.privacy} forbids storing {site.forbidden_sound}; remove --listen and --out",
                )
            ]
        )
    return site
