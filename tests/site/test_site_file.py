"""The site file: each fault is one sentence with its line and place, and all faults are reported at once."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from livessl.core.types import FloatArray
from livessl.errors import ConfigError
from livessl.site.build.grid import search_grid
from livessl.site.build.pipeline import activity_parameters
from livessl.site.load import load_site, parse_site
from livessl.site.models import Site
from small_site import SMALL, Changes, site_of, small, text_of, write_site

SQUARE_M = [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]


def faults_of(text: str) -> list[tuple[str, str]]:
    """Return place and sentence of every fault of a text."""
    with pytest.raises(ConfigError) as caught:
        parse_site(text, "site.yaml")
    return [(fault.where, fault.what) for fault in caught.value.faults]


def line_of(text: str, path: str) -> int | None:
    """Return the number of the line of a dotted path, or of the longest part of it that the text has."""
    lines = text.splitlines()
    number = None
    for level, key in enumerate(path.split(".")):
        start = 0 if number is None else number + 1
        if key.isdigit():
            item = start + int(key)
            return item + 1 if lines[item].lstrip().startswith("- ") else start
        wanted = f"{'  ' * level}{key}:"
        number = next((n for n in range(start, len(lines)) if lines[n].startswith(wanted)), None)
        if number is None:
            return start or None
    return None if number is None else number + 1


ARRAY = "arrays.north"
NODE = "nodes.lab-pc"
JOINT = "joint.both"
WEST: Changes = {"microphones_m": [[1.0, 1.0, 1.0], [1.0, 1.2, 1.0]]}
PI: Changes = {"device": {"name": "pi", "sample_rate_hz": 16000}, "arrays": {"south": [1, 2, 3, 4]}}
ONE_FAULT: dict[str, tuple[Changes, str, str]] = {
    "unknown key": ({"colour": "red"}, "colour", "unknown key 'colour'; remove it"),
    "unknown key inside": (
        {f"{ARRAY}.positon_m": [1, 1, 1]},
        f"{ARRAY}.positon_m",
        "unknown key 'positon_m'; did you mean 'position_m'",
    ),
    "fault of an array that is named like a type": (
        {"arrays.str": {"microphones_m": [[1, 1, 1], [1, 2, 1]], "colour": "red"}},
        "arrays.str.colour",
        "unknown key",
    ),
    "misspelt key": ({"temprature_c": 20}, "temprature_c", "unknown key 'temprature_c'; did you mean 'temperature_c'"),
    "misspelt key of a device": (
        {f"{NODE}.device.sample_rate": 16000},
        f"{NODE}.device.sample_rate",
        "unknown key 'sample_rate'; did you mean 'sample_rate_hz'",
    ),
    "key of the built site": ({"specs": []}, "specs", "unknown key"),
    "another key of the built site": ({"processed": []}, "processed", "unknown key"),
    "missing key": ({"room": ...}, "room", "missing; add it"),
    "missing key inside": ({f"{NODE}.device.name": ...}, f"{NODE}.device.name", "missing; add it"),
    "missing device": ({f"{NODE}.device": ...}, f"{NODE}.device", "missing; add it"),
    "no arrays": ({"arrays": {}, "nodes": {}}, "arrays", "at least 1 item"),
    "wrong type": ({"grid.spacing_m": "coarse"}, "grid.spacing_m", "valid number.*got 'coarse'"),
    "array of a wrong type": ({ARRAY: 5, NODE: ...}, ARRAY, "valid dictionary.*got 5"),
    "list too short": ({"room.size_m": [4.0, 5.0]}, "room.size_m.2", "missing; add it"),
    "negative room": ({"room.size_m": [4.0, -5.0, 3.0]}, "room.size_m.1", "greater than 0, got -5"),
    "NaN": ({f"{ARRAY}.position_m": [float("nan"), 1, 1]}, f"{ARRAY}.position_m.0", "finite number"),
    "room of a solar system": ({"room.size_m": [4.0, 1e300, 3.0]}, "room.size_m.1", "less than or equal"),
    "vanishing spacing": ({"grid.spacing_m": 1e-300}, "grid.spacing_m", "greater than or equal"),
    "bad site name": ({"site": "our lab"}, "site", "got 'our lab'"),
    "bad array name": (
        {"arrays.the north": {"microphones_m": [[1, 1, 1], [1, 2, 1]]}},
        "arrays.the north",
        "rename it",
    ),
    "bad zone name": ({"zones.Tür": {"bounds_m": [[0, 1], [0, 1], [0, 1]]}}, "zones.Tür", "rename it"),
    "bad node name": ({"nodes": {"lab/pc": SMALL["nodes"]["lab-pc"]}}, "nodes.lab/pc", "rename it"),
    "both forms": (
        {f"{ARRAY}.microphones_m": [[1, 1, 1], [1, 2, 1], [2, 1, 1], [1, 1, 2]]},
        ARRAY,
        "expected either microphones_m .* or geometry with position_m, got both",
    ),
    "neither form": ({ARRAY: {}}, ARRAY, "expected either microphones_m .*, got neither"),
    "geometry nowhere": ({f"{ARRAY}.position_m": ...}, ARRAY, "geometry needs position_m"),
    "absolute, and posed": (
        {ARRAY: {"microphones_m": [[1, 1, 1], [1, 2, 1], [2, 1, 1], [1, 1, 2]], "orientation_deg": {"yaw": 3}}},
        ARRAY,
        "microphones_m are absolute; remove position_m and orientation_deg, or use geometry",
    ),
    "no such shape": ({f"{ARRAY}.geometry": {"cube": {}}}, f"{ARRAY}.geometry.cube", "unknown key"),
    "two shapes": (
        {f"{ARRAY}.geometry": {"tetrahedron": {"edge_m": 0.3}, "line": {"spacing_m": 0.1, "count": 4}}},
        f"{ARRAY}.geometry",
        "expected exactly one of tetrahedron, circle, line; got tetrahedron, line",
    ),
    "shape of no shape": ({f"{ARRAY}.geometry": {}}, f"{ARRAY}.geometry", "exactly one of .*; got none"),
    "geometry that is a number": ({f"{ARRAY}.geometry": 3}, f"{ARRAY}.geometry", "expected a shape such as .*, got 3"),
    "shape without size": (
        {f"{ARRAY}.geometry": {"tetrahedron": {"edge_m": 0}}},
        f"{ARRAY}.geometry.tetrahedron.edge_m",
        "greater than 0, got 0",
    ),
    "one microphone": (
        {f"{ARRAY}.geometry": {"circle": {"radius_m": 0.1, "count": 1}}},
        f"{ARRAY}.geometry.circle.count",
        "greater than or equal to 2, got 1",
    ),
    "seventeen microphones": (
        {f"{ARRAY}.geometry": {"line": {"spacing_m": 0.1, "count": 17}}},
        f"{ARRAY}.geometry.line.count",
        "less than or equal to 16, got 17",
    ),
    "missing geometry file": (
        {f"{ARRAY}.geometry": "calibration/nowhere.yaml"},
        f"{ARRAY}.geometry",
        "calibration/nowhere.yaml: geometry file cannot be read: No such file",
    ),
    "two microphones at one place": (
        {ARRAY: {"microphones_m": [[1, 1, 1], [1, 2, 1], [2, 1, 1], [1, 2, 1.0005]]}},
        ARRAY,
        r"microphones 2 and 4 are at one place \(1, 2, 1\); correct one of them",
    ),
    "array outside the room": (
        {f"{ARRAY}.position_m": [3.99, 1.3, 1.4]},
        ARRAY,
        r"microphone 2 at \(4.1632, 1.3, 1.3388\) is outside the room \(4, 5, 3\) m; correct the array's position",
    ),
    "array in millimetres": (
        {f"{ARRAY}.position_m": [1900, 1300, 1400]},
        ARRAY,
        r"outside the room \(4, 5, 3\) m; did you mean position_m: \[1.9, 1.3, 1.4\], from millimetres\?",
    ),
    "array under the floor": ({f"{ARRAY}.position_m": [1.0, 1.3, -0.5]}, ARRAY, "microphone 1 .* outside the room"),
    "grid inside out": (
        {"grid.bounds_m": [[0, 4], [5, 0], [0, 3]]},
        "grid.bounds_m",
        r"expected lower <= upper on y, got \[5, 0\]; swap them",
    ),
    "too few channels": (
        {f"{NODE}.arrays.north": [1, 2, 3]},
        f"{NODE}.arrays.north",
        "expected 4 channels, one for each microphone of 'north', got 3",
    ),
    "too many channels": ({f"{NODE}.arrays.south": [5, 6, 7, 8, 9]}, f"{NODE}.arrays.south", "expected 4 .* got 5"),
    "channel 0": (
        {f"{NODE}.arrays.north": [0, 1, 2, 3]},
        f"{NODE}.arrays",
        r"from 1 on, got 0; channels count from 1; did you mean {north: \[1, 2, 3, 4\], south: \[6, 7, 8, 9\]}\?$",
    ),
    "channel of two arrays": (
        {f"{NODE}.arrays.south": [4, 6, 7, 8]},
        f"{NODE}.arrays.south",
        "channel 4 is already used by 'north'",
    ),
    "channel twice": ({f"{NODE}.arrays.south": [5, 5, 7, 8]}, f"{NODE}.arrays.south", "channel 5 is already used"),
    "array of two nodes": (
        {"nodes.other": {"device": {"name": "other"}, "arrays": {"north": [1, 2, 3, 4]}}},
        "nodes.other.arrays.north",
        "already captured by node 'lab-pc'; remove it from one of the nodes",
    ),
    "node's unknown array": (
        {f"{NODE}.arrays.west": [9, 10, 11, 12]},
        f"{NODE}.arrays.west",
        "expected one of the arrays north, south, got 'west'; correct the name or add the array",
    ),
    "node without arrays": ({f"{NODE}.arrays": {}}, f"{NODE}.arrays", "at least 1 item"),
    "band above Nyquist": (
        {"arrays.south.band_hz": [100, 8000]},
        f"{NODE}.arrays.south",
        "band_hz up to 8000 Hz needs a sample rate above 16000 Hz, the device has 16000 Hz; lower band_hz or raise",
    ),
    "band upside down": ({"band_hz": [6000, 100]}, "band_hz", r"expected \[low, high\] with low < high, got"),
    "array's band upside down": ({f"{ARRAY}.band_hz": [900, 900]}, f"{ARRAY}.band_hz", "with low < high"),
    "bad endpoint of a node": ({f"{NODE}.server": "localhost:5570"}, f"{NODE}.server", "expected tcp://HOST:PORT"),
    "zone inside out": (
        {"zones.door.bounds_m": [[0, 1], [1, 0], [0, 2]]},
        "zones.door.bounds_m",
        r"expected lower <= upper on y, got \[1, 0\]; swap them",
    ),
    "zone outside the room": (
        {"zones.door.bounds_m": [[0, 1], [5.1, 6], [0, 2]]},
        "zones.door.bounds_m",
        r"reaches into the room, on y from 0 to 5 m, got \[5.1, 6\]; correct it or room.size_m",
    ),
    "search volume outside the room": (
        {"grid.bounds_m": [[-2, -1], [0, 5], [0, 3]]},
        "grid.bounds_m",
        r"reaches into the room, on x from 0 to 4 m, got \[-2, -1\]",
    ),
    "array that is called as the map of all": (
        {"arrays.fused": {"microphones_m": [[1, 1, 1], [1, 2, 1]]}},
        "arrays.fused",
        "'fused' is the map of all arrays together; rename it",
    ),
    "warnings as a key": ({"warnings": ["beware"]}, "warnings", "unknown key 'warnings'; remove it"),
    "port of a node that is any": (
        {f"{NODE}.server": "tcp://127.0.0.1:*"},
        f"{NODE}.server",
        r"expected tcp://HOST:PORT or ipc://PATH, got 'tcp://127.0.0.1:\*'",
    ),
    "bad endpoint of the server": (
        {"server.bind": "tcp://127.0.0.1:99999"},
        "server.bind",
        "expected tcp://HOST:PORT or ipc://PATH, got 'tcp://127.0.0.1:99999'",
    ),
    "endpoint of no decimal port": ({"server.bind": "tcp://127.0.0.1:5²"}, "server.bind", "expected tcp://HOST:PORT"),
    "IPv6 endpoint without brackets": (
        {f"{NODE}.server": "tcp://::1:5570"},
        f"{NODE}.server",
        r"expected an IPv6 address in brackets, such as tcp://\[::1\]:5570, got 'tcp://::1:5570'",
    ),
    "endpoint in brackets that is no address": (
        {"server.bind": "tcp://[localhost]:5570"},
        "server.bind",
        "expected an IPv6 address in brackets",
    ),
    "port in the HTTP host": (
        {"server.http.host": "127.0.0.1:8000"},
        "server.http.host",
        "expected a name or an address without a port, such as lab-pc, 127.0.0.1 or ::1, got '127.0.0.1:8000'",
    ),
    "URL among the trusted hosts": (
        {"server.http.trusted_hosts": ["https://site.example/"]},
        "server.http.trusted_hosts",
        r"expected a host name without scheme and port, such as site.example or \*.site.example, got 'https://site",
    ),
    "all hosts trusted": ({"server.http.trusted_hosts": ["*"]}, "server.http.trusted_hosts", r"got '\*'"),
    "root path that is no path": (
        {"server.http.root_path": "livessl"},
        "server.http.root_path",
        "expected a path such as /livessl, got 'livessl'",
    ),
    "proxy by its name": (
        {"server.http.forwarded_allow_ips": ["proxy.example"]},
        "server.http.forwarded_allow_ips",
        "expected an address or a network of proxies, such as 127.0.0.1 or 10.0.0.0/8, got 'proxy.example'",
    ),
    "bad HTTP port": ({"server.http.port": 70000}, "server.http.port", "less than or equal to 65535, got 70000"),
    "speed and temperature": (
        {"speed_of_sound_m_s": 343.0, "temperature_c": 20.0},
        "temperature_c",
        "expected either speed_of_sound_m_s or temperature_c, got both; remove one",
    ),
    "temperature of an oven": ({"temperature_c": 200}, "temperature_c", "between -60 and 80 .*, got 200$"),
    "temperature in Fahrenheit": (
        {"temperature_c": 86},
        "temperature_c",
        r"between -60 and 80 .*, got 86; did you mean 30\.0, from Fahrenheit",
    ),
    "temperature of no number": ({"temperature_c": float("nan")}, "temperature_c", "between -60 and 80 .*, got nan"),
    "min_arrays": ({"fusion.min_arrays": 3}, "fusion.min_arrays", "at most the number of arrays, 2, got 3"),
    "unknown method": ({"fusion.method": "music"}, "fusion.method", "expected one of .*srp-phat.*, got 'music'"),
    "unknown device type": (
        {f"{NODE}.device.type": "radio"},
        f"{NODE}.device",
        "type: expected one of sound, wav, scene, got 'radio'",
    ),
    "device type of no kind": ({f"{NODE}.device.type": ["wav"]}, f"{NODE}.device", "expected one of sound, wav, scene"),
    "device that is a name": ({f"{NODE}.device": "UMC"}, f"{NODE}.device", "expected a mapping such as .* got 'UMC'"),
    "joint array of one": ({JOINT: ["north"]}, JOINT, "at least 2 items"),
    "joint array of no list": ({JOINT: "north"}, JOINT, "valid tuple.*got 'north'"),
    "joint array of nobody": (
        {JOINT: ["north", "west"]},
        f"{JOINT}.west",
        "expected one of the arrays north, south, got 'west'; correct the name or add the array",
    ),
    "joint array of one twice": ({JOINT: ["north", "north"]}, f"{JOINT}.north", "already joined in 'both'; remove it"),
    "array in two joint ones": (
        {
            JOINT: ["north", "south"],
            "arrays.west": WEST,
            f"{NODE}.arrays.west": [9, 10],
            "joint.two": ["west", "north"],
        },
        "joint.two.north",
        "already joined in 'both'; remove it from one of them",
    ),
    "joint array that is called as one": (
        {"joint.south": ["north", "south"]},
        "joint.south",
        "expected a name that no array has; rename it",
    ),
    "joint array that is called as the map of all": ({"joint.fused": ["north", "south"]}, "joint.fused", "rename it"),
    "joint array of a bad name": ({"joint.the two": ["north", "south"]}, "joint.the two", "rename it"),
    "joint array of two nodes": (
        {JOINT: ["north", "south"], f"{NODE}.arrays.south": ..., "nodes.pi": PI},
        JOINT,
        "^joint processing expects arrays sampled by one clock, got 'north' by node 'lab-pc', 'south' by node 'pi'; "
        "record them through one device, or let their maps be summed instead$",
    ),
    "joint array of a node and of none": (
        {JOINT: ["north", "south"], f"{NODE}.arrays.south": ...},
        JOINT,
        "by one clock, got 'north' by node 'lab-pc', 'south' by no node; record them",
    ),
    "joint array of two bands": (
        {JOINT: ["north", "south"], f"{ARRAY}.band_hz": [100, 3000]},
        JOINT,
        r"expects arrays of one band, got \[\(100.0, 3000.0\), \(100.0, 6000.0\)\] Hz; give them one band_hz",
    ),
    "joint array of two beginnings": (
        {JOINT: ["north", "south"], f"{ARRAY}.wav_offset_s": 0.5},
        JOINT,
        "expected arrays of one wav_offset_s, since they are recorded together, got 0, 0.5",
    ),
    "joint array of eighteen microphones": (
        {
            f"{ARRAY}.geometry": {"line": {"spacing_m": 0.05, "count": 14}},
            f"{NODE}.arrays": {"north": list(range(1, 15)), "south": list(range(15, 19))},
            JOINT: ["north", "south"],
        },
        JOINT,
        "expects 16 microphones at most, got 18; join fewer arrays",
    ),
    "joint arrays at one place": (
        {"arrays.south.position_m": [1.9, 1.3, 1.4], JOINT: ["north", "south"]},
        JOINT,
        r"expected arrays at different places, 'north' and 'south' are both at \(1.9, 1.3, 1.4\); correct one",
    ),
    "min_arrays of joint ones": (
        {"fusion.min_arrays": 2, JOINT: ["north", "south"]},
        "fusion.min_arrays",
        r"at most the number of arrays, 1 \(joint ones are one\), got 2",
    ),
    "level above full scale": ({"activity.min_level_dbfs": 1e6}, "activity.min_level_dbfs", "less than or equal to 0"),
}


@pytest.mark.parametrize("name", ONE_FAULT)
def test_fault_is_reported_once_with_its_line_and_place(name: str) -> None:
    changes, path, what = ONE_FAULT[name]
    text = text_of(changes)
    [(where, said)] = faults_of(text)
    line = line_of(text, path)
    assert where == (f"site.yaml: {path}" if line is None else f"site.yaml:{line}: {path}")
    assert re.search(what, said), said
    assert "\n" not in said


def test_small_site_has_no_fault() -> None:
    site_of()


def test_duplicate_key_names_the_second() -> None:
    text = text_of() + "room: {size_m: [1.0, 1.0, 1.0]}\n"
    last = len(text.splitlines())
    faults = dict(faults_of(text))
    assert faults[f"site.yaml:{last}: room"] == "expected each key once, got it twice; remove one"


def test_several_faults_are_reported_at_once() -> None:
    changes: Changes = {
        "colour": "red",
        f"{ARRAY}.position_m": [9.0, 1.3, 1.4],
        "arrays.south.geometry.tetrahedron.edge_m": 0.0005,
        f"{NODE}.server": "nowhere",
        "fusion.method": "music",
        "server.http.port": -1,
    }
    places = [where.rpartition(": ")[2] for where, _ in faults_of(text_of(changes))]
    assert set(places) == {
        "colour",
        ARRAY,
        "arrays.south",
        f"{NODE}.server",
        "fusion.method",
        "server.http.port",
    }


def test_one_faulty_array_causes_no_other_faults() -> None:
    changes: Changes = {f"{ARRAY}.position_m": "here", "fusion.min_arrays": 2, "arrays.south.position_m": [9, 9, 9]}
    for more in ({}, {JOINT: ["north", "south"]}):
        places = [where.rpartition(": ")[2] for where, _ in faults_of(text_of(changes | more))]
        assert places == [f"{ARRAY}.position_m", "arrays.south"]


BILLIONS = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10))


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", "site.yaml", "expected a mapping with the keys site, room and arrays"),
        ("# nothing\n", "site.yaml", "expected a mapping"),
        ("- a\n- b\n", "site.yaml", "expected a mapping"),
        ("just words", "site.yaml", "expected a mapping"),
        ("site: lab\nroom: [1, 2\n", "site.yaml:3", "not valid YAML: expected ',' or ']'"),
        ("site: lab\n\troom: 5\n", "site.yaml:2", "not valid YAML"),
        ("site: a\0b", "site.yaml", "not valid YAML"),
        ("site: 2026-02-31\n", "site.yaml", "not valid YAML"),
        ("site: !!bool perhaps\n", "site.yaml", "not valid YAML"),
        ("site: !!python/object:os.system {}\n", "site.yaml:1", "not valid YAML"),
        ("site: &a [*a]\n", "site.yaml", "an alias contains itself"),
        ("[" * 2000, "site.yaml", "not valid YAML"),
        (BILLIONS, "site.yaml", "its aliases stand for more than 1,000,000 values; write them out"),
        ("site: lab\nfusion: {min_arrays: 0x" + "f" * 4000 + "}\n", "site.yaml:2", "a number of at most 30 digits"),
        ("site: lab\nfusion: {min_arrays: " + "9" * 5000 + "}\n", "site.yaml:2", "a number of at most 30 digits"),
        ("site: \x01", "site.yaml", "not valid YAML: unacceptable character"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_text_that_is_not_a_site_is_refused(text: str, where: str, what: str) -> None:
    [(at, said)] = faults_of(text)
    assert at == where
    assert said.startswith(what) or what in said


@pytest.mark.parametrize(
    ("changes", "where", "what"),
    [
        ({"arrays.south.geometry": "a\0b"}, "arrays.south.geometry", "without NUL characters, got 'a\\x00b'"),
        ({"calibration": "a\0b"}, "calibration", "without NUL characters"),
        ({"zones_file": "a\0b"}, "zones_file", "without NUL characters"),
        (
            {"room.size_m": [999.0] * 3, "grid.spacing_m": 1e-4},
            "grid.spacing_m",
            "at most 1e+18 grid points, got 1e+21",
        ),
        ({"nodes.lab-pc.device": {"type": "scene", "seed": -1}}, "nodes.lab-pc.device.seed", "greater than or equal"),
    ],
)
def test_hostile_value_is_one_fault(changes: dict[str, Any], where: str, what: str) -> None:
    [(at, said)] = faults_of(text_of(changes))
    assert at.partition(": ")[2] == where
    assert what in said


def test_unreadable_file_is_refused(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "missing.yaml", "No such file or directory"),
        (tmp_path, "Is a directory"),
        (tmp_path / "latin.yaml", "it is not UTF-8 text; save it as UTF-8"),
    ):
        (tmp_path / "latin.yaml").write_bytes("site: Tür".encode("latin-1"))
        with pytest.raises(ConfigError) as caught:
            load_site(path)
        [fault] = caught.value.faults
        assert fault.where == str(path)
        assert fault.what.startswith("cannot be read: ")
        assert reason in fault.what


def test_file_is_named_with_its_line(tmp_path: Path) -> None:
    path = write_site(tmp_path, {"fusion.method": "music"})
    with pytest.raises(ConfigError) as caught:
        load_site(path)
    line = line_of(path.read_text(encoding="utf-8"), "fusion.method")
    assert str(caught.value).startswith(f"{path}:{line}: fusion.method: expected one of")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("microphones_m: [[0, 0, 0]]\n", "microphones_m: .*at least 2 items"),
        ("microphones_m: [[0, 0, 0], [0, 0]]\n", "microphones_m.1.2: missing"),
        ("positions: []\n", "positions: unknown key"),
        ("microphones_m: [\n", "cannot be read"),
        ("date: 2026-02-31\n", "cannot be read"),
    ],
)
def test_invalid_geometry_file_is_refused(tmp_path: Path, content: str, what: str) -> None:
    (tmp_path / "array.yaml").write_text(content, encoding="utf-8")
    path = write_site(tmp_path, {f"{ARRAY}.geometry": "array.yaml"})
    with pytest.raises(ConfigError) as caught:
        load_site(path)
    [fault] = caught.value.faults
    assert fault.where.endswith(f": {ARRAY}.geometry")
    assert str(tmp_path / "array.yaml") in fault.what
    assert re.search(what, fault.what), fault.what


def microphones(changes: Changes, directory: Path | None = None) -> FloatArray:
    return (
        site_of({"arrays.south": ..., f"{NODE}.arrays.south": ..., **changes}, directory).array("north").microphones_m
    )


def posed_square(directory: Path, **turn: float) -> FloatArray:
    """Return the microphones' positions relative to the array's origin."""
    (directory / "square.yaml").write_text(yaml.safe_dump({"microphones_m": SQUARE_M}), encoding="utf-8")
    array = {"geometry": "square.yaml", "position_m": [2.0, 2.0, 1.0], "orientation_deg": turn}
    return microphones({ARRAY: array}, directory) - [2.0, 2.0, 1.0]


def test_poses_turn_the_right_way(tmp_path: Path) -> None:
    x, y, z = np.eye(3) * 0.1
    cases: list[tuple[dict[str, float], FloatArray, FloatArray, FloatArray]] = [
        ({}, x, y, z),
        ({"yaw": 90}, y, -x, z),  # counter-clockwise seen from above
        ({"pitch": 90}, -z, y, x),  # lowers the +x end
        ({"roll": 90}, x, z, -y),  # raises the +y end
        ({"yaw": 90, "pitch": 90}, -z, -x, y),  # first pitch, then yaw
        ({"pitch": 90, "roll": 90}, -z, x, -y),  # first roll, then pitch
    ]
    for turn, first, third, fourth in cases:
        turned = posed_square(tmp_path, **turn)
        assert_allclose(turned, np.stack([first, -first, third, fourth]), rtol=0, atol=1e-12, err_msg=str(turn))


def test_absolute_microphones_are_the_posed_ones() -> None:
    pose: Changes = {f"{ARRAY}.orientation_deg": {"yaw": 25, "pitch": -10, "roll": 5}}
    posed_m = microphones(pose)
    absolute_m = microphones({ARRAY: {"microphones_m": posed_m.tolist()}})
    assert_allclose(absolute_m, posed_m, rtol=0, atol=0)
    assert np.abs(microphones({}) - posed_m).max() > 0.01


def test_shapes_have_their_channels_in_order() -> None:
    def shape(**shape: Any) -> FloatArray:
        count = next(iter(shape.values())).get("count", 4)
        array = {"geometry": shape, "position_m": [2.0, 2.0, 1.0]}
        channels = list(range(1, count + 1))
        return microphones({ARRAY: array, f"{NODE}.arrays.north": channels}) - [2.0, 2.0, 1.0]

    tetrahedron = shape(tetrahedron={"edge_m": 0.5})
    distances = np.linalg.norm(tetrahedron[:, None] - tetrahedron[None], axis=2)
    assert_allclose(distances[~np.eye(4, dtype=bool)], 0.5)
    assert tetrahedron[0, 2] > 0.3
    assert_allclose(tetrahedron[1], np.array([0.5 / np.sqrt(3), 0, tetrahedron[2, 2]]), atol=1e-12)
    circle = shape(circle={"radius_m": 0.1, "count": 4})
    assert_allclose(circle, np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]]), atol=1e-12)
    clockwise = shape(circle={"radius_m": 0.1, "count": 4, "clockwise": True})
    assert_allclose(clockwise, circle[[0, 3, 2, 1]], atol=1e-12)
    line = shape(line={"spacing_m": 0.1, "count": 3})
    assert_allclose(line, np.array([[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]]), atol=1e-12)


def test_speed_of_sound_is_given_or_follows_from_the_temperature() -> None:
    assert site_of().c_m_s == 343.0
    assert site_of({"speed_of_sound_m_s": 340.0}).c_m_s == 340.0
    # 331.3 sqrt(1 + 20 / 273.15) = 343.2
    assert site_of({"temperature_c": 20.0}).c_m_s == pytest.approx(343.2, abs=0.05)
    assert site_of({"temperature_c": 0}).c_m_s == pytest.approx(331.3)


def test_search_volume_is_the_room_or_the_bounds() -> None:
    assert search_grid(site_of()).shape == (16, 20, 12)
    box = search_grid(site_of({"grid.bounds_m": [[1, 2], [0, 5], [0, 3]]}))
    assert box.shape == (4, 20, 12)
    plane = search_grid(site_of({"grid.bounds_m": [[0, 4], [0, 5], [1.2, 1.2]]}))
    assert plane.shape == (16, 20, 1)
    assert plane.free_axes == (0, 1)
    assert plane.points_m()[:, 2] == pytest.approx(1.2)


def test_array_may_have_a_band_of_its_own() -> None:
    site = site_of({f"{ARRAY}.band_hz": [200, 3000]})
    assert site.array("north").band_hz == (200.0, 3000.0)
    assert site.array("south").band_hz == (100.0, 6000.0)


def test_zones_hold_positions_inside_and_on_their_surface() -> None:
    site = site_of({"zones.all": {"bounds_m": [[0, 4], [0, 5], [0, 3]]}})
    assert site.zones_of([0.5, 0.5, 1.0]) == ["door", "all"]
    assert site.zones_of([1.0, 1.0, 2.5]) == ["door", "all"]
    assert site.zones_of([1.01, 1.0, 2.5]) == ["all"]
    assert site.zones_of([-0.1, 1.0, 2.5]) == []
    assert site.zones_of(None) == []


CEILING = [[x, y, 2.9] for x, y in [(0.1, 0.1), (5, 0.1), (9.9, 0.1), (9.9, 4), (9.9, 7.9), (0.1, 7.9)]]
HALL: Changes = {
    "room.size_m": [10.0, 8.0, 3.0],
    "grid.spacing_m": 0.1,
    "arrays": {"ceiling": {"microphones_m": CEILING}},
    "nodes": {},
    "zones": {},
}
"""Six microphones around a whole ceiling as one array: a spacing of 0.1 m is many periods of 6 kHz."""


def test_array_too_wide_for_the_grid_is_warned_about() -> None:
    [said] = site_of(HALL).warnings
    found = re.fullmatch(
        r"grid.spacing_m: array 'ceiling' is 12.5 m wide: up to 6000 Hz needs a spacing of about (\S+) m, got 0.1; "
        "positions may be wrong: lower the array's band_hz, or make arrays smaller",
        said,
    )
    assert found is not None
    # 1 / (2 f |grad tau|) over a cell's half diagonal; |grad tau| = 2 sin(angle / 2) / c, and most pairs are seen
    # under more than 60 and less than 180 degrees: from c / (sqrt(3) f) = 0.033 to half of that, 0.016 m
    assert 0.016 < float(found[1]) < 0.033
    assert "warnings" not in site_of(HALL).model_dump()


def test_suggested_band_removes_the_warning() -> None:
    assert site_of({**HALL, "arrays": {"ceiling": {"microphones_m": CEILING, "band_hz": [100, 1500]}}}).warnings == ()
    assert site_of({**HALL, "arrays": {"ceiling": {"microphones_m": CEILING, "band_hz": [4000, 16000]}}}).warnings == ()


def test_joint_array_too_wide_for_the_grid_is_warned_about() -> None:
    [said] = site_of({JOINT: ["north", "south"]}).warnings
    assert re.search("array 'both' is 2.8 m wide: .*; positions may be wrong: .* or take joint.both away", said)


def test_usual_arrays_cause_no_warning() -> None:
    half_a_metre = {"geometry": {"tetrahedron": {"edge_m": 0.5}}}
    assert site_of({"grid.spacing_m": 0.1, f"{ARRAY}.geometry": half_a_metre["geometry"]}).warnings == ()
    assert site_of().warnings == ()


def test_array_may_be_on_a_node_or_on_none() -> None:
    site = site_of({f"{NODE}.arrays.south": ...})
    assert site.node_of("north") == "lab-pc"
    assert site.node_of("south") is None


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp://*:5570",
        "tcp://127.0.0.1:*",
        "tcp://[::1]:1",
        "tcp://[::]:*",
        "tcp://[fe80::1%eth0]:1",
        "ipc:///run/livessl",
    ],
)
def test_valid_endpoints_are_accepted(endpoint: str) -> None:
    assert site_of({"server.bind": endpoint}).server.bind == endpoint


def test_array_of_sixteen_channels_is_accepted() -> None:
    positions = [[1 + 0.1 * k, 1.0, 1.0] for k in range(16)]
    changes: Changes = {ARRAY: {"microphones_m": positions}, f"{NODE}.arrays.north": list(range(9, 25))}
    assert site_of(changes).array("north").microphones_m.shape == (16, 3)


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.dates()
    | st.binary(max_size=4)
    | st.sampled_from([0, -1, 1e-320, 1e308, 10**400, "tcp://x:1", "wav", "scene", "\ud800"])
)
DATA = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(SCALARS, inner, max_size=4),
    max_leaves=8,
)


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        found += places(value, (*path, key))
    return found


WHOLE = small(
    {
        "temperature_c": 20.0,
        "activity": {"threshold": 0.1, "floor_factor": 4.0, "min_level_dbfs": -90.0},
        "fusion": {"method": "srp-phat", "min_arrays": 1},
        "grid": {"spacing_m": 0.5, "bounds_m": [[0, 4], [0, 5], [0, 3]]},
        "arrays.north.orientation_deg": {"yaw": 10.0},
        "arrays.west": {"microphones_m": [[1, 1, 1], [1, 2, 1]], "band_hz": [100, 5000]},
        "nodes.player": {"device": {"type": "scene", "rt60_s": 0.3}, "arrays": {"west": [1, 2]}},
        JOINT: ["north", "south"],
    }
)


@given(DATA)
@settings(max_examples=100, deadline=None)
def test_any_data_is_a_site_or_a_config_error(data: Any) -> None:
    with suppress(ConfigError):
        parse_site(yaml.safe_dump(data, allow_unicode=False))


@given(st.sampled_from(places(WHOLE)), DATA, st.sampled_from(places(WHOLE)), SCALARS)
@settings(max_examples=120, suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_any_value_anywhere_is_fine_or_a_config_error(
    place: tuple[Any, ...], value: Any, other: tuple[Any, ...], scalar: Any
) -> None:
    data = yaml.safe_load(yaml.safe_dump(WHOLE))
    for path, new in ((place, value), (other, scalar)):
        holder = data
        with suppress(KeyError, IndexError, TypeError):  # the first change may have removed the second's place
            for key in path[:-1]:
                holder = holder[key]
            holder[path[-1]] = new
    with suppress(ConfigError):
        assert_usable(parse_site(yaml.safe_dump(data)))


@given(st.text())
@settings(deadline=None)
def test_any_text_is_a_site_or_a_config_error(text: str) -> None:
    with suppress(ConfigError):
        parse_site(text)


def assert_usable(site: Site) -> None:
    assert search_grid(site).size > 0
    assert activity_parameters(site).min_power >= 0
    assert site.c_m_s > 0
    assert len(site.specs) == len(site.arrays)
    assert {name for spec in site.processed for name in site.members(spec.name)} == set(site.arrays)
