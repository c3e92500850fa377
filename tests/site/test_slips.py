"""Slips of the hand in a site file: units, decimal commas, names without quotes, copied arrays, look-alike places."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.errors import ConfigError
from livessl.site.load import parse_site
from small_site import Changes, site_of

HEAD = "site: t\nroom: {size_m: [8.0, 10.0, 4.0]}\n"
TETRAHEDRON = "geometry: {tetrahedron: {edge_m: 0.5}}"


def faults_of(text: str) -> list[str]:
    """The faults of a site file, each with its line."""
    with pytest.raises(ConfigError) as raised:
        parse_site(text, "f")
    return [str(fault) for fault in raised.value.faults]


def warnings_of(changes: Changes) -> tuple[str, ...]:
    return site_of(changes).warnings


def north(line: str) -> str:
    return f"{HEAD}arrays:\n  north: {{{line}}}\n"


@pytest.mark.parametrize("name", ["no", "on", "Yes", "1", "2.5", "0x10", "2024-01-31", "null", "~"])
def test_names_without_quotes_are_named_with_the_cure(name: str) -> None:
    text = f"{HEAD}arrays:\n  {name}: {{{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]}}\n"
    said = [fault for fault in faults_of(text) if "quotes" in fault]
    assert len(said) == 1
    assert said[0].startswith(f"f:4: arrays.{name}: expected a name, got {name} without quotes")
    assert said[0].endswith(f'put the name in quotes: "{name}"')
    if name != "~":  # which is no name with quotes either
        quoted = text.replace(f"{name}: {{geo", f'"{name}": {{geo')
        assert list(parse_site(quoted).arrays) == [name]


def test_the_rest_of_an_entry_with_such_a_name_is_checked() -> None:
    said = faults_of(f"{HEAD}arrays:\n  no: {{{TETRAHEDRON}, positon_m: [4.0, 2.5, 2.0]}}\n")
    assert [fault.split(": ")[1] for fault in said] == ["arrays.no", "arrays.no.positon_m"]


def test_one_mistake_is_one_fault_although_an_alias_repeats_it() -> None:
    said = faults_of(
        f"{HEAD}arrays:\n  a: &a {{microphones_m: [[1, 1, 1], [1, 2, 1]], no: 1}}\n  b: {{<<: *a, wav_offset_s: 1}}\n"
    )
    assert sum("quotes" in fault for fault in said) == 1


def test_a_text_without_quotes_is_named_with_the_cure() -> None:
    text = f"{north(f'{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]')}nodes:\n  pc:\n    server: tcp://127.0.0.1:5570\n"
    said = faults_of(f"{text}    device: {{name: no, sample_rate_hz: 48000}}\n    arrays: {{north: [1, 2, 3, 4]}}\n")
    assert said == ["f:8: nodes.pc.device.name: expected a text, got False; put it in quotes"]


@pytest.mark.parametrize(
    ("line", "where"),
    [
        (f"{TETRAHEDRON}, position_m: [4,0, 2,5, 2,0]", "arrays.north.position_m"),
        (f"{TETRAHEDRON}, position_m: [4, 2,5, 2]", "arrays.north.position_m"),
        (f"{TETRAHEDRON}, position_m: [4.0, 2,5, 2]", "arrays.north.position_m"),
        ("microphones_m: [[1, 1, 1], [0,5, 1, 1], [2, 1, 1], [2, 2, 1]]", "arrays.north.microphones_m.1"),
        ("geometry: {tetrahedron: {edge_m: 0,5}}, position_m: [4, 2, 2]", "arrays.north.geometry.tetrahedron.edge_m"),
    ],
)
def test_decimal_commas_are_named(line: str, where: str) -> None:
    [said] = faults_of(north(line))
    assert said.startswith(f"f:4: {where}: expected ")
    assert "decimal point" in said


@settings(max_examples=15, deadline=None)
@given(whole=st.integers(-20, 40), decimals=st.integers(0, 99))
def test_a_number_with_a_decimal_comma_is_shown_with_a_point(whole: int, decimals: int) -> None:
    line = f"{TETRAHEDRON}, position_m: [4, 2, 2]"
    [said] = faults_of(f"temperature_c: {whole},{decimals}\n{north(line)}")
    assert said == (f"f:1: temperature_c: expected a decimal point, got {whole},{decimals}; write {whole}.{decimals}")


def test_lists_that_are_too_long_without_commas_keep_their_sentence() -> None:
    [said] = faults_of(north(f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.5, 2.0]"))
    assert said.endswith("expected at most 3 items, got 4")


@pytest.mark.parametrize(("unit", "scale"), [("millimetres", 1000), ("centimetres", 100)])
def test_a_room_in_another_unit_is_recognized(unit: str, scale: int) -> None:
    size_m = [scale * length for length in (8, 10, 4)]
    text = north(f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]").replace("[8.0, 10.0, 4.0]", str(size_m))
    text += "grid: {spacing_m: 10}\n"
    if unit == "millimetres":
        said = faults_of(text)
    else:
        said = [warning for warning in parse_site(text).warnings if warning.startswith("room")]
    assert len(said) == 1
    assert f"did you mean [8, 10, 4], from {unit}?" in said[0]


def test_a_yard_is_no_room_in_centimetres() -> None:
    text = north(f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]").replace("[8.0, 10.0, 4.0]", "[400, 400, 10]")
    assert not any("centimetres" in warning for warning in parse_site(f"{text}grid: {{spacing_m: 0.5}}\n").warnings)


def test_an_array_in_millimetres_in_a_room_in_metres_is_recognized() -> None:
    [said] = faults_of(north("geometry: {tetrahedron: {edge_m: 500}}, position_m: [4.0, 2.5, 2.0]"))
    assert said.endswith("give metres, not millimetres")


@pytest.mark.parametrize(
    ("given_c", "meant"),
    [
        (68, "20.0, from Fahrenheit"),
        (50, "10.0, from Fahrenheit"),
        (95, "35.0, from Fahrenheit"),
        (293.15, "20.0, from kelvin"),
    ],
)
def test_a_temperature_in_another_unit_is_recognized(given_c: float, meant: str) -> None:
    line = f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]"
    text = f"temperature_c: {given_c}\n{north(line)}"
    [said] = parse_site(text).warnings if given_c < 80 else faults_of(text)
    assert f"did you mean {meant}?" in said


@pytest.mark.parametrize("celsius", [-20, 0, 20, 45])
def test_usual_temperatures_cause_no_warning(celsius: float) -> None:
    assert warnings_of({"temperature_c": celsius}) == ()


def test_two_arrays_at_one_place_are_a_fault() -> None:
    text = f"{HEAD}arrays:\n  north: &a {{{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]}}\n  south: *a\n"
    assert faults_of(text) == [
        "f:5: arrays.south: expected arrays at different places, 'north' and 'south' are both at (4, 2.5, 2); "
        "correct one of them"
    ]


def test_arrays_that_share_one_microphones_place_are_a_fault() -> None:
    turned = f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0], orientation_deg: {{yaw: 60}}"
    [said] = faults_of(f"{north(f'{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]')}  south: {{{turned}}}\n")
    assert "microphone 1 of 'north' and microphone 1 of 'south' are at one place" in said


def test_arrays_within_each_other_are_warned_about() -> None:
    upside_down = f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0], orientation_deg: {{roll: 180}}"
    site = parse_site(f"{north(f'{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]')}  south: {{{upside_down}}}\n")
    assert any("'north' and 'south' are 0.00 m apart and measure one direction" in said for said in site.warnings)


def circle(position_m: Sequence[float], **orientation_deg: float) -> Changes:
    shape = {"circle": {"radius_m": 0.05, "count": 4}}
    return {"geometry": shape, "position_m": list(position_m), "orientation_deg": orientation_deg}


BARE: Changes = {"nodes": {}, "zones": {}}


@settings(max_examples=10, deadline=None)
@given(height_m=st.floats(0.9, 1.7), yaw=st.floats(0.0, 90.0))
def test_coplanar_arrays_are_warned_about_with_their_plane(height_m: float, yaw: float) -> None:
    arrays = {"north": circle([2.0, 3.5, height_m]), "south": circle([2.0, 1.5, height_m], yaw=yaw)}
    [said] = warnings_of({**BARE, "arrays": arrays})
    assert said.startswith(f"arrays: all microphones lie in the plane z = {height_m:.2f} m: in ")
    assert "mirror image cannot be told apart" in said
    one_side = {"grid.bounds_m": [[0, 4], [0, 5], [0, height_m]]}
    assert warnings_of({**BARE, **one_side, "arrays": arrays}) == ()


@pytest.mark.parametrize("turned", [{"pitch": 90}, {"roll": 40}])
def test_arrays_in_different_planes_cause_no_warning(turned: dict[str, float]) -> None:
    arrays = {"north": circle([2.0, 3.5, 1.3]), "south": circle([2.0, 1.5, 1.3], **turned)}
    assert warnings_of({**BARE, "arrays": arrays}) == ()


def test_one_array_off_the_plane_of_the_others_prevents_the_warning() -> None:
    tetrahedron = {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": [1.0, 2.5, 1.3]}
    arrays = {"north": circle([2.0, 3.5, 1.3]), "south": circle([2.0, 1.5, 1.3]), "west": tetrahedron}
    assert warnings_of({**BARE, "arrays": arrays}) == ()


def test_a_line_is_warned_about_also_in_a_search_plane() -> None:
    line = {"geometry": {"line": {"spacing_m": 0.05, "count": 4}}, "position_m": [2.0, 2.5, 1.3]}
    [said] = warnings_of({**BARE, "arrays": {"north": line}})
    assert "all microphones lie on one line along x" in said
    flat = {"grid.bounds_m": [[0, 4], [0, 5], [1.3, 1.3]]}
    [said] = warnings_of({**BARE, **flat, "arrays": {"north": line}})
    assert "all microphones lie on one line along x" in said
    front = {"grid.bounds_m": [[0, 4], [2.5, 5], [1.3, 1.3]]}
    assert warnings_of({**BARE, **front, "arrays": {"north": line}}) == ()


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("size_m:", "size:"),
        ("size_m:", "sise_m:"),
        ("edge_m:", "edge:"),
        ("edge_m:", "egde_m:"),
        ("edge_m:", "edge_mm:"),
        ("room:", "rooms:"),
        ("arrays:", "arays:"),
    ],
)
def test_a_misspelt_key_is_one_fault_although_the_right_one_is_missing(right: str, wrong: str) -> None:
    text = north(f"{TETRAHEDRON}, position_m: [4.0, 2.5, 2.0]")
    (said,) = faults_of(text.replace(right, wrong))
    assert f"did you mean '{right[:-1]}'?" in said


def test_a_key_that_is_missing_beside_another_slip_is_named() -> None:
    said = faults_of(north("geometry: {tetrahedron: {colour: 3}}, position_m: [4.0, 2.5, 2.0]"))
    assert any("edge_m: missing" in fault for fault in said)
    assert any("unknown key 'colour'" in fault for fault in said)
