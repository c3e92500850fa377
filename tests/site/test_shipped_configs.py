"""The files in config/ and calibration/ are valid and match their descriptions."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from pydantic import BaseModel

from livessl.core.geometry import circle, posed, tetrahedron
from livessl.core.types import FloatArray
from livessl.lab.frame_drawing import drawing
from livessl.lab.plan.design import predict
from livessl.site.draft import order, shape_m
from livessl.site.draft_parts import DraftArray
from livessl.site.interfaces import known_interface
from livessl.site.load import load_site
from livessl.site.models import GeometryFile, Site
from livessl.site.node_models import SoundDeviceConfig

ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))


def geometry(name: str) -> FloatArray:
    text = (ROOT / "calibration" / name).read_text(encoding="utf-8")
    return np.array(GeometryFile.model_validate(yaml.safe_load(text)).microphones_m)


def test_there_are_configs() -> None:
    names = "paper one-array umc1820 umc404hd-pair respeaker-4mic xvf3800 mixed"
    assert {path.stem for path in CONFIGS} >= set(names.split())


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_loads_and_every_array_has_a_node(path: Path) -> None:
    site = load_site(path)
    assert site.site == path.stem
    assert site.warnings == ()
    assert {name for node in site.nodes.values() for name in node.arrays} == set(site.arrays)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_uses_microphones_of_its_interface(path: Path) -> None:
    for node in load_site(path).nodes.values():
        known = known_interface(node.device.name) if isinstance(node.device, SoundDeviceConfig) else None
        if known is not None:
            assert {channel for channels in node.arrays.values() for channel in channels} <= set(known.microphones)


@pytest.mark.parametrize("name", ["respeaker-4mic", "xvf3800", "mixed"])
def test_flat_arrays_hang_on_walls_and_face_the_room(name: str) -> None:
    """The face of an array is towards its own +z: the normal of the plane in which its microphones are."""
    site = load_site(ROOT / "config" / f"{name}.yaml")
    flat = [array for array in site.arrays if site.array(array).aperture_m < 0.1]
    assert flat
    for array in flat:
        first, second, third = site.array(array).microphones_m[:3]
        face = np.cross(second - first, third - first)
        to_middle = (
            np.array([*site.room.size_m[:2], 2 * site.array(array).centre_m[2]]) / 2 - site.array(array).centre_m
        )
        assert float(face @ to_middle) > 0.95 * float(np.linalg.norm(face) * np.linalg.norm(to_middle)), array


def test_drawing_of_the_tetrahedron_is_what_the_code_draws() -> None:
    array = DraftArray("a", "tetrahedron", 0.5, 4, (0.0, 0.0, 0.0), 0.0)
    drawn = (ROOT / "calibration" / "tetrahedron-0.5m.svg").read_text(encoding="utf-8")
    assert drawn == drawing("Tetrahedron, edge 500 mm", order(array), shape_m(array))


def test_errors_in_the_hardware_guide_are_those_that_check_prints() -> None:
    guide = (ROOT / "docs" / "hardware.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[config/([\w-]+)\.yaml\].*\| ([0-9.]+) m \| ([0-9.]+) m \|$", guide, re.MULTILINE)
    assert len(rows) == 5
    for name, median, most in rows:
        errors = predict(load_site(ROOT / "config" / f"{name}.yaml"), 0.7).fused
        assert (f"{errors.percentile_m(50):.2f}", f"{errors.percentile_m(95):.2f}") == (median, most), name


def test_paper_config_is_the_setup_of_the_paper() -> None:
    site = load_site(ROOT / "config" / "paper.yaml")
    assert site.room.size_m == (7.05, 5.64, 2.84)
    node = site.nodes["lab-pc"]
    assert isinstance(node.device, SoundDeviceConfig)
    assert (node.device.name, node.device.sample_rate_hz) == ("UMC1820", 44100)
    assert sorted(node.arrays.values()) == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert site.grid.spacing_m == 0.05
    for spec in site.specs:
        assert spec.aperture_m == pytest.approx(0.5)
    left, right = (spec.centre_m for spec in site.specs)
    assert float(np.linalg.norm(left - right)) == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(
    ("name", "expected_m"),
    [
        ("tetrahedron-0.5m.yaml", tetrahedron(0.5)),
        ("respeaker-4mic.yaml", circle(0.032, 4)),
        ("xvf3800.yaml", posed(circle(0.033 * 2**0.5, 4), (0.0, 0.0, 0.0), yaw_deg=-45.0)),
    ],
)
def test_geometry_file_matches_its_shape_to_a_tenth_of_a_millimetre(name: str, expected_m: FloatArray) -> None:
    assert_allclose(geometry(name), expected_m, rtol=0, atol=1e-4)


def test_one_array_takes_its_shape_from_the_file() -> None:
    [spec] = load_site(ROOT / "config" / "one-array.yaml").specs
    distances = np.linalg.norm(spec.microphones_m[:, None] - spec.microphones_m[None], axis=2)
    file_m = geometry("tetrahedron-0.5m.yaml")
    assert_allclose(distances, np.linalg.norm(file_m[:, None] - file_m[None], axis=2), rtol=0, atol=1e-9)
    assert spec.microphones_m[1, 1] > spec.centre_m[1] + 0.28, "yaw 90: microphone 2 towards +y"


def documented_keys(model: type[BaseModel]) -> set[str]:
    """Return every key of a model of the site file, including those of nested models."""
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        if field.exclude:
            continue
        keys.add(name)
        keys |= {key for inner in _models_in(field.annotation) for key in documented_keys(inner)}
    return keys


def _models_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def test_every_key_of_the_site_file_is_documented() -> None:
    text = (ROOT / "docs" / "site-file.md").read_text(encoding="utf-8")
    missing = sorted(key for key in documented_keys(Site) if not re.search(rf"\b{key}\b", text))
    assert missing == []
