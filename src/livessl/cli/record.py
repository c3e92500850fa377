"""`livessl record`: records a session for replay, from a node's audio device or from files in its place."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from livessl.cli import argument, progress
from livessl.cli.exits import FAILED, OK, stop_on_signal
from livessl.cli.options import add_older_name, add_site, add_wav
from livessl.cli.output import complain
from livessl.cli.own_work import refuse_foreign
from livessl.clock import SystemClock
from livessl.errors import ConfigError, Fault


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    parser.add_argument("--node", required=True, help="name of the node in the site file")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the session")
    parser.add_argument(
        "--format",
        choices=("flac", "wav"),
        default="flac",
        help="format of the recordings: 24-bit FLAC, or WAV with floating-point samples (default: flac)",
    )
    seconds = parser.add_argument(
        "--seconds", type=argument.above_zero, metavar="N", help="stop after N s (default: run until Ctrl-C)"
    )
    add_older_name(parser, "--duration", seconds)
    add_wav(
        parser,
        "record the sound of FILE, in real time, instead of the device; repeat the option for each array of the node",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.capture.record import record_device
    from livessl.cli.node_input import audio_device, check_files, node_config, recordings
    from livessl.recordings.recorder import Recorder, record_playback
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    if not site.may_record:
        what = (
            f"expected recording, got {site.privacy}, which forbids storing {site.forbidden_sound}; "
            "change it only if everyone in the room agrees"
        )
        raise ConfigError([Fault(f"{arguments.site}: privacy", what)])
    config = node_config(site, arguments.node, arguments.site)
    check_files(arguments, config)
    _refuse_to_overwrite(arguments.out, arguments.site)
    clock = SystemClock()
    begun_ns, begun = clock.now_ns(), clock.monotonic_ns()
    length_ns = None if arguments.seconds is None else round(arguments.seconds * 1e9)
    end_ns = None if length_ns is None else begun_ns + length_ns
    with stop_on_signal() as stop, progress.timed("recording", begun_ns, end_ns) as bar:

        def over() -> bool:
            spent_ns = clock.monotonic_ns() - begun
            bar(begun_ns + spent_ns)
            return stop.is_set() or (length_ns is not None and spent_ns >= length_ns)

        device = audio_device(arguments, config, clock)
        if device is not None:
            recorder = Recorder(arguments.out, site, config.arrays, device.sample_rate_hz, arguments.format)
            record_device(recorder, device, over)
            recorded = recorder.recorded
        else:
            parts = recordings(arguments, site, begun_ns)
            recorded = record_playback(arguments.out, site, parts, clock, over, arguments.format)
    if not recorded:
        complain(
            "nothing was recorded, because the device delivered no sound; check its connection with `livessl devices`"
        )
        return FAILED
    logging.info("recorded to %s", arguments.out)
    return OK


def _refuse_to_overwrite(directory: Path, site: Path) -> None:
    """Raise an error if a folder holds recordings or a site file, which are neither replaced nor mixed with others."""
    from livessl.recordings.session import SESSION_FILE, SITE_FILE

    held = directory.iterdir() if directory.is_dir() else ()
    names = sorted(path.name for path in held if path.name == SESSION_FILE or path.suffix.lower() in (".wav", ".flac"))
    if names:
        raise ConfigError(
            [Fault(f"--out {directory}", f"already holds a session or recordings ({names[0]}); choose another folder")]
        )
    refuse_foreign(f"--out {directory}", [directory / SITE_FILE], lambda _: False, site)
