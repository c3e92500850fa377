"""A moving source: that it is where it should be when it should, and that one that stands still is nothing new."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import oaconvolve

from livessl.core.types import Float32Array
from livessl.simulation.moving import place_on_way, render_moving
from livessl.simulation.room import impulse_responses

ROOM_M = (5.0, 6.0, 3.0)
RATE_HZ = 16000.0
C_M_S = 343.0
MICROPHONES_M = np.array([[1.0, 1.0, 1.2], [1.5, 1.0, 1.2]])


def hiss(seconds: float) -> Float32Array:
    return np.random.default_rng(3).standard_normal(round(seconds * RATE_HZ)).astype(np.float32)


def test_stands_still_as_any_source() -> None:
    place_m, sound = [3.1, 4.2, 1.4], hiss(0.33)
    moving = render_moving(
        sound, [0.0], [place_m], MICROPHONES_M, room_size_m=ROOM_M, rt60_s=0.3, sample_rate_hz=RATE_HZ
    )
    responses = impulse_responses(ROOM_M, place_m, MICROPHONES_M, [0.3], sample_rate_hz=RATE_HZ)[0]
    still = oaconvolve(responses, sound[None], axes=1)
    assert moving.shape == still.shape
    np.testing.assert_allclose(moving, still, atol=1e-5 * np.abs(still).max())  # float32 sums in another order


@pytest.mark.parametrize("at_s", [0.5, 1.4])
def test_sounds_from_where_it_is(at_s: float) -> None:
    """Cross-correlation of what two microphones hear peaks at the delay of the place at emission.

    Anechoic, 2 m/s: within a window of 0.1 s it moves 0.2 m. The delay's gradient is 0.5 m / 1 m / c at most, so the
    window's delays spread over 0.2 m * 0.5 / 343 m/s = 0.3 ms, half of it to either side; and a sample.
    """
    times_s, way_m = [0.0, 2.0], [[3.5, 1.5, 1.2], [0.6, 4.0, 1.2]]
    recorded = render_moving(
        hiss(2.0), times_s, way_m, MICROPHONES_M, room_size_m=ROOM_M, rt60_s=0.0, sample_rate_hz=RATE_HZ
    )
    place_m = place_on_way(times_s, way_m, [at_s])[0]
    away_m = np.linalg.norm(MICROPHONES_M - place_m, axis=1)
    middle = round((at_s + away_m.mean() / C_M_S) * RATE_HZ)
    one, other = recorded[:, middle - 800 : middle + 800]
    lag = int(np.argmax(np.correlate(other, one, "full"))) - (len(one) - 1)
    expected_s = (away_m[1] - away_m[0]) / C_M_S
    assert lag / RATE_HZ == pytest.approx(expected_s, abs=0.15e-3 + 1 / RATE_HZ)
    elsewhere_m = place_on_way(times_s, way_m, [at_s + 0.7])[0]
    elsewhere_s = np.diff(np.linalg.norm(MICROPHONES_M - elsewhere_m, axis=1))[0] / C_M_S
    assert abs(elsewhere_s - expected_s) > 2 * (0.15e-3 + 1 / RATE_HZ)  # the test would see it elsewhere


def test_way() -> None:
    way_m = place_on_way([1.0, 2.0, 4.0], [[0, 0, 1], [1, 0, 1], [1, 4, 1]], [0.0, 1.5, 3.0, 9.0])
    assert way_m.tolist() == [[0, 0, 1], [0.5, 0, 1], [1, 2, 1], [1, 4, 1]]


def test_refuses_what_is_no_way() -> None:
    with pytest.raises(ValueError, match="ascending"):
        place_on_way([1.0, 1.0], [[0, 0, 1], [1, 0, 1]], [0.0])
    with pytest.raises(ValueError, match="step_s"):
        render_moving(
            hiss(0.1), [0.0], [[1, 1, 1]], MICROPHONES_M, room_size_m=ROOM_M, rt60_s=0.0, sample_rate_hz=RATE_HZ,
            step_s=1e-6,
        )  # fmt: skip
