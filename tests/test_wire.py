"""Messages survive the wire unchanged, and any other bytes raise WireError."""

from __future__ import annotations

import contextlib
import json
import math
import random
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl import wire
from livessl.core.types import MAX_SAMPLE, Frame, Mark
from livessl.wire import Hello, Welcome, WireError, WireMessage, decode, encode
from small_site import frame, mark
from wire_examples import (
    ACKS,
    BYES,
    EXAMPLES,
    FRAMES,
    HELLOS,
    MARKS,
    QUIET,
    REPORT,
    REQUESTS,
    WELCOMES,
    assert_same,
    refusal,
)


@given(FRAMES | MARKS | HELLOS | ACKS | BYES | REQUESTS | WELCOMES)
@settings(deadline=None)
def test_round_trip(message: WireMessage) -> None:
    data = encode(message)
    assert len(data) <= wire.MAX_MESSAGE_BYTES
    assert_same(decode(data), message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_every_truncation_is_refused(message: WireMessage) -> None:
    data = encode(message)
    whole = []
    if isinstance(message, Mark):  # sections are optional, so a mark without the last ones is whole
        without = replace(message, host=None), replace(message, drift_error_ppm=None, host=None)
        whole = [len(encode(mark)) for mark in (*without, replace(without[1], levels=()))]
    for length in [*range(min(len(data), 200)), len(data) - 1]:
        if length not in whole:
            refusal(data[:length])


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_extra_bytes_are_refused(message: WireMessage) -> None:
    assert_same(decode(encode(message)), message)
    for tail in (b"\0", b"x", b"{}", bytes(8)):
        refusal(encode(message) + tail)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_mutated_messages_raise_only_wire_errors(message: WireMessage) -> None:
    rng = random.Random(5)
    data = encode(message)[:600]
    if isinstance(message, Frame):  # short, so that mutations reach both header and samples
        short = Frame("north", 1, 1000, 0, 16000.0, np.zeros((4, 20), dtype=np.float32), 0.5, True)
        data = encode(short)
    refused = 0
    for _ in range(4000):
        mutated = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            mutated[rng.randrange(len(mutated))] = rng.randrange(256)
        try:
            encode(decode(bytes(mutated)))  # whatever decodes can be encoded again
        except WireError:
            refused += 1
    assert refused > 400


@given(st.binary(max_size=400), st.sampled_from([1, 2, 3, 4, 5, 6, 7, 77]))
@settings(max_examples=500, deadline=None)
def test_random_bodies_raise_only_wire_errors(body: bytes, kind: int) -> None:
    for data in (body, struct.pack("<4sBBq", b"LSSL", wire.VERSION, kind, 0) + body):
        with contextlib.suppress(WireError):
            decode(data)


JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.just(10**400)
    | st.floats()
    | st.text()
    | st.sampled_from(["\ud800", "x" * 2000]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=4,
)


@given(
    st.sampled_from(
        [(3, "node run_id arrays replay problem backlog"), (4, "run_id received settled who_are_you refused")]
    ),
    st.data(),
)
@settings(max_examples=300, deadline=None)
def test_arbitrary_field_values_raise_only_wire_errors(form: tuple[int, str], data: st.DataObject) -> None:
    kind, names = form
    fields = {name: data.draw(JSON_VALUES) for name in names.split()}
    try:
        message = decode(struct.pack("<4sBBq", b"LSSL", wire.VERSION, kind, 0) + json.dumps(fields).encode())
    except WireError:
        return
    encode(message)


def hello_with(**fields: Any) -> bytes:
    whole: dict[str, Any] = {"node": "a", "run_id": "b", "arrays": {"n": 16000}, "replay": False, "problem": None}
    whole |= {"backlog": {}, **fields}
    return encode(EXAMPLES[2])[: struct.calcsize("<4sBBq")] + json.dumps(whole).encode()


def test_hello_of_plain_json_is_decoded() -> None:
    assert decode(hello_with()) == Hello("a", "b", {"n": 16000})


@pytest.mark.parametrize(
    "fields",
    [
        {"node": ""},
        {"node": 5},
        {"node": "n" * 65},
        {"node": "ä" * 33},
        {"node": "\ud800"},
        {"run_id": None},
        {"arrays": ["n"]},
        {"arrays": {"n": 0}},
        {"arrays": {"n": -1}},
        {"arrays": {"n": True}},
        {"arrays": {"n": "16000"}},
        {"arrays": {"n": 10**400}},
        {"arrays": {"n": 1e9}},
        {"arrays": {"n": math.nan}},
        {"arrays": {"n": math.inf}},
        {"arrays": {"": 16000}},
        {"replay": 0},
        {"problem": 3},
        {"problem": "p" * 1001},
        {"problem": "half a pair: \udc00"},
        {"backlog": None},
        {"backlog": {"n": 7}},
        {"backlog": {"n": [7]}},
        {"backlog": {"n": [7, 7]}},
        {"backlog": {"n": [7, 8.5]}},
        {"backlog": {"n": [7, 2**62]}},
        {"extra": 1},
    ],
    ids=str,
)
def test_field_of_a_wrong_value_is_refused(fields: dict[str, Any]) -> None:
    said = refusal(hello_with(**fields))
    assert said.startswith("hello: ")


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_message_carries_its_time_of_sending(message: WireMessage) -> None:
    data = encode(message)
    assert wire.sent_ns(data) == 0
    sent = wire.stamped(wire.stamped(data, 7), 1_767_225_600_123_456_789)
    assert wire.sent_ns(sent) == 1_767_225_600_123_456_789
    assert wire.stamped(sent, 0) == data
    assert encode(decode(sent)) == data


def test_error_about_a_header_names_the_expected_value() -> None:
    data = encode(EXAMPLES[1])
    assert "at least a header" in refusal(data[:5])
    assert "beginning with b'LSSL', got b'HTTP'" in refusal(b"HTTP" + data[4:])
    assert "expected wire version 2, got 1; run the same livessl" in refusal(data[:4] + b"\1" + data[5:])
    assert "known kind of message, got 9" in refusal(data[:5] + b"\x09" + data[6:])


def test_acknowledgement_is_encoded_for_another_version() -> None:
    ack = wire.Ack("run-1", {}, refused="run the same livessl")
    data = encode(ack, 3)
    assert "expected wire version 2, got 3" in refusal(data)
    assert decode(data[:4] + b"\2" + data[5:]) == ack


def test_oversize_is_refused_before_it_is_read() -> None:
    said = refusal(bytes(wire.MAX_MESSAGE_BYTES + 1))
    assert f"expected at most {wire.MAX_MESSAGE_BYTES}" in said
    said = refusal(hello_with(problem="p" * wire.MAX_JSON_BYTES))
    assert f"expected at most {wire.MAX_JSON_BYTES}" in said


def test_largest_frame_is_decoded() -> None:
    samples = np.zeros((16, wire.MAX_FRAME_SAMPLES), dtype=np.float32)
    largest = Frame("n" * wire.MAX_NAME_BYTES, 1, 1, 1, wire.MAX_RATE_HZ, samples, 0.0, False)
    data = encode(largest)
    assert len(data) <= wire.MAX_MESSAGE_BYTES
    assert_same(decode(data), largest)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_samples_must_be_finite(bad: float) -> None:
    samples = np.zeros((4, 10), dtype=np.float32)
    samples[2, 3] = bad
    said = refusal(encode(Frame("north", 1, 1, 1, 16000.0, samples, 0.0, False)))
    assert "array 'north'" in said
    assert "NaN or infinity" in said


def test_samples_beyond_the_range_of_a_converter_are_refused() -> None:
    samples = np.zeros((4, 10), dtype=np.float32)
    samples[2, 3] = -MAX_SAMPLE
    decode(encode(Frame("north", 1, 1, 1, 16000.0, samples, 0.0, False)))
    loud = samples * np.float32(1.001)
    said = refusal(encode(Frame("north", 1, 1, 1, 16000.0, loud, 0.0, False)))
    assert said.endswith("frame of array 'north': expected samples up to 1e+06, got 1.001e+06")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"sample_rate_hz": 0.0}, "rate"),
        ({"sample_rate_hz": math.nan}, "rate"),
        ({"sample_rate_hz": 1e12}, "rate"),
        ({"power": -1.0}, "power"),
        ({"power": math.inf}, "power"),
        ({"power": math.nan}, "power"),
        ({"power": 1e300}, "power"),
        ({"frame_index": 2**62}, "frame index"),
        ({"frame_index": -(2**62)}, "frame index"),
        ({"samples": np.zeros((1, 10), dtype=np.float32)}, "2 to 16 channels, got 1"),
        ({"samples": np.zeros((17, 10), dtype=np.float32)}, "2 to 16 channels, got 17"),
        ({"samples": np.zeros((4, 0), dtype=np.float32)}, "samples, got 0"),
        ({"samples": np.zeros((2, wire.MAX_FRAME_SAMPLES + 1), dtype=np.float32)}, "got 19201"),
    ],
)
def test_frame_outside_the_limits_is_refused(values: dict[str, Any], expected: str) -> None:
    good: dict[str, Any] = {
        "array": "north",
        "sequence": 1,
        "frame_index": 1,
        "time_ns": 1,
        "sample_rate_hz": 16000.0,
        "samples": np.zeros((4, 10), dtype=np.float32),
        "power": 0.0,
        "active": False,
    }
    decode(encode(Frame(**good)))
    assert expected in refusal(encode(Frame(**(good | values))))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"power": math.nan}, "powers from 0"),
        ({"noise_power": -1.0}, "powers from 0"),
        ({"channel_power": (0.0, math.inf)}, "powers from 0"),
        ({"channel_power": (0.0,) * 17}, "at most 16 channels"),
        ({"drift_ppm": math.nan}, "finite drift"),
        ({"frame_index": 2**62}, "frame index"),
    ],
)
def test_mark_outside_the_limits_is_refused(values: dict[str, Any], expected: str) -> None:
    good: dict[str, Any] = {
        "array": "north",
        "sequence": 1,
        "frame_index": 1,
        "power": 0.0,
        "noise_power": 0.0,
        "channel_power": (0.0,) * 4,
    }
    decode(encode(Mark(**good)))
    assert expected in refusal(encode(Mark(**(good | values))))


@pytest.mark.parametrize("name", ["", "n" * 65])
def test_name_of_a_wrong_length_is_not_encoded(name: str) -> None:
    with pytest.raises(ValueError, match="expected 1 to 64 bytes"):
        encode(Mark(name, 1, 1, 0.0, 0.0, ()))


def test_name_that_is_not_text_is_refused() -> None:
    data = encode(Mark("nn", 1, 1, 0.0, 0.0, ()))
    assert "UTF-8" in refusal(data[:-2] + b"\xff\xfe")


def test_decoded_samples_are_read_only() -> None:
    got = decode(encode(frame()))
    assert isinstance(got, Frame)
    assert not got.samples.flags.writeable


def test_greeting_without_answers_omits_the_field() -> None:
    """Older servers refuse fields that they do not know."""
    plain = encode(Hello("lab-pc", "run", {"north": 16000.0}))
    assert b"answers" not in plain
    assert b'"answers":true' in encode(Hello("lab-pc", "run", {"north": 16000.0}, answers=True))
    with pytest.raises(WireError, match="hello: field 'answers' has a wrong type"):
        decode(encode(Hello("lab-pc", "run", {}, answers=True)).replace(b"true", b"7"))


def test_mark_without_sections_is_as_older_servers_read_it() -> None:
    """Header, fixed part, name and powers, and nothing after them."""
    assert len(encode(mark())) == struct.calcsize("<4sBBq") + struct.calcsize("<BQqddQQdBB") + len("north") + 4 * 8
    assert len(encode(replace(mark(), levels=(QUIET,)))) > len(encode(mark()))


@given(st.integers(4, 255), st.binary(max_size=300), st.booleans())
def test_unknown_section_is_skipped(tag: int, body: bytes, is_last: bool) -> None:
    """A newer node may add sections, before or after those that this server knows."""
    plain, whole = encode(mark()), encode(REPORT)
    section = struct.pack("<BH", tag, len(body)) + body
    known = whole[len(plain) :]
    assert decode(plain + (known + section if is_last else section + known)) == REPORT


@pytest.mark.parametrize(
    ("tail", "expected"),
    [
        (struct.pack("<BH", 1, 10) + bytes(10), "levels of 1 to 16 channels, got 10 bytes"),
        (struct.pack("<BH", 1, 0), "levels of 1 to 16 channels, got 0 bytes"),
        (struct.pack("<BH", 1, 17 * 64) + bytes(17 * 64), "levels of 1 to 16 channels"),
        (struct.pack("<BHQ7d", 1, 64, 0, math.nan, 0, 0, 0, 0, 0, 0), "levels up to 1000 dB, got nan"),
        (struct.pack("<BHQ7d", 1, 64, 0, 0, 0, math.inf, 0, 0, 0, 0), "a mean up to 1e+07, got inf"),
        (struct.pack("<BHQ7d", 1, 64, 0, 0, 0, 0, 0, 1e4, 0, 0), "a level up to 1000, got 10000"),
        (struct.pack("<BH", 1, 64) + bytes(63), "a section of 64 bytes, got 63"),
        (struct.pack("<BH", 2, 5) + bytes(5), "a machine's state of at least 29 bytes, got 5"),
        (struct.pack("<BHf", 3, 4, 1.0), "an error of the drift of 8 bytes, got 4"),
        (struct.pack("<BHd", 3, 8, -1.0), "an error of the drift from 0 to 1e+12 ppm, got -1.0"),
        (
            struct.pack("<BHBdQd?BBB", 2, 29, 3, 0, 0, 0, False, 0, 0, 0),
            "a clock's state of 0, 1 or 2, got 0 bytes and 3",
        ),
        (
            struct.pack("<BHBdQd?BBB", 2, 29, 0, 0, 0, 0, False, 1, 0, 0),
            "1 bytes of names and a clock's state of 0, 1 or 2, got 0 bytes",
        ),
        (
            struct.pack("<BHBdQd?BBB", 2, 29, 0, math.inf, 0, 0, False, 0, 0, 0),
            "an error in seconds up to 1e+09, got inf",
        ),
    ],
)
def test_section_of_a_wrong_value_is_refused(tail: bytes, expected: str) -> None:
    said = refusal(encode(mark()) + tail)
    assert said.startswith("mark of array 'north': expected ")
    assert expected in said


def test_sections_without_end_are_refused_at_once() -> None:
    """A mark of a hundred thousand empty sections costs nothing."""
    empty = struct.pack("<BH", 200, 0)
    assert "expected sections of 16384 bytes at most, got 300000" in refusal(encode(mark()) + 100_000 * empty)
    assert decode(encode(mark()) + 5000 * empty) == mark()


@pytest.mark.parametrize("reads", [None, "mark-sections", [7], [""], ["n"] * 65])
def test_welcome_of_a_wrong_value_is_refused(reads: Any) -> None:
    head = encode(Welcome("run"))[: struct.calcsize("<4sBBq")]
    assert "field 'reads' has a wrong type" in refusal(head + json.dumps({"run_id": "run", "reads": reads}).encode())
