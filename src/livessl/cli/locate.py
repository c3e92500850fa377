"""`livessl locate`: locates the sounds in recordings, as fast as the machine can."""

from __future__ import annotations

import argparse
from typing import Any

from livessl.cli import progress
from livessl.cli.exits import OK
from livessl.cli.options import add_joint, add_json, add_method, add_site, add_wav, import_from_here, read_site, wavs
from livessl.cli.output import complain, print_event, print_warnings
from livessl.clock import UnpacedClock
from livessl.garbage import collected_seldom


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    add_wav(
        parser,
        "WAV or FLAC recording of an array; repeat the option for each array",
        hint="If the recordings of the arrays do not begin at the same moment, set wav_offset_s in the site file",
        required=True,
    )
    add_method(parser)
    add_joint(parser)
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    with collected_seldom():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    from livessl import offline
    from livessl.core.types import Event
    from livessl.recordings.assign import assign_files, span_ns
    from livessl.server.api.encode import Messages

    import_from_here()
    site = read_site(arguments)
    print_warnings(site)
    parts = assign_files(site, *wavs(arguments))
    messages = Messages(site, 0, utc=False)
    found = 0
    with progress.timed("locating", *span_ns(parts)) as bar:
        for output in offline.run(site, parts, UnpacedClock(), method=arguments.method, progress=bar):
            if isinstance(output, Event):
                found += 1
                print_event(messages.event(output), as_json=arguments.json)
    if not found:
        factor = site.activity.floor_factor
        complain(
            f"no sound found: nothing rose {factor:g} times in power above the background; "
            "see activity.floor_factor and band_hz in the site file",
            kind="note",
        )
    return OK
