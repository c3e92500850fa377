"""Marks carry the levels of each array's own channels once a second, and leave out nothing that was loud."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import FRAME_NS, Block, Float32Array, Frame, Mark, Message
from livessl.site.build.pipeline import make_pipeline
from small_site import RATE_HZ, hiss, site_of

START_NS = 20 * 1_767_225_600 * FRAME_NS


def two_arrays(*, reports_levels: bool = True) -> Pipeline:
    """Return the pipeline of two arrays on one device, whose inputs are mixed and leave two out."""
    channels = {"north": [2, 1, 8, 3], "south": [5, 10, 6, 7]}
    return make_pipeline(site_of(), channels, float(RATE_HZ), reports_levels=reports_levels)


def messages(pipeline: Pipeline, samples: Float32Array, block: int = 320) -> list[Message]:
    found: list[Message] = []
    for first in range(0, samples.shape[1], block):
        stamp_ns = START_NS + round(first / RATE_HZ * 1e9)
        found += pipeline.push(Block(first, samples[:, first : first + block].copy(), stamp_ns))
    return found


def reports(found: list[Message], array: str) -> list[Mark]:
    return [message for message in found if isinstance(message, Mark) and message.array == array and message.levels]


@settings(max_examples=5, deadline=None)
@given(block=st.integers(80, 1600), seed=st.integers(0, 99))
def test_each_second_of_quiet_has_a_report_of_the_arrays_channels(block: int, seed: int) -> None:
    rising = 1e-3 * 10.0 ** (np.arange(10)[:, None] / 10.0)  # each input is 1 dB above the one before
    samples = (rising * hiss(4.2, 10, seed, level=1.0)).astype(np.float32)
    found = messages(two_arrays(), samples, block)
    for array, inputs in (("north", [2, 1, 8, 3]), ("south", [5, 10, 6, 7])):
        marks = reports(found, array)
        assert len(marks) == 4
        spans = np.diff([mark.frame_index for mark in marks])
        assert spans.tolist() == [20, 20, 20]
        for mark in marks[1:]:
            for level, number in zip(mark.levels, inputs, strict=True):
                expected = 20.0 * math.log10(samples[number - 1].std())
                assert level.rms_dbfs == pytest.approx(expected, abs=0.3)  # noise of a second, 16 000 samples
                assert level.noise_dbfs == pytest.approx(expected, abs=0.5)
                assert level.peak_dbfs > level.rms_dbfs
                assert (level.clipped, level.hum_hz) == (0, None)


def test_report_after_a_sound_has_its_peak_and_its_clipped_samples() -> None:
    """No mark is sent while a sound goes on, so the report after it tells of all of it."""
    samples = hiss(7.0, 10, level=1e-4)
    loud = slice(RATE_HZ * 3 // 2, RATE_HZ * 7 // 2)
    samples[:, loud] += hiss(2.0, 10, seed=1, level=0.05)
    samples[1, RATE_HZ * 2 : RATE_HZ * 2 + 50] = 1.0
    found = messages(two_arrays(), samples)
    frames = [message.frame_index for message in found if isinstance(message, Frame) and message.array == "north"]
    after = [mark for mark in reports(found, "north") if mark.frame_index > frames[-1]]
    first = after[0].levels[0]
    assert first.peak_dbfs == pytest.approx(0.0, abs=0.1)
    assert first.clipped >= 49
    assert after[0].levels[1].clipped == 0
    assert after[2].levels[0].peak_dbfs < -60.0  # the second of the one before had begun in the sound
    assert after[2].levels[0].clipped == first.clipped


def test_pipeline_that_is_no_nodes_reports_nothing() -> None:
    found = messages(two_arrays(reports_levels=False), hiss(2.0, 10, level=1e-3))
    assert not reports(found, "north")
    assert any(isinstance(message, Mark) for message in found)


def test_levels_change_nothing_else() -> None:
    samples = hiss(3.0, 10, level=1e-3)
    samples[:, RATE_HZ : RATE_HZ * 5 // 4] += hiss(0.25, 10, seed=2, level=0.2)
    with_levels, without = messages(two_arrays(), samples), messages(two_arrays(reports_levels=False), samples)
    assert [type(message) for message in with_levels] == [type(message) for message in without]
    for message, plain in zip(with_levels, without, strict=True):
        assert (message.frame_index, message.power) == (plain.frame_index, plain.power)
