"""Messages of every kind: strategies that draw them, and an example of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal

from livessl import wire
from livessl.core.types import MAX_SAMPLE, ChannelLevel, ClockState, Frame, HostState, Mark
from livessl.wire import Ack, Bye, Hello, Request, Welcome, WireError, WireMessage, decode
from small_site import frame, mark

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=16)
TEXTS = st.none() | st.text(st.characters(exclude_categories=["Cs"]), max_size=100)
RASTERS = st.integers(-wire.MAX_FRAME_INDEX, wire.MAX_FRAME_INDEX)
POWERS = st.floats(min_value=0, max_value=wire.MAX_POWER)
RATES = st.floats(min_value=1.0, max_value=wire.MAX_RATE_HZ)
SAMPLES = hnp.arrays(
    np.float32,
    st.tuples(st.integers(2, 16), st.integers(1, 40)),
    elements=st.floats(-MAX_SAMPLE, MAX_SAMPLE, width=32),
)
FRAMES = st.builds(
    Frame,
    array=NAMES,
    sequence=st.integers(1, 2**63 - 1),
    frame_index=RASTERS,
    time_ns=st.integers(-(2**63), 2**63 - 1),
    sample_rate_hz=RATES,
    samples=SAMPLES,
    power=POWERS,
    active=st.booleans(),
) | st.builds(
    Frame,
    array=NAMES,
    sequence=st.just(0),
    frame_index=RASTERS,
    time_ns=st.integers(-(2**63), 2**63 - 1),
    sample_rate_hz=RATES,
    samples=SAMPLES,
    power=POWERS,
    active=st.booleans(),
    requested=st.just(True),
)
DECIBELS = st.floats(-1000.0, 1000.0)
LEVELS = st.builds(
    ChannelLevel,
    peak_dbfs=DECIBELS,
    rms_dbfs=DECIBELS,
    clipped=st.integers(0, 2**64 - 1),
    mean=st.none() | st.floats(-MAX_SAMPLE, MAX_SAMPLE),
    hum_hz=st.none() | st.floats(0.0, 1e6),
    hum_dbfs=st.none() | DECIBELS,
    noise_dbfs=st.none() | DECIBELS,
    noise_over_db=st.none() | DECIBELS,
)
WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)
HOSTS = st.builds(
    HostState,
    synchronized=st.sampled_from([True, False, None]),
    service=WORDS,
    reference=WORDS,
    error_s=st.none() | st.floats(0.0, 1e9),
    lost_blocks=st.integers(0, 2**64 - 1),
    load=st.none() | st.floats(0.0, 1e9),
    sound_server=st.booleans(),
    machine=WORDS,
)
MARKS = st.builds(
    Mark,
    array=NAMES,
    sequence=st.integers(0, 2**63 - 1),
    frame_index=RASTERS,
    power=POWERS,
    noise_power=POWERS,
    channel_power=st.lists(POWERS, max_size=16).map(tuple),
    overflows=st.integers(0, 2**64 - 1),
    lost_frames=st.integers(0, 2**64 - 1),
    drift_ppm=st.floats(allow_nan=False, allow_infinity=False),
    clock=st.sampled_from(ClockState),
    levels=st.lists(LEVELS, max_size=16).map(tuple),
    drift_error_ppm=st.none() | st.floats(0.0, 1e12),
    host=st.none() | HOSTS,
)
HELLOS = st.builds(
    Hello,
    node=NAMES,
    run_id=NAMES,
    arrays=st.dictionaries(NAMES, RATES, max_size=6),
    replay=st.booleans(),
    problem=TEXTS,
    backlog=st.dictionaries(
        NAMES, st.lists(RASTERS, min_size=2, max_size=2, unique=True).map(lambda ends: tuple(sorted(ends))), max_size=6
    ),
    answers=st.booleans(),
)
ACKS = st.builds(
    Ack,
    run_id=NAMES,
    received=st.dictionaries(NAMES, RASTERS, max_size=6),
    settled=st.none() | RASTERS,
    who_are_you=st.booleans(),
    refused=TEXTS,
)
REQUESTS = st.builds(
    Request,
    run_id=NAMES,
    wanted=st.dictionaries(
        NAMES, st.lists(RASTERS, min_size=2, max_size=2, unique=True).map(lambda ends: tuple(sorted(ends))), max_size=6
    ),
)
BYES = st.builds(Bye, node=NAMES, run_id=NAMES)
WELCOMES = st.builds(Welcome, run_id=NAMES, reads=st.lists(NAMES, max_size=8).map(tuple))

QUIET = ChannelLevel(-40.5, -52.25, 3, 0.001, 50.0, -61.0, -70.5, 2.5)
HOST = HostState(True, "chrony", "ntp.example", 0.0021, 4, 0.75, True, "a1b2")
REPORT = replace(
    mark(), levels=(QUIET, replace(QUIET, hum_hz=None, hum_dbfs=None, mean=None)), drift_error_ppm=3.5, host=HOST
)

EXAMPLES: list[WireMessage] = [
    frame(),
    mark(),
    Hello("lab-pc", "run", {"north": 16000.0}, problem="unplugged", backlog={"north": (7, 9)}),
    Ack("run", {"north": 7}, 5),
    Bye("lab-pc", "run"),
    Request("run", {"north": (7, 9)}),
    Welcome("run", ("mark-sections",)),
    REPORT,
]


def assert_same(got: WireMessage, sent: WireMessage) -> None:
    assert type(got) is type(sent)
    if isinstance(sent, Frame):
        assert isinstance(got, Frame)
        assert_array_equal(got.samples.view(np.uint32), sent.samples.view(np.uint32))  # to the bit: -0.0 is not 0.0
        fields = ("array", "sequence", "frame_index", "time_ns", "sample_rate_hz", "power", "active")
        assert [getattr(got, name) for name in fields] == [getattr(sent, name) for name in fields]
    else:
        assert got == sent


def refusal(data: bytes) -> str:
    with pytest.raises(WireError) as caught:
        decode(data)
    return str(caught.value)
