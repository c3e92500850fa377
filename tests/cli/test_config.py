"""`livessl config show`: what it prints is the site again, with the right sources."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cli.command_runs import Run
from livessl.site.load import load_site
from small_site import Changes, small, write_site

ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))
FULL: Changes = {
    "temperature_c": 24.5,
    "arrays.north.band_hz": [200, 4000],
    "arrays.north.uncertainty": {"clock_s": 0.0},
    "uncertainty": {"position_m": 0.05},
    "joint": {},
    "server.http.trusted_hosts": ["site.example", "*.lab.example"],
    "nodes.lab-pc.spool": {"directory": "no"},
}


def shown(run: Run, site: Path, *options: str) -> dict[str, dict[str, Any]]:
    return {one["key"]: one for one in run("config", "show", site, "--json", *options).objects}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_printed_settings_are_the_site_again(run: Run, path: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.yaml"
    text = run("config", "show", path).out.replace("../calibration", str(ROOT / "calibration"))
    again.write_text(text, encoding="utf-8")
    one, other = load_site(path), load_site(again)
    assert other.c_m_s == one.c_m_s
    assert other.nodes == one.nodes
    assert (other.server, other.fusion, other.activity, other.zones) == (
        one.server,
        one.fusion,
        one.activity,
        one.zones,
    )
    for spec, same in zip(one.specs, other.specs, strict=True):
        assert (spec.name, spec.band_hz, spec.uncertainty) == (same.name, same.band_hz, same.uncertainty)
        assert np.array_equal(spec.microphones_m, same.microphones_m)


def test_every_setting_has_its_value_and_source(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, FULL)
    lines = path.read_text(encoding="utf-8").splitlines()
    found = shown(run, path)
    assert found["temperature_c"]["value"] == 24.5
    for one in found.values():
        if one["line"] is not None:
            assert one["source"].startswith(f"{path}:{one['line']}")
            assert one["key"].rpartition(".")[2] in lines[one["line"] - 1]
        else:
            assert one["file"] is None
    assert found["fusion.method"] == {
        "key": "fusion.method", "value": "onset", "source": "default", "file": None, "line": None, "default": True,
    }  # fmt: skip
    assert found["speed_of_sound_m_s"]["source"] == "from temperature_c"
    assert found["speed_of_sound_m_s"]["value"] == load_site(path).c_m_s
    assert found["arrays.south.band_hz"]["value"] == [100.0, 6000.0]
    assert found["arrays.south.band_hz"]["source"] == "the site's, default"


def test_array_takes_the_rest_of_its_uncertainty_from_the_site(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, FULL)
    found, known = shown(run, path), load_site(path).array("north").uncertainty
    for key in ("position_m", "orientation_deg", "clock_s", "temperature_c"):
        assert found[f"arrays.north.uncertainty.{key}"]["value"] == getattr(known, key)
    assert found["arrays.north.uncertainty.clock_s"]["line"] is not None
    assert found["arrays.north.uncertainty.position_m"]["source"].startswith("the site's, ")


def test_given_settings_are_those_of_the_file(run: Run, tmp_path: Path) -> None:
    def leaves(data: Any, place: str = "") -> set[str]:
        if isinstance(data, dict) and data:
            return {leaf for key, value in data.items() for leaf in leaves(value, f"{place}.{key}".strip("."))}
        return {place}

    assert set(shown(run, write_site(tmp_path, FULL), "--given")) == leaves(small(FULL))


def test_positions_that_a_calibration_replaces_are_marked(run: Run, tmp_path: Path) -> None:
    site = load_site(write_site(tmp_path))
    measured = {"arrays": {"south": {"microphones_m": site.array("south").microphones_m.tolist()}}}
    (tmp_path / "lab.yaml").write_text(yaml.safe_dump(measured), encoding="utf-8")
    found = shown(run, write_site(tmp_path, {"calibration": "lab.yaml"}))
    assert found["arrays.south.position_m"]["source"].endswith(", replaced by lab.yaml")
    assert "replaced" not in found["arrays.north.position_m"]["source"]


def test_faulty_site_has_no_settings_to_show(run: Run, tmp_path: Path) -> None:
    done = run("config", "show", write_site(tmp_path, {"colour": "red"}))
    assert (done.code, done.out) == (2, "")
    assert "unknown key 'colour'; remove it" in done.err
