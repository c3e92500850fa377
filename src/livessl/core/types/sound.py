"""Sound as values: blocks, frames, marks, GCCs and arrays; their limits, and the frame length (50 ms)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.states import ClockState
from livessl.core.types.arrays import BoolArray, Float32Array, FloatArray, IntArray, RealArray, read_only
from livessl.core.types.report import ChannelLevel, HostState

FRAME_NS: Final = 50_000_000
"""Length of a frame, and step of the frame index, in nanoseconds: the paper's 50 ms."""

FRAME_S: Final = FRAME_NS / 1e9
"""Length of a frame in seconds."""

MIN_MICROPHONES: Final = 2
"""Fewest microphones of an array: one pair."""

MAX_MICROPHONES: Final = 16
"""Most microphones of an array: tables grow with its 120 pairs."""

MAX_SAMPLE: Final = 1e6
"""Largest magnitude of a sample, 120 dB above full scale. No converter gives more; a larger value comes from a broken
file or sender, and one such sample would mask every other array."""


@dataclass(frozen=True, slots=True)
class Block:
    """Samples that a device delivers at once.

    Parameters
    ----------
    first_index : int
        Index of the first sample, counted by the device from the start of the stream.
    samples : (channels, n) float32
        Samples in [-1, 1). An empty block means that no samples are available yet; reading never waits.
    stamp_ns : int
        Site time at which the first sample was seen to arrive, in nanoseconds since the epoch; it jitters.
    overflow : bool
        Whether samples, of unknown number, were lost just before this block.

    Raises
    ------
    ValueError
        If the samples are not float32 with two axes.
    """

    first_index: int
    samples: Float32Array
    stamp_ns: int
    overflow: bool = False

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.dtype != np.float32:
            raise ValueError(
                f"block: samples must be (channels, n) float32, got {self.samples.shape} {self.samples.dtype}"
            )
        read_only(self.samples)


@dataclass(frozen=True, slots=True)
class Frame:
    """The sound of one array in one interval of 50 ms.

    Parameters
    ----------
    array : str
        Name of the array.
    sequence : int
        Number of the array's frame since its node started, from 1; 0 where `requested`.
    frame_index : int
        Index on the grid of frames: site time of the interval's start divided by 50 ms.
    time_ns : int
        Site time (UTC since the epoch) of the first sample, in nanoseconds.
    sample_rate_hz : float
        Nominal sampling rate.
    samples : (channels, n) float32
        Channels in the order of the array's microphones.
    power : float
        In-band mean power over the channels, full scale squared.
    active : bool
        Whether the causal activity detection found sound in it.
    requested : bool
        Whether it answers a `BackfillRequest`. It is then outside the numbering of the frames that the node sends by
        itself.

    Raises
    ------
    ValueError
        If the samples are not float32 with two axes.
    """

    array: str
    sequence: int
    frame_index: int
    time_ns: int
    sample_rate_hz: float
    samples: Float32Array
    power: float
    active: bool
    requested: bool = False

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.dtype != np.float32:
            raise ValueError(
                f"frame of array {self.array!r}: samples must be (channels, n) float32, "
                f"got {self.samples.shape} {self.samples.dtype}"
            )
        read_only(self.samples)

    def without_samples(self) -> Frame:
        """Return a copy without samples that keeps name, times, power and activity."""
        return Frame(
            self.array,
            self.sequence,
            self.frame_index,
            self.time_ns,
            self.sample_rate_hz,
            np.empty((len(self.samples), 0), dtype=np.float32),
            self.power,
            self.active,
            self.requested,
        )


@dataclass(frozen=True, slots=True)
class Mark:
    """Sign of life for an interval without a frame, with the state of the node.

    Parameters
    ----------
    array, frame_index
        As in `Frame`.
    sequence : int
        Sequence number of the array's last frame, 0 before the first. Marks have no number of their own, because a lost
        mark is no loss.
    power : float
        In-band mean power over the channels in the interval, full scale squared.
    noise_power : float
        The node's estimate of the background, full scale squared.
    channel_power : tuple of float
        In-band mean power of each channel, full scale squared; 0 for a dead channel.
    overflows, lost_frames : int
        Counts since the node started. `overflows` counts blocks that follow lost samples; `lost_frames` counts frames
        that were dropped because of a gap or a full spool.
    drift_ppm : float
        Rate of the device's clock against site time, parts per million; 0 until it is known.
    clock : ClockState
        State of the mapping from sample index to site time.
    levels : tuple of ChannelLevel
        Level of each channel, in the first mark after each second of sound; empty in all others.
    drift_error_ppm : float or None
        Error that `drift_ppm` may have, parts per million, in marks with levels; None if it is not known.
    host : HostState or None
        State of the node's machine, in marks with levels of a node that captures now; None in all others.
    """

    array: str
    sequence: int
    frame_index: int
    power: float
    noise_power: float
    channel_power: tuple[float, ...]
    overflows: int = 0
    lost_frames: int = 0
    drift_ppm: float = 0.0
    clock: ClockState = ClockState.SETTLING
    levels: tuple[ChannelLevel, ...] = ()
    drift_error_ppm: float | None = None
    host: HostState | None = None


Message = Frame | Mark
"""Message of a node about the sound of an array."""


@dataclass(frozen=True, slots=True)
class GCC:
    """Generalized cross-correlations of one array.

    Parameters
    ----------
    pairs : (P, 2) int64
        Microphone indices (i, k), i < k.
    lags_s : (L,) float64
        Lags in seconds, ascending and evenly spaced. Positive lag of pair (i, k): the sound reaches channel k later.
    values : (P, L) float32 or float64
        Correlation, 1 for perfect coherence at that lag.

    Raises
    ------
    ValueError
        If `values` has another shape.
    """

    pairs: IntArray
    lags_s: FloatArray
    values: RealArray

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.pairs), len(self.lags_s)):
            raise ValueError(
                f"GCC: values must be (pairs, lags) = {(len(self.pairs), len(self.lags_s))}, got {self.values.shape}"
            )
        for array in (self.pairs, self.lags_s, self.values):
            read_only(array)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Accuracy to which an array's set-up is known, as standard deviations.

    Parameters
    ----------
    position_m : float
        Place of the array and of its microphones, metres.
    orientation_deg : float
        Angle by which it may be turned, degrees.
    clock_s : float
        Standard deviation of the delay between two channels, seconds; 0 if one converter samples them all.
    temperature_c : float
        Air temperature, degrees Celsius.
    """

    position_m: float = 0.02
    orientation_deg: float = 1.5
    clock_s: float = 1e-4
    temperature_c: float = 5.0


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """A microphone array as the core needs it.

    Parameters
    ----------
    name : str
        Name in the site file.
    microphones_m : (K, 3) float64
        Absolute positions in channel order, metres.
    band_hz : (float, float)
        Lowest and highest frequency used.
    uncertainty : Uncertainty
        How well its set-up is known.
    parts : tuple of int
        Number of microphones on each rigid part of a joint array, in the order of the channels; empty if all are on
        one part.

    Raises
    ------
    ValueError
        If the number of microphones or the band is out of range, or the parts do not add up to the number of
        microphones.
    """

    name: str
    microphones_m: FloatArray
    band_hz: tuple[float, float]
    uncertainty: Uncertainty = Uncertainty()
    parts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        count, *rest = self.microphones_m.shape
        if rest != [3] or not MIN_MICROPHONES <= count <= MAX_MICROPHONES:
            raise ValueError(
                f"array {self.name!r}: expected 2 to 16 microphone positions (K, 3), "
                f"got shape {self.microphones_m.shape}"
            )
        low, high = self.band_hz
        if not 0 <= low < high:
            raise ValueError(f"array {self.name!r}: expected a band 0 <= low < high in Hz, got {self.band_hz}")
        if self.parts and sum(self.parts) != count:
            raise ValueError(f"array {self.name!r}: expected parts of {count} microphones in all, got {self.parts}")
        read_only(self.microphones_m)

    @property
    def centre_m(self) -> FloatArray:
        """Mean microphone position (3,), metres."""
        return np.asarray(self.microphones_m.mean(axis=0))

    @property
    def aperture_m(self) -> float:
        """Largest distance between two microphones, metres."""
        difference = self.microphones_m[:, None] - self.microphones_m[None]
        return float(np.sqrt((difference**2).sum(axis=2)).max())


@dataclass(frozen=True, slots=True)
class Evidence:
    """One array's evidence of one sound.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    gcc : GCC
        Correlations of the whole band.
    below : tuple of GCC
        Correlations of the part of the band below each cut-off, if the array's map is limited against spatial aliasing.
    noise_rms : float
        Root mean square that a pair's GCC, or the real part of its analytic signal, would have if the phases between
        the microphones were random; 0 if it is not known.
    is_presumed : bool
        Whether the array is taken to contribute even if its sound does not stand out from its noise.
    background : (P, L) float32, or None
        What `gcc.values` would be of a background alone that went on as it was before the sound; None if that is not
        known.
    beginning : Evidence or None
        Evidence of the frames in which the sound begins, alone; None if they are not known, or if there are no others.
    """

    spec: ArraySpec
    gcc: GCC
    below: tuple[GCC, ...] = ()
    noise_rms: float = 0.0
    is_presumed: bool = True
    background: Float32Array | None = None
    beginning: Evidence | None = None


@dataclass(frozen=True, slots=True)
class Observation:
    """Delays and levels of one sound in the channels of one array, measured without knowing where the microphones are.

    Parameters
    ----------
    array : str
        Name of the array.
    delays_s : (K,) float64
        Delay of each channel against the mean of all that have one, seconds; NaN for a channel without sound.
    inverted : (K,) bool
        True for channels whose polarity is opposite to that of most channels.
    coherence : (K,) float64
        Mean height of the correlations of each channel with the others at these delays: about 1 for a single direct
        sound, about 0 for a channel that received something else.
    powers : (K,) float64
        Mean power of each channel, with hum and rumble attenuated, full scale squared.
    sharpness : float
        Mean height of all pairs' correlations at these delays over their root mean square; noise gives 1 to 3.
    closure_s : float
        Root mean square difference between each pair's peak lag and the lag that `delays_s` implies, seconds.
    """

    array: str
    delays_s: FloatArray
    inverted: BoolArray
    coherence: FloatArray
    powers: FloatArray
    sharpness: float
    closure_s: float

    def __post_init__(self) -> None:
        for array in (self.delays_s, self.inverted, self.coherence, self.powers):
            read_only(array)


@dataclass(frozen=True, slots=True)
class Received:
    """One array's reception of one sound, from which an `Observation` is made when it is needed.

    Parameters
    ----------
    evidence : Evidence
    powers : (K,) float64
        Mean power of each channel, with hum and rumble attenuated, full scale squared.
    """

    evidence: Evidence
    powers: FloatArray
