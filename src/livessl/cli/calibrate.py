"""`livessl calibrate`: checks a site with claps at places that you know, and measures the arrays' poses."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from livessl.cli import argument, progress
from livessl.cli.calibration_words import (
    clap_line,
    clap_object,
    pose_line,
    pose_object,
    speed_line,
    speed_object,
)
from livessl.cli.doctor import add_recordings, finding_line, recordings_given
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_calibration_file, add_json, add_older_name, read_site
from livessl.cli.output import complain, print_warnings
from livessl.cli.server_answers import add_server
from livessl.cli.truth_file import add_truth, truth_given
from livessl.errors import ConfigError, UseError, did_you_mean

if TYPE_CHECKING:
    from livessl.calibration import Clap, HeardSound
    from livessl.cli.server_sounds import ServerSounds
    from livessl.core.commission.resection import MeasuredSetUp
    from livessl.recordings.assign import AssignedRecording
    from livessl.site.models import Site

WAIT_S: Final = 120.0
"""Default of --wait: time to measure the next place and to walk there, seconds."""

TAPE_STD_M: Final = 0.1
"""Default of --position-std, metres: the place of an array in the room, measured by tape."""

REFINED_SOUNDS: Final = 20
"""Default of --count."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    _add_verify(actions)
    _add_poses(actions)
    _add_refine(actions)


def _add_verify(actions: Any) -> None:
    sub = _action(
        actions,
        "verify",
        _verify,
        "print the error of claps at places that you know, and its likely cause",
        "verify --site site.yaml --at 2,3,1.2 --at 6,8,1.2",
    )
    _add_places(sub, "place of a clap in metres; repeat the option for each clap, in the order of the claps")
    add_truth(sub)
    add_json(sub, "print one JSON object for each clap and each finding")


def _add_poses(actions: Any) -> None:
    sub = _action(
        actions,
        "poses",
        _poses,
        "measure where the arrays are, by claps at places that you know",
        "poses --site site.yaml --at 2,3,1.2 --at 6,8,1.2 … --write",
    )
    _add_places(
        sub,
        "place of a clap in metres; repeat for each clap. With a running server --at is optional: places are proposed",
    )
    add_truth(sub)
    sub.add_argument(
        "--place-std",
        type=argument.above_zero,
        default=0.03,
        metavar="M",
        help="standard deviation, in metres, of the errors of the places that you give (default: 0.03)",
    )
    add_calibration_file(sub)
    add_json(sub, "print one JSON object for each clap, each array and the speed of sound")


def _add_refine(actions: Any) -> None:
    sub = _action(
        actions,
        "refine",
        _refine,
        "measure the arrays' poses by sounds at unknown places, relative to an array whose pose is right (--known)",
        "refine --site site.yaml --known north --write",
        "uses the sounds that the server still keeps, and prompts for more until there are --count",
    )
    sub.add_argument(
        "--known",
        action="append",
        default=[],
        metavar="ARRAY",
        help="array whose pose in the site file is right, relative to which the others are measured; repeat the option "
        "for each such array (default: the first array of the site file)",
    )
    sub.add_argument(
        "--position-std",
        type=argument.above_zero,
        default=TAPE_STD_M,
        metavar="M",
        help="standard deviation, in metres, of the errors of the arrays' places in the room, as the site file gives "
        f"them (default: {TAPE_STD_M:g}, as measured by tape; microphones within an array have much smaller errors)",
    )
    count = sub.add_argument(
        "--count",
        type=argument.positive,
        default=REFINED_SOUNDS,
        metavar="N",
        help="number of sounds to use with a running server, including those that it still keeps "
        f"(default: {REFINED_SOUNDS})",
    )
    add_older_name(sub, "--sounds", count)
    add_calibration_file(sub)
    add_json(sub, "print one JSON object for each array and the speed of sound")


def _action(
    actions: Any,
    name: str,
    act: Callable[[argparse.Namespace], int],
    text: str,
    example: str,
    prompts: str = "prompts for each clap and waits for it",
) -> Any:
    sub = actions.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}. To use a running server, give its site file (--site) or its "
        f"address (--url); the command then {prompts}. To use recordings, give --session or --wav.",
        epilog=f"example: livessl calibrate {example}",
    )
    sub.set_defaults(act=act)
    add_recordings(
        sub, "site file (default: the session's); without recordings, the running server of this site file is used"
    )
    add_server(sub, f"the command then {prompts}")
    sub.add_argument(
        "--wait",
        type=argument.above_zero,
        default=WAIT_S,
        metavar="S",
        help=f"longest wait, in seconds, for a running server to report the next sound (default: {WAIT_S:g})",
    )
    return sub


def _add_places(parser: Any, text: str) -> None:
    parser.add_argument("--at", action="append", type=argument.place, default=[], metavar="X,Y,Z", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.calibration import MOST_CLAPS
    from livessl.cli import calibration_file

    if getattr(arguments, "undo", False):
        path = calibration_file.undo(arguments)
        calibration_file.tell_server(arguments, _server_of_file(arguments), path)
        return OK
    if len(getattr(arguments, "at", [])) > MOST_CLAPS:
        raise UseError(f"--at: expected {MOST_CLAPS} places at most, got {len(arguments.at)}")
    if getattr(arguments, "write", None) is not None:
        calibration_file.refuse_foreign_file(arguments)
    return int(arguments.act(arguments))


def _server_of_file(arguments: argparse.Namespace) -> str | None:
    """Return the address of the server; None without --url and without a valid site file."""
    if arguments.site is None:
        return None if arguments.url is None else str(arguments.url)
    try:
        return _address(arguments, read_site(arguments))
    except ConfigError:
        return None  # no server runs with a site file that cannot be loaded


def _is_live(arguments: argparse.Namespace) -> bool:
    """Return whether a running server is meant: --url, or --site without recordings."""
    recorded = bool(arguments.session or arguments.wav)
    if not recorded and arguments.channels:
        raise UseError("calibrate: --channels names channels of the files of --wav, and none is given; remove it")
    if not recorded and getattr(arguments, "truth", None) is not None:
        raise UseError("calibrate: --truth belongs to a simulated session; give the session as --session DIR")
    if arguments.url and recorded:
        raise UseError(
            "calibrate: expected a running server (--url) or recordings (--session, --wav); give one of them"
        )
    return bool(arguments.url) or (arguments.site is not None and not recorded)


def _server(arguments: argparse.Namespace) -> tuple[Site, ServerSounds]:
    """Return the site, and the sounds of the running server."""
    from livessl.cli.server_sounds import ServerSounds

    if arguments.site is None:
        sounds = ServerSounds(arguments.url, arguments.token_file, arguments.wait)
        if getattr(arguments, "write", None) is not None and sounds.has_joint_arrays():
            raise UseError("--write: the server joins arrays; give its site file as --site")
        return sounds.site(), sounds
    site = read_site(arguments)
    print_warnings(site)
    url = _address(arguments, site)
    if url is None:
        raise UseError(
            "calibrate: the site file has no fixed port of the server (server.http.port: 0); give its address as --url"
        )
    sounds = ServerSounds(url, arguments.token_file, arguments.wait)
    mine, served = ({spec.name: len(spec.microphones_m) for spec in one.processed} for one in (site, sounds.site()))
    if mine != served:
        raise UseError(
            f"--site: expected the site file that the server at {url} runs, with the arrays {_counted(served)}, got "
            f"{_counted(mine)}; give that file, or --url alone"
        )
    return site, sounds


def _address(arguments: argparse.Namespace, site: Site) -> str | None:
    """Return the address of the server, from --url or the site file; None if the system chooses the port (0)."""
    if arguments.url is not None:
        return str(arguments.url)
    http = site.server.http
    if arguments.site is None or http.port == 0:
        return None
    host = "127.0.0.1" if http.host in ("0.0.0.0", "::") else http.host  # noqa: S104 - where the server listens
    scheme = "http" if http.certificate is None else "https"
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{http.port}"


def _counted(arrays: dict[str, int]) -> str:
    return ", ".join(f"{name} ({count} microphones)" for name, count in arrays.items())


def _recorded(arguments: argparse.Namespace) -> tuple[Site, list[HeardSound], Sequence[AssignedRecording]]:
    """Return the site, the sounds in recordings, and the recordings."""
    from livessl.calibration import sounds_of

    site, parts, span = recordings_given(arguments, "calibrate", ", or --site FILE or --url for a running server")
    print_warnings(site)
    with progress.timed("locating", *span) as bar:
        return site, sounds_of(site, parts, bar), parts


def _recorded_claps(arguments: argparse.Namespace) -> tuple[Site, list[Clap]]:
    import numpy as np

    from livessl.calibration import claps_by_time, claps_of

    if arguments.truth is not None:
        known = truth_given(arguments)
        site, sounds, parts = _recorded(arguments)
        return site, claps_by_time(sounds, known, min(part.start_ns for part in parts) / 1e9)
    _require_places(arguments)
    site, sounds, _ = _recorded(arguments)
    _require_inside(site, arguments)
    return site, claps_of(sounds, np.array(arguments.at))


def _require_places(arguments: argparse.Namespace) -> None:
    if not arguments.at:
        raise UseError(
            "calibrate: expected --at X,Y,Z for each clap, got none; give the places in metres, or --truth "
            "SESSION/truth.jsonl for a simulated session"
        )


def _require_inside(site: Site, arguments: argparse.Namespace) -> None:
    import numpy as np

    from livessl.site.build.set_up import PlaceOutsideError, require_near_room

    try:
        require_near_room(site, np.array(arguments.at, dtype=np.float64).reshape(-1, 3))
    except PlaceOutsideError as error:
        raise UseError(f"--at: {error}") from error


def _verify(arguments: argparse.Namespace) -> int:
    from livessl.calibration import verified
    from livessl.core.commission.verification import SetUpVerdict, set_up_verdict

    def show(clap: Clap) -> None:
        print(json.dumps(clap_object(clap)) if arguments.json else clap_line(clap), flush=True)

    if arguments.truth is None:
        _require_places(arguments)
    if _is_live(arguments):
        from livessl.cli.guided import claps_at

        site, sounds = _server(arguments)
        _require_inside(site, arguments)
        claps = claps_at(sounds, arguments.at, show)
    else:
        site, claps = _recorded_claps(arguments)
        for clap in claps:
            show(clap)
    findings = verified(site, claps)
    for finding in findings:
        print(json.dumps({"kind": "finding"} | asdict(finding)) if arguments.json else finding_line(finding))
    verdict = set_up_verdict(findings, [clap.error_m for clap in claps])
    if verdict is SetUpVerdict.UNEXPLAINED:
        complain("nothing explains the errors; check that the places were measured from the corner that is the origin")
    return OK if verdict is SetUpVerdict.OK else FAILED


def _poses(arguments: argparse.Namespace) -> int:
    from livessl.calibration import measured_poses

    if _is_live(arguments):
        from livessl.cli.guided import claps_for_poses

        def show(clap: Clap) -> None:
            print(json.dumps(clap_object(clap)) if arguments.json else clap_line(clap), flush=True)

        site, sounds = _server(arguments)
        _require_inside(site, arguments)
        claps = claps_for_poses(sounds, site, arguments.at, arguments.place_std, show)
    else:
        site, claps = _recorded_claps(arguments)
    measured = measured_poses(site, claps, arguments.place_std)

    def cure() -> str:
        import numpy as np

        from livessl.site.build.set_up import next_clap_place

        place_m = next_clap_place(site, np.array([clap.place_m for clap in claps]), arguments.place_std)
        where = "" if place_m is None else f", next at {', '.join(f'{x:.1f}' for x in place_m)}"
        return f"clap at more places, on all its sides, near and far, high and low{where}"

    return _report(arguments, site, measured, "poses", cure)


def _refine(arguments: argparse.Namespace) -> int:
    from livessl.calibration import refined

    parts: Sequence[AssignedRecording] = ()
    if _is_live(arguments):
        site, server = _server(arguments)
        if len(site.processed) < 2:
            raise UseError(f"calibrate refine: expected two arrays or more, got {len(site.processed)}")
        sounds = _kept_and_new(server, arguments.count)
    else:
        site, sounds, parts = _recorded(arguments)
    names = [spec.name for spec in site.processed]
    stranger = next((name for name in arguments.known if name not in names), None)
    if stranger is not None:
        raise UseError(
            f"--known: expected an array of the site ({', '.join(names)}), got {stranger!r}"
            f"{did_you_mean(stranger, names)}"
        )
    known = arguments.known or names[:1]
    if not arguments.known:
        complain(f"{known[0]!r} is taken to be where the site file says; --known ARRAY names another", kind="note")
    measured = refined(site, sounds, known, arguments.position_std, parts)
    return _report(arguments, site, measured, "refine", lambda: "make more sounds, all over the room, near and far")


def _kept_and_new(server: ServerSounds, count: int) -> list[HeardSound]:
    """Return the sounds that the server keeps and, if they are too few, new ones; two arrays received each of them."""
    from livessl.cli.guided import accepts_shared, ask_for, is_shared

    sounds = [sound for sound in server.kept() if is_shared(sound)]
    while len(sounds) < count:
        prompt = f"clap anywhere, each time at another place ({len(sounds)} of {count})"
        sounds.append(
            server.next_sound(partial(ask_for, prompt), "a sound that two arrays receive clearly", accepts_shared)
        )
    return sounds


def _report(
    arguments: argparse.Namespace, site: Site, measured: MeasuredSetUp, action: str, cure: Callable[[], str]
) -> int:
    """Print the poses and the speed of sound, store them with --write, and return the exit code."""
    from livessl.cli import calibration_file
    from livessl.core.commission.resection import MOST_STD_DEG, MOST_STD_M

    for name, pose in measured.poses.items():
        print(json.dumps(pose_object(name, pose)) if arguments.json else pose_line(name, pose), flush=True)
    print(json.dumps(speed_object(measured, site.c_m_s)) if arguments.json else speed_line(measured, site.c_m_s))
    doubtful = [name for name, pose in measured.poses.items() if not pose.is_determined]
    for name in doubtful:
        complain(
            f"array {name!r}: expected sounds that determine its pose to {MOST_STD_M:g} m and {MOST_STD_DEG:g} "
            f"degrees; {cure()}"
        )
    if arguments.write is not None and not doubtful:
        path = calibration_file.write(arguments, site, action, measured)
        calibration_file.tell_server(arguments, _address(arguments, site), path)
    return FAILED if doubtful else OK
