"""What differs between two readings of a site file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.site.changes import changed_keys, is_of_poses, is_taken_over, moved_arrays, names_of
from livessl.site.findings import dotted
from small_site import site_of

CHANGES: Final[dict[str, tuple[Any, str]]] = {
    "zones.door.bounds_m": ([[0.0, 1.5], [0.0, 1.0], [0.0, 2.5]], "zones.door.bounds_m"),
    "zones.desk": ({"bounds_m": [[2.0, 3.0], [2.0, 3.0], [0.0, 1.0]]}, "zones.desk"),
    "alerts.rules": ({"any": {"events": {}}}, "alerts.rules.any"),
    "alerts.outbox": ("alerts.sqlite", "alerts.outbox"),
    "server.http.port": (8123, "server.http.port"),
    "fusion.min_arrays": (2, "fusion.min_arrays"),
    "arrays.north.position_m": ([1.8, 1.3, 1.4], "arrays.north.position_m"),
    "arrays.south.band_hz": ([200, 4000], "arrays.south.band_hz"),
    "temperature_c": (12.0, "temperature_c"),
    "grid.spacing_m": (0.5, "grid.spacing_m"),
}
"""Dotted keys with a value other than that of the small site, and the key that then differs."""


@settings(max_examples=15)
@given(st.sets(st.sampled_from(sorted(CHANGES))), st.sets(st.sampled_from(sorted(CHANGES))))
def test_exactly_the_keys_that_differ_are_named(one: set[str], other: set[str]) -> None:
    before, after = (site_of({name: CHANGES[name][0] for name in names}) for names in (one, other))
    assert sorted(names_of(changed_keys(before, after))) == sorted(CHANGES[name][1] for name in one ^ other)


@pytest.mark.parametrize(
    ("name", "live", "pose"),
    [
        ("zones.door.bounds_m", True, False),
        ("zones.desk", True, False),
        ("alerts.rules", True, False),
        ("alerts.outbox", False, False),
        ("server.http.port", False, False),
        ("arrays.north.position_m", False, True),
        ("arrays.south.band_hz", False, False),
        ("temperature_c", False, True),
    ],
)
def test_rules_zones_and_poses_are_told_from_what_needs_a_restart(name: str, live: bool, pose: bool) -> None:
    [place] = changed_keys(site_of(), site_of({name: CHANGES[name][0]}))
    assert dotted(place) == CHANGES[name][1]
    assert (is_taken_over(place), is_of_poses(place)) == (live, pose)


def test_offsets_of_recordings_mean_nothing_to_a_server() -> None:
    assert changed_keys(site_of(), site_of({"arrays.north.wav_offset_s": 0.25})) == []


def test_array_that_a_calibration_file_moves_is_named(tmp_path: Path) -> None:
    before = site_of({"calibration": "measured.yaml"}, _measured(tmp_path, 0.0))
    assert moved_arrays(before, site_of({"calibration": "measured.yaml"}, _measured(tmp_path, 0.0))) == []
    after = site_of({"calibration": "measured.yaml"}, _measured(tmp_path, 0.01))
    assert moved_arrays(before, after) == ["south"]
    assert changed_keys(before, after) == []


def _measured(directory: Path, shift_m: float) -> Path:
    """Write a calibration file that moves an array along x, and return its folder."""
    microphones_m = site_of().array("south").microphones_m + np.array([shift_m, 0.0, 0.0])
    content = {"arrays": {"south": {"microphones_m": microphones_m.tolist()}}}
    (directory / "measured.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return directory
