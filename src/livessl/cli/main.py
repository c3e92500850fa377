"""The list of commands, and `main`, which turns errors of files and disks into messages and exit codes."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from livessl import __version__
from livessl.cli.exits import FAILED, INTERRUPTED, OK, WRONG_USE, sigterm_as_ctrl_c
from livessl.cli.output import complain
from livessl.cli.parser import Parser
from livessl.cli.standard_streams import open_standard_streams
from livessl.errors import RunError, UseError
from livessl.log_format import VARIABLE, LogForm, log_form, set_up_logging

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a full disk."""

_OF_PATH: Final = frozenset({errno.ENOENT, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR, errno.EROFS})
"""Error numbers that another path or other permissions cure."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command.

    Parameters
    ----------
    name : str
        Name of the command and, with underscores, of its module in `livessl.cli`, which has `add_arguments(parser)` and
        `run(arguments)`.
    text : str
        One line of help.
    example : str
        A complete command line, shown at the end of the help.
    """

    name: str
    text: str
    example: str


COMMANDS: Final = (
    Command("demo", "locate sounds in a simulated room, without hardware", "livessl demo --once"),
    Command("serve", "run the fusion server with API and dashboard", "livessl serve --site site.yaml"),
    Command("hub", "run the hub, which collects the events of many sites", "livessl hub --config hub.yaml"),
    Command("events", "print live messages of a running server", "livessl events --zone door --json"),
    Command("capture", "run a capture node", "livessl capture --site site.yaml --node lab-pc"),
    Command(
        "locate",
        "locate the sounds in recordings",
        "livessl locate --site site.yaml --wav north=north.wav --wav south=south.wav",
    ),
    Command(
        "relocate",
        "locate stored events again from their recordings, by another method or calibration",
        "livessl relocate --site site.yaml --method srp-phat --out srp-phat.jsonl",
    ),
    Command("replay", "play a recorded session through a server", "livessl replay session/ --speed 2"),
    Command("record", "record a session for replay", "livessl record --site site.yaml --node lab-pc --out session/"),
    Command(
        "simulate",
        "simulate recordings in the site's room",
        "livessl simulate --site site.yaml --rt60 0.7 --out session/",
    ),
    Command(
        "evaluate",
        "compare methods in simulated rooms, repeat the paper's experiments, or report on earlier results",
        "livessl evaluate one-array --sounds sounds/ --positions 10 --out evaluation/",
    ),
    Command(
        "bench",
        "measure how fast this machine locates sounds, or with --live how much load a server on it carries",
        "livessl bench --live --arrays 64 --clients 20 --seconds 30",
    ),
    Command(
        "plan",
        "predict the error everywhere in the room, and suggest where arrays should go",
        "livessl plan --site site.yaml --rt60 0.7 --out plan/",
    ),
    Command(
        "doctor",
        "find what is wrong with a set-up, from recordings or a running server's sounds",
        "livessl doctor --session session/",
    ),
    Command(
        "calibrate",
        "verify a set-up, and measure where the arrays are, by claps at measured places or by any sounds",
        "livessl calibrate verify --session session/ --at 2,3,1.2 --at 6,8,1.2",
    ),
    Command(
        "support-bundle",
        "write a zip with logs, settings and versions, to send to someone who helps you",
        "livessl support-bundle --site site.yaml",
    ),
    Command("keys", "make, list and revoke keys and tokens", "livessl keys token --site site.yaml --name wall"),
    Command("init", "write a first site file", "livessl init --room 8,10,4 --arrays 2 --interface UMC1820"),
    Command("check", "validate a site file and list all its faults", "livessl check site.yaml"),
    Command("config", "show the settings that are in effect", "livessl config show site.yaml"),
    Command("devices", "list the audio inputs of this machine", "livessl devices"),
    Command(
        "levels",
        "show the level and faults of every input of an audio device, live",
        "livessl levels --device UMC1820 --tap",
    ),
)
"""All commands, in the order in which the help lists them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code.

    0 means success, also if Ctrl-C or SIGTERM ended a command that runs until then, or if the program that reads the
    output has ended; 1 means a failure at run time, or that the command found faults; 2 means wrong use or an invalid
    configuration; 130 means that Ctrl-C or SIGTERM interrupted a command that ends by itself.
    """
    # matrix products are small here: a second BLAS thread mostly waits in a loop, and CPU time grows eightfold
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for a library that is loaded later
    open_standard_streams()
    given = sys.argv[1:] if arguments is None else arguments
    parsed = _parser(given).parse_args(given)
    from threadpoolctl import threadpool_limits

    try:
        if parsed.log is not None:
            os.environ[VARIABLE] = parsed.log  # for the processes that this one starts
        set_up_logging(parsed.command, log_form(), verbose=parsed.verbose)
        with sigterm_as_ctrl_c(), threadpool_limits(limits=1, user_api="blas"):
            return int(parsed.run(parsed))
    except UseError as error:
        for line in str(error).splitlines():
            complain(line)
        return WRONG_USE
    except BrokenPipeError:  # the program that reads our output, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except RunError as error:
        complain(str(error))
        return FAILED
    except OSError as error:
        complain(_of_file(error))
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


def _of_file(error: OSError) -> str:
    """Return the file that an error is about, as far as it is known, what is wrong with it and what to do."""
    where = "" if error.filename is None else f"{error.filename}: "  # a file that is open has no name in its errors
    if error.errno in _FULL:
        return f"{where}{error.strerror}; free some space"
    if not where or error.strerror is None:
        return str(error)
    cure = "; correct the path or its permissions" if error.errno in _OF_PATH else ""
    return f"{where}{error.strerror}{cure}"


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; only the command that is given is imported and described in full."""
    parser = Parser(prog="livessl", description="Locate sounds in a room, live.", epilog="example: livessl demo")
    parser.add_argument("-V", "--version", action="version", version=f"livessl {__version__}")
    parser.add_argument("--verbose", action="store_true", help="log debug messages to stderr as well")
    parser.add_argument(
        "--log",
        type=LogForm,
        choices=list(LogForm),
        help=f"format of the log lines (default: the environment variable {VARIABLE}, otherwise text)",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    names = {command.name for command in COMMANDS}
    chosen = next((word for word in given if word in names), None)
    for command in COMMANDS:
        sub = commands.add_parser(
            command.name,
            help=command.text,
            description=f"{command.text[0].upper()}{command.text[1:]}.",
            epilog=f"example: {command.example}",
        )
        if command.name == chosen:
            module = import_module(f"livessl.cli.{command.name.replace('-', '_')}")
            sub.set_defaults(run=module.run, command=command.name)
            module.add_arguments(sub)
    return parser
