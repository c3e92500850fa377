"""`livessl doctor`: prints what is wrong with a set-up, on which channel, and the cure; asks the server or recordings.

The faults are found in `examination.py` and `server/set_up_watch.py`, and worded in `core/commission/findings.py`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from livessl.cli import progress
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_joint, add_json, add_wav, joints, read_site, refuse_unused, wavs
from livessl.cli.output import complain, print_warnings
from livessl.cli.server_answers import add_server, ask_for
from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.core.commission.blind_spot import BlindSpot
    from livessl.core.commission.finding import Finding
    from livessl.examination import Examination
    from livessl.recordings.assign import AssignedRecording
    from livessl.recordings.session import Session
    from livessl.site.models import Site


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_recordings(parser)
    add_server(parser, "its latest sounds are examined")
    add_json(parser, "print one JSON object per finding")


def add_recordings(parser: Any, site: str = "site file (default: the session's own)") -> None:
    """Add --site with a help text, --session, --wav, --channels and --joint, which `recordings_given` reads."""
    parser.add_argument("--site", type=Path, help=site)
    parser.add_argument(
        "--session",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="recorded session; repeat the option for each session",
    )
    add_wav(parser, "WAV or FLAC recording of one array, instead of --session; repeat the option for each array")
    add_joint(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.core.commission.finding import LEAST_SOUNDS

    if arguments.url and (arguments.session or arguments.wav or arguments.channels or arguments.joint):
        raise UseError(
            "doctor: with --url the server's own sounds are examined, so that --session, --wav, --channels and --joint "
            "have no effect; remove them, or --url"
        )
    if not arguments.url:
        given = {"--token-file": arguments.token_file}
        refuse_unused("doctor", given, "without --url, because no server is asked")
    examination, hidden = _ask(arguments.url, arguments.token_file) if arguments.url else _examine(arguments)
    for finding in examination.findings:
        print(
            json.dumps({"kind": "finding"} | asdict(finding)) if arguments.json else finding_line(finding), flush=True
        )
    if examination.sounds < LEAST_SOUNDS:
        complain(
            f"{_count(examination.sounds)} found: too few to examine poses and the order of channels; record ten, such "
            "as claps, at different places in the room",
            kind="note",
        )
    elif not examination.findings and not arguments.json:
        print(f"no fault found in {_count(examination.sounds)}")
    for note in hidden:
        complain(note, kind="note")
    return OK if examination.is_faultless else FAILED


def _examine(arguments: argparse.Namespace) -> tuple[Examination, list[str]]:
    """Return what recordings show, and in words what they cannot show."""
    from livessl.examination import examine_parts

    site, parts, span = recordings_given(arguments, "doctor", ", or --url")
    print_warnings(site)
    with progress.timed("examining", *span) as bar:
        examination = examine_parts(site, parts, bar)
    return examination, [blind_spot_line(spot) for spot in examination.blind_spots]


def _ask(url: str, token_file: Path | None) -> tuple[Examination, list[str]]:
    """Return what a running server has found, and in its own words what its sounds cannot show."""
    from livessl.core.commission.finding import Finding
    from livessl.examination import Examination
    from livessl.schema.findings import Findings

    answer = ask_for(Findings, url, "findings", token_file)
    findings = tuple(Finding(**one.model_dump(exclude={"kind"})) for one in answer.findings)
    return Examination(findings, answer.sounds), [f"{spot.message}; {spot.cure}" for spot in answer.blind_spots]


def recordings_given(
    arguments: argparse.Namespace, command: str, otherwise: str = ""
) -> tuple[Site, list[AssignedRecording], tuple[int, int | None]]:
    """Return the site, the recordings given by --session, or --site and --wav, and the time that they span in ns."""
    from livessl.recordings.assign import assign_files, assign_sessions, span_ns
    from livessl.recordings.session import read_session
    from livessl.site.load import load_site

    if bool(arguments.session) == bool(arguments.wav):
        raise UseError(
            f"{command}: expected --session DIR, or --wav ARRAY=FILE for each array{otherwise}; give one of them"
        )
    if arguments.session:
        if arguments.channels:
            raise UseError(
                f"{command}: --channels names channels of the files of --wav, and has no effect on a session; remove "
                "it, and give the order in the site file (nodes.NAME.arrays) with --site"
            )
        sessions = [read_session(directory) for directory in arguments.session]
        joint = joints(arguments)
        site = load_site(arguments.site, joint) if arguments.site else sessions[0].site(joint)
        parts = list(assign_sessions(site, sessions))
        site = _with_recorded_inputs(site, sessions)
    elif arguments.site is None:
        raise UseError(f"{command}: expected --site FILE with --wav; give the site file that the recordings belong to")
    else:
        site = read_site(arguments)
        parts = list(assign_files(site, *wavs(arguments)))
    return site, parts, span_ns(parts)


def _with_recorded_inputs(site: Site, sessions: Sequence[Session]) -> Site:
    """Return the site with the inputs that sessions were recorded from, where it has others; findings name them."""
    recorded = {array: inputs for session in sessions for array, inputs in session.inputs().items()}

    def of_recording(array: str, inputs: list[int]) -> list[int]:
        found = recorded.get(array, inputs)
        return inputs if sorted(found) == sorted(inputs) else found  # in another order, they are those of the channels

    nodes = {
        name: node.model_copy(
            update={"arrays": {array: of_recording(array, inputs) for array, inputs in node.arrays.items()}}
        )
        for name, node in site.nodes.items()
    }
    return site.model_copy(update={"nodes": nodes})


def finding_line(finding: Finding) -> str:
    """Return a finding as a line of text."""
    where = f" (input {finding.input})" if finding.input is not None else ""
    return (
        f"{finding.severity:<8} {finding.fault:<12} {finding.message}{where}; {finding.cure}  "
        f"[{100 * finding.confidence:.0f} % sure]"
    )


def blind_spot_line(spot: BlindSpot) -> str:
    """Return as a line of text what the sounds could not have shown."""
    from livessl.core.commission.blind_spot import CURE

    return f"{spot.message}; {CURE}"


def _count(sounds: int) -> str:
    return "1 sound" if sounds == 1 else f"{sounds} sounds"
