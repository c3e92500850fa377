"""Faults of channels that no sound is needed for, from the samples to the findings of a running server."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import numpy as np
import pytest
from playwright.sync_api import expect

from browser import faultless_page, running_browser, visit
from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import Float32Array
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.app import Server
from small_site import HANG_S, RATE_HZ, hiss, running_server, site_of, wait_until

START_NS = 1_767_225_600_000_000_000
SECONDS = 14.0


def hum(samples: Float32Array, channel: int) -> None:
    t = np.arange(samples.shape[1]) / RATE_HZ
    samples[channel] += sum(0.002 / n * np.sin(2.0 * np.pi * 60.0 * n * t) for n in (1, 2, 3))


def constant(samples: Float32Array, channel: int) -> None:
    samples[channel] -= 0.03


def noise(samples: Float32Array, channel: int) -> None:
    samples[channel] *= 10.0 ** (14.0 / 20.0)


def clips(samples: Float32Array, channel: int) -> None:
    samples[channel, 8 * RATE_HZ : 8 * RATE_HZ + 400] = -1.0


def play(server: Server, north: Float32Array, south: Float32Array) -> None:
    """Replay the sound of two arrays to a server."""
    played = [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), samples), START_NS, (1, 2, 3, 4))
        for name, samples in (("north", north), ("south", south))
    ]
    endpoint = server.parts.receiver.endpoint
    send_session(site_of(), endpoint, played, UnpacedClock(START_NS), SystemClock(), "run", lambda: False)


@pytest.mark.parametrize(
    ("first", "second"), [(("hum", hum), ("dc", constant)), (("noisy", noise), ("clipping", clips))]
)
def test_faults_that_nodes_report_are_findings_of_the_server(
    first: tuple[str, Callable[[Float32Array, int], None]], second: tuple[str, Callable[[Float32Array, int], None]]
) -> None:
    """Each fault is in one channel of one array, and nothing else is found."""
    north, south = (hiss(SECONDS, seed=seed, level=3e-4) for seed in (1, 2))
    first[1](north, 2)
    second[1](south, 0)
    with running_server(site_of()) as server:
        play(server, north, south)

        def found() -> list[tuple[str, str, int, int]]:
            findings = httpx.get(f"{server.url}/api/v1/findings").json()["findings"]
            return sorted((one["fault"], one["array"], one["channel"], one["input"]) for one in findings)

        wait_until(lambda: len(found()) >= 2, "two findings")
        assert found() == sorted([(first[0], "north", 3, 3), (second[0], "south", 1, 5)])
        arrays = {array["name"]: array for array in httpx.get(f"{server.url}/api/v1/arrays").json()["arrays"]}
        assert [channel["faults"] for channel in arrays["north"]["channels"]] == [[], [], [first[0]], []]
        assert [channel["faults"] for channel in arrays["south"]["channels"]] == [[second[0]], [], [], []]
        metrics = httpx.get(f"{server.url}/metrics").text
        assert 'livessl_findings{severity="warning"} 2.0' in metrics


@pytest.mark.browser
def test_page_meters_each_channel_and_marks_the_faulty_one() -> None:
    north, south = (hiss(SECONDS, seed=seed, level=3e-4) for seed in (1, 2))
    hum(north, 2)
    with running_server(site_of()) as server, running_browser() as browser, faultless_page(browser) as page:
        play(server, north, south)
        visit(page, server.url)
        card = page.get_by_test_id("array-north")
        expect(card).to_contain_text("channel 3: hums", timeout=1000 * HANG_S)
        meters = [page.get_by_test_id(f"channel-north-{number}") for number in (1, 2, 3, 4)]
        reported = httpx.get(f"{server.url}/api/v1/arrays").json()["arrays"][0]["channels"]
        for number, (meter, channel) in enumerate(zip(meters, reported, strict=True), 1):
            if number == 3:
                expect(meter).to_have_class("channel faulty")
            else:
                expect(meter).to_have_class("channel")
            title = str(meter.get_attribute("title"))
            assert title.startswith(f"channel {number}: ")
            assert f"peak \u2212{-channel['peak_dbfs']:.1f} dBFS" in title
            assert f"noise floor \u2212{-channel['noise_dbfs']:.1f} dBFS" in title
            assert ("hum at 60 Hz" in title) == ("faults: hum" in title) == (number == 3)
            bottom_percent = float(meter.locator(".peak").evaluate("line => line.style.bottom").removesuffix("%"))
            assert bottom_percent == pytest.approx(100 * (1 + channel["peak_dbfs"] / 96.0), abs=0.2)
