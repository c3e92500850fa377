"""Real processes over TCP: a node whose clock is off, and sounds that its array hears too faintly to send them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import urllib.request
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import soundfile
from processes import NODES, TAIL_S, Playing, wait_for

from livessl.simulation.scene import Scene, make_scene, render
from small_site import HANG_S, RATE_HZ, hiss, site_of

pytestmark = pytest.mark.processes

LOUD, FAINT = 4, 2
AHEAD_S = 0.137
WEAKER_DB = 39.0
NEAR_M = 0.5
SAME_M = 0.001

ATTEMPTS = 3
"""Runs of which one has to bring every frame in time for its final result: a busy machine may keep some back."""


def scene() -> Scene:
    """Bursts of noise; the last ones are faint at the south array."""
    site = site_of()
    made = make_scene(
        site.room.size_m,
        rt60_s=0.0,
        sounds=[(f"burst-{k}", hiss(0.3 + 0.1 * k, 1, seed=k)[0]) for k in range(3)],
        count=LOUD + FAINT,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=11,
        lead_s=2.0,
        gap_s=1.5,
    )
    return replace(made, noise_dbfs=-55.0, duration_s=made.duration_s + TAIL_S)


def record(directory: Path, made: Scene) -> None:
    share = 10.0 ** (-WEAKER_DB / 20.0)
    faint = [replace(source, sound=source.sound * share) for source in made.sources[LOUD:]]
    scenes = {"north": made, "south": replace(made, sources=(*made.sources[:LOUD], *faint))}
    for array, of_array in scenes.items():
        samples = render(of_array, site_of().array(array).microphones_m, seed=len(array))
        soundfile.write(directory / f"{array}.wav", samples.T, RATE_HZ, subtype="FLOAT")


def metrics(url: str) -> str:
    with urllib.request.urlopen(url, timeout=HANG_S) as answer:
        return str(answer.read().decode())


def offline(site: Path, recordings: Path) -> list[dict[str, Any]]:
    wavs = [part for array in NODES.values() for part in ("--wav", f"{array}={recordings / array}.wav")]
    command = [sys.executable, "-m", "livessl", "locate", "--site", str(site), *wavs, "--json"]
    said = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    return [json.loads(line) for line in said.splitlines()]


def offset_is_known(site: Playing) -> bool:
    """Return whether the site knows how far the clock of the southern array is off.

    Its reason says so, too, unless the machine is busy: that frames come late is the nearer reason then.
    """
    arrays = site.get("arrays")
    offset = None if arrays is None else arrays["arrays"][1]["clock_offset"]
    return offset is not None and abs(offset["offset_s"] - AHEAD_S) < 0.005


@dataclass(frozen=True)
class Run:
    """What a live site answered at the end: its site file, events, both arrays, and metrics."""

    site: Path
    events: list[dict[str, Any]]
    arrays: list[dict[str, Any]]
    told: str

    @property
    def is_in_time(self) -> bool:
        """True if no frame came too late for its final result."""
        return not any(array["counters"]["too_late"] for array in self.arrays)


def run_live(recordings: Path, directory: Path, made: Scene) -> Run:
    changes = {"arrays.south.wav_offset_s": AHEAD_S}
    with Playing(recordings, directory, changes=changes) as site:
        site.start()
        wait_for(lambda: offset_is_known(site), "the offset", 90)
        site.sleep_until(made.duration_s - TAIL_S)
        wait_for(lambda: len(site.events()) >= len(made.sources), "the last event", 60)
        wait_for(lambda: not site.awaits_final_results(), "the final results", 60)
        told = metrics(f"http://127.0.0.1:{site.http}/metrics")
        return Run(site.site, site.events(), site.get("arrays")["arrays"], told)


def test_a_clock_that_is_off_and_sounds_that_one_array_hears(tmp_path: Path) -> None:
    made = scene()
    record(tmp_path, made)
    runs = (run_live(tmp_path, tmp_path / f"live-{attempt}", made) for attempt in range(ATTEMPTS))
    run = next((run for run in runs if run.is_in_time), None)
    assert run is not None, "frames came too late in every run"
    events, told, (north, south) = run.events, run.told, run.arrays
    expected = offline(run.site, tmp_path)
    assert len(events) == len(expected) == len(made.sources)
    for k, (event, other, source) in enumerate(zip(events, expected, made.sources, strict=True)):
        assert event["status"] == "located"
        assert event["arrays"] == ["north", "south"]
        assert math.dist(event["position_m"], source.position_m) < NEAR_M
        assert [contribution["asked"] for contribution in event["contributions"]] == [False, k >= LOUD]
        assert event["heard_by"] == (["north"] if k >= LOUD else ["north", "south"])
        # live and offline the same sound is cut into frames at other samples
        assert math.dist(event["position_m"], other["position_m"]) < SAME_M
        assert event["confidence"] == pytest.approx(other["confidence"], abs=0.001)
        assert event["at_s"] == pytest.approx(other["start_s"], abs=1e-6)
    assert south["state"] == "degraded"
    assert south["clock_offset"]["offset_s"] == pytest.approx(AHEAD_S, abs=0.005)
    assert south["clock_offset"]["corrected_s"] == 0.15
    assert (south["counters"]["asked"], south["counters"]["helped"]) == (FAINT, FAINT)
    assert north["state"] == "healthy"
    assert 'livessl_array_clock_offset_seconds{array="south",reference="a"} 0.1' in told
    assert 'livessl_array_total{array="south",what="helped"} 2.0' in told
