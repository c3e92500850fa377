"""What the paper's text says, and what our results say to it. The claims are fixed; nothing here is fitted to a result.

A claim becomes a statement about one number and the region it must lie in. With the number's 99 % bootstrap interval:
inside the region is *reproduced*, apart from it *not reproduced*, across its edge *cannot be told*. "At every RT" is
judged by the worst one, whose resamples lean to the worse side: it takes more than elsewhere to be reproduced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.lab.evaluate.paper import C_M_S
from livessl.lab.evaluate.statistics import Interval, Results

HALF_CELL_M: Final = 0.87
"""The paper's bound: the diagonal of a 0.5 m cell."""

LEAST_POSITIONS: Final = 30
"""With fewer a bootstrap interval means little, and nothing can be told."""

_INF: Final = float("inf")

_MORE: Final = 1e-6
"""Above zero: on a grid, medians are often equal, and equal is not better."""


class Verdict(StrEnum):
    """What a result says to a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    CANNOT_BE_TOLD = "cannot be told"


@dataclass(frozen=True, slots=True)
class Claim:
    """One statement of the paper.

    Parameters
    ----------
    name : str
        Short and stable.
    paper : str
        What it says.
    measure : str
        The number that decides, in words.
    region : (float, float)
        Where the number lies if the claim holds.
    ours : Interval or None
        None where the experiment was not run.
    verdict : Verdict
    note : str
        How it came about, or why it does not.
    """

    name: str
    paper: str
    measure: str
    region: tuple[float, float]
    ours: Interval | None
    verdict: Verdict
    note: str = ""


def judged(interval: Interval, region: tuple[float, float]) -> Verdict:
    """Compare an interval with a region, ends included."""
    low, high = region
    if low <= interval.low and interval.high <= high:
        return Verdict.REPRODUCED
    if interval.high < low or interval.low > high:
        return Verdict.NOT_REPRODUCED
    return Verdict.CANNOT_BE_TOLD


def claims(campaigns: Mapping[str, Results]) -> list[Claim]:
    """All claims in the order of the paper; those of experiments that were not run cannot be told."""
    return [
        *_one_array(campaigns.get("one-array")),
        *_diversity(campaigns.get("diversity")),
        *_office(campaigns.get("office")),
        *_theory(),
        *_widths(campaigns.get("one-array"), campaigns.get("diversity")),
    ]


def _claim(
    results: Results | None,
    name: str,
    paper: str,
    measure: str,
    region: tuple[float, float],
    number: Callable[[Results], FloatArray],
    note: str = "",
) -> Claim:
    """Work a claim out, where there is what it needs."""
    if results is None:
        return Claim(name, paper, measure, region, None, Verdict.CANNOT_BE_TOLD, "not run")
    try:
        ours = Interval.of(number(results))
    except (KeyError, _NothingLeftError):
        return Claim(name, paper, measure, region, None, Verdict.CANNOT_BE_TOLD, "run without what this needs")
    if results.positions < LEAST_POSITIONS:
        few = f"{results.positions} positions are too few"
        return Claim(name, paper, measure, region, ours, Verdict.CANNOT_BE_TOLD, few)
    return Claim(name, paper, measure, region, ours, judged(ours, region), note)


class _NothingLeftError(Exception):
    """No reverberation time of the campaign is one that the claim speaks of."""


def _over(
    results: Results,
    wanted: Callable[[float], bool],
    number: Callable[[float], FloatArray],
    join: Callable[..., FloatArray],
) -> FloatArray:
    """Join a number of each reverberation time wanted: the largest, the least, the mean."""
    chosen = [number(rt60_s) for rt60_s in results.rt60s_s if wanted(rt60_s)]
    if not chosen:
        raise _NothingLeftError
    return np.asarray(join(np.stack(chosen), axis=0))


def _one_array(results: Results | None) -> list[Claim]:
    def median(system: str, rt60_s: float, method: str = "srp-phat") -> FloatArray:
        assert results is not None
        return results.medians(system, method, rt60_s)

    def gain(system: str, method: str, rt60_s: float) -> FloatArray:
        return median(system, rt60_s) - median(system, rt60_s, method)

    found = [
        _claim(
            results,
            "anechoic, small",
            "median error 0.73 m (99 % interval within ±0.12 m)",
            "median at RT 0, m",
            (0.61, 0.85),
            lambda _: median("small", 0.0),
        ),
        _claim(
            results,
            "anechoic, large",
            "median error 0.64 m (99 % interval within ±0.20 m)",
            "median at RT 0, m",
            (0.44, 0.84),
            lambda _: median("large", 0.0),
        ),
        _claim(
            results,
            "small within a cell to 0.8 s",
            "the small array's median stays under 0.87 m up to about 0.8 s",
            "largest median at RT 0 to 0.8 s, m",
            (-_INF, HALF_CELL_M),
            lambda r: _over(r, lambda t: t <= 0.8, lambda t: median("small", t), np.max),
            _crossing(results, "small"),
        ),
        _claim(
            results,
            "large within a cell to 0.2 s",
            "the large array's median stays under 0.87 m up to about 0.2 s",
            "largest median at RT 0 to 0.2 s, m",
            (-_INF, HALF_CELL_M),
            lambda r: _over(r, lambda t: t <= 0.2, lambda t: median("large", t), np.max),
            _crossing(results, "large"),
        ),
        _claim(
            results,
            "large not beyond 0.2 s",
            "… and only to about 0.2 s",
            "least median at RT 0.4 s and above, m",
            (HALF_CELL_M, _INF),
            lambda r: _over(r, lambda t: t >= 0.4, lambda t: median("large", t), np.min),
        ),
        _claim(
            results,
            "small beats large above 0.4 s",
            "above 0.4 s the small array is clearly better",
            "least difference large − small at RT above 0.4 s, m",
            (_MORE, _INF),
            lambda r: _over(r, lambda t: t > 0.4, lambda t: median("large", t) - median("small", t), np.min),
        ),
        _claim(
            results,
            "large beats small when dry",
            "the large array is better only at the shortest reverberation times",
            "difference small − large at RT 0, m",
            (_MORE, _INF),
            lambda _: median("small", 0.0) - median("large", 0.0),
        ),
    ]
    for system, from_s in (("small", 0.6), ("large", 0.4)):
        found += _cepstral(results, system, from_s, gain)
    found.append(
        _claim(
            results,
            "averaging hurts above 0.6 s",
            "averaging GCCs over 25 ms frames degrades the small array significantly above 0.6 s",
            "mean difference averaged − srp-phat at RT above 0.6 s, small, m",
            (_MORE, _INF),
            lambda r: -_over(r, lambda t: t > 0.6, lambda t: gain("small", "averaged", t), np.mean),
        )
    )
    return found


def _cepstral(
    results: Results | None, system: str, from_s: float, gain: Callable[[str, str, float], FloatArray]
) -> list[Claim]:
    return [
        _claim(
            results,
            f"cepstral helps, {system}",
            f"cepstral prefiltering helps the {system} array above {from_s:g} s",
            f"mean gain at RT above {from_s:g} s, m",
            (_MORE, _INF),
            lambda r: _over(r, lambda t: t > from_s, lambda t: gain(system, "cepstral", t), np.mean),
        ),
        _claim(
            results,
            f"cepstral does not help before, {system}",
            f"… and not up to {from_s:g} s",
            f"mean gain at RT up to {from_s:g} s, m",
            (-_INF, 0.0),
            lambda r: _over(r, lambda t: t <= from_s, lambda t: gain(system, "cepstral", t), np.mean),
        ),
        _claim(
            results,
            f"cepstral by 0.1 m at most, {system}",
            "… by 0.1 m at most",
            "largest gain at any RT, m",
            (-_INF, 0.1),
            lambda r: _over(r, lambda _: True, lambda t: gain(system, "cepstral", t), np.max),
        ),
    ]


def _diversity(results: Results | None) -> list[Claim]:
    def median(system: str, rt60_s: float) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", rt60_s)

    def always(first: str, second: str) -> Callable[[Results], FloatArray]:
        return lambda r: _over(r, lambda _: True, lambda t: median(first, t) - median(second, t), np.min)

    def gain(rt60_s: float) -> FloatArray:
        return median("pair-0m", rt60_s) - median("pair-5m", rt60_s)

    return [
        _claim(
            results,
            "eight joint beat two at 0 m",
            "8 microphones processed jointly are better than two arrays at 0 m",
            "least difference two at 0 m − joint over RT, m",
            (_MORE, _INF),
            always("pair-0m", "joint-8"),
        ),
        _claim(
            results,
            "two at 0 m beat one",
            "two arrays at 0 m are better than one",
            "least difference one − two at 0 m over RT, m",
            (_MORE, _INF),
            always("small", "pair-0m"),
        ),
        _claim(
            results,
            "5 m gain 0.4 m at least",
            "5 m between two arrays reduce the median by 0.4 to 0.5 m at every RT",
            "least gain 0 m − 5 m over RT, m",
            (0.35, _INF),
            lambda r: _over(r, lambda _: True, gain, np.min),
            "0.4 m to one digit is 0.35 or more",
        ),
        _claim(
            results,
            "5 m gain 0.5 m at most",
            "… by 0.4 to 0.5 m",
            "largest gain 0 m − 5 m over RT, m",
            (-_INF, 0.55),
            lambda r: _over(r, lambda _: True, gain, np.max),
            "0.5 m to one digit is 0.55 or less",
        ),
    ]


def _office(results: Results | None) -> list[Claim]:
    def median(system: str) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", results.rt60s_s[0])

    simulated = "our office is simulated; the paper's was real, and its recordings are not public"
    return [
        _claim(
            results,
            "office, 3 m gain 0.44 m",
            "3 m between the arrays reduce the median by 0.44 m",
            "gain 0 m − 3 m, m",
            (0.34, 0.54),
            lambda _: median("pair-0m") - median("pair-3m"),
            f"both medians to ±0.05 m; {simulated}",
        ),
        _claim(
            results,
            "office, splitting costs 0.1 m",
            "from 8 joint microphones to two arrays at 0 m the median worsens by about 0.1 m",
            "cost two at 0 m − joint, m",
            (0.0, 0.2),
            lambda _: median("pair-0m") - median("joint-8"),
            simulated,
        ),
        _claim(
            results,
            "office, 1 m beats 0 m",
            "1 m is better than 0 m",
            "gain 0 m − 1 m, m",
            (_MORE, _INF),
            lambda _: median("pair-0m") - median("pair-1m"),
            simulated,
        ),
        _claim(
            results,
            "office, 2 m worse than 1 m",
            "2 m is worse than 1 m, which the paper calls atypical",
            "cost 2 m − 1 m, m",
            (_MORE, _INF),
            lambda _: median("pair-2m") - median("pair-1m"),
            simulated,
        ),
    ]


def _theory() -> list[Claim]:
    kd = 2.0 * np.pi * 100.0 / C_M_S * 5.0
    beyond = np.linspace(kd, 200.0, 200_000)
    largest = float(np.abs(np.sinc(beyond / np.pi)).max())
    exact = [Interval(value, value, value) for value in (kd, largest)]
    return [
        Claim(
            "kd",
            "kd = 9.16 at 100 Hz and 5 m",
            "2 pi f d / c",
            (9.155, 9.165),
            exact[0],
            judged(exact[0], (9.155, 9.165)),
        ),
        Claim(
            "coherence",
            "|rho| <= 0.13 beyond",
            "largest |sin(kd)/kd| for kd of 9.16 and above",
            (0.0, 0.13),
            exact[1],
            judged(exact[1], (0.0, 0.13)),
            "the bound holds; 0.128 is the lobe at kd 7.73, below 9.16",
        ),
    ]


def _widths(one: Results | None, diversity: Results | None) -> list[Claim]:
    found = []
    for results, name, systems, paper_m in (
        (one, "small", ("small",), 0.12),
        (one, "large", ("large",), 0.20),
        (diversity, "two arrays", tuple(f"pair-{metres}m" for metres in range(6)), 0.05),
    ):
        text = f"99 % intervals of {name}: within ±{paper_m:g} m of the median"
        measure = "largest half width over RT, m"
        region = (0.0, paper_m)
        if results is None or not all(results.has(system) for system in systems):
            found.append(Claim(f"width, {name}", text, measure, region, None, Verdict.CANNOT_BE_TOLD, "not run"))
            continue
        intervals = [
            Interval.of(results.medians(system, "srp-phat", rt60_s)) for system in systems for rt60_s in results.rt60s_s
        ]
        width = max((interval.high - interval.low) / 2.0 for interval in intervals)
        full = width * float(np.sqrt(results.positions / 1000.0))
        ours = Interval(width, full, full)
        verdict = Verdict.CANNOT_BE_TOLD
        note = (
            f"{results.positions} positions; scaled to the paper's 1000 it is {full:.2f} m, by which it is judged; we "
            "resample positions, whose four events err nearly alike: taken for independent they would give half of it"
        )
        if results.positions >= LEAST_POSITIONS:
            verdict = judged(Interval(full, full, full), region)
        found.append(Claim(f"width, {name}", text, measure, region, ours, verdict, note))
    return found


def _crossing(results: Results | None, system: str) -> str:
    """Where the median first exceeds the bound, in words."""
    if results is None or not results.has(system):
        return ""
    for rt60_s in results.rt60s_s:
        if results.medians(system, "srp-phat", rt60_s)[0] >= HALF_CELL_M:
            return f"ours first exceeds it at RT {rt60_s:g} s"
    return "ours never exceeds it"
