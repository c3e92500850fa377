"""`livessl doctor`: what is wrong with a set-up, on which channel, and what cures it."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from livessl.cli import progress
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_joint, add_json, add_wav, joints, read_site, wavs
from livessl.cli.output import complain, print_warnings
from livessl.core.commission.findings import Finding
from livessl.core.commission.trial import LEAST_SOUNDS
from livessl.errors import UseError
from livessl.examination import examine_parts
from livessl.recordings.assign import AssignedRecording, assign_files, assign_sessions, span_ns
from livessl.recordings.session import read_session
from livessl.site.load import load_site
from livessl.site.models import Site


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument("--site", type=Path, help="site file (default: the session's own)")
    parser.add_argument(
        "--session", action="append", type=Path, default=[], metavar="DIR", help="recorded session; repeatable"
    )
    add_wav(parser, "recording of an array instead, WAV or FLAC; repeat for each array")
    add_joint(parser)
    add_json(parser, "print one JSON object per finding")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    site, parts = _given(arguments)
    print_warnings(site)
    with progress.timed("examining", *span_ns(parts)) as bar:
        examination = examine_parts(site, parts, bar)
    for finding in examination.findings:
        print(json.dumps({"kind": "finding"} | asdict(finding)) if arguments.json else _line(finding), flush=True)
    if examination.sounds < LEAST_SOUNDS:
        complain(
            f"{_count(examination.sounds)} found: too few to examine poses and the order of channels; record ten, such "
            "as claps, at different places in the room",
            kind="note",
        )
    elif not examination.findings and not arguments.json:
        print(f"no fault found in {_count(examination.sounds)}")
    return OK if examination.is_sound else FAILED


def _given(arguments: argparse.Namespace) -> tuple[Site, list[AssignedRecording]]:
    if bool(arguments.session) == bool(arguments.wav):
        raise UseError("doctor: expected --session DIR, or --wav ARRAY=FILE for each array; give one of them")
    if arguments.session:
        sessions = [read_session(directory) for directory in arguments.session]
        joint = joints(arguments)
        site = load_site(arguments.site, joint) if arguments.site else sessions[0].site(joint)
        return site, list(assign_sessions(site, sessions))
    if arguments.site is None:
        raise UseError("doctor: expected --site FILE with --wav; give the site file that the recordings belong to")
    site = read_site(arguments)
    return site, list(assign_files(site, *wavs(arguments)))


def _line(finding: Finding) -> str:
    where = f" (input {finding.input})" if finding.input is not None else ""
    return (
        f"{finding.severity:<8} {finding.fault:<12} {finding.message}{where}; {finding.cure}  "
        f"[{100 * finding.confidence:.0f} % sure]"
    )


def _count(sounds: int) -> str:
    return "1 sound" if sounds == 1 else f"{sounds} sounds"
