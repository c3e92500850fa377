"""The site file: each fault is one sentence with its line and place, and all faults are reported at once."""

from __future__ import annotations

import re

import pytest

from site_faults import ARRAY, JOINT, NODE, faults_of, line_of
from small_site import SMALL, Changes, site_of, text_of

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
