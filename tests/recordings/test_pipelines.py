"""Pipelines of recordings: arrays get their channels, and the messages do not depend on block boundaries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl import wire
from livessl.clock import UnpacedClock
from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.pipeline import Pipeline, Wiring
from livessl.core.types import FRAME_NS, ArraySpec, Block, ClockState, Float32Array, Frame, Mark, Message
from livessl.errors import DeviceError
from livessl.recordings.assign import recording_channels
from livessl.recordings.play import paced_messages, unpaced_messages
from livessl.recordings.recording import MemoryRecording, SplicedRecording, TimedRecording
from livessl.site.build.pipeline import make_pipeline
from livessl.site.models import Site
from small_site import RATE_HZ, Changes, hiss, site_of

START_NS = 1_767_225_600_000_000_000
SITE = site_of()


def scene(channels: int = 8) -> Float32Array:
    """Two seconds of quiet with a burst after 1.2 s."""
    samples = hiss(2.0, channels, level=1e-3)
    first, last = round(1.2 * RATE_HZ), round(1.4 * RATE_HZ)
    samples[:, first:last] += hiss(0.2, channels, seed=1, level=0.2)
    return samples


SCENE = scene()


def messages(cuts: Sequence[int], channels: dict[str, list[int]], site: Site = SITE) -> list[Message]:
    """Return the pipeline's messages for the scene, cut at these samples."""
    pipeline = make_pipeline(site, channels, float(RATE_HZ))
    made: list[Message] = []
    edges = [0, *sorted(cuts), SCENE.shape[1]]
    for first, stop in pairwise(edges):
        stamp_ns = START_NS + round(first / RATE_HZ * 1e9)
        made += pipeline.push(Block(first, np.ascontiguousarray(SCENE[:, first:stop]), stamp_ns))
    return made + pipeline.flush()


BOTH = {"north": [1, 2, 3, 4], "south": [5, 6, 7, 8]}
WHOLE = messages([], BOTH)


def by_array(made: Sequence[Message], array: str) -> list[bytes]:
    """Return an array's messages as bytes, without the clock fields of marks, which depend on each stamp."""
    mine = [message for message in made if message.array == array]
    for message in mine:
        if isinstance(message, Mark):
            assert abs(message.drift_ppm) < 1e-3  # stamps are rounded to a nanosecond
    plain = [replace(m, drift_ppm=0.0, clock=ClockState.LOCKED) if isinstance(m, Mark) else m for m in mine]
    return [wire.encode(message) for message in plain]


def frames_of(made: Sequence[Message], array: str) -> list[Frame]:
    return [message for message in made if isinstance(message, Frame) and message.array == array]


def test_burst_becomes_frames_and_quiet_marks() -> None:
    for array in BOTH:
        frames = frames_of(WHOLE, array)
        active = [frame.frame_index - START_NS // FRAME_NS for frame in frames if frame.active]
        assert active == [24, 25, 26, 27]  # 1.2 s to 1.4 s
        frame_indices = [frame.frame_index - START_NS // FRAME_NS for frame in frames]
        assert frame_indices == list(range(24 - 8, 28 + 6))  # 0.4 s before, 0.3 s after
        marks = [message for message in WHOLE if isinstance(message, Mark) and message.array == array]
        assert len(marks) > 20
        messages = [message for message in WHOLE if message.array == array]
        assert [m.sequence for m in messages] == list(accumulate(isinstance(m, Frame) for m in messages))


def test_frames_hold_the_sound_of_their_channels() -> None:
    shuffled = {"north": [3, 1, 8, 2], "south": [5, 6, 7, 4]}
    for channels in (BOTH, shuffled):
        made = messages([], channels)
        for array, numbers in channels.items():
            for frame in frames_of(made, array):
                first = round((frame.time_ns - START_NS) / 1e9 * RATE_HZ)
                expected = SCENE[np.array(numbers) - 1, first : first + frame.samples.shape[1]]
                assert np.array_equal(frame.samples, expected)
    assert by_array(messages([], shuffled), "north") != by_array(WHOLE, "north")


@given(st.lists(st.integers(1, SCENE.shape[1] - 1), unique=True, max_size=60))
@settings(max_examples=20, deadline=None)
def test_frames_do_not_depend_on_block_boundaries(cuts: list[int]) -> None:
    made = messages(cuts, BOTH)
    for array in BOTH:
        assert by_array(made, array) == by_array(WHOLE, array)


def test_different_sound_gives_different_messages() -> None:
    assert by_array(WHOLE, "north") != by_array(WHOLE, "south")


def test_paced_messages_are_those_of_the_pipelines() -> None:
    pipelines = [make_pipeline(SITE, {name: numbers}, float(RATE_HZ)) for name, numbers in BOTH.items()]
    recordings = [TimedRecording(MemoryRecording(name, float(RATE_HZ), SCENE), START_NS) for name in BOTH]
    clock = UnpacedClock(START_NS)
    made: list[Message] = []
    for known_ns, batch in paced_messages(pipelines, recordings, clock):
        assert known_ns == clock.now_ns()
        for message in batch:
            assert (message.frame_index + 1) * FRAME_NS <= known_ns + 1  # no message precedes its sound
        made += batch
    assert known_ns == START_NS + 2_000_000_000
    for array in BOTH:
        assert by_array(made, array) == by_array(WHOLE, array)


@given(
    rate_hz=st.sampled_from([16_000.0, 22_050.0, 44_100.0]),
    channels=st.integers(2, 16),
    offset_ns=st.integers(0, 90_000_000),
    gap_ns=st.sampled_from([0, 30_000_000, 170_000_000]),
    seed=st.integers(0, 1 << 30),
)
@settings(max_examples=8, deadline=None)
def test_blocks_passed_together_give_the_same_messages_at_the_same_times(
    rate_hz: float, channels: int, offset_ns: int, gap_ns: int, seed: int
) -> None:
    """To the last bit, for narrow and wide arrays whose recordings begin at different times and have a gap."""
    rng = np.random.default_rng(seed)
    samples = rng.normal(0.0, 1e-3, (channels, round(2.0 * rate_hz))).astype(np.float32)
    samples[:, round(1.3 * rate_hz) : round(1.5 * rate_hz)] *= 200.0
    wide = TimedRecording(MemoryRecording("wide", rate_hz, samples), START_NS)
    later = replace(wide, start_ns=START_NS + 2_000_000_000 + gap_ns)
    stereo = TimedRecording(MemoryRecording("two", rate_hz, samples[:2]), START_NS + offset_ns)
    recordings = [TimedRecording(SplicedRecording((wide, later)), START_NS), stereo]

    def pipelines() -> list[Pipeline]:
        places_m = np.random.default_rng(1).uniform(0.0, 0.3, (channels, 3))
        specs = [ArraySpec(name, places_m[:count], (100.0, 6000.0)) for name, count in (("wide", channels), ("two", 2))]
        wirings = [Wiring(spec, np.arange(len(spec.microphones_m))) for spec in specs]
        return [Pipeline([wiring], rate_hz, ActivityParameters()) for wiring in wirings]

    clock = UnpacedClock(START_NS)
    one_by_one = [
        (end_ns, [*map(wire.encode, some)]) for end_ns, some in paced_messages(pipelines(), recordings, clock)
    ]
    together = [(end_ns, [*map(wire.encode, some)]) for end_ns, some in unpaced_messages(pipelines(), recordings)]
    assert together == one_by_one
    assert sum(len(some) for _, some in together) > 100


def test_messages_of_a_short_recording_are_flushed() -> None:
    """The recording is shorter than the warm-up, so that all messages come at its end."""
    pipeline = make_pipeline(SITE, {"north": [1, 2, 3, 4]}, float(RATE_HZ))
    short = TimedRecording(MemoryRecording("short", float(RATE_HZ), SCENE[:, : RATE_HZ // 4]), START_NS)
    batches = [batch for _, batch in paced_messages([pipeline], [short], UnpacedClock())]
    assert [len(batch) for batch in batches[:-1]] == [0] * (len(batches) - 1)
    assert len(batches[-1]) == 5


def test_pipeline_names_its_arrays() -> None:
    assert make_pipeline(SITE, BOTH, float(RATE_HZ)).arrays == ["north", "south"]


def recording(channels: int, rate_hz: float = RATE_HZ) -> MemoryRecording:
    return MemoryRecording("take1.wav", float(rate_hz), hiss(0.1, channels))


NODELESS: Changes = {"nodes": {}}


@pytest.mark.parametrize(
    ("changes", "array", "channels", "wanted", "expected"),
    [
        ({}, "south", 4, None, [1, 2, 3, 4]),  # as many channels as microphones
        ({}, "south", 8, None, [5, 6, 7, 8]),  # the whole device: the node's channels
        ({}, "south", 6, None, [1, 2, 3, 4]),  # not the whole device
        ({}, "north", 8, None, [1, 2, 3, 4]),
        (NODELESS, "south", 8, None, [1, 2, 3, 4]),
        ({}, "south", 8, [8, 7, 2, 1], [8, 7, 2, 1]),  # the channels given
        (NODELESS, "south", 4, [4, 3, 2, 1], [4, 3, 2, 1]),
    ],
)
def test_channels_of_an_array_are_chosen(
    changes: Changes, array: str, channels: int, wanted: list[int] | None, expected: list[int]
) -> None:
    assert recording_channels(site_of(changes), array, recording(channels), wanted) == expected


@pytest.mark.parametrize(
    ("changes", "one", "wanted", "said"),
    [
        ({}, recording(3), None, "expected 4 channels, one for each microphone of array 'north', got 3"),
        (
            {},
            recording(4),
            [1, 2, 3],
            "expected 4 different channel numbers from 1 to 4 for array 'north', got [1, 2, 3]",
        ),
        (
            {},
            recording(4),
            [0, 1, 2, 3],
            "expected 4 different channel numbers from 1 to 4 for array 'north', got [0, 1, 2, 3]; channels "
            "count from 1",
        ),
        (
            {},
            recording(4),
            [1, 2, 3, 5],
            "expected 4 different channel numbers from 1 to 4 for array 'north', got [1, 2, 3, 5]",
        ),
        (
            {},
            recording(4, 44100),
            None,
            "expected 16000 Hz for array 'north', got 44100 Hz; resample the file or correct "
            "nodes.lab-pc.device.sample_rate_hz",
        ),
        (
            NODELESS,
            recording(4, 8000),
            None,
            "array 'north' uses up to 6000 Hz and needs more than 12000 Hz, got 8000 Hz; lower band_hz",
        ),
    ],
)
def test_recording_that_does_not_fit_is_refused(
    changes: Changes, one: MemoryRecording, wanted: list[int] | None, said: str
) -> None:
    with pytest.raises(DeviceError) as caught:
        recording_channels(site_of(changes), "north", one, wanted)
    assert str(caught.value).startswith("take1.wav: ")
    assert said in str(caught.value)


def test_channel_given_twice_is_refused() -> None:
    with pytest.raises(DeviceError, match="expected 4 different channel numbers"):
        recording_channels(SITE, "north", recording(4), [1, 2, 2, 4])
