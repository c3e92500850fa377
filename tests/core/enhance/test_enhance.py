"""One signal of two arrays: aligned whatever their clocks show, and clearer than each of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sound_at import (
    C_M_S,
    NORTH,
    PLACE_M,
    QUIET_S,
    RATE_HZ,
    SOUND_S,
    SOUTH,
    burst,
    hiss,
    received,
    recorded,
)

from livessl.core.enhance.align import shifted
from livessl.core.enhance.beam import ArraySound
from livessl.core.enhance.enhance import Enhancement, plan
from livessl.core.types import ArraySpec, FloatArray

SPECS = (NORTH, SOUTH)


def sounds_of(
    level: float, clocks_ns: Sequence[int] = (0, 0), seed: int = 0, hole: slice | None = None
) -> tuple[list[ArraySound], dict[str, FloatArray], dict[str, FloatArray]]:
    """What both arrays recorded in noise, the sound's part of it, and the noise's."""
    sound = burst(seed)
    clean = {spec.name: received(spec, sound) for spec in SPECS}
    noise = {spec.name: hiss(spec, len(sound), seed + n, level) for n, spec in enumerate(SPECS, 1)}
    made = [
        recorded(spec, clean[spec.name] + noise[spec.name], time_ns=time_ns, hole=hole if spec is NORTH else None)
        for spec, time_ns in zip(SPECS, clocks_ns, strict=True)
    ]
    return made, clean, noise


def during(made: Enhancement, signal: FloatArray) -> FloatArray:
    """The signal while the source emits its sound, which begins at `QUIET_S` of site time."""
    first = round((QUIET_S - made.time_ns / 1e9) * RATE_HZ)
    return signal[first : first + round(SOUND_S * RATE_HZ)]


def power(signal: FloatArray) -> float:
    return float(np.square(signal).mean())


def as_float32(parts: dict[str, FloatArray]) -> dict[str, np.ndarray[tuple[int, int], np.dtype[np.float32]]]:
    return {name: np.asarray(part, dtype=np.float32) for name, part in parts.items()}


def snr_db(sound: FloatArray, noise: FloatArray) -> float:
    return float(10.0 * np.log10(power(sound) / power(noise)))


@settings(max_examples=6)
@given(ahead_s=st.floats(-0.045, 0.045), seed=st.integers(0, 100))
def test_clip_is_clearer_than_the_best_microphone_whatever_the_clocks_show(ahead_s: float, seed: int) -> None:
    made, clean, noise = sounds_of(0.01, (0, round(1e9 * ahead_s)), seed)
    enhancement = plan(made, PLACE_M, C_M_S)
    kept, left = (during(enhancement, enhancement.apply(as_float32(part))) for part in (clean, noise))
    span = slice(round((QUIET_S + 0.01) * RATE_HZ), round((QUIET_S + SOUND_S) * RATE_HZ))
    best_db = max(snr_db(c[span], n[span]) for name in clean for c, n in zip(clean[name], noise[name], strict=True))
    assert snr_db(kept, left) > best_db + 4.5  # eight microphones, of which four are far away
    assert sum(part.share for part in enhancement.parts) == pytest.approx(1.0)


@pytest.mark.parametrize("level", [0.001, 0.01])
def test_clip_is_the_sound_of_the_source_at_its_own_time(level: float) -> None:
    made, clean, _ = sounds_of(level)
    enhancement = plan(made, PLACE_M, C_M_S)
    found = enhancement.apply(as_float32(clean))
    expected = shifted(burst(), -enhancement.time_ns / 1e9 * RATE_HZ, len(found))
    assert np.corrcoef(during(enhancement, found), during(enhancement, expected))[0, 1] > 0.995
    early = shifted(expected, -1.0, len(found))  # a sample off would show
    assert np.corrcoef(during(enhancement, found), during(enhancement, early))[0, 1] < 0.95


@given(ahead_s=st.floats(-0.045, 0.045))
@settings(max_examples=6)
def test_lag_between_the_clocks_is_reported(ahead_s: float) -> None:
    made, _, _ = sounds_of(0.003, (0, round(1e9 * ahead_s)))
    first, other = plan(made, PLACE_M, C_M_S).parts
    behind_s = other.lag_s if first.array == "north" else -other.lag_s
    assert behind_s == pytest.approx(ahead_s, abs=5e-5)  # the arrays' own noise moves the peak by less than a sample


def test_apply_is_linear() -> None:
    made, clean, noise = sounds_of(0.01)
    enhancement = plan(made, PLACE_M, C_M_S)
    whole = enhancement.apply({sound.spec.name: sound.samples for sound in made})
    parts = [enhancement.apply(as_float32(part)) for part in (clean, noise)]
    np.testing.assert_allclose(whole, parts[0] + parts[1], atol=1e-5)


def test_gap_of_one_array_is_filled_by_the_other() -> None:
    hole = slice(10000, 13000)
    made, _, _ = sounds_of(0.003, hole=hole)
    enhancement = plan(made, PLACE_M, C_M_S)
    whole = plan(sounds_of(0.003)[0], PLACE_M, C_M_S)
    shift = round(-enhancement.time_ns / 1e9 * RATE_HZ) - round(
        np.linalg.norm(NORTH.centre_m - PLACE_M) / C_M_S * RATE_HZ
    )
    inside = slice(hole.start + shift + 600, hole.stop + shift - 600)
    signals = [
        each.apply({sound.spec.name: sound.samples for sound in given})
        for each, given in ((enhancement, made), (whole, sounds_of(0.003)[0]))
    ]
    assert power(signals[0][inside]) == pytest.approx(power(signals[1][inside]), rel=0.3)
    alone = enhancement.apply({"north": made[0].samples, "south": np.zeros_like(made[1].samples)})
    assert power(alone[inside]) < 1e-9  # the test would not notice if the hole had been full


def test_array_that_received_something_else_is_left_out() -> None:
    made, _, _ = sounds_of(0.003)
    noise = recorded(SOUTH, hiss(SOUTH, made[1].samples.shape[1], 9, 0.05))
    enhancement = plan([made[0], noise], PLACE_M, C_M_S)
    shares = {part.array: part.share for part in enhancement.parts}
    assert shares == {"north": pytest.approx(1.0), "south": 0.0}


def test_arrays_of_different_rates_are_combined() -> None:
    def at(spec: ArraySpec, rate_hz: float) -> ArraySound:
        sound = burst(3, 48000.0)[:: round(48000.0 / rate_hz)]
        samples = received(spec, sound, rate_hz=rate_hz) + hiss(spec, len(sound), round(rate_hz), 0.001)
        return recorded(spec, samples, rate_hz=rate_hz)

    enhancement = plan([at(NORTH, 16000.0), at(SOUTH, 48000.0)], PLACE_M, C_M_S)
    assert all(part.share > 0.02 for part in enhancement.parts)
    assert [part.lag_s for part in enhancement.parts] == pytest.approx([0.0, 0.0], abs=5e-5)


def test_one_array_is_enough_and_none_is_an_error() -> None:
    made, _, _ = sounds_of(0.003)
    [part] = plan(made[:1], PLACE_M, C_M_S).parts
    assert (part.array, part.share) == ("north", 1.0)
    with pytest.raises(ValueError, match="expected the sound of one array or more, got none"):
        plan([], PLACE_M, C_M_S)


def test_noise_alone_gives_a_finite_signal() -> None:
    made = [recorded(spec, hiss(spec, 19200, n, 0.01)) for n, spec in enumerate(SPECS)]
    enhancement = plan(made, PLACE_M, C_M_S)
    assert np.isfinite(enhancement.apply({sound.spec.name: sound.samples for sound in made})).all()
