"""The sound of all arrays from which an event or window is located, and its loudness (greatest frame power).

Estimators take it in this form. It makes no verdict.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.locate.estimator import Course, Sound
from livessl.core.types import Float32Array, FloatArray, Frame


class Segments(Sequence[Float32Array]):
    """Segments of one array's samples, each (K, n), which are joined from frames when they are read.

    Samples are therefore never copied for all arrays at once, and unused samples are not copied at all. Frames whose
    samples were released, which are always the first ones, are missing.
    """

    def __init__(self, segments: Iterable[Sequence[Frame]]) -> None:
        kept = ([frame for frame in segment if frame.samples.size] for segment in segments)
        self._segments = [segment for segment in kept if segment]

    @overload
    def __getitem__(self, index: int) -> Float32Array: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Float32Array]: ...
    def __getitem__(self, index: int | slice) -> Float32Array | Sequence[Float32Array]:
        if isinstance(index, slice):
            return Segments(self._segments[index])
        return np.concatenate([frame.samples for frame in self._segments[index]], axis=1)

    def __len__(self) -> int:
        return len(self._segments)


class Sounds(Mapping[str, Sound]):
    """The sound of each array, in the form that estimators use.

    Parameters
    ----------
    sources : int
        Number of sources to search for.
    suspects : collection of str
        Names of the suspect arrays.
    ended : bool
        Whether the sound has ended, so that each array's sound is complete.
    second_looks : bool
        Whether there is time to locate an unsure event a second time.
    """

    def __init__(
        self, sources: int, suspects: Collection[str] = (), *, ended: bool = True, second_looks: bool = True
    ) -> None:
        self.sources = sources
        self.suspects = suspects
        self.ended = ended
        self.second_looks = second_looks
        self._segments: dict[str, Sequence[Sequence[Frame]]] = {}
        self._onsets: dict[str, tuple[OnsetGCC, ...]] = {}
        self._courses: dict[str, Course] = {}
        self._requested: set[str] = set()

    def add(
        self,
        array: str,
        segments: Sequence[Sequence[Frame]],
        onsets: tuple[OnsetGCC, ...],
        course: Course,
        *,
        requested: bool = False,
    ) -> None:
        """Add the sound of an array: at least one segment of frames, and the frames' correlations and `Course`.

        `requested` is True if the array did not detect the sound, and its frames were requested.
        """
        self._segments[array], self._onsets[array], self._courses[array] = segments, onsets, course
        if requested:
            self._requested.add(array)

    def copy(self) -> Sounds:
        """Return a copy to which sounds can be added."""
        copy = Sounds(self.sources, self.suspects, ended=self.ended, second_looks=self.second_looks)
        copy._segments |= self._segments
        copy._onsets |= self._onsets
        copy._courses |= self._courses
        copy._requested |= self._requested
        return copy

    def without(self, arrays: Collection[str]) -> Sounds:
        """Return a copy without the sounds of some arrays."""
        copy = self.copy()
        for array in arrays:
            copy._segments.pop(array, None)
            copy._onsets.pop(array, None)
            copy._courses.pop(array, None)
        return copy

    @property
    def has_onsets(self) -> bool:
        """True if the estimator correlates every frame, and so weights each array by the sound that it received."""
        return any(self._onsets.values())

    def __getitem__(self, array: str) -> Sound:
        segments = self._segments[array]
        return Sound(
            Segments(segments),
            segments[0][0].sample_rate_hz,
            self._onsets[array],
            array in self.suspects,
            self.sources,
            self.ended,
            array not in self._requested,
            self._courses[array],
            self.second_looks,
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self._segments)

    def __len__(self) -> int:
        return len(self._segments)


@dataclass(frozen=True, slots=True)
class BackfilledSound:
    """The requested frames of an array, from the start of the event on.

    The correlations and their `Course` include the pre-roll.
    """

    frames: list[Frame]
    onsets: tuple[OnsetGCC, ...]
    course: Course


@dataclass(slots=True)
class Excerpt:
    """The sound of all arrays from which an event or a window is located.

    Parameters
    ----------
    sounds : Sounds
    start_ns, end_ns : int
        Site times of the start of the first frame and of the end of the last one.
    powers : dict of array to (n,) float64
        In-band mean power of each frame, full scale squared, of every array that detected the sound, also of arrays
        that are not used because enough others are clearer.
    """

    sounds: Sounds
    start_ns: int = 2**63 - 1
    end_ns: int = -(2**63)
    powers: dict[str, FloatArray] = field(default_factory=dict)

    def add(
        self,
        array: str,
        segments: Sequence[Sequence[Frame]],
        onsets: tuple[OnsetGCC, ...],
        course: Course,
        powers: FloatArray,
    ) -> None:
        """Add the sound of an array: see `Sounds.add`; `powers` (n,) of its frames are in full scale squared."""
        self.sounds.add(array, segments, onsets, course)
        self.powers[array] = powers

    def extend(self, start_ns: int, end_ns: int) -> None:
        """Extend the excerpt so that it includes the time from `start_ns` to `end_ns`."""
        self.start_ns, self.end_ns = min(self.start_ns, start_ns), max(self.end_ns, end_ns)

    @property
    def middle_ns(self) -> int:
        """Site time of the middle of the excerpt, nanoseconds."""
        return (self.start_ns + self.end_ns) // 2

    @property
    def greatest_power(self) -> float:
        """Greatest power of a frame, full scale squared."""
        return max(float(power.max()) for power in self.powers.values())

    def without(self, arrays: Collection[str]) -> Excerpt:
        """Return this excerpt without the sounds of some arrays; its times do not change."""
        powers = {name: power for name, power in self.powers.items() if name not in arrays}
        return Excerpt(self.sounds.without(arrays), self.start_ns, self.end_ns, powers)

    def with_backfill(self, backfilled: Mapping[str, BackfilledSound]) -> Excerpt:
        """Return this excerpt with the sounds of requested frames added; its times do not change."""
        joined = Excerpt(self.sounds.copy(), self.start_ns, self.end_ns, dict(self.powers))
        for name, sound in backfilled.items():
            powers = np.array([frame.power for frame in sound.frames])
            joined.sounds.add(name, [sound.frames], sound.onsets, sound.course, requested=True)
            joined.powers[name] = powers
        return joined
