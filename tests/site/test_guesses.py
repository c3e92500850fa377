"""What `check` takes likely mistakes for: units, axes, counting, addresses and keys; and when it says nothing."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from livessl.errors import ConfigError
from livessl.site.load import parse_site
from livessl.site.models import Site
from small_site import SMALL, Changes, site_of, text_of

NORTH = "arrays.north"
NODE = "nodes.lab-pc"
inside_m = st.tuples(st.floats(0.5, 3.5), st.floats(0.5, 4.5), st.floats(0.6, 2.4)).map(
    lambda place: [round(length, 2) for length in place]
)


def said_of(changes: Changes) -> list[str]:
    """The sentences of the faults, or else the warnings, of the small site with changes."""
    try:
        return list(site_of(changes).warnings)
    except ConfigError as error:
        return [fault.what for fault in error.faults]


def shown(numbers: list[float]) -> str:
    return "[" + ", ".join(f"{number:g}" for number in numbers) + "]"


@settings(max_examples=25, deadline=None)
@given(place_m=inside_m, unit=st.sampled_from([(100, "centimetres"), (1000, "millimetres")]))
def test_position_in_another_unit_is_shown_in_metres(place_m: list[float], unit: tuple[int, str]) -> None:
    assume(max(place_m) > 0.6)
    per_metre, name = unit
    [said] = said_of({f"{NORTH}.position_m": [per_metre * length for length in place_m]})
    assert said.endswith(f"; did you mean position_m: {shown(place_m)}, from {name}?")


@settings(max_examples=25, deadline=None)
@given(y=st.floats(4.3, 4.7), x=st.floats(0.5, 3.5), z=st.floats(0.6, 2.4))
def test_swapped_axes_are_shown_in_the_right_order(x: float, y: float, z: float) -> None:
    """The room is 4 m long and 5 m wide, so that a y beyond 4 m is no x."""
    x, y, z = (round(length, 2) for length in (x, y, z))
    [said] = said_of({f"{NORTH}.position_m": [y, x, z]})
    assert said.endswith(f"; did you mean position_m: {shown([x, y, z])}, with x and y swapped?")


def test_axes_of_explicit_microphones_are_swapped_back() -> None:
    swapped = [[4.5, 1.0, 1.0], [4.5, 1.2, 1.0], [4.7, 1.0, 1.0], [4.5, 1.0, 1.2]]
    [said] = said_of({NORTH: {"microphones_m": swapped}})
    meant = "[" + ", ".join(shown([y, x, z]) for x, y, z in swapped) + "]"
    assert said.endswith(f"did you mean microphones_m: {meant}, with x and y swapped?")


def test_position_from_the_middle_of_the_room_is_moved_to_its_corner() -> None:
    [said] = said_of({f"{NORTH}.position_m": [-1.0, 1.5, 1.4]})
    assert "did you mean position_m: [1, 4, 1.4]? Positions count from a corner of the room" in said


def test_array_that_only_sticks_through_a_wall_is_no_swap() -> None:
    [said] = said_of({f"{NORTH}.position_m": [3.95, 1.3, 1.4]})
    assert said.endswith("; correct the array's position or room.size_m")


@pytest.mark.parametrize(("edge_m", "unit"), [(300, "millimetres"), (30, "centimetres")])
def test_size_of_an_array_in_another_unit_is_recognized(edge_m: float, unit: str) -> None:
    [said] = said_of({f"{NORTH}.geometry": {"tetrahedron": {"edge_m": edge_m}}})
    assert said.endswith(f"its size is {edge_m} m; give metres, not {unit}")


@settings(max_examples=20, deadline=None)
@given(degrees=st.sampled_from([45, 90, 135, 180, 225, 270, 315, -45, -90, -135, -180]), decimals=st.integers(2, 6))
def test_common_angles_in_radians_are_recognized(degrees: int, decimals: int) -> None:
    radians = round(math.radians(degrees), decimals)
    assume(len(repr(radians).partition(".")[2]) > 1)
    [said] = said_of({f"{NORTH}.orientation_deg": {"yaw": radians}})
    assert (
        said == f"{NORTH}.orientation_deg.yaw: {radians:g} degrees is unlikely; did you mean {degrees}, from radians?"
    )


@settings(max_examples=20, deadline=None)
@given(tenths=st.integers(-3600, 3600))
def test_angles_in_degrees_with_one_decimal_are_not_doubted(tenths: int) -> None:
    assert said_of({f"{NORTH}.orientation_deg": {"yaw": tenths / 10}}) == []


@pytest.mark.parametrize("degrees", [90.0, 1.25, 0.5, 2.75, 3.5, 6.0, 12.57, 87.27])
def test_other_angles_are_not_doubted(degrees: float) -> None:
    assert said_of({f"{NORTH}.orientation_deg": {"pitch": degrees, "yaw": 10.0}}) == []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"speed_of_sound_m_s": 1125}, "not that of air; did you mean 342.9, from feet per second?"),
        ({"speed_of_sound_m_s": 1235}, "not that of air; did you mean 343.1, from kilometres per hour?"),
        ({"speed_of_sound_m_s": 767}, "not that of air; did you mean 342.9, from miles per hour?"),
        ({"grid.spacing_m": 5}, "grid points 5 m apart are unlikely; did you mean 0.05, from centimetres?"),
        ({"grid.spacing_m": 50}, "grid points 50 m apart are unlikely; did you mean 0.05, from millimetres?"),
        ({"grid.spacing_m": 100}, "grid points 100 m apart are unlikely; did you mean 0.1, from millimetres?"),
        (
            {"zones.door.bounds_m": [[0, 1000], [0, 1000], [0, 2500]]},
            "zones.door.bounds_m: 2500 m is far outside the room; did you mean bounds_m: [[0, 1], [0, 1], [0, 2.5]]",
        ),
        (
            {"zones.door.bounds_m": [[4.5, 4.9], [0, 1], [0, 2]]},
            "got [4.5, 4.9]; did you mean bounds_m: [[0, 1], [4.5, 4.9], [0, 2]], with x and y swapped?",
        ),
        ({"zones.door.bounds_m": [[7, 8], [7, 8], [0, 2]]}, "got [7, 8]; correct it or room.size_m"),
        ({f"{NODE}.device.sample_rate_hz": 48}, "did you mean sample_rate_hz: 48000, from kilohertz?"),
        ({f"{NODE}.device.sample_rate_hz": 8000}, "lower band_hz or raise sample_rate_hz"),
        ({"band_hz": [0.1, 6]}, "a band up to 6 Hz is unlikely; did you mean [100, 6000], from kilohertz?"),
        ({f"{NODE}.arrays": {"north": [1, 2, 3, 4]}}, "arrays.south: no node captures it; add its channels"),
        (
            {f"{NODE}.arrays": {"north": [0, 1, 2, 3], "south": [4, 5, 6, 7]}},
            "channels count from 1; did you mean {north: [1, 2, 3, 4], south: [5, 6, 7, 8]}?",
        ),
        ({f"{NODE}.arrays.north": [-1, 1, 2, 3]}, "expected channel numbers from 1 on, got -1; channels count from 1"),
        (
            {f"{NODE}.device.name": "ReSpeaker 4 Mic Array (UAC1.0)"},
            "the microphones of ReSpeaker 4 Mic are 2 to 5; the other channels are its processed sound (1) and",
        ),
        ({f"{NODE}.device.name": "UMC404HD"}, "south: UMC404HD has 4 inputs, got 8; correct the channels"),
        (
            {"server.bind": "tcp://127.0.0.1:5571"},
            "nodes.lab-pc.server: port 5570 differs from that of server.bind, 5571; did you mean tcp://127.0.0.1:5571?",
        ),
        (
            {"server.bind": "tcp://127.0.0.1:5571", "server.http.port": 5570},
            "port 5570, that of the dashboard, differs from that of server.bind, 5571",
        ),
        (
            {"server.bind": "tcp://127.0.0.1:5570", f"{NODE}.server": "tcp://10.0.0.5:5570"},
            "10.0.0.5 is another machine, but server.bind tcp://127.0.0.1:5570 listens only to its own; did you mean",
        ),
        (
            {f"{NODE}.arrays.Norht": [9, 10, 11, 12]},
            "expected one of the arrays north, south, got 'Norht'; did you mean",
        ),
        ({f"{NODE}.sample_rate_hz": 48000}, "unknown key 'sample_rate_hz'; it belongs to nodes.NAME.device"),
        ({"bounds_m": []}, "unknown key 'bounds_m'; it belongs to grid or zones.NAME"),
        ({"SITE": "x"}, "unknown key 'SITE'; did you mean 'site'?"),
        (
            {f"{NORTH}.geometry": {"tetrahedron": {"edge_m": 0.3, "edge_mm": 300}}},
            "unknown key 'edge_mm'; did you mean 'edge_m'? Convert its value from millimetres",
        ),
        ({"temperature_f": 70}, "did you mean 'temperature_c'? Convert its value from degrees Fahrenheit"),
        (
            {f"{NORTH}.orientation_rad": {"yaw": 1}},
            "unknown key 'orientation_rad'; did you mean 'orientation_deg'? Convert its value from radians",
        ),
    ],
)
def test_likely_mistake_is_named_with_what_was_meant(changes: Changes, expected: str) -> None:
    said = said_of(changes)
    assert any(expected in sentence for sentence in said), said


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"speed_of_sound_m_s": 331.0},
        {"speed_of_sound_m_s": 1480.0},
        {"grid.spacing_m": 0.5, "arrays.north.band_hz": [100, 1000], "arrays.south.band_hz": [100, 1000]},
        {"nodes": {}},
        {"server.bind": "tcp://127.0.0.1:5570"},
        {"server.bind": "tcp://*:5570", f"{NODE}.server": "tcp://server.example:5570"},
        {f"{NODE}.server": "ipc:///run/livessl"},
        {"zones.door.bounds_m": [[-1, 5], [-1, 6], [-1, 4]]},
        {f"{NODE}.device.name": "UMC1820: USB Audio (hw:2,0)"},
    ],
)
def test_sound_settings_cause_no_guess(changes: Changes) -> None:
    assert said_of(changes) == []


@settings(max_examples=25, deadline=None)
@given(length_m=st.floats(100.0, 2000.0), points=st.integers(50, 200))
def test_a_coarse_grid_is_usual_in_a_yard(length_m: float, points: int) -> None:
    """From a hundred points along the longest edge; before, centimetres are more likely."""
    spacing_m = math.ceil(length_m / points)
    changes: Changes = {"room.size_m": [length_m, length_m / 2.0, 10.0], "grid.spacing_m": spacing_m}
    said = [one for one in said_of(changes) if one.startswith("grid.spacing_m: grid points")]
    assert bool(said) == (100 * spacing_m > length_m)


def test_what_a_guess_says_is_valid_when_it_is_written() -> None:
    """The cure of a fault can be pasted into the file."""
    text = text_of({f"{NORTH}.position_m": [1900, 1300, 1400]})
    with pytest.raises(ConfigError) as raised:
        parse_site(text)
    found = re.search(r"position_m: (\[.*?\])", str(raised.value))
    assert found is not None
    mended: Site = site_of({f"{NORTH}.position_m": [float(x) for x in found[1].strip("[]").split(",")]})
    assert mended.arrays["north"].position_m == tuple(SMALL["arrays"]["north"]["position_m"])
