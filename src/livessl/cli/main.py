"""The command line: arguments, progress bars, exit codes. No logic. Each command imports what it needs when it runs."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from threadpoolctl import threadpool_limits

from livessl import __version__
from livessl.cli import argument, progress
from livessl.clock import Clock, PacedClock, SystemClock, UnpacedClock
from livessl.core.types import Event
from livessl.errors import RunError, UseError
from livessl.site import keys as keyring
from livessl.site.build.grid import search_grid
from livessl.site.load import load_site
from livessl.site.models import (
    METHODS,
    ConfigError,
    Fault,
    HttpConfig,
    NodeConfig,
    Site,
    SoundDeviceConfig,
    StoreConfig,
    open_doors,
)

if TYPE_CHECKING:
    from livessl.lab.demo import Outcome
    from livessl.recordings.assign import Part
    from livessl.server.api.encode import JsonObject
    from livessl.server.app import Server

T = TypeVar("T")

OK: Final = 0
FAILED: Final = 1
WRONG_USE: Final = 2
INTERRUPTED: Final = 130

WITHIN_M: Final = 0.5
"""The demo calls an event located if it is this near to the truth."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code.

    0 success, also of what runs until Ctrl-C or SIGTERM; 1 failure at run time; 2 wrong use or configuration; 130 for a
    command that Ctrl-C or SIGTERM cut short before its own end.
    """
    given = sys.argv[1:] if arguments is None else arguments
    parsed = _parser(given).parse_args(given)
    logging.basicConfig(
        level=logging.DEBUG if parsed.verbose else logging.INFO, format="livessl: %(message)s", stream=sys.stderr
    )
    try:
        # the products are small: a second thread spins more than it works, eight times the processor's time in all
        with _sigterm_interrupts(), threadpool_limits(limits=1, user_api="blas"):
            return int(parsed.run(parsed))
    except UseError as error:
        for line in str(error).splitlines():
            _complain(line)
        return WRONG_USE
    except BrokenPipeError:  # whoever read our output has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (RunError, OSError) as error:
        _complain(str(error))
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """SIGTERM does what Ctrl-C does."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def _polite_stop() -> Iterator[threading.Event]:
    """Within it, Ctrl-C and SIGTERM only set the event: loops look at it and end in order."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    """All commands; what is dear to describe is described only where it is among the words given."""
    parser = argparse.ArgumentParser(
        prog="livessl", description="Tells, live, where in a room a sound happened.", epilog="example: livessl demo"
    )
    parser.add_argument("--version", action="version", version=f"livessl {__version__}")
    parser.add_argument("--verbose", action="store_true", help="say more on stderr")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], int], text: str, example: str) -> Any:
        sub = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + ".", epilog=f"example: {example}"
        )
        sub.set_defaults(run=run)
        return sub

    sub = command("demo", _demo, "show everything with no hardware", "livessl demo --once")
    sub.add_argument("--once", action="store_true", help="run the scene once, print each event and its error")
    sub.add_argument("--json", action="store_true", help="print one JSON object per event")
    sub.add_argument("--port", type=int, default=8000, help="of the dashboard (default 8000)")
    sub.add_argument("--events", type=argument.positive, default=8, help="sounds in the scene (default 8)")
    sub.add_argument("--no-browser", action="store_true", help="do not open the dashboard")

    sub = command("serve", _serve, "run the fusion server with API and dashboard", "livessl serve --site site.yaml")
    _add_site(sub)
    _add_method(sub)
    _add_joint(sub)

    sub = command("capture", _capture, "run a capture node", "livessl capture --site site.yaml --node lab-pc")
    _add_site(sub)
    sub.add_argument("--node", required=True, help="name of the node in the site file")
    _add_joint(sub)
    _add_wav(sub, "play FILE at real speed instead of the device; give it for each array of the node")
    sub.add_argument("--loop", action="store_true", help="play the files again and again")
    sub.add_argument(
        "--start-at",
        type=argument.time,
        metavar="TIME",
        help="when the files begin, RFC 3339 (default: now, or with several nodes the next full 5 s of the clock)",
    )

    sub = command(
        "locate",
        _locate,
        "localize what was recorded",
        "livessl locate --site site.yaml --wav north=north.wav --wav south=south.wav",
    )
    _add_site(sub)
    _add_wav(sub, "recording of an array; all begin together", required=True)
    _add_method(sub)
    _add_joint(sub)
    sub.add_argument("--json", action="store_true", help="print one JSON object per event")

    sub = command("replay", _replay, "play a recorded session through a server", "livessl replay session/ --speed 2")
    sub.add_argument(
        "directories", type=Path, metavar="DIR", nargs="+", help="made by record or simulate; one for each node"
    )
    sub.add_argument("--site", type=Path, help="site file (default: the session's own)")
    sub.add_argument("--speed", type=argument.speed, default=1.0, help="times real time, or 'max' (default 1)")
    sub.add_argument(
        "--server", type=argument.endpoint, metavar="ENDPOINT", help="a running server, such as tcp://127.0.0.1:5570"
    )
    sub.add_argument("--once", action="store_true", help="end with the session instead of keeping the dashboard up")
    sub.add_argument("--json", action="store_true", help="print one JSON object per event")
    _add_method(sub)
    _add_joint(sub)

    sub = command(
        "record", _record, "record a session for replay", "livessl record --site site.yaml --node lab-pc --out session/"
    )
    _add_site(sub)
    sub.add_argument("--node", required=True, help="name of the node in the site file")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="where to; must not hold a session")
    sub.add_argument("--format", choices=("flac", "wav"), default="flac", help="24-bit FLAC or float WAV")
    sub.add_argument(
        "--duration", type=argument.above_zero, metavar="S", help="stop after S seconds (default: on Ctrl-C)"
    )
    _add_wav(sub, "record FILE at real speed instead of the device: a rehearsal")

    sub = command(
        "simulate",
        _simulate,
        "simulate recordings in the site's room",
        "livessl simulate --site site.yaml --rt60 0.7 --out session/",
    )
    _add_site(sub)
    sub.add_argument("--events", type=Path, metavar="DIR", help="WAV or FLAC files to play (default: our own sounds)")
    sub.add_argument(
        "--rt60", type=argument.rt60, default=0.7, metavar="S", help="reverberation time, 0 to 5 (default 0.7)"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="where to; must hold no recording")
    sub.add_argument("--count", type=argument.positive, default=8, help="sounds in the scene (default 8)")
    sub.add_argument("--sample-rate", type=argument.positive, default=44100, metavar="HZ", help="default 44100")
    sub.add_argument("--seed", type=int, default=0, help="same seed, same session (default 0)")

    sub = command(
        "evaluate",
        _evaluate,
        "repeat the paper's experiments in simulated rooms",
        "livessl evaluate one-array --events sounds/ --positions 10 --out evaluation/",
    )
    if "evaluate" in given:
        from livessl.lab.evaluate import command as evaluation

        evaluation.add_arguments(sub)

    _add_bench(command)

    sub = command(
        "plan",
        _plan,
        "tell what error to expect where, and where arrays should go",
        "livessl plan --site site.yaml --rt60 0.7 --out plan/",
    )
    if "plan" in given:
        _add_plan(sub)

    _add_keys(command)

    sub = command("check", _check, "validate a site file, all faults at once", "livessl check site.yaml")
    sub.add_argument("site", type=Path)
    sub.add_argument("--json", action="store_true", help="print the result as JSON")

    sub = command("devices", _devices, "list audio devices", "livessl devices")
    sub.add_argument("--json", action="store_true", help="print the list as JSON")
    return parser


def _add_bench(command: Callable[..., Any]) -> None:
    sub = command(
        "bench",
        _bench,
        "measure how much this machine carries, and how fast it answers",
        "livessl bench --live --arrays 64 --clients 20 --seconds 30",
    )
    sub.add_argument("--live", action="store_true", help="a server under load, instead of the kernels alone")
    sub.add_argument("--arrays", type=argument.positive, default=4, help="live: that sound all the time (default 4)")
    sub.add_argument("--clients", type=argument.positive, default=4, help="live: that subscribe (default 4)")
    sub.add_argument("--watchers", type=argument.count, default=0, help="live: that watch the power map (default none)")
    sub.add_argument(
        "--seconds", type=argument.above_zero, default=20.0, help="live: to measure, after a warm-up (default 20)"
    )
    sub.add_argument(
        "--spacing", type=argument.above_zero, default=0.1, metavar="M", help="live: of the grid (default 0.1)"
    )
    sub.add_argument(
        "--rt60", type=argument.rt60, default=0.3, metavar="S", help="live: of the simulated room (default 0.3)"
    )
    sub.add_argument("--spin", action="store_true", help="live: let a foreign process spin on each core")
    sub.add_argument("--json", action="store_true", help="print one JSON object")


def _add_plan(sub: Any) -> None:
    from livessl.lab.plan.design import CALIBRATION_M

    _add_site(sub)
    sub.add_argument(
        "--rt60", type=argument.not_negative, default=0.7, metavar="S", help="reverberation time (default 0.7)"
    )
    sub.add_argument(
        "--height", type=argument.not_negative, metavar="M", help="of the sounds (default 1.5, if searched)"
    )
    sub.add_argument(
        "--calibration",
        type=argument.above_zero,
        default=CALIBRATION_M,
        metavar="M",
        help=f"how well the microphones' places are known (default {CALIBRATION_M:g})",
    )
    sub.add_argument("--json", action="store_true", help="print one JSON object")
    sub.add_argument("--out", type=Path, metavar="DIR", help="also write plan.json and plan.png there")


def _add_keys(command: Callable[..., Any]) -> None:
    example = "livessl keys token --site site.yaml --name wall"
    keys = command("keys", _keys_list, "make and enrol keys and tokens", example)
    deeds = keys.add_subparsers(title="what to do", metavar="WHAT", required=True)

    def deed(name: str, run: Callable[[argparse.Namespace], int], text: str, example: str) -> Any:
        sub = deeds.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + ".", epilog=f"example: livessl keys {example}"
        )
        sub.set_defaults(run=run)
        _add_site(sub)
        return sub

    deed("server", _keys_server, "make the server's key pair", "server --site site.yaml")
    sub = deed("node", _keys_node, "make a node's key pair, on the node", "node lab-pc --site site.yaml --server 4f8a…")
    sub.add_argument("name", help="of the node in the site file; `replay` for who plays sessions to a server")
    sub.add_argument(
        "--server", type=argument.key, metavar="KEY", help="the server's public key, as `keys server` told it"
    )
    sub = deed("enrol", _keys_enrol, "let a node in, on the server", "enrol lab-pc 9c01… --site site.yaml")
    sub.add_argument("name", help="of the node in the site file")
    sub.add_argument("key", type=argument.key, help="the node's public key, as `keys node` told it")
    sub = deed("token", _keys_token, "make a token for a client", "token --site site.yaml --name wall --role viewer")
    sub.add_argument("--name", required=True, help="of the client, to revoke it by")
    sub.add_argument("--role", choices=[str(role) for role in keyring.Role], default="viewer", help="default viewer")
    sub = deed("revoke", _keys_revoke, "let a node or a client in no longer", "revoke --site site.yaml --token wall")
    which = sub.add_mutually_exclusive_group(required=True)
    which.add_argument("--node", metavar="NAME")
    which.add_argument("--token", metavar="NAME")
    sub = deed("list", _keys_list, "tell who may connect", "list --site site.yaml")
    sub.add_argument("--json", action="store_true", help="print one JSON object")


def _add_site(parser: Any) -> None:
    parser.add_argument("--site", type=Path, required=True, help="site file")


def _add_method(parser: Any) -> None:
    parser.add_argument("--method", choices=sorted(METHODS), help="estimator (default: the site's)")


def _add_joint(parser: Any) -> None:
    parser.add_argument(
        "--joint",
        action="append",
        type=argument.joint,
        default=[],
        metavar="NAME=ARRAY,ARRAY,…",
        help="process arrays of one node as one of all their microphones, besides what the site file joins",
    )


def _add_wav(parser: Any, text: str, *, required: bool = False) -> None:
    parser.add_argument(
        "--wav",
        action="append",
        type=argument.assignment,
        default=[],
        metavar="ARRAY=FILE",
        help=text,
        required=required,
    )
    parser.add_argument(
        "--channels",
        action="append",
        type=argument.channels,
        default=[],
        metavar="ARRAY=1,2,3,4",
        help="channels of the file, from 1, in microphone order",
    )


def _bench(arguments: argparse.Namespace) -> int:
    from livessl.lab.bench import kernels as kernel_bench
    from livessl.lab.bench import live as live_bench

    if not arguments.live:
        with progress.counted("measuring", "round") as show:
            report = kernel_bench.measure(SystemClock(), progress=show)
        print(json.dumps(report.as_json()) if arguments.json else kernel_bench.table(report))
        return OK
    demand = live_bench.Demand(
        arrays=arguments.arrays,
        clients=arguments.clients,
        seconds=arguments.seconds,
        watchers=arguments.watchers,
        spacing_m=arguments.spacing,
        rt60_s=arguments.rt60,
        spin=arguments.spin,
    )
    with progress.counted("measuring", "s") as show:
        outcome = live_bench.measure(demand, SystemClock(), progress=show)
    print(json.dumps(outcome.json()) if arguments.json else live_bench.table(outcome))
    return OK


def _demo(arguments: argparse.Namespace) -> int:
    try:
        return _show_demo(arguments)
    except KeyboardInterrupt:
        if arguments.once:
            raise
        logging.info("stopped")
        return OK


def _show_demo(arguments: argparse.Namespace) -> int:
    from livessl.lab import demo

    clock = SystemClock()
    with (
        tempfile.TemporaryDirectory(prefix="livessl-demo-") as name,
        progress.counted("simulating the room", "source") as bar,
    ):
        directory = Path(name)
        site, scene = demo.prepare(directory, arguments.port, arguments.events, bar)
        truth = demo.read_truth(directory)
        with demo.running(directory, site, loop=not arguments.once, clock=clock) as (url, start_ns):
            print(f"dashboard: {url}", file=sys.stderr)
            if not arguments.once and not arguments.no_browser:
                threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
            until_ns = start_ns + round((scene.duration_s + 1.5) * 1e9) if arguments.once else None
            events = []
            if not arguments.json:
                print(_DEMO_HEAD)
            for event in demo.events_of(url, until_ns, clock):
                events.append(event)
                outcome = demo.nearest_source(truth, event, start_ns, scene.duration_s)
                print(_demo_json(outcome) if arguments.json else _demo_row(outcome), flush=True)
                if not arguments.once:
                    events.clear()
    outcomes = demo.match(truth, events, start_ns, scene.duration_s)
    good = [o for o in outcomes if o.located and o.error_m is not None and o.error_m <= WITHIN_M]
    surplus = len(events) - len({o.event["id"] for o in outcomes if o.event is not None})
    summary = f"{len(good)} of {len(outcomes)} sounds located within {WITHIN_M:g} m; {surplus} events without a sound"
    print(summary, file=sys.stderr)
    return OK if len(good) == len(outcomes) else FAILED


_DEMO_HEAD: Final = f"{'time':>7}  {'sound':<14} {'true position':<22} {'found':<22} {'error':>7}  status"


def _demo_row(outcome: Outcome) -> str:
    event = outcome.event
    assert event is not None
    error = "-" if outcome.error_m is None else f"{outcome.error_m:.2f} m"
    return (
        f"{outcome.start_s:6.2f}s  {outcome.name:<14} {_xyz(outcome.true_position_m):<22} "
        f"{_xyz(event['position_m']):<22} {error:>7}  {event['status']}"
    )


def _demo_json(outcome: Outcome) -> str:
    truth = {"name": outcome.name, "start_s": outcome.start_s, "position_m": list(outcome.true_position_m)}
    return json.dumps({**(outcome.event or {}), "truth": truth, "error_m": outcome.error_m})


def _serve(arguments: argparse.Namespace) -> int:
    from livessl.server.app import Server

    site = load_site(arguments.site, _once_each(arguments.joint, "--joint"))
    _tell_warnings(site)
    server = Server(site, SystemClock(), method=arguments.method)
    logging.info("listening for nodes on %s, dashboard on %s", server.endpoint, server.url)
    _run_server(server)
    return OK


def _run_server(server: Server) -> None:
    try:
        server.run()
    except KeyboardInterrupt:
        logging.info("stopped")


def _capture(arguments: argparse.Namespace) -> int:
    from livessl.capture.node import capture_device, capture_recordings
    from livessl.recordings.assign import span_ns

    site = load_site(arguments.site, _once_each(arguments.joint, "--joint"))
    config = _node(site, arguments.node, arguments.site)
    _check_played(arguments, config)
    clock = SystemClock()
    run_id = _run_id(arguments.node, clock)
    if isinstance(config.device, SoundDeviceConfig) and not arguments.wav:
        device = _sound_device(config, config.device, clock)
        with _polite_stop() as stop:
            capture_device(site, arguments.node, device, clock, run_id, stop.is_set)
        return OK
    parts = _played_parts(arguments, site, clock.now_ns())
    with _polite_stop() as stop, progress.timed("playing", *span_ns(parts)) as bar:
        capture_recordings(site, arguments.node, parts, clock, run_id, stop.is_set, bar)
    return OK


def _check_played(arguments: argparse.Namespace, config: NodeConfig) -> None:
    """What a node plays instead of its device must be all of it; what only files can do needs files."""
    wavs, _ = _wavs(arguments)
    known, faults = ", ".join(config.arrays), []
    if wavs:
        strangers = [name for name in wavs if name not in config.arrays]
        missing = [name for name in config.arrays if name not in wavs]
        faults += [Fault(f"--wav {name}=…", f"node {arguments.node!r} has the arrays {known}") for name in strangers]
        faults += [Fault("--wav", f"expected a file for each of {known}; add --wav {name}=FILE") for name in missing]
    else:
        given = {"--channels": arguments.channels}
        if isinstance(config.device, SoundDeviceConfig):
            given |= {"--start-at": getattr(arguments, "start_at", None), "--loop": getattr(arguments, "loop", None)}
        what = "applies to files, and none is given; take it away or add --wav"
        faults += [Fault(option, what) for option, value in given.items() if value]
    if faults:
        raise ConfigError(faults)


def _wavs(arguments: argparse.Namespace) -> tuple[dict[str, Path], dict[str, list[int]]]:
    """Files and chosen channels by array."""
    return _once_each(arguments.wav, "--wav"), _once_each(arguments.channels, "--channels")


def _sound_device(config: NodeConfig, device: SoundDeviceConfig, clock: Clock) -> Any:
    from livessl.capture.sound_device import SoundDevice

    return SoundDevice(device, max(map(max, config.arrays.values())), clock)


def _run_id(node: str, clock: Clock) -> str:
    """New at each start, and short enough for the wire whatever the node's name is."""
    return f"{clock.now_ns()}-{os.getpid()}-{node}"[:64]


def _played_parts(arguments: argparse.Namespace, site: Site, now_ns: int) -> list[Part]:
    """What a node plays instead of a device."""
    from livessl.capture.stand_in import parts_from_node
    from livessl.recordings.assign import common_start_ns, parts_from_wavs, repeated

    start_ns = getattr(arguments, "start_at", None) or common_start_ns(now_ns, len(site.nodes))
    if not arguments.wav:
        with progress.counted("simulating the room", "source") as bar:
            parts = parts_from_node(site, arguments.node, start_ns, arguments.site.parent, bar)
    else:
        parts = parts_from_wavs(site, *_wavs(arguments), start_ns)
    return repeated(parts) if getattr(arguments, "loop", False) else parts


def _locate(arguments: argparse.Namespace) -> int:
    from livessl import offline
    from livessl.recordings.assign import parts_from_wavs, span_ns
    from livessl.server.api.encode import Messages

    site = load_site(arguments.site, _once_each(arguments.joint, "--joint"))
    _tell_warnings(site)
    parts = parts_from_wavs(site, *_wavs(arguments))
    messages = Messages(site, 0, utc=False)
    found = 0
    with progress.timed("listening", *span_ns(parts)) as bar:
        for output in offline.run(site, parts, UnpacedClock(), method=arguments.method, progress=bar):
            if isinstance(output, Event):
                found += 1
                _print_event(messages.event(output), as_json=arguments.json)
    if not found:
        factor = site.activity.floor_factor
        _complain(
            f"no sound found: nothing rose {factor:g} times in power above the background; "
            "see activity.floor_factor and band_hz in the site file",
            kind="note",
        )
    return OK


def _print_event(event: JsonObject, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(event), flush=True)
        return
    spread = max(event["covariance_m2"][k][k] for k in range(3)) ** 0.5 if event["covariance_m2"] else float("nan")
    print(
        f"{event['start_s']:9.2f} s  {event['duration_s']:5.2f} s  {_xyz(event['position_m']):<22} ± {spread:.2f} m  "
        f"confidence {event['confidence']:.2f}  {event['status']:<14} {', '.join(event['arrays'])}"
        + (f"  ({event['reason']})" if event["reason"] else ""),
        flush=True,
    )


def _replay(arguments: argparse.Namespace) -> int:
    from livessl.recordings.assign import parts_from_sessions
    from livessl.recordings.session import read_session

    sessions = [read_session(directory) for directory in arguments.directories]
    joint = _once_each(arguments.joint, "--joint")
    site = load_site(arguments.site, joint) if arguments.site else sessions[0].site(joint)
    parts = parts_from_sessions(site, sessions)
    if arguments.server is not None:
        with _polite_stop() as stop:
            _send(site, arguments.server, parts, arguments.speed, stop)
        return OK
    from livessl.server.app import Server

    # keys and history are the real server's; a session's own site says nothing of who may look here
    http = site.server.http if arguments.site else HttpConfig(port=site.server.http.port)
    here = site.server.model_copy(update={"bind": "tcp://127.0.0.1:*", "http": http, "events_db": None, "sinks": ()})
    site = site.model_copy(update={"server": here, "keys": None, "store": StoreConfig()})
    show: Callable[[JsonObject], None] = lambda event: _print_event(event, as_json=arguments.json)  # noqa: E731
    server = Server(site, SystemClock(), method=arguments.method, on_event=show)
    logging.info("dashboard on %s", server.url)
    stop = threading.Event()
    failures: list[Exception] = []

    def send() -> None:
        try:
            _send(site, server.endpoint, parts, arguments.speed, stop)
            server.wait_idle()
        except Exception as error:  # noqa: BLE001 - raised again below
            failures.append(error)
        if arguments.once or failures:
            server.stop()
        else:
            logging.info("the session has ended; the dashboard stays until Ctrl-C")

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    _run_server(server)
    stop.set()
    sender.join(timeout=4.0)
    if failures:
        raise failures[0]
    return OK


def _send(site: Site, endpoint: str, parts: Sequence[Part], speed: float, stop: threading.Event) -> None:
    from livessl.capture.node import send_session
    from livessl.recordings.assign import span_ns

    clock = SystemClock()
    begin_ns, end_ns = span_ns(parts)
    pace = UnpacedClock(begin_ns) if speed == float("inf") else PacedClock(begin_ns, speed)
    with progress.timed("playing", begin_ns, end_ns) as bar:
        send_session(site, endpoint, parts, pace, clock, _run_id("replay", clock), stop.is_set, bar)


def _record(arguments: argparse.Namespace) -> int:
    from livessl.capture.record import record_device
    from livessl.recordings.recorder import Recorder, record_parts

    site = load_site(arguments.site)
    if site.privacy == "positions-only":
        what = "positions-only: no sound may be stored, so nothing is recorded; change it if everyone there agrees"
        raise ConfigError([Fault(f"{arguments.site}: privacy", what)])
    config = _node(site, arguments.node, arguments.site)
    _check_played(arguments, config)
    _refuse_recordings(arguments.out)
    clock = SystemClock()
    begun_ns, begun = clock.now_ns(), clock.monotonic_ns()
    length_ns = None if arguments.duration is None else round(arguments.duration * 1e9)
    end_ns = None if length_ns is None else begun_ns + length_ns
    with _polite_stop() as stop, progress.timed("recording", begun_ns, end_ns) as bar:

        def over() -> bool:
            spent_ns = clock.monotonic_ns() - begun
            bar(begun_ns + spent_ns)
            return stop.is_set() or (length_ns is not None and spent_ns >= length_ns)

        if isinstance(config.device, SoundDeviceConfig) and not arguments.wav:
            device = _sound_device(config, config.device, clock)
            recorder = Recorder(arguments.out, site, config.arrays, device.sample_rate_hz, arguments.format)
            record_device(recorder, device, over)
            recorded = recorder.recorded
        else:
            parts = _played_parts(arguments, site, begun_ns)
            recorded = record_parts(arguments.out, site, parts, clock, over, arguments.format)
    if not recorded:
        _complain("nothing was recorded: the device delivered no sound")
        return FAILED
    logging.info("recorded to %s", arguments.out)
    return OK


def _refuse_recordings(directory: Path) -> None:
    """Nothing that was recorded is ever overwritten, nor mixed with anything."""
    from livessl.recordings.session import SESSION_FILE

    held = directory.iterdir() if directory.is_dir() else ()
    names = sorted(path.name for path in held if path.name == SESSION_FILE or path.suffix.lower() in (".wav", ".flac"))
    if names:
        raise ConfigError(
            [Fault(f"--out {directory}", f"already holds a session or recordings ({names[0]}); choose another folder")]
        )


def _simulate(arguments: argparse.Namespace) -> int:
    from livessl.recordings.session import SESSION_FILE
    from livessl.simulate.export import TRUTH_FILE, write_scene
    from livessl.simulate.scene import make_scene, read_sounds, synthesised_sounds

    site = load_site(arguments.site)
    if (arguments.out / SESSION_FILE).exists() and not (arguments.out / TRUTH_FILE).exists():
        raise ConfigError([Fault(f"--out {arguments.out}", "holds a recorded session; choose another folder")])
    rate = float(arguments.sample_rate)
    try:
        sounds = read_sounds(arguments.events, rate) if arguments.events else synthesised_sounds(rate, arguments.seed)
        scene = make_scene(
            site.room.size_m,
            rt60_s=arguments.rt60,
            sounds=sounds,
            count=arguments.count,
            sample_rate_hz=rate,
            c_m_s=site.c_m_s,
            keep_away_m=[spec.centre_m for spec in site.specs],
            seed=arguments.seed,
        )
        with progress.counted("simulating the room", "source") as bar:
            write_scene(arguments.out, site, scene, seed=arguments.seed, progress=bar)
    except ValueError as error:
        _complain(str(error))
        return WRONG_USE
    logging.info("%d sounds in %.1f s written to %s", len(scene.sources), scene.duration_s, arguments.out)
    return OK


def _evaluate(arguments: argparse.Namespace) -> int:
    from livessl.lab.evaluate import command as evaluation

    try:
        with progress.counted(f"evaluating {arguments.experiment}", "position") as bar:
            written = evaluation.run(arguments, arguments.jobs or os.cpu_count() or 1, bar)
    except ValueError as error:
        _complain(str(error))
        return WRONG_USE
    for path in written:
        print(path)
    return OK


def _plan(arguments: argparse.Namespace) -> int:
    from livessl.lab.plan import design, figure, words

    site = load_site(arguments.site)
    if arguments.out is not None:
        figure.require_matplotlib()
    try:
        with progress.counted("trying places", "array") as bar:
            plan = design.make_plan(site, arguments.rt60, arguments.height, arguments.calibration, bar)
    except ValueError as error:
        _complain(str(error))
        return WRONG_USE
    result = words.as_json(plan)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "plan.json").write_text(json.dumps(result, allow_nan=False) + "\n", encoding="utf-8")
        figure.draw(plan, arguments.out / "plan.png")
    print(json.dumps(result, allow_nan=False) if arguments.json else words.as_text(plan))
    return OK


def _check(arguments: argparse.Namespace) -> int:
    try:
        site = load_site(arguments.site)
        doors = open_doors(site)
        if doors:
            raise ConfigError([Fault(f"{arguments.site}: {door.where}", door.what) for door in doors])
    except ConfigError as error:
        if arguments.json:
            faults = [{"where": fault.where, "what": fault.what} for fault in error.faults]
            print(json.dumps({"valid": False, "faults": faults}))
            return WRONG_USE
        raise
    grid = search_grid(site)
    if arguments.json:
        checked = {"valid": True, "faults": [], "warnings": list(site.warnings), "site": site.site}
        print(json.dumps({**checked, "arrays": list(site.arrays), "nodes": grid.size}))
    else:
        _tell_warnings(site)
        arrays = ", ".join(f"{spec.name} ({len(spec.microphones_m)} microphones)" for spec in site.processed)
        print(f"{arguments.site}: valid; site {site.site!r}, arrays {arrays}, {grid.size:,} grid nodes")
    return OK


def _keys_folder(arguments: argparse.Namespace) -> Path:
    site = load_site(arguments.site)
    if site.keys is None:
        what = "expected the folder that holds the keys, got none; add keys: keys to the site file"
        raise ConfigError([Fault(f"{arguments.site}: keys", what)])
    return site.file(site.keys)


def _tokens_file(arguments: argparse.Namespace) -> Path:
    site = load_site(arguments.site)
    if site.server.http.tokens is None:
        what = "expected the file that holds the tokens, got none; add tokens: tokens.yaml to server.http"
        raise ConfigError([Fault(f"{arguments.site}: server.http.tokens", what)])
    return site.file(site.server.http.tokens)


def _keys_server(arguments: argparse.Namespace) -> int:
    key = keyring.make_server_keys(_keys_folder(arguments))
    print(key.hex())
    logging.info("the server's public key; on each node: livessl keys node NAME --site SITE --server %s", key.hex())
    return OK


def _keys_node(arguments: argparse.Namespace) -> int:
    key = keyring.make_node_keys(_keys_folder(arguments), arguments.name, arguments.server)
    print(key.hex())
    logging.info(
        "the node's public key; on the server: livessl keys enrol %s %s --site SITE", arguments.name, key.hex()
    )
    return OK


def _keys_enrol(arguments: argparse.Namespace) -> int:
    keyring.enrol(_keys_folder(arguments), arguments.name, arguments.key)
    logging.info("node %r is enrolled; a running server knows it once it is restarted", arguments.name)
    return OK


def _keys_token(arguments: argparse.Namespace) -> int:
    print(keyring.add_token(_tokens_file(arguments), arguments.name, arguments.role))
    logging.info("this is the only time that the token is shown; a running server knows it once it is restarted")
    return OK


def _keys_revoke(arguments: argparse.Namespace) -> int:
    if arguments.node is not None:
        keyring.dismiss(_keys_folder(arguments), arguments.node)
    else:
        keyring.revoke_token(_tokens_file(arguments), arguments.token)
    logging.info("a running server forgets it once it is restarted")
    return OK


def _keys_list(arguments: argparse.Namespace) -> int:
    site = load_site(arguments.site)
    nodes = {} if site.keys is None else keyring.enrolled(site.file(site.keys))
    tokens = site.server.http.tokens
    clients = () if tokens is None else keyring.read_tokens(site.file(tokens)).clients
    if arguments.json:
        told = [{"name": client.name, "role": str(client.role)} for client in clients]
        print(json.dumps({"nodes": {name: key.hex() for name, key in nodes.items()}, "clients": told}))
        return OK
    for name, key in nodes.items():
        print(f"node    {name:<20} {key.hex()}")
    for client in clients:
        print(f"client  {client.name:<20} {client.role}")
    return OK


def _devices(arguments: argparse.Namespace) -> int:
    from livessl.capture.sound_device import input_devices

    devices = input_devices()
    if arguments.json:
        print(json.dumps([_device_json(device) for device in devices]))
    elif not devices:
        print("no audio input found")
    else:
        print(f"{'channels':>8}  {'rate':>8}  name")
        for device in devices:
            print(f"{device.channels:8d}  {device.default_sample_rate_hz:6.0f}Hz  {device.host_api}: {device.name}")
    return OK


def _device_json(device: Any) -> JsonObject:
    return {
        "name": device.name,
        "host_api": device.host_api,
        "channels": device.channels,
        "default_sample_rate_hz": device.default_sample_rate_hz,
    }


def _node(site: Site, name: str, path: Path) -> NodeConfig:
    if name not in site.nodes:
        known = ", ".join(site.nodes) or "none"
        raise ConfigError([Fault(f"{path}: nodes", f"expected one of {known}, got --node {name}")])
    return site.nodes[name]


def _tell_warnings(site: Site) -> None:
    for warning in site.warnings:
        _complain(warning, kind="note")


def _complain(text: str, kind: str = "error") -> None:
    print(f"livessl: {kind}: {text}", file=sys.stderr)


def _xyz(position: Sequence[float] | None) -> str:
    return "-" if position is None else "(" + ", ".join(f"{x:5.2f}" for x in position) + ")"


def _once_each(pairs: Sequence[tuple[str, T]], option: str) -> dict[str, T]:
    names = [name for name, _ in pairs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError([Fault(option, f"expected each array once, got {twice!r} twice; take one away")])
    return dict(pairs)
