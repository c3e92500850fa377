"""The comparison of two source trees reports what changed, and finds the working tree the same as its own commit."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

import unchanged
import unchanged_commands
import unchanged_probes
from conftest import require
from unchanged_probes import Finding, Options
from unchanged_trees import (
    Done,
    Keys,
    Pair,
    ProbeError,
    Tree,
    checked_out,
    differences,
    keys_of,
    missing,
    missing_keys,
    ratios,
)

ROOT = Path(__file__).parents[1]
EVENT = b'{"kind": "event", "start_s": 1.95, "position_m": [4.02, 0.93, 1.2]}\n'


def test_equal_outputs_do_not_differ() -> None:
    assert differences({"stdout": EVENT, "exit code": b"0"}, {"exit code": b"0", "stdout": EVENT}) == []


def test_changed_byte_is_reported_with_its_place_and_surroundings() -> None:
    [line] = differences(
        {"stdout": EVENT, "exit code": b"0"}, {"stdout": EVENT.replace(b"1.95", b"1.96"), "exit code": b"0"}
    )
    assert line.startswith(f"stdout: byte {EVENT.index(b'5')} of {len(EVENT)}: ")
    assert '"start_s": 1.95' in line
    assert '"start_s": 1.96' in line


def test_changed_byte_of_a_binary_is_reported_in_hexadecimal_digits() -> None:
    assert differences({"frame": b"\x00\xff\x10"}, {"frame": b"\x00\xff\x11"}) == [
        "frame: byte 2 of 3: base 00 ff 10, head 00 ff 11"
    ]


@pytest.mark.parametrize("heading", ["COMMAND", "{serve,support-bundle}"])
def test_commands_are_found_in_a_help_and_choices_of_options_are_none(heading: str) -> None:
    text = (
        "usage: livessl [--log {text,json}] COMMAND ...\n\noptions:\n  --log {text,json}  form of the log lines\n"
        f"\ncommands:\n  {heading}\n    serve            run the\n                     server\n"
        "    support-bundle   collect what helps\n\nsee also: docs\n"
    )
    assert unchanged_commands.commands_of(text) == ["serve", "support-bundle"]


def test_help_of_a_command_without_others_lists_none() -> None:
    assert unchanged_commands.commands_of("positional arguments:\n  FILE      site file\n    more of it\n") == []


def test_only_the_words_of_a_reason_may_change() -> None:
    one = b'{"position_m": [1.0], "reason": "a \\"b\\" c", "zones": []}'
    reworded, none = one.replace(b" c", b" d"), one.replace(b'"a \\"b\\" c"', b"null")
    moved = reworded.replace(b"1.0", b"1.1")
    assert len({one, reworded, none, moved}) == 4
    same, *others = (unchanged_probes.without_reasons({"stdout": text}) for text in (one, reworded, none, moved))
    assert [other == same for other in others] == [True, False, False]


def test_shorter_output_is_reported() -> None:
    [line] = differences({"stdout": EVENT + EVENT}, {"stdout": EVENT})
    assert line.startswith(f"stdout: byte {len(EVENT)} of {2 * len(EVENT)} and {len(EVENT)}")


def test_changed_exit_code_is_reported() -> None:
    ok, failed = Done(0, EVENT, "").outputs("locate"), Done(1, EVENT, "").outputs("locate")
    assert len(differences(ok, failed)) == 1


def test_output_of_one_tree_alone_is_reported() -> None:
    assert differences({"a": b""}, {"b": b""}) == ["a: only base has it", "b: only head has it"]


ANSWER: dict[str, Any] = {
    "v": 1,
    "arrays": [{"name": "north", "offset": None}, {"name": "south", "offset": {"ms": 1.5}}],
    "events": [],
}


def keys(**changes: Any) -> Keys:
    return keys_of(ANSWER | changes, "health")


def test_json_may_gain_fields() -> None:
    assert missing_keys(keys(), keys(more={"a": 1})) == []


def test_missing_fields_are_reported_at_any_depth() -> None:
    assert missing_keys(keys(more=1), keys()) == ["health.more: head lacks it"]
    assert missing_keys(keys(), keys(arrays=[{"name": "north", "offset": {}}])) == [
        "health.arrays[].offset.ms: head lacks it"
    ]


def test_field_of_another_kind_is_reported_unless_it_is_null() -> None:
    assert missing_keys(keys(), keys(v="1")) == ["health.v: base has number, head has string"]
    assert missing_keys(keys(), keys(v=1.0)) == []
    assert missing_keys(keys(), keys(v=None)) == []


def test_what_lies_inside_null_or_an_empty_list_is_not_missed() -> None:
    assert missing_keys(keys(), keys(arrays=[{"name": "north", "offset": None}])) == []
    assert missing_keys(keys(events=[{"id": "1"}]), keys()) == []


def test_missing_path_is_reported_and_an_added_one_is_not() -> None:
    assert missing({"GET /a", "GET /b"}, {"GET /a", "GET /c"}) == ["GET /b: head lacks it"]


def test_ratio_of_medians_and_whether_the_runs_overlap() -> None:
    base = [{"map": 10.0, "peak": 1.0}, {"map": 12.0, "peak": 1.1}, {"map": 11.0, "peak": 1.05}]
    head = [{"map": 11.5, "peak": 2.0}, {"map": 12.5, "peak": 2.1}, {"map": 13.0, "peak": 2.2, "new": 1.0}]
    slower, much_slower = ratios(base, head)
    assert (slower.name, slower.within_spread) == ("map", True)
    assert slower.ratio == pytest.approx(12.5 / 11.0)
    assert (much_slower.name, much_slower.within_spread) == ("peak", False)
    assert much_slower.ratio == pytest.approx(2.0)


def test_report_is_one_line_when_all_is_the_same_and_short_otherwise() -> None:
    assert unchanged.report("wire", Finding("11 messages", [])) == "wire       same (11 messages)"
    lines = unchanged.report("wire", Finding("", [f"message {k}" for k in range(20)]), most=3).splitlines()
    assert lines[0] == "wire       DIFFERENT: message 0"
    assert [line.strip() for line in lines[1:]] == ["message 1", "message 2", "and 17 more"]


def test_any_difference_or_failure_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def same(pair: Pair, options: Options) -> Finding:
        return Finding("nothing", [])

    def different(pair: Pair, options: Options) -> Finding:
        return Finding("nothing", ["a byte"])

    def broken(pair: Pair, options: Options) -> Finding:
        raise ProbeError("head: serve: does not answer")

    for name, probe in (("wire", same), ("check", different), ("api", broken)):
        monkeypatch.setitem(unchanged_probes.PROBES, name, probe)
    pair = Pair(Tree("base", ROOT), Tree("head", ROOT), tmp_path)
    assert unchanged.probe(pair, ["wire"], Options())
    assert not unchanged.probe(pair, ["check", "wire"], Options())
    assert not unchanged.probe(pair, ["api", "wire"], Options())


def test_changed_code_of_the_wire_is_found(tmp_path: Path) -> None:
    """A tree that is this one, but for a bit of each message and, in the second case, of what it decodes."""
    source = ROOT / "src" / "livessl"
    changed = tmp_path / "src" / "livessl"
    changed.mkdir(parents=True)
    for path in source.iterdir():
        if path.name not in ("wire.py", "__pycache__"):
            (changed / path.name).symlink_to(path)
    pair = Pair(Tree("base", ROOT), Tree("head", tmp_path), tmp_path)
    text = (source / "wire.py").read_text(encoding="utf-8")

    (changed / "wire.py").write_text(text, encoding="utf-8")
    assert unchanged_probes.wire(pair, Options()).differences == []

    flipped = "\n_same = encode\ndef encode(m):\n    d = _same(m)\n    return d[:9] + bytes([d[9] ^ 1]) + d[10:]\n"
    (changed / "wire.py").write_text(text + flipped, encoding="utf-8")
    found = unchanged_probes.wire(pair, Options()).differences
    assert {line.partition(":")[0] for line in found} >= {"frame", "mark", "hello", "ack", "bye", "request"}
    assert any("byte 9 of" in line for line in found)

    lenient = "\n_strict = decode\ndef decode(data):\n    return _strict(data[:4] + bytes([VERSION]) + data[5:])\n"
    (changed / "wire.py").write_text(text + lenient, encoding="utf-8")
    found = unchanged_probes.wire(pair, Options()).differences
    assert found
    assert all("damaged" in line for line in found)


def _is_checkout() -> bool:
    command = ["git", "-C", str(ROOT), "rev-parse", "--verify", "--quiet", "HEAD"]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def test_working_tree_is_the_same_as_its_commit(capsys: pytest.CaptureFixture[str]) -> None:
    require(_is_checkout(), "this is no checkout of git")
    assert unchanged.main(["HEAD", "--only", "wire", "commands"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [["wire", "same"], ["commands", "same"]]


def test_commit_that_does_not_exist_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    require(_is_checkout(), "this is no checkout of git")
    assert unchanged.main(["no-such-commit"]) == 2
    assert "expected a commit of" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--scenes 0", "--seeds 0", "--sounds 0", "--repeats 1"])
def test_size_with_which_nothing_would_be_compared_is_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        unchanged.main(["HEAD", *option.split()])
    assert "expected a whole number from" in capsys.readouterr().err


def test_checked_out_commit_is_removed_again() -> None:
    require(_is_checkout(), "this is no checkout of git")
    with checked_out(ROOT, "HEAD", None) as pair:
        assert (pair.base.root / "src" / "livessl").is_dir()
        assert pair.head.root == ROOT
    assert not pair.base.root.exists()
    listed = subprocess.run(["git", "-C", str(ROOT), "worktree", "list"], check=True, capture_output=True, text=True)
    assert str(pair.base.root) not in listed.stdout
