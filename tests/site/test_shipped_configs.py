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

from livessl.core.geometry import circle, tetrahedron
from livessl.core.types import FloatArray
from livessl.site.load import load_site
from livessl.site.models import GeometryFile, Site
from livessl.site.node_models import SoundDeviceConfig

ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))


def geometry(name: str) -> FloatArray:
    text = (ROOT / "calibration" / name).read_text(encoding="utf-8")
    return np.array(GeometryFile.model_validate(yaml.safe_load(text)).microphones_m)


def test_there_are_configs() -> None:
    assert {path.name for path in CONFIGS} >= {"paper.yaml", "one-array.yaml"}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_loads_and_every_array_has_a_node(path: Path) -> None:
    site = load_site(path)
    assert site.site == path.stem
    assert site.warnings == ()
    assert {name for node in site.nodes.values() for name in node.arrays} == set(site.arrays)


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
    [("tetrahedron-0.5m.yaml", tetrahedron(0.5)), ("respeaker-4mic.yaml", circle(0.032, 4))],
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
