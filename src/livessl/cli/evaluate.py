"""`livessl evaluate`: campaigns in simulated rooms. Packages of the extra `evaluate` are imported only when it runs."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from livessl.cli import argument, progress
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.output import complain
from livessl.lab.evaluate.layout import layout_of
from livessl.lab.evaluate.paper import CLASSES, EXPERIMENTS, Settings, experiment_of
from livessl.lab.evaluate.scenarios import HALVES, LOCALIZER, ROOMS, SCENARIOS, SESSION_SNR_DB, SESSIONS
from livessl.site.load import load_site

REPORT: Final = "report"
"""The experiment that runs nothing: it reports campaigns that were run."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "experiment",
        choices=[*sorted(EXPERIMENTS), LOCALIZER, REPORT],
        help=f"{LOCALIZER}: onset against srp-phat; {REPORT}: only what --with names, reported together",
    )
    parser.add_argument(
        "--site", type=Path, help="site file with a room and arrays instead of the paper's, for one-array or diversity"
    )
    parser.add_argument("--events", type=Path, metavar="DIR", help="clips named like doorslam001.wav")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="results; a run that was cut resumes")
    parser.add_argument(
        "--with",
        dest="others",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="another experiment's --out, to be reported together; may be given more than once",
    )
    parser.add_argument(
        "--positions", type=argument.positive, metavar="N", help="of the source (default: as many as the paper)"
    )
    parser.add_argument("--rt", metavar="S,S,…", help="reverberation times, seconds; 0:2:0.2 is a range")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same results (default 0)")
    parser.add_argument("--jobs", type=argument.positive, help="processes (default: one a core)")
    parser.add_argument("--scheduler", metavar="tcp://…", help="Dask scheduler to use instead of processes here")
    parser.add_argument("--classes", default=",".join(CLASSES), help=f"of sounds (default {','.join(CLASSES)})")
    parser.add_argument(
        "--snr",
        metavar="DB[,DB…]",
        help=f"white sensor noise, so far below each recording's mean power, inf for none (default: none); {LOCALIZER} "
        "takes several",
    )
    parser.add_argument("--grid", type=float, metavar="M", help="search grid's spacing (default: the paper's)")
    parser.add_argument("--sample-rate", type=argument.positive, default=16000, metavar="HZ", help="of the simulation")
    parser.add_argument("--segment", choices=("longest", "peak"), default="longest", help="which one is localized")
    parser.add_argument("--half", choices=HALVES, default="test", help=f"{LOCALIZER}: half of the clips (default test)")
    parser.add_argument(
        "--scenario",
        default=ROOMS,
        metavar="NAME[,NAME…]",
        help=f"{LOCALIZER}: some of {', '.join(SCENARIOS)}, which share sounds and rooms (default {ROOMS}); or one of "
        f"{', '.join(SESSIONS)}",
    )
    parser.add_argument("--no-band-limit", action="store_true", help="do not limit the band against spatial aliasing")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    try:
        with progress.counted(f"evaluating {arguments.experiment}", "position") as bar:
            written = evaluate(arguments, arguments.jobs or os.cpu_count() or 1, bar)
    except ValueError as error:
        complain(str(error))
        return WRONG_USE
    for path in written:
        print(path)
    return OK


def settings_of(arguments: argparse.Namespace) -> Settings:
    """Return the settings that the arguments describe.

    Raises
    ------
    ValueError
        Where a value is impossible.
    ConfigError
        Where the site file is wrong.
    """
    layout = None if arguments.site is None else layout_of(load_site(arguments.site))
    experiment = experiment_of(arguments.experiment, layout)
    rt60s_s = experiment.rt60s_s if arguments.rt is None else reverberation_times_s(arguments.rt)
    from livessl.simulation.room import absorption

    for rt60_s in rt60s_s:
        absorption(rt60_s, experiment.room_m, experiment.c_m_s)
    if arguments.grid is not None and not 0.02 <= arguments.grid <= 2.0:
        raise ValueError(f"--grid: expected 0.02 to 2 metres, got {arguments.grid:g}")
    if arguments.sample_rate < experiment.lag_rate_hz:
        raise ValueError(
            f"--sample-rate: the band ends at {experiment.band_hz[1]:g} Hz, expected "
            f"{math.ceil(experiment.lag_rate_hz)} Hz or more, got {arguments.sample_rate}"
        )
    return Settings(
        experiment=arguments.experiment,
        positions=arguments.positions or experiment.positions,
        rt60s_s=rt60s_s,
        seed=arguments.seed,
        sample_rate_hz=float(arguments.sample_rate),
        spacing_m=arguments.grid or experiment.spacing_m,
        snr_db=_one_level_db(arguments.snr),
        segment=arguments.segment,
        band_limit=not arguments.no_band_limit,
        layout=layout,
    )


def evaluate(arguments: argparse.Namespace, jobs: int, show: Callable[[int, int], None]) -> list[Path]:
    """Run the campaign and write what it found; return the files.

    Raises
    ------
    ValueError
        Where an argument, a sound or the folder is not as it must be, or an extra is not installed.
    """
    try:
        from livessl.lab.evaluate.campaign import run_campaign
        from livessl.lab.evaluate.job import Job, read_clips
        from livessl.lab.evaluate.report import require_campaign, write_report
    except ImportError as error:
        raise ValueError(f"evaluate needs more packages: pip install 'livessl[evaluate]' ({error})") from error

    if arguments.experiment == REPORT:
        if arguments.site is not None:
            raise ValueError("evaluate report: runs nothing, so expected no --site; take it away")
        if not arguments.others:
            raise ValueError(
                "evaluate report: expected one or more folders of campaigns, got none; name them by --with"
            )
        return write_report(arguments.out, arguments.others)
    if arguments.events is None:
        raise ValueError("evaluate: expected sounds to play, got none; name their folder by --events")
    if arguments.experiment == LOCALIZER:
        return _run_localizer(arguments, jobs, show)
    for folder in arguments.others:
        require_campaign(folder)  # now, not when hours are over
    settings = settings_of(arguments)
    classes = [name.strip() for name in arguments.classes.split(",") if name.strip()]
    clips = read_clips(arguments.events, classes, settings.sample_rate_hz)
    results = run_campaign(Job(settings, clips), arguments.out, jobs=jobs, scheduler=arguments.scheduler, progress=show)
    return [results, *write_report(arguments.out, [arguments.out, *arguments.others])]


def _run_localizer(arguments: argparse.Namespace, jobs: int, show: Callable[[int, int], None]) -> list[Path]:
    from livessl.lab.evaluate.campaign import run_campaign
    from livessl.lab.evaluate.job import Job, read_clips
    from livessl.lab.evaluate.localizer_report import write_localizer_report
    from livessl.lab.evaluate.sessions import SessionSettings
    from livessl.lab.evaluate.sessions_report import write_sessions_report

    settings = _localizer_settings(arguments)
    classes = [name.strip() for name in arguments.classes.split(",") if name.strip()]
    clips = read_clips(arguments.events, classes, settings.sample_rate_hz)
    job = Job(settings, clips)
    results = run_campaign(job, arguments.out, jobs=jobs, scheduler=arguments.scheduler, progress=show)
    write = write_sessions_report if isinstance(settings, SessionSettings) else write_localizer_report
    return [results, *write(arguments.out)]


def _localizer_settings(arguments: argparse.Namespace) -> Any:
    """Return the settings that the arguments describe: of a session's scenario, or of the localizer's rooms."""
    from livessl.lab.evaluate import localizer, sessions

    names = _scenarios(arguments.scenario)
    rt60s_s = None if arguments.rt is None else reverberation_times_s(arguments.rt)
    snrs_db = None if arguments.snr is None else levels_db(arguments.snr)
    common = {"seed": arguments.seed, "sample_rate_hz": float(arguments.sample_rate), "half": arguments.half}
    if names[0] in SESSIONS:
        return sessions.SessionSettings(
            positions=arguments.positions or sessions.POSITIONS,
            scenario=names[0],
            rt60s_s=rt60s_s or (SESSIONS[names[0]].rt60_s,),
            snrs_db=snrs_db or (SESSION_SNR_DB,),
            **common,
        )
    return localizer.LocalizerSettings(
        positions=arguments.positions or localizer.POSITIONS,
        rt60s_s=rt60s_s or localizer.RT60S_S,
        snrs_db=snrs_db or localizer.SNRS_DB,
        spacing_m=arguments.grid or localizer.SPACING_M,
        scenarios=names,
        **common,
    )


def reverberation_times_s(text: str) -> tuple[float, ...]:
    """Reverberation times from `0,0.4` or `0:2:0.2` (both ends included), seconds, ascending.

    Raises
    ------
    ValueError
        Where the text is neither.
    """
    try:
        if ":" in text:
            first, last, step = (float(part) for part in text.split(":"))
            count = round((last - first) / step) + 1
            times = [round(first + index * step, 6) for index in range(count)]
        else:
            times = [float(part) for part in text.split(",")]
        if not times or not all(0.0 <= time < 60.0 for time in times):
            raise ValueError
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ValueError(f"--rt: expected seconds such as 0,0.4,0.8 or 0:2:0.2, got {text!r}") from None
    return tuple(sorted(set(times)))


def levels_db(text: str) -> tuple[float, ...]:
    """Levels from `inf,20,10`, dB.

    Raises
    ------
    ValueError
        Where the text is none.
    """
    try:
        levels = tuple(dict.fromkeys(float(part) for part in text.split(",")))
        if not all(level > -math.inf for level in levels):  # nor NaN
            raise ValueError
    except ValueError:
        raise ValueError(f"--snr: expected decibels such as 20 or inf,20,10, got {text!r}") from None
    return levels


def _one_level_db(text: str | None) -> float | None:
    if text is None:
        return None
    level, *more = levels_db(text)
    if more:
        raise ValueError(f"--snr: expected one level, for only {LOCALIZER} takes several, got {text}")
    return None if level == math.inf else level


def _scenarios(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    unknown = [name for name in names if name not in SCENARIOS and name not in SESSIONS]
    if unknown:
        known = ", ".join([*SCENARIOS, *SESSIONS])
        raise ValueError(f"--scenario: expected some of {known}, got {', '.join(unknown)}")
    if len(names) > 1 and any(name in SESSIONS for name in names):
        alone = " and ".join(name for name in names if name in SESSIONS)
        raise ValueError(f"--scenario: {alone}: each of {', '.join(SESSIONS)} is run alone, got {', '.join(names)}")
    return names
