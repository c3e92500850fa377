"""What an array's death costs the others: how soon it shows, and how late events are told then and afterwards."""

from __future__ import annotations

import shutil
import signal
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import soundfile
from processes import WEST, Hearer, Playing, duration_s, make_recordings, wait_for

from small_site import RATE_HZ

DIES_S = 4.0
"""Of the recording, in its quiet beginning; sounds from here on count."""

CUT_S = 3.0
"""Where the cable is cut again and again: so long, and as long not."""

NODES = {"a": "north", "b": "south", "c": "west"}


@dataclass(frozen=True)
class Death:
    """How late events of all sounds after a death were told, from the sound's end on, and how soon the death showed."""

    fault: str
    delays_s: list[float]
    shown_s: float | None

    @property
    def p50_s(self) -> float:
        """Median."""
        return statistics.median(self.delays_s)

    @property
    def p95_s(self) -> float:
        """95 % are told sooner."""
        return statistics.quantiles(self.delays_s, n=20)[-1]


def nothing(site: Playing, end_s: float) -> float | None:
    """The array lives."""
    return None


def process_stopped(site: Playing, end_s: float) -> float | None:
    """With SIGSTOP: its connection is there, and nothing comes."""
    site.processes["c"].send_signal(signal.SIGSTOP)
    return shown_after_s(site)


def cable_cut(site: Playing, end_s: float) -> float | None:
    """Nothing passes any more, and nobody is told."""
    site.proxies["c"].weather.cut = True
    return shown_after_s(site)


def all_zero(site: Playing, end_s: float) -> float | None:
    """Its microphones fall silent: that is in its recording."""
    return shown_after_s(site)


def cable_loose(site: Playing, end_s: float) -> float | None:
    """Cut and joined again, every few seconds: many deaths, some of them amid sounds."""
    while site.now_s() < end_s:
        site.proxies["c"].weather.cut ^= True
        time.sleep(CUT_S)
    return None


DEATHS: dict[str, Callable[[Playing, float], float | None]] = {
    "undisturbed": nothing,
    "process stopped": process_stopped,
    "cable cut": cable_cut,
    "all-zero samples": all_zero,
    "cable loose": cable_loose,
}


def shown_after_s(site: Playing) -> float:
    """How long it takes until the API says that the third array is not well."""
    began_s = time.monotonic()

    def shown() -> bool:
        answer = site.get("arrays")
        states = {array["name"]: array["state"] for array in answer["arrays"]} if answer else {}
        return states.get("west") in ("lost", "degraded")

    wait_for(shown, "the death to show", 5.0)
    return time.monotonic() - began_s


def make_death_recordings(directory: Path, count: int) -> None:
    """For three arrays, and, in `silent`, with one whose microphones die."""
    silent = directory / "silent"
    silent.mkdir(parents=True)
    make_recordings(directory, count, gap_s=1.5, changes=WEST, lead_s=DIES_S + 1.0)
    for array in NODES.values():
        shutil.copy(directory / f"{array}.wav", silent)
    samples, _ = soundfile.read(silent / "west.wav", always_2d=True)
    samples[round(DIES_S * RATE_HZ) :] = 0.0
    soundfile.write(silent / "west.wav", samples, RATE_HZ, subtype="PCM_16")


def play_death(recordings: Path, directory: Path, fault: str) -> Death:
    """Play to three arrays, let one die, and listen to what subscribers are told."""
    end_s = duration_s(recordings)
    shutil.rmtree(directory, ignore_errors=True)
    played = recordings / "silent" if fault == "all-zero samples" else recordings
    with Playing(played, directory, nodes=NODES, changes=WEST) as site:
        site.start()
        with Hearer(site.http) as hearer:
            site.sleep_until(DIES_S)
            shown_s = DEATHS[fault](site, end_s)
            site.sleep_until(end_s + 1.0)
    return Death(fault, sorted(hearer.delays_s.values()), shown_s)
