"""The benchmarks in short: the map against this machine's own look-ups, the peers against the formula, and the text."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
import pytest

import exactness
import hall
import help_time
import peer_maps
import peers
import performance_page
import speech
import startup
from growth import Fit
from livessl.clock import SystemClock
from livessl.core.geometry import Grid
from livessl.core.kernels import kernels as kernels_in_use
from livessl.core.kernels import with_numba, with_numpy
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.refine import FindPeaks
from livessl.core.types import Evidence
from livessl.lab.bench import kernels

Json = dict[str, Any]

GRID: Final = Grid(((0.0, 8.0), (0.0, 10.0), (0.0, 4.0)), 1.0)


@pytest.fixture(scope="module")
def sounds() -> peer_maps.Sounds:
    return kernels.Blocks(kernels.array_specs(2), sources=1).sound("voice", 0)


def test_kernels_are_timed_beside_bare_look_ups() -> None:
    """The ratio itself is in docs/performance.md: a timed test would fail on a busy machine."""
    report = kernels.measure(SystemClock(), rounds=2, arrays=(2,), spacings_m=())
    (ratio,) = (timing.least_ratio for timing in report.timings if timing.least_ratio is not None)
    assert 0.1 < ratio < 100.0
    assert report.kernels in ("numba", "NumPy")


@pytest.mark.parametrize("in_hall", [True, False])
def test_a_hub_shows_each_sound_of_the_benchmarks_hall_once(in_hall: bool) -> None:
    """The function itself checks how many events are shown."""
    assert hall.milliseconds_an_event(40, in_hall=in_hall) > 0.0
    places_m = list(hall.placed(20, np.random.default_rng(0)))
    assert sum(at_border for at_border, _ in places_m) == 10
    assert all(abs(place_m[0] - hall.BORDER_M) <= hall.NEAR_M for at_border, place_m in places_m if at_border)


@pytest.mark.parametrize("name", peer_maps.PEERS)
def test_peer_maps_what_the_formula_does(name: str, sounds: peer_maps.Sounds) -> None:
    if name in ("acoular", "pyroomacoustics"):
        pytest.importorskip(name)
    specs, points_m = kernels.array_specs(2), GRID.points_m()
    truth = peer_maps.reference(specs, points_m)(sounds)
    power = peer_maps.PEERS[name](specs, points_m)(sounds)
    assert np.corrcoef(power, truth)[0, 1] > 0.99
    assert power.argmax() == truth.argmax()


@pytest.mark.parametrize("form", [with_numba, with_numpy])
def test_ours_maps_what_the_formula_does(form: ModuleType, sounds: peer_maps.Sounds) -> None:
    """Nearest of eight lags a sample: an error of 1/28 sample RMS, 0.03 rad at 6 kHz; 1e-3 of the power."""
    specs = kernels.array_specs(2)
    truth = peer_maps.reference(specs, GRID.points_m())(sounds)
    ours = peers.Ours(specs, GRID, form)
    power = ours.power(sounds)
    assert np.corrcoef(power, truth)[0, 1] > 0.999
    assert ours.peak(sounds) == power.argmax() == truth.argmax()
    assert kernels_in_use.in_use is with_numba  # the form was used for that alone


def test_fused_maps_are_what_the_search_is_held_against() -> None:
    cases = exactness.compare(spacings_m=(0.5,), counts=(2, 3), sounds=1)
    assert len(cases) == 2 * len(kernels.KINDS)
    assert all(case["same"] == case["maps"] == 1 for case in cases)


def test_a_search_that_is_wrong_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    among = PeakSearch.among

    def wrong(self: PeakSearch, evidence: Sequence[Evidence]) -> FindPeaks:
        find = among(self, evidence)
        return lambda count, *rest: [replace(peak, point=peak.point + 1) for peak in find(count, *rest)]

    monkeypatch.setattr(PeakSearch, "among", wrong)
    cases = exactness.compare(spacings_m=(0.5,), counts=(2,), sounds=1)
    assert sum(case["same"] for case in cases) == 0


def test_fits_recover_what_they_are_given() -> None:
    x = [1.0, 2.0, 5.0, 20.0]
    power = Fit.power(x, [3.0 * one**1.7 for one in x])
    assert (power.factor, power.exponent) == pytest.approx((3.0, 1.7))
    line = Fit.line(x, [4.0 + 0.25 * one for one in x])
    assert (line.offset, line.factor) == pytest.approx((4.0, 0.25))
    assert line(8.0) == pytest.approx(6.0)
    assert line.worst < 1e-9
    assert Fit.line([1.0, 2.0, 3.0], [1.0, 2.0, 4.0]).worst > 0.05


MACHINE: Final = {
    "cpu": "A processor", "cores": 2, "memory_gb": 16.0, "system": "Linux x86_64", "python": "3.11.7",
    "packages": {"numpy": "2.0"}, "load_before": 0.1,
}  # fmt: skip
WHATS: Final = ("GCC", "peak", "map")
TIMES: Final = {"median_ms": 2.0, "p95_ms": 3.0, "least_ms": 1.0}


def live(arrays: int, clients: int, spin: bool) -> Json:
    """A service that takes 10 % of a core and 0.5 % an array and 0.1 % a client; 100 MB and 2 MB an array."""
    return {
        "machine": MACHINE,
        "demand": {"arrays": arrays, "clients": clients, "spin": spin},
        "frames_dropped": 0,
        "lost": {"late": 0},
        "updates": 84.0,
        "updates_due": 84,
        "latency_ms": {"p50": 5.0, "p95": 20.0, "p99": 30.0},
        "cpu_percent": 10.0 + 0.5 * arrays + 0.1 * clients,
        "rss_mb": [90.0, 95.0, 100.0 + 2.0 * arrays],
        "nothing_dropped": True,
    }


def measured() -> dict[str, Json]:
    """What the benchmarks write, by file."""
    codes = ["livessl, map, compiled", "livessl, search, compiled", *peer_maps.PEERS]
    side_by_side = [
        {"name": name, "spacing_m": spacing_m, "nodes": 2000, "timed_nodes": 2000, "ratio": 1234.5, "median_ms": 2.0}
        | {"correlation": None, "same_peaks": None}
        for name in codes
        for spacing_m in (peers.COARSE_M, peers.FINE_M)
    ]
    searches = [
        {"spacing_m": m, "arrays": n, "length": length, "kind": kind, **TIMES}
        for m in peers.SPACINGS_M
        for n in peers.COUNTS
        for length in ("block", "1 s")
        for kind in kernels.KINDS
    ]
    case = {"spacing_m": 0.05, "arrays": 8, "kind": "noise", "maps": 6, "same": 6}
    timing = {
        "name": "map, 2 arrays, 0.1 m",
        "ratio": 1.9,
        "median_ms": 2.0,
        "p99_ms": 3.0,
        "again_median_ms": 1.5,
        "again_p99_ms": 2.5,
    }
    return {
        "kernels": {
            "machine": MACHINE, "kernels": "numba", "rounds": 9, "lookup_ns": 0.3, "timings": [timing]
        },
        "peers": {
            "machine": MACHINE, "rounds": 9, "search_rounds": 9, "checked": 3, "frame_bytes": 35_347,
            "steering_bytes_a_node": 50_000, "side_by_side": side_by_side, "searches": searches,
            "microphones": [{"microphones": n, "what": what, **TIMES} for n in (2, 4) for what in WHATS],
            "maps": [{"nodes": nodes, **TIMES} for nodes in (1000, 2000)],
            "forms": [{"kernels": "numba", "ratio": 1.8}, {"kernels": "NumPy", "ratio": 4.4}],
        },
        "exactness": {
            "machine": MACHINE, "maps": 540, "same": 540, "most_arrays": 8,
            "cases": [case],
        },
        "startup": {
            "machine": MACHINE, "took_s": [1.2, 1.0, 1.3], "processor_s": [0.9, 0.8, 1.1],
            "answered_s": [1.4, 1.1, 1.3],
        },
    }  # fmt: skip


def write(folder: Path, files: dict[str, Json]) -> Path:
    for name, report in files.items():
        (folder / f"{name}.json").write_text(json.dumps(report))
    return folder


def test_text_is_made_of_the_files(tmp_path: Path) -> None:
    runs = {performance_page.live_name(*demand): live(*demand) for demand in performance_page.LIVE}
    text = performance_page.document(write(tmp_path, measured() | runs))
    assert "540 of 540 maps" in text
    assert "takes 1.8 times as long as only reading its values" in text
    assert "(4.4 times without numba)" in text
    assert "| the service's processor | arrays = 4, 8, 16, 32, 64 | 12.0 + 0.500 arrays % of a core | 0% |" in text
    # 16 servers of 64 arrays: (16 x 12 % + 1000 x 0.5 %) / 60 %, (16 x 100 MB + 1000 x 2 MB) / 60 %
    assert "| 1000 | 500 | 16 | 12 | 6.00 GB |" in text
    assert "listens 1.20 s after it was called (median of 3, 1.00 to 1.30 s; 0.900 s of processor)" in text
    assert "is answered after 1.30 s" in text


def test_a_start_is_timed_until_it_listens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["startup.py", "--out", str(tmp_path), "--starts", "1"])
    assert startup.main() == 0
    report = json.loads((tmp_path / "startup.json").read_text())
    assert report["processor_s"][0] > 0.1
    assert 0.1 < report["took_s"][0] < report["answered_s"][0] < 60.0


def test_a_start_that_fails_tells_what_was_said(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="No such file"):
        startup.start(tmp_path / "nothing.yaml", SystemClock())


def test_help_is_timed() -> None:
    took = help_time.measure(["check"], 1)
    assert 0.0 < took["shortest_s"] <= took["median_s"]
    assert 0.0 < took["processor_s"] < 60.0


def test_text_without_the_service_says_so(tmp_path: Path) -> None:
    assert "Not measured here." in performance_page.document(write(tmp_path, measured()))


def test_text_wants_all_of_the_service_or_nothing(tmp_path: Path) -> None:
    folder = write(tmp_path, measured() | {"live-4-1": live(4, 1, False)})
    with pytest.raises(ValueError, match=r"live-4-20.json, .*live-64-20-spin.json lacking"):
        performance_page.document(folder)


def test_files_of_two_machines_make_no_text(tmp_path: Path) -> None:
    files = measured()
    files["exactness"] = {**files["exactness"], "machine": {**MACHINE, "cpu": "Another"}}
    with pytest.raises(ValueError, match="of one machine"):
        performance_page.document(write(tmp_path, files))


def test_rates_of_dropped_clips_are_summed_by_whether_somebody_speaks() -> None:
    rows = [
        speech.Row("speech 20 dB below a door", "30 dB", 20, 19),
        speech.Row("a talker, take", "as recorded", 1, 1),
        speech.Row("doorslam", "30 dB", 10, 2),
    ]
    page = speech.report(rows, 40, 2, 33.4)
    assert "| speech 20 dB below a door | 30 dB | 20 | 19 (95 %) |" in page
    assert "Of all 21 clips with speech, 20 (95.2 %) are dropped." in page
    assert "Of all 10 clips without speech, 2 (20.0 %) are dropped." in page
    assert "took 33 ms of processor time" in page
