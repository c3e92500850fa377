"""The claims of the paper's text, and the numbers that decide whether they are reproduced. Nothing is fitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.lab.evaluate.paper import C_M_S
from livessl.lab.evaluate.statistics import Interval, Results
from livessl.lab.evaluate.verdict import LEAST_POSITIONS, NOT_RUN, Claim, Verdict, decided, judged, over

HALF_CELL_M: Final = 0.87
"""The paper's bound, in metres: the diagonal of a 0.5 m cell."""

_INF: Final = float("inf")

_MORE: Final = 1e-6
"""Least difference, in metres, that counts as better: medians on a grid are often equal, and equal is not better."""


def claims(campaigns: Mapping[str, Results]) -> list[Claim]:
    """Return all claims in the order of the paper; claims of experiments that were not run are undecided."""
    return [
        *_one_array(campaigns.get("one-array")),
        *_diversity(campaigns.get("diversity")),
        *_office(campaigns.get("office")),
        *_theory(),
        *_widths(campaigns.get("one-array"), campaigns.get("diversity")),
    ]


def _one_array(results: Results | None) -> list[Claim]:
    return [*_sizes(results), *_methods(results)]


def _sizes(results: Results | None) -> list[Claim]:
    """Claims about the small and the large array with the standard method."""

    def median(system: str, rt60_s: float) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", rt60_s)

    def stays_within(system: str, until_s: float) -> Claim:
        return decided(
            results,
            f"{system} within a cell to {until_s:g} s",
            f"the {system} array's median stays under 0.87 m up to about {until_s:g} s",
            f"largest median at RT 0 to {until_s:g} s, m",
            (-_INF, HALF_CELL_M),
            lambda r: over(r, lambda t: t <= until_s, lambda t: median(system, t), np.max),
            _crossing(results, system),
        )

    return [
        decided(
            results,
            "anechoic, small",
            "median error 0.73 m (99 % interval within ±0.12 m)",
            "median at RT 0, m",
            (0.61, 0.85),
            lambda _: median("small", 0.0),
        ),
        decided(
            results,
            "anechoic, large",
            "median error 0.64 m (99 % interval within ±0.20 m)",
            "median at RT 0, m",
            (0.44, 0.84),
            lambda _: median("large", 0.0),
        ),
        stays_within("small", 0.8),
        stays_within("large", 0.2),
        decided(
            results,
            "large not beyond 0.2 s",
            "… and only to about 0.2 s",
            "least median at RT 0.4 s and above, m",
            (HALF_CELL_M, _INF),
            lambda r: over(r, lambda t: t >= 0.4, lambda t: median("large", t), np.min),
        ),
        *_small_against_large(results, median),
    ]


def _small_against_large(results: Results | None, median: Callable[[str, float], FloatArray]) -> list[Claim]:
    return [
        decided(
            results,
            "small beats large above 0.4 s",
            "above 0.4 s the small array is clearly better",
            "least difference large − small at RT above 0.4 s, m",
            (_MORE, _INF),
            lambda r: over(r, lambda t: t > 0.4, lambda t: median("large", t) - median("small", t), np.min),
        ),
        decided(
            results,
            "large beats small when dry",
            "the large array is better only at the shortest reverberation times",
            "difference small − large at RT 0, m",
            (_MORE, _INF),
            lambda _: median("small", 0.0) - median("large", 0.0),
        ),
    ]


def _methods(results: Results | None) -> list[Claim]:
    """Claims about the other methods of correlation."""

    def gain(system: str, method: str, rt60_s: float) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", rt60_s) - results.medians(system, method, rt60_s)

    return [
        *_cepstral(results, "small", 0.6, gain),
        *_cepstral(results, "large", 0.4, gain),
        decided(
            results,
            "averaging hurts above 0.6 s",
            "averaging GCCs over 25 ms frames degrades the small array significantly above 0.6 s",
            "mean difference averaged − srp-phat at RT above 0.6 s, small, m",
            (_MORE, _INF),
            lambda r: -over(r, lambda t: t > 0.6, lambda t: gain("small", "averaged", t), np.mean),
        ),
    ]


def _cepstral(
    results: Results | None, system: str, from_s: float, gain: Callable[[str, str, float], FloatArray]
) -> list[Claim]:
    return [
        decided(
            results,
            f"cepstral helps, {system}",
            f"cepstral prefiltering helps the {system} array above {from_s:g} s",
            f"mean gain at RT above {from_s:g} s, m",
            (_MORE, _INF),
            lambda r: over(r, lambda t: t > from_s, lambda t: gain(system, "cepstral", t), np.mean),
        ),
        decided(
            results,
            f"cepstral does not help before, {system}",
            f"… and not up to {from_s:g} s",
            f"mean gain at RT up to {from_s:g} s, m",
            (-_INF, 0.0),
            lambda r: over(r, lambda t: t <= from_s, lambda t: gain(system, "cepstral", t), np.mean),
        ),
        decided(
            results,
            f"cepstral by 0.1 m at most, {system}",
            "… by 0.1 m at most",
            "largest gain at any RT, m",
            (-_INF, 0.1),
            lambda r: over(r, lambda _: True, lambda t: gain(system, "cepstral", t), np.max),
        ),
    ]


def _diversity(results: Results | None) -> list[Claim]:
    def median(system: str, rt60_s: float) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", rt60_s)

    def always(first: str, second: str) -> Callable[[Results], FloatArray]:
        return lambda r: over(r, lambda _: True, lambda t: median(first, t) - median(second, t), np.min)

    def gain(rt60_s: float) -> FloatArray:
        return median("pair-0m", rt60_s) - median("pair-5m", rt60_s)

    return [
        decided(
            results,
            "eight joint beat two at 0 m",
            "8 microphones processed jointly are better than two arrays at 0 m",
            "least difference two at 0 m − joint over RT, m",
            (_MORE, _INF),
            always("pair-0m", "joint-8"),
        ),
        decided(
            results,
            "two at 0 m beat one",
            "two arrays at 0 m are better than one",
            "least difference one − two at 0 m over RT, m",
            (_MORE, _INF),
            always("small", "pair-0m"),
        ),
        decided(
            results,
            "5 m gain 0.4 m at least",
            "5 m between two arrays reduce the median by 0.4 to 0.5 m at every RT",
            "least gain 0 m − 5 m over RT, m",
            (0.35, _INF),
            lambda r: over(r, lambda _: True, gain, np.min),
            "0.4 m to one digit is 0.35 or more",
        ),
        decided(
            results,
            "5 m gain 0.5 m at most",
            "… by 0.4 to 0.5 m",
            "largest gain 0 m − 5 m over RT, m",
            (-_INF, 0.55),
            lambda r: over(r, lambda _: True, gain, np.max),
            "0.5 m to one digit is 0.55 or less",
        ),
    ]


def _office(results: Results | None) -> list[Claim]:
    def median(system: str) -> FloatArray:
        assert results is not None
        return results.medians(system, "srp-phat", results.rt60s_s[0])

    simulated = "our office is simulated; the paper's was real, and its recordings are not public"
    return [
        decided(
            results,
            "office, 3 m gain 0.44 m",
            "3 m between the arrays reduce the median by 0.44 m",
            "gain 0 m − 3 m, m",
            (0.34, 0.54),
            lambda _: median("pair-0m") - median("pair-3m"),
            f"both medians to ±0.05 m; {simulated}",
        ),
        decided(
            results,
            "office, splitting costs 0.1 m",
            "from 8 joint microphones to two arrays at 0 m the median worsens by about 0.1 m",
            "cost two at 0 m − joint, m",
            (0.0, 0.2),
            lambda _: median("pair-0m") - median("joint-8"),
            simulated,
        ),
        decided(
            results,
            "office, 1 m beats 0 m",
            "1 m is better than 0 m",
            "gain 0 m − 1 m, m",
            (_MORE, _INF),
            lambda _: median("pair-0m") - median("pair-1m"),
            simulated,
        ),
        decided(
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
    """Claims that follow from formulae alone."""
    kd = 2.0 * np.pi * 100.0 / C_M_S * 5.0
    beyond = np.linspace(kd, 200.0, 200_000)
    largest = float(np.abs(np.sinc(beyond / np.pi)).max())

    def exact(name: str, paper: str, measure: str, region: tuple[float, float], value: float, note: str = "") -> Claim:
        ours = Interval(value, value, value)
        return Claim(name, paper, measure, region, ours, judged(ours, region), note)

    return [
        exact("kd", "kd = 9.16 at 100 Hz and 5 m", "2 pi f d / c", (9.155, 9.165), kd),
        exact(
            "coherence",
            "|rho| <= 0.13 beyond",
            "largest |sin(kd)/kd| for kd of 9.16 and above",
            (0.0, 0.13),
            largest,
            "the bound holds; 0.128 is the lobe at kd 7.73, below 9.16",
        ),
    ]


def _widths(one: Results | None, diversity: Results | None) -> list[Claim]:
    """Claims about the width of the paper's intervals."""
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
            found.append(Claim(f"width, {name}", text, measure, region, None, Verdict.UNDECIDED, NOT_RUN))
            continue
        intervals = [
            Interval.of(results.medians(system, "srp-phat", rt60_s)) for system in systems for rt60_s in results.rt60s_s
        ]
        width = max((interval.high - interval.low) / 2.0 for interval in intervals)
        full = width * float(np.sqrt(results.positions / 1000.0))
        ours = Interval(width, full, full)
        verdict = Verdict.UNDECIDED
        note = (
            f"{results.positions} positions; the verdict is on {full:.2f} m, scaled to the paper's 1000; we resample "
            "positions, because the errors of their four events are nearly alike: treated as independent, the events "
            "would give half of it"
        )
        if results.positions >= LEAST_POSITIONS:
            verdict = judged(Interval(full, full, full), region)
        found.append(Claim(f"width, {name}", text, measure, region, ours, verdict, note))
    return found


def _crossing(results: Results | None, system: str) -> str:
    """Say at which reverberation time the median first exceeds the bound."""
    if results is None or not results.has(system):
        return ""
    for rt60_s in results.rt60s_s:
        if results.medians(system, "srp-phat", rt60_s)[0] >= HALF_CELL_M:
            return f"our median first exceeds it at RT {rt60_s:g} s"
    return "our median never exceeds it"
