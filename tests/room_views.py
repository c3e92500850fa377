"""A room whose views the dashboard draws, what it has drawn, and where that should be, computed independently of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from playwright.sync_api import Locator, Page, expect

from browser import visit
from livessl.core.types import FloatArray
from livessl.server.app import Server
from scene_server import replay_scene
from small_site import HANG_S, SMALL, running_server, site_of, wait_until

MS: Final = 1000 * HANG_S
NORTH: Final = SMALL["arrays"]["north"]
TITLES: Final = {"side": "Side elevation", "front": "Front elevation", "3d": "3-D view"}
HALF_PIXEL: Final = 0.5
"""Error in pixels of a place that is right."""
PLAN: Final = """
async (id) => {
  const { Plan } = await import("./static/plan.js");
  const { size, scale, view, camera, labels } = Plan.of(document.getElementById(id));
  return { size, scale, view, camera, written: labels ? labels.written : [] };
}
"""
"""Script that returns what a plan has drawn last, and where."""

AT: Final = """
async ([id, position]) => {
  const { Plan } = await import("./static/plan.js");
  return Plan.of(document.getElementById(id)).at(position);
}
"""
"""Script that returns the pixels of a position in metres."""

COLOUR: Final = """
([id, x, y]) => {
  const canvas = document.getElementById(id);
  const ratio = devicePixelRatio;
  return [...canvas.getContext("2d").getImageData(Math.floor(x * ratio), Math.floor(y * ratio), 1, 1).data].slice(0, 3);
}
"""
"""Script that reads the colour of a pixel of a canvas."""


@contextmanager
def room_server() -> Iterator[Server]:
    """A server that has replayed the small scene; a third array, which is silent, differs from the first in x alone."""
    east = {**NORTH, "position_m": [3.2, *NORTH["position_m"][1:]]}
    changes = {
        "arrays": {**SMALL["arrays"], "east": east},
        "nodes.lab-pc.arrays": {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]},
        "zones.fan": {"bounds_m": [[3, 4], [0, 1], [0, 3]], "exclude": True},
        "zones.desk": {"polygon_m": [[1.2, 2.2], [3.4, 2.0], [3.4, 3.2], [2.4, 2.7]], "z_m": [0, 1.1]},
    }
    with running_server(site_of(changes)) as server:
        replay_scene(server)
        yield server


def opened(page: Page, server: Server, view: str = "", width: int = 1440) -> None:
    """Open the live page at a view, and wait until it is drawn."""
    page.emulate_media(reduced_motion="reduce")
    page.set_viewport_size({"width": width, "height": 900})
    visit(page, server.url + (f"/#view={view}" if view else ""))
    expect(page.get_by_test_id("event")).to_have_count(2, timeout=MS)
    shown(page, view or "side")


def shown(page: Page, view: str) -> dict[str, Any]:
    """Wait until a view is drawn; return what is drawn."""
    found: list[dict[str, Any]] = []

    def is_drawn() -> bool:
        found.append(page.evaluate(PLAN, "side"))
        return bool(found[-1]["view"] == view and found[-1]["written"])

    expect(page.locator("#side-title")).to_have_text(TITLES[view], timeout=MS)
    wait_until(is_drawn, f"the view {view}")
    return found[-1]


def publish(server: Server, message: dict[str, Any]) -> None:
    assert server.loop is not None
    server.loop.call_soon_threadsafe(server.parts.fanout.publish, message)


def camera(page: Page) -> dict[str, Any]:
    found: dict[str, Any] = page.evaluate(PLAN, "side")["camera"]
    return found


def choice(page: Page, name: str) -> Locator:
    return page.get_by_role("radio", name=name, exact=True)


def directions(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Unit vectors (3, 3) to the right, up and towards someone who looks at the room from a direction."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(toward, right), toward])


def overlap(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Return whether two boxes, each with left, top, width and height, overlap."""
    return bool(
        a["left"] < b["left"] + b["width"]
        and b["left"] < a["left"] + a["width"]
        and a["top"] < b["top"] + b["height"]
        and b["top"] < a["top"] + a["height"]
    )


def leaves(box: dict[str, Any], width: float, height: float) -> bool:
    """Return whether a part of a box is outside a canvas of this size."""
    across = box["left"] < 0 or box["left"] + box["width"] > width
    return bool(across or box["top"] < 0 or box["top"] + box["height"] > height)
