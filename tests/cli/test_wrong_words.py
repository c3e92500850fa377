"""Wrong words on the command line: one line, with the word that was probably meant."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cli.command_runs import COMMANDS, Run
from livessl.cli.main import main
from livessl.errors import did_you_mean
from publishing_lives import free_port
from small_site import write_site


@settings(max_examples=20)
@given(word=st.sampled_from(COMMANDS), data=st.data())
def test_a_doubled_letter_is_seen_through(word: str, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(word) - 1))
    assert did_you_mean(word[:at] + word[at] + word[at:], COMMANDS) == f"; did you mean {word!r}?"


@settings(max_examples=12)
@given(word=st.text("qxz", min_size=6, max_size=12))
def test_nothing_is_proposed_for_another_word(word: str) -> None:
    assert did_you_mean(word, COMMANDS) == ""


@pytest.mark.parametrize(
    ("arguments", "meant", "prog"),
    [
        ("plann --site s.yaml", "did you mean 'plan'?", "livessl"),
        ("keys tokn --site s.yaml", "did you mean 'token'?", "livessl keys"),
        ("evaluate ofice --out d", "did you mean 'office'?", "livessl evaluate"),
        ("record --site s.yaml --node n --out d --format flacc", "did you mean 'flac'?", "livessl record"),
        ("serve --site s.yaml --jiont a=b,c", "did you mean '--joint'?", "livessl serve"),
        ("calibrate verify --sesion d", "did you mean '--session'?", "livessl calibrate verify"),
        ("check s.yaml more", "unrecognized arguments: more", "livessl check"),
        ("simulate --out d", "required: --site", "livessl simulate"),
        ("init --array n=pyramide:0.3", "expected an array of kind", "livessl init"),
        ("init --array n=squere:0.3", "did you mean 'square'?", "livessl init"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_help(run: Run, arguments: str, meant: str, prog: str) -> None:
    done = run(*arguments.split())
    assert (done.code, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert line.startswith("livessl: error: ")
    assert meant in line
    assert line.endswith(f" see {prog} --help")


def test_names_of_nodes_and_arrays_are_proposed(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    assert "did you mean 'lab-pc'?" in run("capture", "--site", site, "--node", "lab_pc").err
    assert "did you mean 'lab-pc'?" in run("record", "--site", site, "--node", "labpc", "--out", tmp_path / "o").err
    done = run("capture", "--site", site, "--node", "lab-pc", "--wav", "sout=s.wav", "--wav", "north=n.wav")
    assert "has the arrays north, south; did you mean 'south'?" in done.err


@pytest.mark.parametrize("command", [("check",), ("plan", "--site")])
def test_a_site_file_that_is_not_there_has_a_cure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    for path in (tmp_path / "none.yaml", tmp_path):
        assert main([*command, str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert str(path) in line
        assert "`livessl init`" in line


def test_options_without_effect_are_refused(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    for command in (("doctor", "--session", tmp_path), ("calibrate", "refine", "--session", tmp_path)):
        done = run(*command, "--site", site, "--channels", "north=2,1,3,4")
        assert (done.code, "--channels names channels of the files of --wav" in done.err) == (2, True)
    for ignored in (("--session", tmp_path), ("--wav", "north=n.wav"), ("--joint", "both=north,south")):
        done = run("doctor", "--site", site, "--url", "http://127.0.0.1:9", *ignored)
        assert (done.code, "have no effect" in done.err) == (2, True)
    done = run("doctor", "--site", site, "--url", f"http://127.0.0.1:{free_port()}")
    assert (done.code, "no answer from a server" in done.err) == (1, True)


LOCALIZER = "evaluate localizer --out results --sounds sounds"


@pytest.mark.parametrize(
    ("command", "refusal"),
    [
        (
            "replay session --server tcp://127.0.0.1:9 --json --method onset",
            "replay: --json and --method have no effect with --server, because that server locates and publishes the "
            "events; remove them",
        ),
        ("replay session --server tcp://127.0.0.1:9 --json", "replay: --json has no effect with --server, because"),
        (f"{LOCALIZER} --with earlier", "evaluate: --with has no effect with localizer; remove it"),
        (f"{LOCALIZER} --segment peak --no-band-limit", "evaluate: --segment and --no-band-limit have no effect"),
        (
            "evaluate office --out results --sounds sounds --half development",
            "--half has no effect with office; remove",
        ),
        ("evaluate report --out r --with e --sounds s", "--sounds has no effect with report, which simulates nothing;"),
        ("bench --arrays 8 --spin", "bench: --arrays and --spin have no effect without --live; remove them"),
        ("relocate clips --site site.yaml --token-file token", "relocate: --token-file has no effect without --url"),
        ("doctor --session session --token-file token", "doctor: --token-file has no effect without --url"),
    ],
)
def test_options_that_another_option_makes_useless_are_refused(run: Run, command: str, refusal: str) -> None:
    done = run(*command.split())
    assert (done.code, done.out) == (2, "")
    assert refusal in done.err
    assert len(done.err.splitlines()) == 1
