"""`livessl init`: what it writes is a valid site, and it neither blocks nor overwrites."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cli.command_runs import Run
from livessl.capture.portaudio import InputDevice
from livessl.errors import DeviceError
from livessl.lab.frame_drawing import PAGE_MM, drawing
from livessl.site.draft import proposed_pose, searchable, shape_m, site_text
from livessl.site.draft_nodes import nodes_of
from livessl.site.draft_parts import SIZE_M, Draft, DraftArray, DraftNode
from livessl.site.load import load_site, parse_site
from small_site import HANG_S

UMC = ("--yes", "--interface", "UMC1820")
kinds = st.sampled_from(sorted(SIZE_M))
rooms_m = st.tuples(st.floats(3.0, 20.0), st.floats(3.0, 20.0), st.floats(2.2, 6.0))


@pytest.fixture
def connected(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A function that sets the interfaces that are connected to the machine."""

    def connect(*devices: InputDevice) -> None:
        monkeypatch.setattr("livessl.capture.input_search.list_inputs", lambda: list(devices))

    connect()
    return connect


def arrays_of(kind: str, size_m: float, room_m: tuple[float, float, float], count: int) -> tuple[DraftArray, ...]:
    return tuple(
        DraftArray(f"a{index}", kind, size_m, 4, *proposed_pose(room_m, kind, index, count)) for index in range(count)
    )


@settings(max_examples=12, deadline=None)
@given(kind=kinds, room_m=rooms_m, count=st.integers(1, 4))
def test_proposed_site_is_valid_and_causes_no_warning(
    kind: str, room_m: tuple[float, float, float], count: int
) -> None:
    arrays = arrays_of(kind, SIZE_M[kind], room_m, count)
    draft = Draft("lab", room_m, 20.0, arrays, nodes_of(arrays, ["some interface"], {}))
    site = parse_site(site_text(searchable(draft)))
    assert site.warnings == ()
    for array, spec in zip(arrays, site.specs, strict=True):
        assert np.linalg.norm(spec.centre_m - array.centre_m) < 1e-3
        built, meant = (
            np.linalg.norm(places - places.mean(axis=0), axis=1) for places in (spec.microphones_m, shape_m(array))
        )
        assert np.allclose(built, meant, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(
    names=st.lists(st.from_regex(r"[A-Za-z0-9._-]{1,12}", fullmatch=True), min_size=2, max_size=2, unique=True).filter(
        lambda names: "fused" not in names
    ),
    interface=st.text(st.characters(categories=["L", "N", "P", "Zs"]), min_size=1, max_size=20),
)
def test_names_are_read_back_as_they_were_given(names: list[str], interface: str) -> None:
    arrays = tuple(
        DraftArray(name, "tetrahedron", 0.5, 4, (1.0 + 3 * index, 2.0, 1.2), 0.0) for index, name in enumerate(names)
    )
    node = DraftNode(
        "lab-pc",
        interface,
        48000.0,
        {name: (4 * k + 1, 4 * k + 2, 4 * k + 3, 4 * k + 4) for k, name in enumerate(names)},
    )
    site = parse_site(site_text(Draft("lab", (6.0, 5.0, 2.7), 20.0, arrays, (node,))))
    assert list(site.arrays) == names
    assert list(site.nodes["lab-pc"].arrays) == names
    assert site.nodes["lab-pc"].device.name == interface  # type: ignore[union-attr]


def test_flags_determine_the_site(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    arrays = ("--array", "north=tetrahedron:0.4@4,2.5,1.5@90", "--array", "south=line:0.1x6@4,7.5,1.2")
    options = (
        "--room",
        "8,10,4",
        "--temperature",
        "24",
        "--name",
        "hall",
        "--interface",
        "my interface",
        "--rate",
        96000,
    )
    done = run("init", path, "--yes", *options, *arrays, "--channels", "south=9,10,11,12,13,14")
    assert done.code == 0
    assert f"next: livessl check {path}" in done.out
    site = load_site(path)
    assert (site.site, site.room.size_m, site.temperature_c) == ("hall", (8.0, 10.0, 4.0), 24.0)
    assert site.nodes["lab-pc"].device.sample_rate_hz == 96000
    assert site.nodes["lab-pc"].arrays == {"north": [1, 2, 3, 4], "south": [9, 10, 11, 12, 13, 14]}
    north, south = site.specs
    assert north.microphones_m[1] == pytest.approx([4.0, 2.5 + 0.4 / 3**0.5, 1.5 - 0.1 * (2 / 3) ** 0.5], abs=1e-4)
    assert south.aperture_m == pytest.approx(0.5)
    checked = run("check", path)
    assert (checked.code, checked.err) == (0, "")


@pytest.mark.parametrize(
    ("interfaces", "count", "nodes"),
    [
        (["UMC1820"], 2, {"lab-pc": {"array-1": [1, 2, 3, 4], "array-2": [5, 6, 7, 8]}}),
        (["UMC404HD"], 2, {"lab-pc-1": {"array-1": [1, 2, 3, 4]}, "lab-pc-2": {"array-2": [1, 2, 3, 4]}}),
        (["UMC1820", "UMC1820"], 2, {"lab-pc-1": {"array-1": [1, 2, 3, 4]}, "lab-pc-2": {"array-2": [1, 2, 3, 4]}}),
        (["ReSpeaker 4 Mic Array"], 1, {"lab-pc": {"array-1": [2, 3, 4, 5]}}),
        (["XVF3800", "UMC404HD"], 2, {"lab-pc-1": {"array-1": [3, 4, 5, 6]}, "lab-pc-2": {"array-2": [1, 2, 3, 4]}}),
    ],
)
def test_arrays_are_dealt_to_the_inputs_of_known_interfaces(
    run: Run, tmp_path: Path, interfaces: list[str], count: int, nodes: dict[str, dict[str, list[int]]]
) -> None:
    path = tmp_path / "site.yaml"
    assert run("init", path, "--yes", "--arrays", count, *(f"--interface={name}" for name in interfaces)).code == 0
    site = load_site(path)
    assert {name: node.arrays for name, node in site.nodes.items()} == nodes
    assert site.warnings == ()


def test_connected_interface_is_proposed(run: Run, tmp_path: Path, connected: Callable[..., None]) -> None:
    connected(
        InputDevice("HDA Intel: ALC892 (hw:0,0)", "ALSA", 2, 44100.0),
        InputDevice("Zoom F8: USB Audio (hw:1,0)", "ALSA", 8, 48000.0),
    )
    assert run("init", tmp_path / "site.yaml", "--yes").code == 0
    assert load_site(tmp_path / "site.yaml").nodes["lab-pc"].device.name == "Zoom F8: USB Audio"  # type: ignore[union-attr]


def test_machine_without_portaudio_gets_a_site_file(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> list[InputDevice]:
        raise DeviceError("no PortAudio")

    monkeypatch.setattr("livessl.capture.input_search.list_inputs", missing)
    assert run("init", tmp_path / "site.yaml", "--yes").code == 0
    assert load_site(tmp_path / "site.yaml").warnings == ()


def test_existing_file_is_replaced_only_on_request(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text("mine", encoding="utf-8")
    done = run("init", path, *UMC)
    assert done.code == 2
    assert (
        done.err == f"livessl: error: {path}: expected a new file, but it exists; give another name, or add --force\n"
    )
    assert path.read_text(encoding="utf-8") == "mine"
    assert run("init", path, *UMC, "--force").code == 0
    assert load_site(path).site == "lab"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--array", "north"), "expected NAME=KIND:SIZE@X,Y,Z@YAW, such as"),
        (("--array", "north=cube:1"), "expected an array of kind tetrahedron, square, line, circle, got 'cube'"),
        (("--array", "north=square:0.5x5"), "expected square:SIZE, which has 4 microphones, got"),
        (("--array", "n=line:0.1@1,2"), "expected x,y,z in metres"),
        (("--array", "n=line:0.1", "--array", "n=line:0.1"), "expected each array once, got 'n' twice"),
        (
            ("--array", "n=line", "--array", "s=line", "--arrays", "1"),
            "expected at least the 2 arrays of --array, got 1",
        ),
        (("--room", "8,0,4"), "expected three lengths above 0"),
        (("--room", "8000,10000,4000"), "did you mean [8, 10, 4], from millimetres?"),
        (("--array", "n=tetrahedron@9,1,1"), "is outside the room"),
        (
            ("--array", "n=line:0.02x6", "--interface", "UMC404HD"),
            "at most 4 microphones, the inputs of UMC404HD, got 6",
        ),
        (("--channels", "west=1,2,3,4"), "expected one of the arrays array-1, array-2, got 'west'"),
        (
            ("--interface", "a", "--interface", "b", "--interface", "c"),
            "at most one interface for each array, got 3 for 2",
        ),
        (("--name", "our lab"), "expected a name of letters"),
    ],
)
def test_wrong_flags_write_nothing(run: Run, tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    given = () if "--interface" in options else ("--interface", "UMC1820")
    done = run("init", tmp_path / "site.yaml", "--yes", *given, *options)
    assert done.code == 2
    assert message in done.err
    assert list(tmp_path.iterdir()) == []


def test_input_that_is_no_terminal_is_not_read(tmp_path: Path) -> None:
    """The pipe stays open and empty: a command that read from it would wait for ever."""
    reader, writer = os.pipe()
    command = [sys.executable, "-m", "livessl", "init", str(tmp_path / "site.yaml"), "--interface", "UMC1820"]
    try:
        done = subprocess.run(command, stdin=reader, capture_output=True, text=True, timeout=HANG_S, check=False)
    finally:
        os.close(reader)
        os.close(writer)
    assert done.returncode == 0, done.stderr
    assert "defaults are used" in done.stderr
    assert load_site(tmp_path / "site.yaml").warnings == ()


def in_terminal(path: Path, answers: str) -> tuple[int, str]:
    """Run the command in a terminal in which somebody types; return its exit code and what it printed."""
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "livessl", "init", str(path), "--interface", "UMC1820"]
    os.write(master, answers.encode())
    try:
        done = subprocess.run(command, stdin=slave, capture_output=True, text=True, timeout=HANG_S, check=False)
    finally:
        os.close(slave)
        os.close(master)
    return done.returncode, done.stderr


def test_answers_in_a_terminal_determine_the_site(tmp_path: Path) -> None:
    answers = ["hall", "8 m", "8,10,4", "", "1", "desk", "sq", "0.3", "4,5,1.2", "45", "8,7,6,5"]
    code, asked = in_terminal(tmp_path / "site.yaml", "\n".join([*answers, ""]))
    assert code == 0, asked
    assert "expected x,y,z in metres, such as 2.5,3,1.2, got '8 m'" in asked
    site = load_site(tmp_path / "site.yaml")
    assert (site.site, site.room.size_m, site.temperature_c, list(site.arrays)) == ("hall", (8, 10, 4), 20, ["desk"])
    assert site.nodes["lab-pc"].arrays == {"desk": [8, 7, 6, 5]}
    [desk] = site.specs
    assert desk.microphones_m[0] == pytest.approx([4.15, 5.15, 1.2], abs=1e-4), "a corner of the square"


def test_wrong_answers_in_a_terminal_are_explained_and_asked_again(tmp_path: Path) -> None:
    answers = [
        "",
        *("8000,10000,4000", ""),
        *("8,10,4", "86"),
        *("", "21"),  # the default room
        "2",
        *("west", "", "", "1,9,1", ""),
        *("west", "", "", "1.5,2.5,1.2", ""),
        *("west", "", "", "4,3,1.2", ""),
        *("east", "", "", "4,3,1.2", ""),
        *("1,2,3", ""),
        *("", ""),
    ]
    code, asked = in_terminal(tmp_path / "site.yaml", "\n".join([*answers, ""]))
    assert code == 0, asked
    for explained in (
        "did you mean [8, 10, 4], from millimetres?",
        "did you mean 30.0, from Fahrenheit?",
        "is outside the room (6, 5, 2.7) m; correct the array's position or room.size_m",
        "expected each key once, got it twice; remove one",
        "expected 4 channels, one for each microphone of 'west', got 3",
    ):
        assert explained in asked
    site = load_site(tmp_path / "site.yaml")
    assert (site.room.size_m, site.temperature_c, list(site.arrays)) == ((6, 5, 2.7), 21, ["west", "east"])
    assert site.nodes["lab-pc"].arrays == {"west": [1, 2, 3, 4], "east": [5, 6, 7, 8]}


@pytest.mark.parametrize(
    ("name", "message"),
    [("", "expected the name of a file, got a folder"), ("no/site.yaml", "expected a folder that exists, got ")],
)
def test_place_that_cannot_be_written_is_refused_before_anything_is_asked(
    run: Run, tmp_path: Path, name: str, message: str
) -> None:
    done = run("init", tmp_path / name, *UMC, "--force")
    assert done.code == 2
    assert done.err.startswith(f"livessl: error: {tmp_path / name}: {message}")


def test_faults_of_flags_name_no_line_of_a_file_that_does_not_exist(run: Run, tmp_path: Path) -> None:
    arrays = ("--array", "a=tetrahedron@3,2,1", "--array", "b=tetrahedron@3,2,1")
    done = run("init", tmp_path / "site.yaml", *UMC, *arrays)
    assert done.code == 2
    assert done.err.startswith("livessl: error: arrays.b: microphone 1 of 'a' and microphone 1 of 'b' are at one place")


def test_end_of_input_writes_nothing(tmp_path: Path) -> None:
    code, asked = in_terminal(tmp_path / "site.yaml", "hall\n\x04")
    assert code == 2
    assert "the input ended before the last question, and nothing was written" in asked
    assert not (tmp_path / "site.yaml").exists()


@settings(max_examples=20, deadline=None)
@given(kind=kinds, size_m=st.floats(0.02, 1.0), count=st.integers(2, 16))
def test_drawing_shows_every_microphone_on_the_page(kind: str, size_m: float, count: int) -> None:
    array = DraftArray("a", kind, size_m, count if kind in ("line", "circle") else 4, (0.0, 0.0, 0.0), 0.0)
    page = ElementTree.fromstring(drawing("A & B", "1 < 2", shape_m(array)))
    texts = page.findall("{*}text")
    for text in texts:
        assert 0 < float(text.attrib["x"]) < PAGE_MM[0]
        assert 0 < float(text.attrib["y"]) < PAGE_MM[1]
    labels = [text.text or "" for text in texts if text.get("text-anchor") == "middle"]
    shown = sorted(int(number) for label in labels for number in label.split(", "))
    assert shown == sorted(2 * [*range(1, array.count + 1)]), "each once from above and once from the side"


def test_drawing_is_to_scale() -> None:
    page = ElementTree.fromstring(drawing("t", "o", shape_m(DraftArray("a", "tetrahedron", 0.5, 4, (0, 0, 0), 0.0))))
    assert page.attrib["width"] == "210mm"
    assert page.attrib["viewBox"] == "0 0 210 297", "one unit is one millimetre"
    texts = {text.text: text for text in reversed(page.findall("{*}text"))}
    assert any("Scale 1:10." in (name or "") for name in texts)
    places = {name: np.array([float(texts[name].attrib[axis]) for axis in "xy"]) for name in ("2", "3", "4")}
    for one, other in (("2", "3"), ("3", "4"), ("4", "2")):
        assert np.linalg.norm(places[one] - places[other]) == pytest.approx(50.0, abs=0.02)
    assert places["3"][1] < places["4"][1], "y points up, and 2, 3, 4 are counter-clockwise"


def test_drawing_of_a_frame_is_written_instead_of_a_site(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "frame.svg"
    done = run("init", *UMC, "--array", "a=square:0.2", "--drawing", path)
    assert done.code == 0
    assert "Square, edge 200 mm" in path.read_text(encoding="utf-8")
    assert [file.name for file in tmp_path.iterdir()] == ["frame.svg"]
