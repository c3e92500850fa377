"""The picture of an alert: it shows where the sound was, and needs nothing but the alert and the site."""

from __future__ import annotations

import asyncio
import io
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.image import imread

from alert_desk import after, alert_site, encoded, sound
from livessl.core.stream.final_pass import FinalResults
from livessl.server.alerts import evidence
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.picture import MARGIN_M, MAX_PX, picture_of
from livessl.server.alerts.rules import Match
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site
from small_site import running_server, site_of, wait_until

WHITE = np.array([1.0, 1.0, 1.0])


def alert_at(x_m: float, y_m: float, std_m: float = 0.05) -> JsonObject:
    event = encoded(sound(1, (x_m, y_m, 1.0), std_m=std_m))
    return AlertMessages(site_of(), "http://ears").of_event("door", event, Match({"door": 0.9}), 1, 0)


def pixels(alert: JsonObject, site: Site, size_px: int = 640) -> np.ndarray:
    picture = picture_of(alert, site, ZoneMap(site), size_px)
    assert picture is not None
    return np.asarray(imread(io.BytesIO(picture), format="png"))[..., :3]


def colour_at(image: np.ndarray, x_m: float, y_m: float, site: Site) -> np.ndarray:
    rows, columns, _ = image.shape
    width_m, depth_m = (side + 2 * MARGIN_M for side in site.room.size_m[:2])
    column, row = (x_m + MARGIN_M) / width_m * columns, (1 - (y_m + MARGIN_M) / depth_m) * rows
    return np.asarray(image[min(int(row), rows - 1), min(int(column), columns - 1)])


@settings(max_examples=15)
@given(x_m=st.floats(0.3, 3.7), y_m=st.floats(0.3, 4.7), std_m=st.floats(0.02, 0.3), size_px=st.integers(200, 700))
def test_cross_is_where_the_sound_was_and_it_is_brighter_there(
    x_m: float, y_m: float, std_m: float, size_px: int
) -> None:
    site = site_of()
    image = pixels(alert_at(x_m, y_m, std_m), site, size_px)
    assert max(image.shape) == size_px
    assert colour_at(image, x_m, y_m, site) == pytest.approx(WHITE)
    rows, columns, _ = image.shape
    bright = np.argwhere(image.sum(axis=2) > 2.9)  # the cross and the ellipse lie around it
    middle = (bright.min(axis=0) + bright.max(axis=0)) / 2.0
    y_found = (1 - (middle[0] + 0.5) / rows) * (site.room.size_m[1] + 2 * MARGIN_M) - MARGIN_M
    x_found = (middle[1] + 0.5) / columns * (site.room.size_m[0] + 2 * MARGIN_M) - MARGIN_M
    pixel_m = 6.0 / size_px
    spread_m = 2.5 * std_m
    if spread_m < min(x_m, y_m, 4.0 - x_m, 5.0 - y_m):  # the ellipse is not cut off at the margin
        assert (x_found, y_found) == pytest.approx((x_m, y_m), abs=3 * pixel_m)


def test_picture_shows_the_arrays_and_the_zones_of_the_moment() -> None:
    site = site_of()
    image = pixels(alert_at(3.5, 4.5), site)
    for spec in site.processed:
        x_m, y_m, _ = spec.centre_m
        assert colour_at(image, x_m, y_m, site)[1] > 0.8
    drawn = site_of({"zones.desk": {"polygon_m": [[2.5, 0.5], [3.5, 0.5], [3.0, 1.0]]}})
    assert not np.array_equal(pixels(alert_at(3.5, 4.5), drawn), image)


def test_alert_about_no_place_has_no_picture() -> None:
    array = {"name": "north", "state": "lost", "reason": None}
    alert = AlertMessages(site_of(), "").of_array("lost", array, 0, 0)
    assert picture_of(alert, site_of(), ZoneMap(site_of())) is None
    assert (alert["picture"], alert["clips"]) == (None, None)


def test_clip_that_is_too_large_or_never_comes_is_not_attached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Clips:
        def __init__(self, size: int | None, waiting: int) -> None:
            self.size, self.waiting, self.looks = size, waiting, 0

        def is_waiting(self, event_id: str) -> bool:
            return self.looks < self.waiting

        def best_file(self, event_id: str) -> Path | None:
            self.looks += 1
            if self.size is None:
                return None
            (tmp_path / "a.flac").write_bytes(bytes(self.size))
            return tmp_path / "a.flac"

    def found(clips: Any) -> Path | None:
        site = site_of()
        return asyncio.run(Evidence(lambda: site, lambda: ZoneMap(site), clips).clip(alert_at(1.0, 1.0)))

    for name, value in (("LOOK_S", 0.001), ("QUEUED_S", 0.003), ("CLIP_WAIT_S", 0.02), ("MAX_CLIP_BYTES", 100)):
        monkeypatch.setattr(evidence, name, value)
    assert found(Clips(100, 0)) == tmp_path / "a.flac"
    assert found(Clips(101, 0)) is None
    assert found(None) is None
    never, lasting = Clips(None, 0), Clips(None, 10**6)
    assert (found(never), found(lasting)) == (None, None)
    assert never.looks < lasting.looks == 20
    direction, early, site = Clips(100, 0), Clips(None, 10**6), site_of()
    about = alert_at(1.0, 1.0)
    about["event"]["status"] = "direction-only"
    assert asyncio.run(Evidence(lambda: site, lambda: ZoneMap(site), direction).clip(about)) == tmp_path / "a.flac"
    found_early = Evidence(lambda: site, lambda: ZoneMap(site), early).clip(alert_at(1.0, 1.0), waits=False)
    assert asyncio.run(found_early) is None
    assert (direction.looks, early.looks) == (1, 1)


def test_large_picture_takes_little_memory() -> None:
    alert, site = alert_at(1.0, 1.0), site_of()
    tracemalloc.start()
    try:
        assert picture_of(alert, site, ZoneMap(site), MAX_PX) is not None
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 6 * 3 * MAX_PX**2


def test_alert_links_to_its_picture_which_the_server_draws(tmp_path: Path) -> None:
    rules = {"door": {"events": {"zones": ["door"]}, "hold_off_s": 0}}
    clips = {"server.clips": {"folder": "clips"}, "server.events_db": "events.sqlite"}
    site = alert_site(tmp_path, clips, rules=rules)
    with running_server(site) as server:
        begin_ns = server.parts.clock.now_ns()
        event = replace(sound(1), start_ns=begin_ns, end_ns=begin_ns + 10**9)
        server.parts.event_log.add_final(FinalResults((event,), after(event)), Messages(site, 0, utc=True), {})
        wait_until(lambda: httpx.get(f"{server.url}/api/v1/alerts").json()["alerts"], "the alert")
        [alert] = httpx.get(f"{server.url}/api/v1/alerts").json()["alerts"]
        small = httpx.get(alert["picture"], params={"size": 100})
        assert (small.status_code, small.headers["content-type"]) == (200, "image/png")
        assert max(imread(io.BytesIO(small.content), format="png").shape[:2]) == 100
        assert httpx.get(alert["clips"]).json()["event_id"] == event.id
        assert httpx.get(alert["picture"], params={"size": 5000}).status_code == 422
        assert httpx.get(alert["picture"].replace("alert_", "alert_f")).status_code == 404


def test_pictures_show_where_the_arrays_are_now() -> None:
    sites = [site_of(), site_of({"arrays.south.position_m": [3.2, 0.8, 1.5]})]
    now = iter(sites)
    evidence = Evidence(lambda: next(now), lambda: ZoneMap(sites[0]), None)
    alert = alert_at(1.0, 1.0)
    assert [evidence.picture(alert), evidence.picture(alert)] == [picture_of(alert, one, ZoneMap(one)) for one in sites]
    assert picture_of(alert, sites[0], ZoneMap(sites[0])) != picture_of(alert, sites[1], ZoneMap(sites[1]))
