"""`livessl evaluate`: experiments in simulated rooms.

The packages of the extra `evaluate` are imported only when an experiment runs, so that the help works without them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from livessl.cli import argument, progress
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.options import add_json, add_older_name, refuse_unused
from livessl.cli.output import complain
from livessl.lab.evaluate.layout import layout_of
from livessl.lab.evaluate.paper import CLASSES, EXPERIMENTS, Settings, experiment_of
from livessl.lab.evaluate.scenarios import HALVES, LOCALIZER, NOISE, ROOMS, SCENARIOS, SESSION_SNR_DB, SESSIONS
from livessl.site.load import load_site

REPORT: Final = "report"
"""Name of the experiment that simulates nothing, and reports the results of earlier runs."""

PAPER: Final = "García-Barrios et al., Applied Acoustics, doi:10.1016/j.apacoust.2022.109138"
"""The paper whose experiments are repeated."""

SEGMENT: Final = "longest"
"""Default of --segment."""

HALF: Final = "test"
"""Default of --half."""

ALONE: Final = (NOISE, *SESSIONS)
"""Scenarios of the localizer that cannot be combined with others."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add = parser.add_argument
    add(
        "experiment",
        choices=[*sorted(EXPERIMENTS), LOCALIZER, REPORT],
        help=f"experiments of the paper ({PAPER}): one-array (a small or a large array, at many "
        "reverberation times), diversity (two small arrays at several distances, compared with one) and office (the "
        f"same in an office); {LOCALIZER} compares the methods onset and srp-phat; {REPORT} simulates nothing: it "
        "writes one report on the results of earlier runs of the paper's experiments, in the folders given by --with",
    )
    add(
        "--site",
        type=Path,
        help="site file whose room and arrays replace those of the paper (only with one-array and diversity)",
    )
    sounds = add(
        "--sounds",
        type=Path,
        metavar="DIR",
        help="folder of sound files, WAV or FLAC, each named by class and number, such as doorslam001.wav",
    )
    add_older_name(parser, "--events", sounds)
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for the results; the same command resumes an interrupted run",
    )
    add(
        "--with",
        dest="others",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="folder of results (--out of an earlier run of an experiment of the paper) to include in the report; "
        f"repeat the option for each folder (not with {LOCALIZER})",
    )
    add("--jobs", type=argument.positive, help="number of parallel processes (default: one per core)")
    add(
        "--scheduler",
        metavar="tcp://…",
        help="address of a Dask scheduler, which then runs the work instead of local processes",
    )
    add_json(parser, "print the paths of the written files as one JSON object")
    _add_simulation(parser.add_argument_group("simulation"))
    _add_localization(parser.add_argument_group("localization"))
    _add_comparison(parser.add_argument_group(f"with {LOCALIZER}"))


def _add_simulation(group: Any) -> None:
    add = group.add_argument
    add(
        "--positions",
        type=argument.positive,
        metavar="N",
        help="number of source positions (default: the experiment's own)",
    )
    rt60 = add(
        "--rt60",
        metavar="S,S,…",
        help="reverberation times in seconds, such as 0,0.4, or a range such as 0:2:0.2 (default: the experiment's "
        "own)",
    )
    add_older_name(group, "--rt", rt60)
    add("--seed", type=argument.seed, default=0, help="random seed; the same seed gives the same results (default: 0)")
    add("--classes", default=",".join(CLASSES), help=f"classes of sounds to use (default: {','.join(CLASSES)})")
    add(
        "--snr",
        metavar="DB[,DB…]",
        help="signal-to-noise ratio, dB, of the white sensor noise to add: mean power of the recording over that of "
        f"the noise; inf: none; only {LOCALIZER} accepts several values (default: inf)",
    )
    rate = add(
        "--rate",
        dest="sample_rate",
        type=argument.positive,
        default=16000,
        metavar="HZ",
        help="sampling rate in hertz (default: 16000)",
    )
    add_older_name(group, "--sample-rate", rate)


def _add_localization(group: Any) -> None:
    add = group.add_argument
    spacing = add(
        "--spacing",
        type=float,
        metavar="M",
        help="spacing of the search grid in metres (default: the experiment's own)",
    )
    add_older_name(group, "--grid", spacing)
    add(
        "--segment",
        choices=("longest", "peak"),
        default=SEGMENT,
        help="segment of each sound to locate: the longest, or `peak` for the one with the loudest frame (default: "
        f"longest; not with {LOCALIZER})",
    )
    add(
        "--no-band-limit",
        action="store_true",
        help="use the full band for all pairs of microphones, even if it causes spatial aliasing (not with "
        f"{LOCALIZER})",
    )


def _add_comparison(group: Any) -> None:
    add = group.add_argument
    add(
        "--half",
        choices=HALVES,
        default=HALF,
        help="half of the sounds to use: the constants of the methods were fitted on `development`, results are "
        "reported on `test` (default: test)",
    )
    add(
        "--scenario",
        default=ROOMS,
        metavar="NAME[,NAME…]",
        help=f"one or more of {', '.join(SCENARIOS)}, compared on the same sounds and rooms (default: {ROOMS}); "
        f"or only one of {', '.join(ALONE)}; docs/accuracy/README.md has the results of each",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    try:
        with progress.counted(f"evaluating {arguments.experiment}", "position") as bar:
            written = evaluate(arguments, arguments.jobs or os.cpu_count() or 1, bar)
    except ValueError as error:
        complain(str(error))
        return WRONG_USE
    if arguments.json:
        print(json.dumps({"files": [str(path) for path in written]}))
        return OK
    for path in written:
        print(path)
    return OK


def settings_of(arguments: argparse.Namespace) -> Settings:
    """Return the settings of an experiment of the paper.

    Raises
    ------
    ValueError
        If a value is impossible.
    ConfigError
        If the site file is invalid.
    """
    layout = None if arguments.site is None else layout_of(load_site(arguments.site))
    experiment = experiment_of(arguments.experiment, layout)
    rt60s_s = experiment.rt60s_s if arguments.rt60 is None else reverberation_times_s(arguments.rt60)
    from livessl.simulation.room import absorption

    for rt60_s in rt60s_s:
        absorption(rt60_s, experiment.room_m, experiment.c_m_s)
    if arguments.spacing is not None and not 0.02 <= arguments.spacing <= 2.0:
        raise ValueError(f"--spacing: expected 0.02 to 2 metres, got {arguments.spacing:g}")
    if arguments.sample_rate < experiment.lag_rate_hz:
        raise ValueError(
            f"--rate: the band ends at {experiment.band_hz[1]:g} Hz, expected "
            f"{math.ceil(experiment.lag_rate_hz)} Hz or more, got {arguments.sample_rate}"
        )
    return Settings(
        experiment=arguments.experiment,
        positions=arguments.positions or experiment.positions,
        rt60s_s=rt60s_s,
        seed=arguments.seed,
        sample_rate_hz=float(arguments.sample_rate),
        spacing_m=arguments.spacing or experiment.spacing_m,
        snr_db=_one_level_db(arguments.snr),
        segment=arguments.segment,
        band_limit=not arguments.no_band_limit,
        layout=layout,
    )


def evaluate(arguments: argparse.Namespace, jobs: int, show: Callable[[int, int], None]) -> list[Path]:
    """Run an experiment, write its results and its report, and return the paths of the files.

    Parameters
    ----------
    arguments : argparse.Namespace
    jobs : int
        Worker processes.
    show : callable
        Called with the number of positions done and the total.

    Raises
    ------
    ValueError
        If an argument, a sound or the folder is unusable, or the extra `evaluate` is not installed.
    """
    try:
        from livessl.lab.evaluate.campaign import run_campaign
        from livessl.lab.evaluate.job import Job, read_clips
        from livessl.lab.evaluate.report import require_campaign, write_report
    except ImportError as error:
        raise ValueError(
            f"evaluate: expected the packages of the extra 'evaluate' ({error}); run pip install 'livessl[evaluate]'"
        ) from error

    _refuse_unused(arguments)
    if arguments.experiment == REPORT:
        if not arguments.others:
            raise ValueError("evaluate report: expected one or more folders of results, got none; add --with DIR")
        return write_report(arguments.out, arguments.others)
    if arguments.sounds is None:
        raise ValueError("evaluate: expected sounds to play, got none; add --sounds DIR")
    if arguments.experiment == LOCALIZER:
        return _run_localizer(arguments, jobs, show)
    for folder in arguments.others:
        require_campaign(folder)  # before hours of computation
    settings = settings_of(arguments)
    classes = [name.strip() for name in arguments.classes.split(",") if name.strip()]
    clips = read_clips(arguments.sounds, classes, settings.sample_rate_hz)
    results = run_campaign(Job(settings, clips), arguments.out, jobs=jobs, scheduler=arguments.scheduler, progress=show)
    return [results, *write_report(arguments.out, [arguments.out, *arguments.others])]


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """Refuse the options that have no effect on the experiment."""
    of_paper = {
        "--site": arguments.site,
        "--segment": arguments.segment != SEGMENT,
        "--no-band-limit": arguments.no_band_limit,
    }
    of_localizer = {"--half": arguments.half != HALF, "--scenario": arguments.scenario != ROOMS}
    of_simulation = {
        "--sounds": arguments.sounds,
        "--positions": arguments.positions,
        "--rt60": arguments.rt60,
        "--snr": arguments.snr,
        "--spacing": arguments.spacing,
        "--scheduler": arguments.scheduler,
    }
    name, why = arguments.experiment, f"with {arguments.experiment}"
    if name == REPORT:
        refuse_unused("evaluate", of_paper | of_localizer | of_simulation, f"{why}, which simulates nothing")
    elif name == LOCALIZER:
        refuse_unused("evaluate", of_paper | {"--with": arguments.others}, why)
    else:
        refuse_unused("evaluate", of_localizer, why)


def _run_localizer(arguments: argparse.Namespace, jobs: int, show: Callable[[int, int], None]) -> list[Path]:
    from livessl.lab.evaluate.campaign import run_campaign
    from livessl.lab.evaluate.job import Job, read_clips
    from livessl.lab.evaluate.localizer_report import write_localizer_report
    from livessl.lab.evaluate.noise import NoiseSettings
    from livessl.lab.evaluate.noise_report import write_noise_report
    from livessl.lab.evaluate.sessions import SessionSettings
    from livessl.lab.evaluate.sessions_report import write_sessions_report

    settings = _localizer_settings(arguments)
    classes = [name.strip() for name in arguments.classes.split(",") if name.strip()]
    clips = read_clips(arguments.sounds, classes, settings.sample_rate_hz)
    job = Job(settings, clips)
    results = run_campaign(job, arguments.out, jobs=jobs, scheduler=arguments.scheduler, progress=show)
    reports = {SessionSettings: write_sessions_report, NoiseSettings: write_noise_report}
    write = reports.get(type(settings), write_localizer_report)
    return [results, *write(arguments.out)]


def _localizer_settings(arguments: argparse.Namespace) -> Any:
    """Return the settings of the experiment that compares methods, in rooms or in sessions."""
    from livessl.lab.evaluate import localizer, noise, sessions

    names = _scenarios(arguments.scenario)
    rt60s_s = None if arguments.rt60 is None else reverberation_times_s(arguments.rt60)
    snrs_db = None if arguments.snr is None else levels_db(arguments.snr)
    common = {"seed": arguments.seed, "sample_rate_hz": float(arguments.sample_rate), "half": arguments.half}
    if names[0] == NOISE:
        if rt60s_s is not None:
            raise ValueError(f"--rt60: the rooms of {NOISE} have reverberation times of their own; remove --rt60")
        return noise.NoiseSettings(
            positions=arguments.positions or noise.POSITIONS,
            snrs_db=snrs_db or noise.SNRS_DB,
            spacing_m=arguments.spacing or localizer.SPACING_M,
            **common,
        )
    if names[0] in SESSIONS:
        if arguments.spacing is not None:
            raise ValueError(
                f"--spacing: {names[0]} takes the spacing of the search grid from its site; remove --spacing"
            )
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
        spacing_m=arguments.spacing or localizer.SPACING_M,
        scenarios=names,
        **common,
    )


def reverberation_times_s(text: str) -> tuple[float, ...]:
    """Return reverberation times in seconds, ascending, from `0,0.4` or `0:2:0.2` (both ends included).

    Raises
    ------
    ValueError
        If the text is neither.
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
        raise ValueError(f"--rt60: expected seconds such as 0,0.4,0.8 or 0:2:0.2, got {text!r}") from None
    return tuple(sorted(set(times)))


def levels_db(text: str) -> tuple[float, ...]:
    """Return levels in decibels from `inf,20,10`.

    Raises
    ------
    ValueError
        If the text holds none.
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
        raise ValueError(f"--snr: expected one level, got {text}; only {LOCALIZER} takes several")
    return None if level == math.inf else level


def _scenarios(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    unknown = [name for name in names if name not in SCENARIOS and name not in ALONE]
    if unknown:
        known = ", ".join([*SCENARIOS, *ALONE])
        raise ValueError(f"--scenario: expected some of {known}, got {', '.join(unknown)}")
    if len(names) > 1 and any(name in ALONE for name in names):
        alone = " and ".join(name for name in names if name in ALONE)
        raise ValueError(f"--scenario: {alone}: each of {', '.join(ALONE)} is run alone, got {', '.join(names)}")
    return names
