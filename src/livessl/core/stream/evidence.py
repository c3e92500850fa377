"""Collects the excerpts of sound from which events and windows are located.

It also decides which samples are kept while a sound continues. It correlates frames before a sound begins, so that
locating the sound does not have to wait for the correlation of the pre-roll.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.locate.estimator import Course
from livessl.core.stream.activity import exact_mask, runs
from livessl.core.stream.alignment import Alignment
from livessl.core.stream.array_stream import ArrayStream
from livessl.core.stream.excerpt import Excerpt, Segments, Sounds
from livessl.core.stream.load_policy import Clearest
from livessl.core.stream.site_state import SiteState
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, Frame

KEPT_ARRAYS: Final = 24
"""Number of arrays whose samples are kept while a sound continues: those with the greatest onset strength so far, one
and a half times as many as an estimator uses. Only correlations are kept for the others, because 64 arrays send 45
MB/s."""

RELEASE_FRAMES: Final = 10
"""Number of frames between two choices of the `KEPT_ARRAYS`."""


class EvidenceCollector:
    """Correlates the arrays' frames and collects excerpts of them.

    Parameters
    ----------
    state : SiteState
    alignment : Alignment
        The arrays' frames on the joint frame index.
    correlates_ahead : bool
        Whether frames are correlated before a sound begins. With many arrays there is no time for this afterwards.
    """

    def __init__(self, state: SiteState, alignment: Alignment, *, correlates_ahead: bool) -> None:
        self._state = state
        self._cache = state.cache  # that of the event that goes on, or of the last one
        self._votes = state.votes
        self._channel_faults = state.channel_faults
        self._parameters = state.parameters
        self._alignment = alignment
        self._correlates_ahead = correlates_ahead
        self._ahead: range | None = None  # frame indices that the streams' upcoming correlations have followed
        self._onset_strength: dict[str, float] = {}  # of each array, in the event that goes on
        self._clearest = Clearest()  # of the event that goes on
        self._begin = 0  # frame index at which it begins, pre-roll included
        self._postponed: list[int] = []  # quiet frame indices of the event that are correlated if sound follows
        self._located: frozenset[str] | None = None

    # --- the arrays that an event is located from

    @property
    def located(self) -> frozenset[str] | None:
        """Arrays from which the current event is located; None for all."""
        return self._located

    def end_event(self) -> None:
        """Forget the arrays from which the event was located."""
        self._located = None

    def _choose(self, frame_indices: Iterable[int]) -> list[ArrayStream]:
        """Choose the arrays from which the event is located; return those that were not chosen before.

        Parameters
        ----------
        frame_indices : iterable of int
            Frame indices that have closed since the last choice.
        """
        streams = self._alignment.streams
        for frame_index in frame_indices:
            for name, stream in streams.items():
                frame = stream.frames.get(frame_index)
                if frame is not None:
                    self._clearest.note(name, frame.power, active=frame.active)
        limit = self._state.most_arrays
        if len(streams) <= limit:
            self._located = None
            return []
        joined = self._clearest.choose(limit)
        self._located = self._clearest.chosen
        return [streams[name] for name in joined]

    def _is_located(self, stream: ArrayStream) -> bool:
        return self._located is None or stream.spec.name in self._located

    def _streams(self) -> list[ArrayStream]:
        """Return the streams of the arrays from which the event is located."""
        return [stream for stream in self._alignment.streams.values() if self._is_located(stream)]

    # --- correlations

    def begin_event(self, start: int) -> None:
        """Correlate the pre-roll of an event that became active at `start`.

        The correlations begin anew, so that an event does not depend on earlier sound. They continue if a sound was
        split because of its length.
        """
        self._onset_strength = {}
        self._postponed.clear()
        self._begin = self._alignment.pre_roll_start(start)
        span = range(self._begin, start)
        goes_on = start == self._alignment.reported_until and self._cache is self._state.cache
        self._cache = self._state.cache
        if not goes_on:
            self._clearest = Clearest()
        self._choose([*span, start])
        if not goes_on:
            streams = self._streams()
            is_ready = self._ahead == span
            late: list[ArrayStream] = []
            for stream in self._alignment.streams.values():
                is_ahead = is_ready and stream.upcoming.has(k for k in span if k in stream.frames)
                stream.begin_correlations(from_upcoming=is_ahead)
                if not is_ahead:
                    late.append(stream)
            self._correlate([stream for stream in streams if stream in late], span)
        self._ahead = None

    def correlate(self, frame_index: int, *, active: bool) -> None:
        """Correlate the frames of an event at a frame index; `active` is True if any array is active there.

        While the server is overloaded, quiet frames are correlated only if sound follows.
        """
        joined = self._choose([frame_index])
        if not (active or self._state.relief.ahead):
            self._postponed.append(frame_index)
            return
        self._correlate(joined, range(self._begin, frame_index))
        self._correlate(self._streams(), [*self._postponed, frame_index])
        self._postponed.clear()

    def correlate_arrived(self, frame_index: int) -> None:
        """Correlate the frames that have arrived at a frame index, while other arrays are still awaited."""
        here = [s for s in self._streams() if frame_index in s.frames and frame_index not in s.correlations.onsets]
        if here and not self._postponed and (self._state.relief.ahead or any(s.has_active(frame_index) for s in here)):
            self._correlate(here, [frame_index])

    def correlate_ahead(self, frame_index: int, begin: int | None) -> None:
        """Correlate the frames at a quiet frame index, which may be in the pre-roll of the next sound.

        Parameters
        ----------
        frame_index : int
            The quiet frame index.
        begin : int or None
            First frame index after the last sound. The pre-roll of the next sound begins there if that sound comes
            soon; otherwise its start is not known yet.
        """
        if begin is None or not (self._correlates_ahead and self._state.relief.ahead):
            return
        if frame_index - begin >= self._parameters.activity.pre_roll_frames:
            return
        streams = self._streams()
        if frame_index == begin:
            for stream in self._alignment.streams.values():
                stream.begin_upcoming()
        elif self._ahead != range(begin, frame_index):
            return
        followed = ((stream.spec.name, stream.upcoming, stream.frames) for stream in streams)
        self._state.cache.extend(followed, [frame_index])
        self._ahead = range(begin, frame_index + 1)

    def discard_ahead(self) -> None:
        """Discard correlations made ahead, because an active frame arrived or frame indices have changed."""
        self._ahead = None

    def _correlate(self, streams: Iterable[ArrayStream], frame_indices: Sequence[int]) -> None:
        self._cache.extend(((s.spec.name, s.correlations, s.frames) for s in streams), frame_indices)

    # --- samples

    def release_samples(self, frame_index: int) -> None:
        """Release the samples of the arrays with the least onset strength, except those that a window may need.

        Call it every `RELEASE_FRAMES` of an event.
        """
        streams = self._alignment.streams
        kept = min(KEPT_ARRAYS, self._state.most_arrays)
        if len(streams) <= kept:
            return
        lately, strength = range(frame_index - RELEASE_FRAMES + 1, frame_index + 1), self._onset_strength
        for name, stream in streams.items():
            if self._is_located(stream):
                onsets = stream.correlations.at(lately)
                strength[name] = strength.get(name, 0.0) + sum(one.weight for one in onsets)
            else:
                strength[name] = -1.0
        strongest = sorted(strength, key=lambda name: -strength[name])
        window_s, hang_over_s = self._parameters.window_s, self._parameters.activity.hang_over_s
        before = frame_index - round((window_s + hang_over_s) / FRAME_S)
        for name in strongest[kept:]:
            if streams[name].correlations.onsets or strength[name] < 0.0:
                streams[name].release_samples(before)

    # --- excerpts

    def window(self, last: int) -> Excerpt:
        """Return the active frames of the window that ends with a frame index.

        Frames of suspect arrays, and of arrays with faulty channels, are not included.
        """
        window = range(last - self._parameters.window_frames + 1, last + 1)
        second_looks = self._state.relief.second_looks
        sounds = Sounds(self._parameters.live_sources, ended=False, second_looks=second_looks)
        excerpt = Excerpt(sounds, window.start * FRAME_NS, window.stop * FRAME_NS)
        for name, stream in self._alignment.streams.items():
            segments, there = stream.segments([k for k in window if stream.has_active(k)])
            if segments and not self._votes.is_suspect(name) and self._channel_faults.of(name) is None:
                excerpt.powers[name] = np.array([stream.frames[k].power for k in there])
                onsets, course = _correlated(stream, window, there[0])
                if self._is_located(stream) and (onsets or Segments(segments)):
                    excerpt.sounds.add(name, segments, onsets, course)
        return excerpt

    def whole_sounds(self, arrays: Iterable[str], span: range) -> list[tuple[ArraySpec, list[Frame]]]:
        """Return each array's longest segment of frames in a span; without arrays whose samples were released."""
        specs, streams = self._state.arrays, [self._alignment.streams[name] for name in arrays]
        return [(specs[s.spec.name], max(s.segments(span)[0], key=len)) for s in streams if s.has_samples(span)]

    def event(self, span: range) -> Excerpt:
        """Return the active frames, by the exact rule, of an event that spans these frame indices with its pre-roll."""
        second_looks = self._state.relief.second_looks
        excerpt = Excerpt(Sounds(self._parameters.sources, self._votes.suspects(), second_looks=second_looks))
        for stream in self._alignment.streams.values():
            self._add(excerpt, stream, span)
        return excerpt

    def _add(self, excerpt: Excerpt, stream: ArrayStream, span: range) -> None:
        active = [k for k in span if stream.has_active(k)]
        if not active:
            return
        # frames beyond the hang-over may be the pre-roll of the array's next sound, which come when that begins
        own_end = active[-1] + self._parameters.activity.hang_over_frames + 1
        _, there = stream.segments(range(span.start, min(span.stop, own_end)))
        power = np.array([stream.frames[k].power for k in there])
        mask = exact_mask(power, self._parameters.activity.threshold)
        frame_indices = [there[index] for start, stop in runs(mask) for index in range(start, stop)]
        segments, _ = stream.segments(frame_indices)
        if not segments:
            return
        start, end = frame_indices[0], frame_indices[-1] + 1
        excerpt.powers[stream.spec.name] = power[mask]
        if self._is_located(stream):
            needed = [frame_index for frame_index in there if frame_index < end]
            if not stream.correlations.has(needed) and stream.has_samples(needed):  # some frames came late
                stream.begin_correlations()
                self._correlate([stream], range(span.start, end))
            # what is active but far below the loudest frame is the beginning of the sound, not its background
            onsets, course = _correlated(stream, range(span.start, end), min(start, active[0]))
            if onsets or Segments(segments):
                excerpt.sounds.add(stream.spec.name, segments, onsets, course)
        excerpt.extend(start * FRAME_NS - stream.rest_ns, end * FRAME_NS - stream.rest_ns)


def _correlated(stream: ArrayStream, span: range, begin: int) -> tuple[tuple[OnsetGCC, ...], Course]:
    """Return the correlations of an array's frames in a span, and their `Course`; the sound begins at `begin`."""
    there = [k for k in span if k in stream.correlations.onsets and k in stream.frames]
    powers = np.array([stream.frames[k].power for k in there])
    return stream.correlations.at(there), Course(np.array(there, dtype=np.int64), powers, begin)
