"""The value types: what they reject, that they cannot be changed, and the units of their properties."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from livessl.core.types import (
    FRAME_NS,
    FRAME_S,
    GCC,
    ArraySpec,
    Block,
    Estimate,
    Event,
    Frame,
    Status,
)

SAMPLES = np.zeros((2, 800), dtype=np.float32)


def frame(**changes: Any) -> Frame:
    arguments: dict[str, Any] = {
        "array": "north",
        "sequence": 1,
        "frame_index": 7,
        "time_ns": 7 * FRAME_NS + 11,
        "sample_rate_hz": 16000.0,
        "samples": SAMPLES.copy(),
        "power": 0.0,
        "active": False,
    }
    return Frame(**(arguments | changes))


def spec(**changes: Any) -> ArraySpec:
    arguments: dict[str, Any] = {"name": "north", "microphones_m": np.eye(3), "band_hz": (100.0, 6000.0)}
    return ArraySpec(**(arguments | changes))


def test_frame_is_fifty_milliseconds() -> None:
    assert FRAME_NS == 50 * 10**6
    assert FRAME_S == 0.05


@pytest.mark.parametrize("samples", [SAMPLES[0], SAMPLES.astype(np.float64)], ids=["one axis", "float64"])
def test_samples_of_another_shape_or_type_are_an_error(samples: Any) -> None:
    with pytest.raises(ValueError, match=r"array 'north': samples must be \(channels, n\) float32, got"):
        frame(samples=samples)
    with pytest.raises(ValueError, match=r"block: samples must be \(channels, n\) float32, got"):
        Block(0, samples, 0)


def test_a_block_may_be_empty() -> None:
    assert Block(0, SAMPLES[:, :0].copy(), 0).samples.shape == (2, 0)


def test_values_cannot_be_changed() -> None:
    values: list[tuple[Any, str]] = [
        (frame(), "samples"),
        (Block(0, SAMPLES.copy(), 0), "samples"),
        (spec(), "microphones_m"),
        (Estimate(0, np.zeros(3), np.zeros((3, 3)), 0.5, ("north",)), "position_m"),
        (Estimate(0, np.zeros(3), np.zeros((3, 3)), 0.5, ("north",)), "covariance_m2"),
        *((GCC(np.array([[0, 1]]), np.zeros(5), np.zeros((1, 5))), name) for name in ("pairs", "lags_s", "values")),
    ]
    for value, name in values:
        with pytest.raises(ValueError, match="read-only"):
            getattr(value, name)[0] = 1
        with pytest.raises(FrozenInstanceError):
            setattr(value, name, None)


def test_a_gcc_needs_a_row_for_each_pair_and_a_column_for_each_lag() -> None:
    with pytest.raises(ValueError, match=r"\(pairs, lags\) = \(1, 5\), got \(1, 4\)"):
        GCC(np.array([[0, 1]]), np.zeros(5), np.zeros((1, 4)))


@pytest.mark.parametrize("shape", [(1, 3), (17, 3), (4, 2), (4,)])
def test_an_array_has_two_to_sixteen_microphones_in_space(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="array 'north': expected 2 to 16 microphone positions"):
        spec(microphones_m=np.zeros(shape))


@pytest.mark.parametrize("count", [2, 16])
def test_two_and_sixteen_microphones_are_allowed(count: int) -> None:
    assert len(spec(microphones_m=np.zeros((count, 3))).microphones_m) == count


@pytest.mark.parametrize("band_hz", [(-1.0, 100.0), (100.0, 100.0), (200.0, 100.0)])
def test_a_band_must_ascend_from_zero_or_above(band_hz: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="array 'north': expected a band 0 <= low < high in Hz"):
        spec(band_hz=band_hz)


def test_centre_is_the_mean_and_aperture_the_largest_distance() -> None:
    made = spec(microphones_m=np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 1.0], [0.0, 0.5, 1.0]]))
    np.testing.assert_allclose(made.centre_m, [1.0, 1.5, 1.0])
    assert made.aperture_m == pytest.approx(5.0)


@pytest.mark.parametrize("shapes", [((2,), (3, 3)), ((3,), (3,))])
def test_an_estimate_has_three_coordinates(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match=r"expected position \(3,\) and covariance \(3, 3\)"):
        Estimate(0, np.zeros(shapes[0]), np.zeros(shapes[1]), 0.5, ())


def test_event_lasts_from_start_to_end_in_seconds() -> None:
    event = Event("site-1", 10**9, 10**9 + 3 * FRAME_NS, Status.REFUSED, "why", None, 0.1, "srp-phat")
    assert event.duration_s == pytest.approx(0.15)
