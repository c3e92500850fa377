"""The functions of `import livessl`: values in, values out, and one clear error for unusable input."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import livessl
from livessl.core.types import Status
from livessl.errors import DeviceError
from small_site import RATE_HZ, heard, hiss, scene, site_of, write_site, write_wav

ARRAYS = ("north", "south")


def samples() -> dict[str, livessl.offline.Samples]:
    return {name: heard(name) for name in ARRAYS}


def positions(events: list[livessl.Event]) -> list[list[float]]:
    return [event.estimate.position_m.tolist() for event in events if event.estimate is not None]


def test_samples_and_files_give_the_same_events(tmp_path: Path) -> None:
    site = write_site(tmp_path)
    files = {name: write_wav(tmp_path / f"{name}.wav", heard(name)) for name in ARRAYS}
    from_files = livessl.locate(site, files)
    assert all(event.status is Status.LOCATED for event in from_files)
    assert len(from_files) == len(scene().sources)
    for source, position_m in zip(scene().sources, positions(from_files), strict=True):
        assert position_m == pytest.approx(source.position_m, abs=0.1)
    mixed: dict[str, livessl.offline.Given] = {"north": str(files["north"]), "south": heard("south")}
    for given in ({**samples()}, mixed):
        assert positions(livessl.locate(livessl.load_site(site), given)) == positions(from_files)


def test_microphones_may_have_a_file_each(tmp_path: Path) -> None:
    microphones = [write_wav(tmp_path / f"{k}.wav", heard("north")[k : k + 1]) for k in range(4)]
    given: dict[str, livessl.offline.Given] = {
        "north": [str(microphones[0]), *microphones[1:]],
        "south": heard("south"),
    }
    assert positions(livessl.locate(site_of(), given)) == positions(livessl.locate(site_of(), {**samples()}))


def test_integers_are_scaled_by_their_full_scale() -> None:
    integers = {name: np.round(heard(name) * 32767).astype(np.int16) for name in ARRAYS}
    of_integers, of_floats = livessl.locate(site_of(), integers), livessl.locate(site_of(), samples())
    assert np.array(positions(of_integers)) == pytest.approx(np.array(positions(of_floats)), abs=0.01)
    assert of_integers[0].power == pytest.approx(of_floats[0].power, rel=0.01)


def test_another_method_gives_other_positions() -> None:
    events = livessl.locate(site_of(), samples(), method="srp-phat")
    assert {event.method for event in events} == {"srp-phat"}
    assert positions(events) != positions(livessl.locate(site_of(), samples()))


def test_unknown_method_is_an_error_with_a_guess() -> None:
    with pytest.raises(
        livessl.ConfigError, match=r"expected one of onset, .*, got 'srp-fat'; did you mean 'srp-phat'\?"
    ):
        livessl.locate(site_of(), samples(), method="srp-fat")


def test_estimator_of_the_reference_is_registered_and_locates(monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[1] / "docs" / "reference" / "estimators.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert code is not None
    names: dict[str, Any] = {}
    exec(code[1], names)
    monkeypatch.setitem(livessl.METHODS, "product", "removed:again")  # restored after the test
    livessl.register("product", names["Product"])
    events = livessl.locate(site_of(), samples(), method="product")
    assert [event.method for event in events] == ["product", "product"]
    for source, position_m in zip(scene().sources, positions(events), strict=True):
        assert position_m == pytest.approx(source.position_m, abs=0.25)  # one step of the grid


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "expected one for each of north, south"),
        ({"west": hiss()}, "no array 'west'; arrays are north, south"),
        ({"north": hiss()[0]}, r"expected samples \(channels, n\), got shape \(16000,\)"),
        ({"north": hiss().T}, r"got \(16000, 4\); pass samples.T"),
        ({"north": hiss(channels=3)}, "expected 4 channels"),
        ({"north": np.full((4, 100), np.nan)}, "expected finite samples"),
        ({"north": "none.wav"}, "no such file"),
    ],
)
def test_unusable_recordings_give_one_clear_error(given: dict[str, livessl.offline.Given], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        livessl.locate(site_of(), given)


def test_samples_without_a_rate_are_refused_if_the_site_has_no_rate() -> None:
    with pytest.raises(DeviceError, match="pass sample_rate_hz"):
        livessl.locate(site_of({"nodes": {}}), samples())
    assert livessl.locate(site_of({"nodes": {}}), samples(), sample_rate_hz=RATE_HZ)


def test_power_map_is_highest_where_the_sound_was() -> None:
    source = scene().sources[0]
    stop_s = source.start_s + len(source.sound) / RATE_HZ
    found = livessl.power_map(site_of(), samples(), source.start_s, stop_s)
    assert found.power.shape == (len(found.x_m), len(found.y_m), len(found.z_m))
    assert set(found.arrays) == set(ARRAYS)
    highest = np.unravel_index(found.power.argmax(), found.power.shape)
    place_m = [axis[index] for axis, index in zip((found.x_m, found.y_m, found.z_m), highest, strict=True)]
    half_cell_m = 0.125 + 0.05
    assert place_m == pytest.approx(source.position_m, abs=2 * half_cell_m)
    assert found.power == pytest.approx(sum(found.arrays.values()), rel=1e-5)
    with pytest.raises(DeviceError, match="expected sound from 1000 s"):
        livessl.power_map(site_of(), samples(), start_s=1000.0)


def test_simulation_is_the_same_for_the_same_seed(tmp_path: Path) -> None:
    one = livessl.simulate(site_of(), rt60_s=0.0, count=1, seed=4)
    again = livessl.simulate(write_site(tmp_path), rt60_s=0.0, count=1, seed=4)
    other = livessl.simulate(site_of(), rt60_s=0.0, count=1, seed=5)
    assert one.sample_rate_hz == RATE_HZ  # the site's device
    assert (one.recordings["north"] == again.recordings["north"]).all()
    assert one.scene.sources[0].position_m.tolist() != other.scene.sources[0].position_m.tolist()


def test_every_name_of_the_front_door_exists() -> None:
    assert {name for name in livessl.__all__ if getattr(livessl, name, None) is None} == set()
    assert set(livessl.__all__) <= set(dir(livessl))
    with pytest.raises(AttributeError, match="no attribute 'lokate'"):
        livessl.lokate  # noqa: B018


def test_import_loads_no_heavy_module() -> None:
    code = "import sys, livessl; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) & {"numpy", "scipy", "pydantic", "numba", "fastapi", "zmq", "yaml"} == set()
