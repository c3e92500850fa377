"""Results of the fusion as values: estimates, updates, events, tracks, candidates and backfill requests.

How they are judged is in `core/stream/verdict.py`; their JSON is made in `server/api/encode.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from livessl.core.states import Status, TrackState
from livessl.core.types.arrays import FloatArray, read_only
from livessl.core.types.sound import Evidence, Received


@dataclass(frozen=True, slots=True)
class Candidate:
    """One of several places that explain a sound about equally well.

    Parameters
    ----------
    position_m : (3,) float64
        Metres, room corner at the origin.
    probability : float
        Probability of this place among all candidates, 0 to 1.
    """

    position_m: FloatArray
    probability: float

    def __post_init__(self) -> None:
        read_only(self.position_m)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A position and its certainty.

    Parameters
    ----------
    time_ns : int
        Site time at the middle of the sound used, in nanoseconds.
    position_m : (3,) float64
        Metres, room corner at the origin.
    covariance_m2 : (3, 3) float64
        Covariance of the position's whole error, in square metres. Rows and columns are zero along an axis on which the
        search volume is flat.
    confidence : float
        From 0 to 1. With `onset` it is the probability that the position is within 0.5 m of the source, given errors of
        the set-up as large as the site file states. With other methods it is the margin of the map's peak over the next
        best place, which is not a probability.
    arrays : tuple of str
        Arrays from which the position was computed.
    candidates : tuple of Candidate
        The position, and then the places that explain the sound about as well, most probable first; empty if there are
        none.
    set_up_covariance_m2 : (3, 3) float64
        The part of `covariance_m2` that comes from errors of the poses and of the speed of sound, as large as the site
        file states. All sounds from one place have this error in common.
    confidence_of_sound : float or None
        The confidence that an exact set-up would give; None if that equals `confidence`.

    Raises
    ------
    ValueError
        If position or covariance has another shape.
    """

    time_ns: int
    position_m: FloatArray
    covariance_m2: FloatArray
    confidence: float
    arrays: tuple[str, ...]
    candidates: tuple[Candidate, ...] = ()
    set_up_covariance_m2: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    confidence_of_sound: float | None = None

    @property
    def sound_confidence(self) -> float:
        """The confidence without the error of the set-up."""
        return self.confidence if self.confidence_of_sound is None else self.confidence_of_sound

    @property
    def sound_covariance_m2(self) -> FloatArray:
        """The part of `covariance_m2` (3, 3) by which positions of one source differ from one another."""
        return self.covariance_m2 - self.set_up_covariance_m2

    def __post_init__(self) -> None:
        if self.position_m.shape != (3,) or self.covariance_m2.shape != (3, 3):
            raise ValueError(
                f"estimate: expected position (3,) and covariance (3, 3), "
                f"got {self.position_m.shape} and {self.covariance_m2.shape}"
            )
        read_only(self.position_m)
        read_only(self.covariance_m2)
        read_only(self.set_up_covariance_m2)


@dataclass(frozen=True, slots=True)
class Contribution:
    """One array's part in an event.

    Parameters
    ----------
    array : str
        Name of the array.
    active_s : float
        Length of its sound that was used, in seconds.
    power : float
        In-band mean power of that sound, full scale squared.
    azimuth_deg, elevation_deg, distance_m : float
        Direction and distance of the position from the array's centre; azimuth counter-clockwise from +x.
    agrees : bool or None
        Whether the array agrees with the others; False for an outlier, which has no part in the position. None if it
        was alone, or the estimator does not look for outliers.
    off_deg : float or None
        Angle between an outlier's own direction and the position; None if it agrees.
    asked : bool
        True if the array did not detect the sound and its frames came by a backfill request.
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
    """Position of a sound that is still going on, from its last window.

    Parameters
    ----------
    event_id : str
        `Event.id` of the event that the sound will become.
    status, estimate, power, contributions, complete_ns
        As in `Event`, but of the window alone.
    others : tuple of Estimate
        Further sources that sound at the same time.
    """

    event_id: str
    status: Status
    estimate: Estimate
    power: float
    contributions: tuple[Contribution, ...] = ()
    complete_ns: int = 0
    others: tuple[Estimate, ...] = ()


@dataclass(frozen=True, slots=True)
class Event:
    """A finished sound and where it happened.

    Parameters
    ----------
    id : str
        Stable name of the event.
    start_ns, end_ns : int
        Site time at which its first active frame begins and its last one ends, in nanoseconds.
    status : Status
        Whether `estimate` is a position, a direction only, or missing.
    reason : str or None
        Why the status is not `located`, which outliers were excluded, or by how much the set-up alone may be wrong if
        that is more than 0.5 m; None otherwise.
    estimate : Estimate or None
        None if the event was refused.
    power : float or None
        Greatest in-band frame power over all arrays, full scale squared. Of two sources that sounded at the same time,
        each has its share; None for a second source whose share cannot be determined.
    method : str
        Name of the localization method.
    contributions : tuple of Contribution
        One for each array used.
    heard_by : tuple of str
        All arrays that detected it, used or not.
    late_frames : int
        Active frames that arrived after their frame index had closed.
    latency_s : float
        Time from the end of the sound to this answer, in seconds.
    late : bool
        Whether the answer uses active frames that arrived after their frame index had closed.
    complete_ns : int
        Site time at which the last sound needed for the answer ended: the end of the hang-over.
    source : int
        1, or 2 for the second of two sources that sounded at the same time, each of which has an event.
    received : tuple of Received
        What each array received, for the examination of the set-up; empty for a second source and under overload.
        Two events that differ only in it are equal.
    """

    id: str
    start_ns: int
    end_ns: int
    status: Status
    reason: str | None
    estimate: Estimate | None
    power: float | None
    method: str
    contributions: tuple[Contribution, ...] = ()
    heard_by: tuple[str, ...] = ()
    late_frames: int = 0
    latency_s: float = 0.0
    late: bool = False
    complete_ns: int = 0
    source: int = 1
    received: tuple[Received, ...] = field(default=(), compare=False, repr=False)

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
        Number that stays the same while the track lives.
    state : TrackState
        new, update or end.
    time_ns : int
        Site time of position and velocity, in nanoseconds.
    position_m, velocity_m_s : (3,) float64
        Metres, metres per second.
    covariance_m2 : (3, 3) float64
        Covariance of the position, square metres.
    """

    id: int
    state: TrackState
    time_ns: int
    position_m: FloatArray
    velocity_m_s: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True, slots=True)
class Window:
    """The evidence from which a window was located, for power maps that are drawn on demand.

    Parameters
    ----------
    time_ns : int
        Site time at the middle of the window, in nanoseconds.
    evidence : tuple of Evidence
        One for each array that detected the sound.
    """

    time_ns: int
    evidence: tuple[Evidence, ...]


@dataclass(frozen=True, slots=True)
class BackfillRequest:
    """A request for the frames of an array over a span in which it sent none.

    Parameters
    ----------
    array : str
        Name of the array.
    first, last : int
        Frame indices, both included, by the array's own clock.
    """

    array: str
    first: int
    last: int


Output = Update | Event | Track | Window | BackfillRequest
"""Value that fusion returns from a step."""
