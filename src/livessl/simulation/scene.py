"""Makes scenes (sounds at positions and times in a room), and renders the recordings of microphones there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
import soundfile
from numpy.typing import ArrayLike
from scipy.signal import oaconvolve, resample_poly

from livessl.core.geometry import as_positions_m
from livessl.core.types import Float32Array, FloatArray, read_only
from livessl.simulation.room import absorption, impulse_responses
from livessl.simulation.sounds import SOUNDS, hand_clap

NamedSound = tuple[str, Float32Array]
"""Name of a sound, and its mono samples (n,)."""

CLEARANCE_M: Final = 1.0
"""Least distance from a source to the centre of an array."""

GAP_S: Final = 0.8
"""Least pause, in seconds, between the reverberation of a sound and the next sound, unless another one is given."""

MAX_JITTER_S: Final = 0.5
"""Longest random addition, in seconds, to the pause between sounds, so that their starts are not periodic."""

OWN_RATES_HZ: Final = (8000.0, 1e6)
"""Lowest and highest sampling rate, in hertz, of the project's own sounds. At lower rates, half the rate would be
within the band of their hiss; at higher rates, the samples of a second would fill the memory."""

TRIES: Final = 10_000
"""Number of random positions that are tried before the room counts as having no free position."""


@dataclass(frozen=True, slots=True)
class Source:
    """One sound at one place.

    Parameters
    ----------
    name : str
        Name of the sound.
    start_s : float
        Time at which the first sample is emitted, seconds after the start of the scene.
    position_m : (3,) float64
        Metres.
    sound : (n,) float32
        Samples at the scene's sample rate; the array is made read-only.

    Raises
    ------
    ValueError
        If a shape, type or sign is wrong.
    """

    name: str
    start_s: float
    position_m: FloatArray
    sound: Float32Array

    def __post_init__(self) -> None:
        if self.position_m.shape != (3,):
            raise ValueError(f"source {self.name!r}: expected position (3,), got {self.position_m.shape}")
        if self.sound.ndim != 1 or self.sound.size == 0 or self.sound.dtype != np.float32:
            raise ValueError(
                f"source {self.name!r}: expected sound (n,) float32, got {self.sound.shape} {self.sound.dtype}"
            )
        if not self.start_s >= 0:
            raise ValueError(f"source {self.name!r}: expected a start at 0 s or later, got {self.start_s}")
        read_only(self.position_m)
        read_only(self.sound)


@dataclass(frozen=True, slots=True)
class Scene:
    """A room and all sounds in it.

    Parameters
    ----------
    room_size_m : (3,) float
        Metres, one corner at the origin.
    rt60_s : float
        Nominal reverberation time in seconds; 0 is anechoic. See `livessl.simulation.room.absorption`.
    c_m_s : float
        Speed of sound, m/s.
    sample_rate_hz : float
        Sample rate of the sounds and of the rendered recordings.
    sources : tuple of Source
        Sources in the order of their starts.
    duration_s : float
        Length of the scene in seconds; later sound is cut off.
    noise_dbfs : float
        RMS of each microphone's own white noise, dB re full scale (1.0).
    level_dbfs : float
        Expected peak of direct and reverberant sound, 1 m away from the source with the largest peak, dB re full scale.
        The levels of the sounds relative to one another do not change.
    """

    room_size_m: tuple[float, float, float]
    rt60_s: float
    c_m_s: float
    sample_rate_hz: float
    sources: tuple[Source, ...]
    duration_s: float
    noise_dbfs: float = -75.0
    level_dbfs: float = -9.0


def make_scene(
    room_size_m: Sequence[float],
    *,
    rt60_s: float,
    sounds: Sequence[NamedSound],
    count: int,
    sample_rate_hz: float,
    c_m_s: float,
    keep_away_m: ArrayLike,
    seed: int,
    lead_s: float = 1.5,
    gap_s: float = GAP_S,
    margin_m: float = 0.5,
    height_m: tuple[float, float] = (0.5, 2.2),
) -> Scene:
    """Place sounds at random in a room, one after the other.

    Positions are uniform in the allowed part of the room. Sounds are used in random order, each equally
    often. Starts fall on whole samples and are not periodic. Each sound begins after the reverberation of the sound
    before it.

    Parameters
    ----------
    room_size_m : (3,)
        Metres, one corner at the origin.
    rt60_s : float
        Nominal reverberation time, seconds.
    sounds : sequence of (name, (n,) float32)
        Sounds to choose from, at `sample_rate_hz`.
    count : int
        Number of sources, 1 or more.
    sample_rate_hz : float
        Sample rate of the scene.
    c_m_s : float
        Speed of sound, m/s.
    keep_away_m : (n, 3)
        Centres of the arrays, metres. Every source is at least 1 m away from them.
    seed : int
        The same seed and arguments give the same scene.
    lead_s : float
        Silence before the first source, seconds.
    gap_s : float
        Least pause, seconds, between the end of a sound plus `rt60_s` and the start of the next, or the scene's end.
    margin_m : float
        Least distance from the walls, metres.
    height_m : (float, float)
        Least and greatest height, metres, limited further by `margin_m`.

    Raises
    ------
    ValueError
        If there is no sound, `count` is below 1, no position is free, or the room cannot have the reverberation time.
    """
    absorption(rt60_s, room_size_m, c_m_s)
    if not sounds:
        raise ValueError("scene: expected one sound or more, got none")
    if count < 1:
        raise ValueError(f"scene: expected one source or more, got {count}")
    centres_m = as_positions_m(np.reshape(keep_away_m, (-1, 3)))
    lower_m, upper_m = _allowed_m(room_size_m, margin_m, height_m)
    rng = np.random.default_rng(seed)
    rounds = -(-count // len(sounds))
    chosen = np.concatenate([rng.permutation(len(sounds)) for _ in range(rounds)])[:count]
    sources: list[Source] = []
    time_s = lead_s
    for index in chosen:
        name, sound = sounds[index]
        start_s = float(np.ceil((time_s + rng.uniform(0.0, MAX_JITTER_S)) * sample_rate_hz) / sample_rate_hz)
        sources.append(Source(name, start_s, _free_place_m(lower_m, upper_m, centres_m, rng), sound))
        time_s = start_s + len(sound) / sample_rate_hz + rt60_s + gap_s
    x, y, z = room_size_m
    return Scene((x, y, z), rt60_s, c_m_s, sample_rate_hz, tuple(sources), time_s)


def render(
    scene: Scene,
    microphones_m: ArrayLike,
    *,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Float32Array:
    """Compute the recordings of microphones in a scene.

    The gain depends only on the scene, so the relative levels of arrays are right even if they are rendered separately.

    Parameters
    ----------
    scene : Scene
        The scene. A start between two samples is moved to the nearer sample.
    microphones_m : (K, 3)
        Absolute positions, metres.
    seed : int
        Seed of the microphones' own noise. Use different seeds for separate calls, so that their noise is independent.
    progress : callable or None
        Called after each source with (sources done, sources in all).

    Returns
    -------
    (K, n) float32
        Samples in [-1, 1].

    Raises
    ------
    ValueError
        If a source or microphone is outside the room, or the sound would clip.
    """
    microphones = as_positions_m(microphones_m)
    rate_hz = scene.sample_rate_hz
    rng = np.random.default_rng(seed)
    recorded = rng.standard_normal((len(microphones), round(scene.duration_s * rate_hz)), dtype=np.float32)
    recorded *= np.float32(_amplitude(scene.noise_dbfs))
    gain = _gain(scene)
    for done, source in enumerate(scene.sources, start=1):
        responses = impulse_responses(
            scene.room_size_m,
            source.position_m,
            microphones,
            [scene.rt60_s],
            sample_rate_hz=rate_hz,
            c_m_s=scene.c_m_s,
        )[0]
        wet = oaconvolve(responses, gain * source.sound[None], axes=1)
        first = round(source.start_s * rate_hz)
        span = recorded[:, first : first + wet.shape[1]]
        span += wet[:, : span.shape[1]]
        if progress is not None:
            progress(done, len(scene.sources))
    peak = float(np.abs(recorded).max(initial=0.0))
    if peak > 1.0:
        raise ValueError(
            f"scene: expected a peak of 1 at most, got {peak:.2f}; a microphone is too near a source: move it, "
            f"or lower level_dbfs from {scene.level_dbfs:g} by {20 * np.log10(peak):.1f} dB"
        )
    return recorded


def truth(scene: Scene) -> list[dict[str, object]]:
    """Return the results of a perfect localizer, ready for JSON.

    Returns
    -------
    list of dict
        For each source: `name`, `start_s` (time of its first sample after the start of the scene, seconds),
        `duration_s` (without reverberation) and `position_m` [x, y, z].
    """
    return [
        {
            "name": source.name,
            "start_s": source.start_s,
            "duration_s": len(source.sound) / scene.sample_rate_hz,
            "position_m": source.position_m.tolist(),
        }
        for source in scene.sources
    ]


def synthesised_sounds(sample_rate_hz: float, seed: int) -> list[NamedSound]:
    """Synthesise each of the project's own sounds once: (name, (n,) float32). The seed determines the samples.

    Raises
    ------
    ValueError
        If the sampling rate is outside `OWN_RATES_HZ`.
    """
    _require_own_rate(sample_rate_hz)
    return [
        (name, sound(np.random.default_rng([seed, index]), sample_rate_hz))
        for index, (name, sound) in enumerate(SOUNDS.items())
    ]


def synthesised_claps(sample_rate_hz: float, seed: int, count: int) -> list[NamedSound]:
    """Synthesise claps of two hands, each another one; parameters and errors are those of `synthesised_sounds`."""
    _require_own_rate(sample_rate_hz)
    return [("clap", hand_clap(np.random.default_rng([seed, index]), sample_rate_hz)) for index in range(count)]


def _require_own_rate(sample_rate_hz: float) -> None:
    low, high = OWN_RATES_HZ
    if not low <= sample_rate_hz <= high:
        raise ValueError(
            f"sampling rate: expected {low:g} to {high:g} Hz for the project's own sounds, got {sample_rate_hz:g}"
        )


def read_sounds(directory: Path, sample_rate_hz: float) -> list[NamedSound]:
    """Read every WAV and FLAC file of a directory, in order of their names.

    Parameters
    ----------
    directory : Path
        Directory with the files; its subdirectories are not searched.
    sample_rate_hz : float
        Sample rate of the result; files with another rate are resampled.

    Returns
    -------
    list of (name, (n,) float32)
        Name of each file without its ending, and the mean of its channels.

    Raises
    ------
    ValueError
        If there is no such file, or a file cannot be read, is empty, silent or has values that are not finite.
    """
    paths = sorted(path for path in directory.glob("*") if path.suffix.lower() in {".wav", ".flac"})
    if not paths:
        raise ValueError(f"{directory}: expected WAV or FLAC files, got none; give a directory that holds sounds")
    return [(path.stem, _read(path, sample_rate_hz)) for path in paths]


def _read(path: Path, sample_rate_hz: float) -> Float32Array:
    try:
        samples, rate_hz = soundfile.read(path, dtype="float32", always_2d=True)
    except (OSError, soundfile.LibsndfileError) as error:
        raise ValueError(f"{path}: expected a readable WAV or FLAC file, got {error}; replace or remove it") from error
    if len(samples) == 0:
        raise ValueError(f"{path}: expected sound, got a file of no samples; replace or remove it")
    if not np.isfinite(samples).all():
        raise ValueError(f"{path}: expected finite samples, got NaN or infinity; replace or remove it")
    mono = samples.mean(axis=1)
    if not mono.any():
        raise ValueError(f"{path}: expected sound, got only zeros; replace or remove it")
    ratio = Fraction(sample_rate_hz).limit_denominator(1000) / rate_hz
    return np.asarray(resample_poly(mono, ratio.numerator, ratio.denominator), dtype=np.float32)


def _amplitude(level_db: float) -> float:
    return float(10.0 ** (level_db / 20.0))


def _gain(scene: Scene) -> np.float32:
    """Return the factor that gives the largest peak of all sources the level `level_dbfs` at 1 m.

    At 1 m a direct path has the amplitude 1/(4 pi), and the diffuse field 16 pi (1 - alpha) / (alpha S) times the power
    of the direct path (critical distance: Kuttruff, Room Acoustics, ch. 5).
    """
    peak = max((float(np.abs(source.sound).max()) for source in scene.sources), default=0.0)
    if peak == 0.0:
        return np.float32(0.0)
    x, y, z = scene.room_size_m
    alpha = absorption(scene.rt60_s, scene.room_size_m, scene.c_m_s)
    diffuse = 16.0 * np.pi * (1.0 - alpha) / (alpha * 2.0 * (x * y + y * z + z * x))
    return np.float32(4.0 * np.pi * _amplitude(scene.level_dbfs) / (peak * np.sqrt(1.0 + diffuse)))


def _allowed_m(
    room_size_m: Sequence[float], margin_m: float, height_m: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    lower_m = np.full(3, margin_m)
    upper_m = np.array(room_size_m, dtype=np.float64) - margin_m
    lower_m[2] = max(lower_m[2], height_m[0])
    upper_m[2] = min(upper_m[2], height_m[1])
    if not (lower_m < upper_m).all():
        raise ValueError(
            f"scene: a room of {' x '.join(f'{x:g}' for x in room_size_m)} m leaves no place {margin_m:g} m from its "
            f"walls and {height_m[0]:g} to {height_m[1]:g} m high; make margin_m smaller or height_m wider"
        )
    return lower_m, upper_m


def _free_place_m(
    lower_m: FloatArray, upper_m: FloatArray, centres_m: FloatArray, rng: np.random.Generator
) -> FloatArray:
    for _ in range(TRIES):
        position_m = rng.uniform(lower_m, upper_m)
        if (np.linalg.norm(centres_m - position_m, axis=1) >= CLEARANCE_M).all():
            return position_m
    raise ValueError(
        f"scene: expected a place {CLEARANCE_M:g} m or more from every array, found none in {TRIES} tries; "
        "make margin_m smaller, height_m wider or the room larger"
    )
