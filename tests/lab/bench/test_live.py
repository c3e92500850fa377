"""The load has its stated form, and a tiny run through real processes and sockets gives a complete report."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from livessl.cli.main import main
from livessl.clock import SystemClock
from livessl.core.stream.fusion import Fusion
from livessl.core.types import FRAME_NS, Event, Update
from livessl.lab.bench import kernels, live, load
from livessl.lab.bench.live import Demand, Outcome
from livessl.lab.processes import NotStartedError
from livessl.site.build.fusion import make_fusion
from livessl.site.load import parse_site

DEMAND = Demand(arrays=2, clients=2, seconds=10.0, spacing_m=0.2, rt60_s=0.0)
GOOD = Outcome(
    demand=DEMAND,
    cores=2,
    frames_sent=400,
    frames_dropped=0,
    frames_received=400,
    lost={"late": 0, "missed": 0},
    updates_due=84,
    updates=84.0,
    events=4.0,
    latency_ms={"p50": 5.0, "p95": 20.0, "p99": 30.0, "max": 40.0},
    stages_ms={"sent": {"p50": 1.0, "p95": 2.0, "p99": 3.0, "max": 4.0}},
    pictures=0,
    cpu_percent=12.0,
    rss_mb=(100.0, 101.0, 102.0),
    shed={"updates": 0, "frames": 0, "level": 0},
)


@pytest.mark.parametrize("arrays", [1, 4, 64])
def test_generated_site_is_valid_and_every_array_is_apart(arrays: int) -> None:
    site = parse_site(load.site_text(arrays, 0.5, "tcp://127.0.0.1:5570", 8000))
    centres = np.array([spec.centre_m for spec in site.specs])
    assert len(centres) == arrays
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + 10 * np.eye(arrays)
    assert apart.min() > load.EDGE_M


def test_updates_due_are_the_updates_of_the_fusion() -> None:
    """The load's frames give an update for each window that is due and an event for each sound, without a server."""
    site = parse_site(load.site_text(2, 0.2, "tcp://127.0.0.1:5570", 8000))
    scene = load._scene(site, rt60_s=0.0)
    sounds = [load._Sound(spec, scene, seed) for seed, spec in enumerate(site.specs)]
    first = 34_000_000_000 // load.PERIOD_FRAMES * load.PERIOD_FRAMES
    fusion: Fusion = make_fusion(site)
    outputs = []
    with threadpool_limits(limits=1):
        for frame_index in range(first, first + 2 * load.PERIOD_FRAMES):
            frames = [sound.frame(frame_index, frame_index - first + 1) for sound in sounds]
            assert min(frame.power for frame in frames) > 0
            outputs += fusion.step(frames, (frame_index + 1) * FRAME_NS)
    updates = [output.complete_ns for output in outputs if isinstance(output, Update)]
    assert updates == load.windows_ns(site, first * FRAME_NS, (first + 2 * load.PERIOD_FRAMES) * FRAME_NS)
    assert len(updates) == 2 * load.SOUND_FRAMES // 2
    events = [output for output in outputs if isinstance(output, Event) and output.estimate]
    assert len(events) == load.PLACES
    for event in events:
        source = scene.sources[(event.end_ns - 1) // FRAME_NS // load.PERIOD_FRAMES % load.PLACES]
        assert event.estimate is not None
        assert math.dist(event.estimate.position_m, source.position_m) < 0.05  # refined below the grid


def test_a_run_with_losses_is_no_success() -> None:
    assert GOOD.nothing_dropped
    for fault in ({"frames_dropped": 1}, {"lost": {"late": 1}}, {"updates": 83.5}):
        assert not replace(GOOD, **fault).nothing_dropped


def test_table_shows_losses() -> None:
    shown = live.table(GOOD)
    assert "84.0 of 84 per client" in shown
    assert "nothing was dropped" in shown
    bad = live.table(replace(GOOD, lost={"late": 7}))
    assert "7 late" in bad
    assert "more than the machine can carry" in bad


@pytest.mark.processes
def test_a_tiny_run_reports_every_number(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "--live", "--arrays", "2", "--clients", "2", "--watchers", "1", "--seconds", "3"]
    assert main([*arguments, "--spacing", "0.2", "--rt60", "0", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["demand"] == {
        "arrays": 2,
        "clients": 2,
        "seconds": 3.0,
        "watchers": 1,
        "spacing_m": 0.2,
        "rt60_s": 0.0,
        "spin": False,
    }
    # frames that were on their way before the server's first answer may be sent twice or not be counted
    assert shown["frames_sent"] - 8 <= shown["frames_received"] <= shown["frames_sent"]
    assert shown["frames_sent"] > 100
    assert shown["frames_dropped"] == 0
    assert shown["updates_due"] >= 20
    assert shown["updates"] > 0
    assert shown["events"] >= 1
    assert shown["pictures"] >= 1  # an overloaded server draws no more
    assert 0 < shown["latency_ms"]["p50"] <= shown["latency_ms"]["p95"] <= shown["latency_ms"]["max"]
    assert set(shown["stages_ms"]) == {"load", "sent", "received", "located", "delivered"}
    assert shown["cpu_percent"] > 0
    assert min(shown["rss_mb"]) > 10


def test_a_server_that_does_not_start_is_an_error() -> None:
    with pytest.raises(NotStartedError, match="did not start"):
        live.measure(DEMAND, SystemClock(), start=lambda _: subprocess.Popen([sys.executable, "-c", ""]))


def test_bench_without_live_measures_the_kernels(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    report = kernels.KernelReport(
        "compiled", 0.25, (kernels.Timing("map, 2 arrays", 1.5, 2.5, 1.4, 1.2, 2.1, ratio=1.9),)
    )
    monkeypatch.setattr(kernels, "measure", lambda clock, progress: report)
    assert main(["bench"]) == 0
    shown = capsys.readouterr().out
    assert "a bare look-up takes 0.25 ns" in shown
    row = ["map,", "2", "arrays", "1.500", "2.500", "1.200", "2.100", "1.90"]
    assert row in [line.split() for line in shown.splitlines()]
    assert main(["bench", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["timings"][0]["ratio"] == 1.9
