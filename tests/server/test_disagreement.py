"""Through sockets and server: an array turned against its site file is named, and two sources are two events."""

from __future__ import annotations

from dataclasses import replace

import httpx
import numpy as np

from livessl.capture.node import capture_recordings
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.app import Server
from livessl.simulation.scene import Scene, Source, render
from livessl.site.models import Site
from small_site import RATE_HZ, hiss, running_server, scene, site_of, wait_until

CLOCK = SystemClock()
EAST = {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [3.3, 2.4, 2.1]}
CHANNELS = {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8], "east": [9, 10, 11, 12]}
THREE = {"arrays.east": EAST, "nodes.lab-pc.arrays": CHANNELS}


def play(server: Server, true_site: Site, sounding: Scene) -> None:
    """Send a scene live, as received by arrays in the places of one site, to a server whose site may differ."""
    start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS
    parts = []
    for seed, spec in enumerate(true_site.specs):
        samples = render(sounding, spec.microphones_m, seed=seed)
        parts.append(
            AssignedRecording(spec.name, MemoryRecording(spec.name, float(RATE_HZ), samples), start_ns, (1, 2, 3, 4))
        )
    node = site_of({**THREE, "nodes.lab-pc.server": server.endpoint})
    capture_recordings(node, "lab-pc", parts, CLOCK, "run-1", lambda: False)


def test_turned_array_is_named_by_events_state_and_metrics() -> None:
    wrong = {**EAST, "orientation_deg": {"yaw": 40}}
    with running_server(site_of({**THREE, "arrays.east": wrong})) as server:
        play(server, site_of(THREE), scene(3))
        wait_until(lambda: server.parts.event_log.published == 3, "the events")
        events = httpx.get(f"{server.url}/api/v1/events").json()["events"]
        metrics = httpx.get(f"{server.url}/metrics").text
    for event, source in zip(reversed(events), scene(3).sources, strict=True):
        assert event["status"] == "located"
        assert event["arrays"] == ["north", "south"]
        assert "located without the outlier 'east'" in event["reason"]
        # dry, 0.3 m wide, and noise 66 dB below: the two good arrays are right to a few centimetres
        assert np.linalg.norm(np.array(event["position_m"]) - source.position_m) < 0.1
        told = {each["array"]: (each["agrees"], each["off_deg"]) for each in event["contributions"]}
        assert told["north"] == told["south"] == (True, None)
        assert told["east"][0] is False
        assert 15 < told["east"][1] < 45
    assert 'livessl_array_sounds{array="east",verdict="disagreed"} 3.0' in metrics
    assert 'livessl_array_sounds{array="north",verdict="agreed"} 3.0' in metrics
    (east,) = (array for array in server.parts.array_states.describe() if array["name"] == "east")
    assert east["agreement"] == {"agreed": 0, "disagreed": 3}


def test_two_sources_at_once_are_two_events_and_stay_two() -> None:
    """The second begins while the first goes on: two equal noises that begin and end together are not told apart."""
    places_m = [np.array([0.7, 3.1, 1.1]), np.array([3.2, 1.9, 1.9])]
    sources = tuple(
        Source(f"hiss {seed}", 1.0 + 0.15 * seed, place_m, hiss(0.4, 1, seed=seed)[0])
        for seed, place_m in enumerate(places_m)
    )
    sounding = replace(scene(), sources=sources, duration_s=2.5)
    with running_server(site_of(THREE)) as server:
        play(server, site_of(THREE), sounding)
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        second, first = sorted(httpx.get(f"{server.url}/api/v1/events").json()["events"], key=lambda e: -e["source"])
    assert second["id"] == f"{first['id']}-2"
    assert (first["source"], second["source"]) == (1, 2)
    assert first["replaces"] == second["replaces"] == []
    found = [np.array(event["position_m"]) for event in (first, second)]
    apart = [[float(np.linalg.norm(found[i] - places_m[k])) for k in (0, 1)] for i in (0, 1)]
    assert min(max(apart[0][0], apart[1][1]), max(apart[0][1], apart[1][0])) < 0.5
