"""The server examines its set-up with the sounds that it locates."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from cli.command_runs import Run
from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.types import Float32Array
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.schema.findings import Findings
from livessl.server.app import Server
from small_site import RATE_HZ, heard, running_server, site_of, wait_until

SOUNDS = 8


def replayed(server: Server, south: Float32Array, run: str) -> None:
    """Replay a scene with this recording of the array `south`."""
    samples = {"north": heard("north", SOUNDS), "south": south}
    recordings = [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), one), 0, (1, 2, 3, 4))
        for name, one in samples.items()
    ]
    send_session(site_of(), server.endpoint, recordings, UnpacedClock(), SystemClock(), run, lambda: False)
    server.wait_idle()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


def test_a_fault_makes_its_array_degraded_and_ends_when_it_is_mended(
    server: Server, caplog: pytest.LogCaptureFixture, run: Run
) -> None:
    with caplog.at_level(logging.WARNING):
        replayed(server, heard("south", SOUNDS)[[0, 2, 1, 3]], "swapped")
        wait_until(lambda: server.parts.set_up_watch.state.sounds == SOUNDS, "all sounds")
    answer = httpx.get(f"{server.url}/api/v1/findings").json()
    (finding,) = answer["findings"]
    assert (answer["sounds"], answer["blind_spots"]) == (SOUNDS, [])
    assert (finding["fault"], finding["array"], finding["severity"]) == ("swapped", "south", "error")
    assert "channels 2 and 3 of 'south' are swapped" in caplog.text
    states = {array["name"]: array for array in httpx.get(f"{server.url}/api/v1/arrays").json()["arrays"]}
    assert states["south"]["state"] == "degraded"
    assert states["south"]["reason"].startswith("channels 2 and 3 of 'south' are swapped: misfit ")
    metrics = httpx.get(f"{server.url}/metrics").text
    assert 'livessl_findings{severity="error"} 1.0' in metrics

    done = run("doctor", "--url", server.url, "--json")
    assert (done.code, [json.loads(line) for line in done.out.splitlines()]) == (1, [finding])

    replayed(server, heard("south", SOUNDS), "mended")
    wait_until(lambda: httpx.get(f"{server.url}/api/v1/findings").json()["sounds"] == SOUNDS, "all sounds")
    mended = httpx.get(f"{server.url}/api/v1/findings").json()
    Findings.model_validate_json(json.dumps(mended), strict=True)
    assert mended["findings"] == []
    assert mended["least_sounds"] == LEAST_SOUNDS
    assert mended["blind_spots"]  # two arrays hide a shift along the line between them
    done = run("doctor", "--url", server.url)
    assert done.out == f"no fault found in {SOUNDS} sounds\n"
    told = [line.removeprefix("livessl: note: ") for line in done.err.splitlines()]
    assert told == [f"{spot['message']}; {spot['cure']}" for spot in mended["blind_spots"]]


def test_an_inverted_channel_is_named_with_the_input_of_the_interface(server: Server) -> None:
    samples = heard("south", SOUNDS) * np.array([[1.0], [1.0], [1.0], [-1.0]], dtype=np.float32)
    replayed(server, samples, "inverted")
    wait_until(lambda: server.parts.set_up_watch.state.sounds == SOUNDS, "all sounds")
    (finding,) = httpx.get(f"{server.url}/api/v1/findings").json()["findings"]
    assert (finding["fault"], finding["array"], finding["channel"], finding["input"]) == ("inverted", "south", 4, 8)


def test_a_server_that_cannot_be_asked_is_told_in_one_line(run: Run) -> None:
    done = run("doctor", "--url", "http://127.0.0.1:9")
    assert done.code == 1
    assert "no answer from a server" in done.err
    assert done.err.count("\n") == 1
    assert run("doctor", "--url", "ftp://here").code == 2
