"""The values that flow through livessl: frozen, validated where they are made, arrays read-only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
UInt8Array = NDArray[np.uint8]
UInt16Array = NDArray[np.uint16]
FloatArray = NDArray[np.float64]
RealArray = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complex64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

FRAME_NS: Final = 50_000_000
"""Length of a frame and step of the grid of frames, in nanoseconds: the paper's 50 ms."""

FRAME_S: Final = FRAME_NS / 1e9
"""Length of a frame in seconds."""

MIN_MICROPHONES: Final = 2
MAX_MICROPHONES: Final = 16

MAX_SAMPLE: Final = 1e6
"""120 dB above full scale: no converter gives more, and what does is a broken file or sender, whose one sample would
drown every other array."""


class ClockState(StrEnum):
    """How far a node's mapping from sample index to site time can be trusted."""

    SETTLING = "settling"
    LOCKED = "locked"
    STEPPED = "stepped"


class Status(StrEnum):
    """What an event's answer is worth."""

    LOCATED = "located"
    DIRECTION_ONLY = "direction-only"
    REFUSED = "refused"


class TrackState(StrEnum):
    """Where a track is in its life."""

    NEW = "new"
    UPDATE = "update"
    END = "end"


def read_only(array: NDArray[Any]) -> None:
    """Make `array` refuse writes, so that a value may be shared without copies."""
    array.setflags(write=False)


@dataclass(frozen=True, slots=True)
class Block:
    """What a device hands over at once.

    Parameters
    ----------
    first_index : int
        Index of the first sample, counted by the device from the start of the stream.
    samples : (channels, n) float32
        In [-1, 1). Zero samples mean "still nothing": a device that waits says so instead of blocking.
    stamp_ns : int
        Site time of the first sample as seen on arrival, in nanoseconds since the epoch; jitters.
    overflow : bool
        Samples were lost just before this block; how many is unknown.
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
    """One frame index of one array's sound.

    Parameters
    ----------
    array : str
        Name of the array.
    sequence : int
        Counts the array's frames since its node started, from 1; 0 where `requested`.
    frame_index : int
        Index on the grid of 50 ms: `time_ns` of the interval's start divided by 50 ms.
    time_ns : int
        Site time (UTC since the epoch) of the first sample.
    sample_rate_hz : float
        Nominal sampling rate.
    samples : (channels, n) float32
        In channel order of the array's microphones.
    power : float
        In-band mean power over the channels, full scale squared.
    active : bool
        Whether the causal activity detection found sound in it.
    requested : bool
        The frame answers a `BackfillRequest`. It stands outside the count of frames that the node sends by itself.
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


@dataclass(frozen=True, slots=True)
class Mark:
    """Says "alive, and quiet in this frame index", and how the node is.

    Parameters
    ----------
    array, frame_index
        As in `Frame`.
    sequence : int
        Of the array's last frame; 0 before the first. Marks have no number of their own: one that is not sent is no
        loss.
    power : float
        In-band mean power over the channels in the interval, full scale squared.
    noise_power : float
        The node's estimate of the background, full scale squared.
    channel_power : tuple of float
        In-band mean power of each channel, full scale squared; 0 is a dead channel.
    overflows, lost_frames : int
        Since the node started: blocks that followed a loss of samples; frames thrown away for a gap or a full spool.
    drift_ppm : float
        Rate of the device's clock against site time, parts per million; 0 until it is known.
    clock : ClockState
        State of the mapping from sample index to site time.
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


@dataclass(frozen=True, slots=True)
class GCC:
    """Generalized cross-correlations of one array.

    Parameters
    ----------
    pairs : (P, 2) int64
        Microphone indices (i, k), i < k.
    lags_s : (L,) float64
        Lags in seconds, ascending and evenly spaced. Positive lag of pair (i, k): channel k hears it later.
    values : (P, L) float32 or float64
        1 is perfect coherence at that lag.
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
    """

    name: str
    microphones_m: FloatArray
    band_hz: tuple[float, float]

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
        Of its whole band.
    below : tuple of GCC
        Of what lies below each of the band's cut-offs, where its map is limited against spatial aliasing.
    """

    spec: ArraySpec
    gcc: GCC
    below: tuple[GCC, ...] = ()


@dataclass(frozen=True, slots=True)
class Estimate:
    """A position and how sure it is.

    Parameters
    ----------
    time_ns : int
        Site time at the middle of the sound used.
    position_m : (3,) float64
        Metres, room corner at the origin.
    covariance_m2 : (3, 3) float64
        Square metres. An axis that the search volume fixes has zeros.
    confidence : float
        0 to 1: how far the map's peak stands out from the next best place. Not yet a probability.
    arrays : tuple of str
        Who contributed.
    """

    time_ns: int
    position_m: FloatArray
    covariance_m2: FloatArray
    confidence: float
    arrays: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.position_m.shape != (3,) or self.covariance_m2.shape != (3, 3):
            raise ValueError(
                f"estimate: expected position (3,) and covariance (3, 3), "
                f"got {self.position_m.shape} and {self.covariance_m2.shape}"
            )
        read_only(self.position_m)
        read_only(self.covariance_m2)


@dataclass(frozen=True, slots=True)
class Contribution:
    """What one array brought to an event.

    Parameters
    ----------
    array : str
        Name of the array.
    active_s : float
        Length of its sound that was used, seconds.
    power : float
        Its in-band mean power over that time, full scale squared.
    azimuth_deg, elevation_deg, distance_m : float
        Direction and distance from the array's centre to the position found; azimuth counter-clockwise from +x.
    agrees : bool or None
        Whether it agrees with the others; one that does not was outvoted, and has no part in the position. None where
        nobody can tell: it was alone, or the estimator does not ask.
    off_deg : float or None
        By what angle it heard the sound elsewhere, where it does not agree.
    asked : bool
        It had not found the sound active by itself, and was asked for what it had.
    """

    array: str
    active_s: float
    power: float
    azimuth_deg: float
    elevation_deg: float
    distance_m: float
    agrees: bool | None = None
    off_deg: float | None = None
    asked: bool = False


@dataclass(frozen=True, slots=True)
class Update:
    """Where the sound that is still going on seems to be: as in `Event`, from its last moments."""

    event_id: str
    status: Status
    estimate: Estimate
    power: float
    contributions: tuple[Contribution, ...] = ()
    complete_ns: int = 0
    others: tuple[Estimate, ...] = ()
    """Further sources that sound at the same time."""


@dataclass(frozen=True, slots=True)
class Event:
    """A finished sound and where it happened.

    Parameters
    ----------
    id : str
        Stable name of the event.
    start_ns, end_ns : int
        Site time of its first and last active frame's outer edges.
    status : Status
        Whether `estimate` is a position, a direction only, or refused.
    reason : str or None
        Why it is not simply located, in words.
    estimate : Estimate or None
        None when refused.
    power : float
        Greatest in-band frame power over all arrays, full scale squared.
    method : str
        Name of the estimator.
    contributions : tuple of Contribution
        One for each array used.
    heard_by : tuple of str
        Every array that found it active, used or not.
    late_frames : int
        Frames that came after their window had closed.
    latency_s : float
        From the end of the sound to this answer.
    late : bool
        Whether sound took part in it that came after its windows had closed.
    complete_ns : int
        Site time at which all had happened that the answer waits for: the sound, and the quiet that ends it.
    source : int
        1; or 2 for the second of two sources that sounded at the same time, of which each has an event.
    """

    id: str
    start_ns: int
    end_ns: int
    status: Status
    reason: str | None
    estimate: Estimate | None
    power: float
    method: str
    contributions: tuple[Contribution, ...] = ()
    heard_by: tuple[str, ...] = ()
    late_frames: int = 0
    latency_s: float = 0.0
    late: bool = False
    complete_ns: int = 0
    source: int = 1

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return (self.end_ns - self.start_ns) / 1e9


@dataclass(frozen=True, slots=True)
class Track:
    """A source followed over several estimates.

    Parameters
    ----------
    id : int
        Stable while the track lives.
    state : TrackState
        new, update or end.
    time_ns : int
        Site time of the state below.
    position_m, velocity_m_s : (3,) float64
        Metres, metres a second.
    covariance_m2 : (3, 3) float64
        Of the position.
    """

    id: int
    state: TrackState
    time_ns: int
    position_m: FloatArray
    velocity_m_s: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True, slots=True)
class Window:
    """What a window was localized from: enough to draw its power maps, should somebody want to look at them.

    Parameters
    ----------
    time_ns : int
        Site time at the middle of the window.
    evidence : tuple of Evidence
        One for each array that heard it.
    """

    time_ns: int
    evidence: tuple[Evidence, ...]


@dataclass(frozen=True, slots=True)
class BackfillRequest:
    """A wish for an array's frames of a time at which it sent none.

    Parameters
    ----------
    array : str
    first, last : int
        Raster intervals, both included, by the array's own clock.
    """

    array: str
    first: int
    last: int


Message = Frame | Mark
"""What a node sends about sound."""

Output = Update | Event | Track | Window | BackfillRequest
"""What fusion says."""
