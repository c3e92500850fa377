"""Joins the frames of all arrays on the grid of frames and turns them into updates, events and tracks.

`Fusion.step(messages, now_ns)` is the only door, live and replayed. A frame index closes when every array that is
being waited for has reached it, or at its deadline; who is late or missing contributes nothing. It reads no clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, overload

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.geometry import direction_deg
from livessl.core.locate.estimators import Estimator, Localization, PowerMaps, Sound
from livessl.core.stream.activity import THRESHOLD, exact_mask, runs
from livessl.core.stream.array_health import LEAST_VOTES, LOST_NS, VOTES, ArrayStatus, Stream, Votes, doubts
from livessl.core.stream.backfill import MOST_ASKED_S, Asked, AskedSound, better, is_sure, nearest
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import Each, Ear, Listening
from livessl.core.stream.tracker import SILENCE_S, Tracker
from livessl.core.types import (
    FRAME_NS,
    FRAME_S,
    ArraySpec,
    BackfillRequest,
    Contribution,
    Estimate,
    Event,
    Float32Array,
    FloatArray,
    Frame,
    Message,
    Output,
    Status,
    Track,
    Update,
    Window,
)

ANSWER_S: Final = 0.3
"""Long against the way to a node and back, short for who waits for an event."""

EARLIEST_NS: Final = -30_000_000_000
LATEST_NS: Final = 500_000_000
"""Frames this far from the server's time come from a clock that is wrong: sound is never ahead of its time by more than
two clocks that NTP keeps can differ, and what is older a node's buffer cannot hold."""

JUMP_FRAMES: Final = 1200
"""A gap of a minute is skipped, not walked through."""

_SOME: Final = 64
"""One sample in so many of a channel tells nearly always that it is not all zeros."""

WEAK_FRAMES: Final = 4
"""One active frame in so many is looked at for microphones that hear nothing: they are told of after a second."""

MOST_KEPT: Final = 24
"""Arrays whose samples are kept while a sound goes on: those that have heard it most clearly so far, half as many again
as any answer goes by. Of the others is kept what was made of them: 64 arrays send 45 MB a second."""

LET_GO_FRAMES: Final = 10
"""Between two looks which arrays these are."""

RANGE_UNKNOWN: Final = 0.25
"""Where the position's spread exceeds this share of the distance to the nearest array, only the direction is told."""


RANGE_APERTURES: Final = 2.0
"""Further away than so many times its own width, an array alone tells no distance: what reverberation does to its
delays, which the covariance cannot know, moves the place along the line of sight by metres."""


@dataclass(frozen=True, slots=True)
class FusionParameters:
    """How arrays are joined.

    Parameters
    ----------
    deadline_s : float
        How long an interval waits for a late array.
    answer_s : float
        How long an event waits for what arrays were asked for.
    window_s, update_s : float
        Length of the windows that updates are made from, and the time between updates.
    max_event_s : float
        A sound longer than this is cut into several events.
    min_arrays : int
        With fewer an event is refused.
    threshold : float
        The activity rule's.
    pre_roll_s, hang_over_s : float
        As the nodes use them: an event ends after a quiet hang-over.
    sources, live_sources : int
        How many sources, 1 or 2, are looked for in a sound that has ended, and in the windows of one that goes on.
    """

    deadline_s: float = 0.5
    answer_s: float = ANSWER_S
    window_s: float = 0.2
    update_s: float = 0.1
    max_event_s: float = 10.0
    min_arrays: int = 1
    threshold: float = THRESHOLD
    pre_roll_s: float = 0.4
    hang_over_s: float = 0.3
    sources: int = 2
    live_sources: int = 1


@dataclass(slots=True)
class _OpenEvent:
    start: int
    last_active: int
    closed: int  # the last frame index looked at: what lies beyond may have come, but is not the event's
    late_frames: int = 0
    ended: bool = False  # by quiet or length; else it is cut short, for nothing more comes
    became_quiet: bool = False
    clarity: dict[str, float] = field(default_factory=dict)  # how clearly each array has heard it so far
    heard: _Heard | None = None
    told: list[Output] | None = None  # by those that heard it, while others are asked
    asked: dict[str, Asked] = field(default_factory=dict)
    asked_ns: int = 0


class Fusion:
    """The server's heart.

    Parameters
    ----------
    site : str
        Name that event ids begin with.
    arrays : sequence of ArraySpec
    estimator : Estimator
    parameters : FusionParameters
    updates : bool
        Whether to localize windows while a sound lasts; offline nobody looks at them.
    newest_only : bool
        Whether, of several windows that are due at once, the newest alone is localized: what is live must not fall
        further behind. `updates_left_out` counts the others.
    clock_offsets : ClockOffsets or None
        What is known of the arrays' clocks, learned from the events told; None takes them all to agree.
    each : callable or None
        What arrays are listened to by, several at once perhaps: see `Listening`.
    """

    def __init__(
        self,
        site: str,
        arrays: Sequence[ArraySpec],
        estimator: Estimator,
        parameters: FusionParameters | None = None,
        *,
        updates: bool = True,
        newest_only: bool = False,
        clock_offsets: ClockOffsets | None = None,
        each: Each | None = None,
    ) -> None:
        self._site = site
        self._estimator = estimator
        self._parameters = parameters or FusionParameters()
        self._updates = updates
        self._newest_only = newest_only
        self.clock_offsets = clock_offsets
        self._learns = True
        self._watches = True  # how arrays are doing
        self._streams = {spec.name: Stream(spec) for spec in arrays}
        self._tracker = Tracker()
        self._next: int | None = None
        self._reached: deque[tuple[int, int]] = deque()
        self._event: _OpenEvent | None = None
        self._heard_until = -(2**63)
        self._now_ns = 0
        self._told_until = self._closing_until = -(2**63)
        self._due: int | None = None
        self._listening = Listening(estimator, each)
        self._ahead: tuple[int, int] | None = None  # frame indices, first and last, that were listened to ahead
        self._excluded: Collection[str] = ()
        self._votes: dict[str, Votes] = dict.fromkeys(self._streams, ())
        self.can_backfill: set[str] = set()
        """Arrays whose nodes can be asked for what they did not send."""
        self.updates_left_out = 0
        self.unknown_arrays = 0

    def twin(self) -> Fusion:
        """Another of the same site around the same estimator, at its beginning, that makes events only."""
        specs = [stream.spec for stream in self._streams.values()]
        other = Fusion(
            self._site, specs, self._estimator, self._parameters, updates=False, clock_offsets=self.clock_offsets
        )
        other._listening, other._votes, other.can_backfill = self._listening, self._votes, self.can_backfill
        other._watches = False  # nobody asks the twin
        other._align()
        self._learns = False  # the twin hears all, and in order
        return other

    def begin(self, frame_index: int) -> None:
        """Take it that everything before this frame index has been told."""
        self._heard_until = frame_index

    def frames_ahead(self, array: str) -> int:
        """By how many frames an array's frame indices are ahead of the joint ones."""
        stream = self._streams.get(array)
        return 0 if stream is None else stream.ahead

    def leave_out(self, told: int, closing: int) -> None:
        """Tell no event that another fusion tells: of sound before `told`, or that comes to its end by `closing`."""
        self._told_until, self._closing_until = told, closing

    @property
    def closed(self) -> int | None:
        """The last frame index that was closed; None before the first."""
        return None if self._next is None else self._next - 1

    @property
    def hears(self) -> bool:
        """Whether a sound goes on."""
        return self._event is not None

    @property
    def needed_from(self) -> int | None:
        """Before this frame index no frame will be looked at again; None at the beginning."""
        if self._next is None:
            return None
        begin = self._next if self._event is None else self._event.start
        return max(self._heard_until, begin - round(self._parameters.pre_roll_s / FRAME_S))

    @property
    def parameters(self) -> FusionParameters:
        """How arrays are joined."""
        return self._parameters

    def step(self, messages: Iterable[Message], now_ns: int) -> list[Output]:
        """Take in messages, in any order between arrays; return what there is to tell."""
        outputs = self._start_over() if self._went_back(now_ns) else []
        if not self._learns and self._event is None:
            self._align()
        self._now_ns = now_ns
        for message in messages:
            self._accept(message)
        if self._event is not None and self._next is not None:  # while others' frames are on their way
            at = self._next
            here = [s for s in self._streams.values() if at in s.frames and at not in s.ear.onsets]
            self._hear(here, [self._next])
        outputs += self._close_ready()
        if self._event is not None and self._everyone_silent():
            outputs += self._finish()
        outputs += self._tracker.step(now_ns)
        return outputs

    def flush(self, now_ns: int) -> list[Output]:
        """End of the recording: close what is open without waiting for anyone."""
        self._now_ns = now_ns
        for stream in self._streams.values():
            stream.waited_for = False
        outputs = self._close_ready()
        return outputs + self._finish() if self._event is not None else outputs

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out what an array's sound will need, so that its first event does not wait for it."""
        self._estimator.prepare(array, sample_rate_hz)

    def power_maps(self, window: Window, separately: Collection[str] | None = None) -> PowerMaps:
        """The estimator's maps of a window that it localized; it may be called from another thread than `step`."""
        return self._estimator.power_maps(window.evidence, separately)

    def leave(self, array: str) -> None:
        """The array's node said good-bye: nobody waits for it."""
        if array in self._streams:
            self._streams[array].left = True

    def exclude(self, arrays: Collection[str]) -> None:
        """Wait for none of these arrays and ask none of them, from now on, and all others again."""
        self._excluded = arrays

    def status(self, now_ns: int, *, levels: bool = True) -> list[ArrayStatus]:
        """How every array is doing. Any thread may ask: nothing that this walks through ever changes its size.

        Without `levels` nothing is said of the channels' power, which costs a transform for each array.
        """
        clocks = self.clock_offsets
        return [
            stream.status(now_ns, self._votes[name], None if clocks is None else clocks.of(name), levels=levels)
            for name, stream in self._streams.items()
        ]

    def _went_back(self, now_ns: int) -> bool:
        return self._next is not None and (self._next - 1) * FRAME_NS - now_ns > LATEST_NS

    def _start_over(self) -> list[Output]:
        """The server's clock was set back: what came before lies in its future now, and would make all else late."""
        outputs = self._finish() if self._event is not None else []
        outputs += self._tracker.step(self._now_ns + round(2e9 * SILENCE_S))
        self._streams = {
            name: Stream(old.spec, counters=old.counters, ahead=old.ahead, rest_ns=old.rest_ns)
            for name, old in self._streams.items()
        }
        self._reached.clear()
        self._listening.clear()
        self._ahead = None
        self._votes.update(dict.fromkeys(self._votes, ()))
        self._next, self._heard_until = None, -(2**63)
        return outputs

    def _accept(self, message: Message) -> None:
        stream = self._streams.get(message.array)
        if stream is None:
            self.unknown_arrays += 1
            return
        if stream.ahead:
            message = replace(message, frame_index=message.frame_index - stream.ahead)
        if isinstance(message, Frame) and message.sequence == 0:
            self._take_answer(stream, message)
            return
        ahead_ns = message.frame_index * FRAME_NS - self._now_ns
        if not EARLIEST_NS <= ahead_ns <= LATEST_NS:
            stream.counters["rejected"] += 1
            side = "ahead of" if ahead_ns > 0 else "behind"
            stream.worry(self._now_ns, f"its clock is {abs(ahead_ns) / 1e9:.1f} s {side} the server's; set both by NTP")
            return
        if isinstance(message, Frame):
            if not self._accept_frame(stream, message):
                return
        else:
            stream.take_mark(message, self._now_ns)
        stream.heard_ns, stream.left = self._now_ns, False
        stream.watermark = (
            message.frame_index if stream.watermark is None else max(stream.watermark, message.frame_index)
        )
        if not self._reached or message.frame_index > self._reached[-1][0]:
            self._reached.append((message.frame_index, self._now_ns))
        if (self._reached[-1][0] - message.frame_index) * FRAME_S < self._parameters.deadline_s:
            stream.waited_for = True
        if self._next is None:
            self._next = message.frame_index

    def _accept_frame(self, stream: Stream, frame: Frame) -> bool:
        if len(frame.samples) != len(stream.spec.microphones_m):
            stream.counters["rejected"] += 1
            expected, got = len(stream.spec.microphones_m), len(frame.samples)
            stream.worry(self._now_ns, f"its frames have {got} channels, the server's site file says {expected}")
            return False
        if frame.active and self._next is not None and frame.frame_index < self._next:
            stream.counters["late"] += 1
            stream.worry(self._now_ns, "its frames come after their deadline")
            if self._event is not None:
                self._event.late_frames += 1
        if frame.sample_rate_hz != stream.rate_hz:
            stream.frames.clear()  # its node came back with another device: the two do not make one sound
            stream.forget()
            stream.rate_hz = frame.sample_rate_hz
        stream.frames[frame.frame_index] = frame
        stream.counters["frames"] += 1
        if stream.watermark is None or frame.frame_index >= stream.watermark:
            stream.power, stream.active = frame.power, frame.active
            stream.find_dead(self._now_ns, _alive(frame.samples))
            if frame.active and self._watches and frame.frame_index % WEAK_FRAMES == 0:
                stream.find_weak(self._now_ns, frame.samples)
        return True

    def _close_ready(self) -> list[Output]:
        outputs: list[Output] = []
        if self._next is None:
            return outputs
        newest = self._newest()
        if newest - self._next > JUMP_FRAMES:
            outputs += self._finish() if self._event is not None else []
            self._next = newest
        while True:
            if self._event is not None and self._event.asked:
                if not self._is_answered(self._event):
                    break
                outputs += self._finish()
            if self._next > self._newest() or not self._may_close(self._next):
                break
            frame_index, self._next = self._next, self._next + 1
            outputs += self._close(frame_index)
            self._prune()
        due, self._due = self._due, None
        if due is not None and self._event is not None and not self._event.ended and due >= self._event.start:
            outputs += self._update(self._event, due)
        return outputs

    def _newest(self) -> int:
        return max(stream.watermark for stream in self._streams.values() if stream.watermark is not None)

    def _may_close(self, frame_index: int) -> bool:
        while self._reached and self._reached[0][0] < frame_index:
            self._reached.popleft()
        late = [stream for stream in self._streams.values() if self._is_waited_for(stream, frame_index)]
        if not late:
            return True
        first_ns = self._reached[0][1] if self._reached else self._now_ns
        if self._now_ns - first_ns < self._parameters.deadline_s * 1e9:
            return False
        for stream in late:
            stream.waited_for = False
            stream.worry(self._now_ns, "its frames come after their deadline")
        return True

    def _is_waited_for(self, stream: Stream, frame_index: int) -> bool:
        if stream.watermark is None or stream.heard_ns is None or stream.left or stream.spec.name in self._excluded:
            return False
        return stream.watermark < frame_index and stream.waited_for and self._now_ns - stream.heard_ns < LOST_NS

    def _everyone_silent(self) -> bool:
        quiet_ns = self._parameters.deadline_s * 1e9 + self._parameters.hang_over_s * 1e9
        return all(s.heard_ns is None or self._now_ns - s.heard_ns > quiet_ns for s in self._streams.values())

    def _close(self, frame_index: int) -> list[Output]:
        active = any(stream.has_active(frame_index) for stream in self._streams.values())
        if active and self._event is None:
            self._event = self._open(frame_index)
        event = self._event
        if event is None:
            self._listen_ahead(frame_index, self._heard_until)
            return []
        event.closed = frame_index
        self._hear(self._streams.values(), [frame_index])
        if active:
            event.last_active, self._ahead = frame_index, None
        else:
            self._listen_ahead(frame_index, event.last_active + 1)
        if frame_index - event.last_active >= round(self._parameters.hang_over_s / FRAME_S):
            event.became_quiet = True
            return self._end(event)
        outputs: list[Output] = []
        period = round(self._parameters.update_s / FRAME_S)
        if self._updates and active and (frame_index - event.start + 1) % period == 0:
            if self._newest_only:
                self.updates_left_out += self._due is not None
                self._due = frame_index
            else:
                outputs += self._update(event, frame_index)
        if (frame_index - event.start + 1) * FRAME_S >= self._parameters.max_event_s:
            return outputs + self._end(event)
        if (frame_index - event.start + 1) % LET_GO_FRAMES == 0:
            self._let_go(event, frame_index)
        return outputs

    def _let_go(self, event: _OpenEvent, frame_index: int) -> None:
        """Let the samples go that no answer will be told by: those of arrays that hear the sound least clearly.

        What windows may still be made of stays.
        """
        if len(self._streams) <= MOST_KEPT:
            return
        lately = range(frame_index - LET_GO_FRAMES + 1, frame_index + 1)
        for name, stream in self._streams.items():
            heard = sum(onsets.weight for onsets in stream.ear.at(lately))
            event.clarity[name] = event.clarity.get(name, 0.0) + heard
        clearest = sorted(event.clarity, key=lambda name: -event.clarity[name])
        before = frame_index - round((self._parameters.window_s + self._parameters.hang_over_s) / FRAME_S)
        for name in clearest[MOST_KEPT:]:
            if self._streams[name].ear.onsets:
                self._streams[name].let_go(before)

    def _open(self, frame_index: int) -> _OpenEvent:
        """Begin an event, and listen to its pre-roll afresh, so that it is the same whatever came before.

        Where a sound goes on that was cut for its length, the listeners go on, too.
        """
        span = range(self._span_start(frame_index), frame_index)
        if frame_index != self._heard_until:
            ready = self._ahead == (span.start, span.stop - 1)
            for stream in self._streams.values():
                ready = ready and stream.next_ear.has(r for r in span if r in stream.frames)
            for stream in self._streams.values():
                stream.ear = stream.next_ear if ready else Ear()
            if not ready:
                self._hear(self._streams.values(), span)
        self._ahead = None
        return _OpenEvent(frame_index, frame_index, frame_index)

    def _hear(self, streams: Iterable[Stream], frame_indices: Sequence[int]) -> None:
        self._listening.hear(((stream.spec.name, stream.ear, stream.frames) for stream in streams), frame_indices)

    def _hear_anew(self, stream: Stream, frame_indices: Sequence[int]) -> None:
        stream.ear = Ear()
        self._hear([stream], frame_indices)

    def _listen_ahead(self, frame_index: int, begin: int) -> None:
        """In quiet, listen to what a sound that comes soon will begin with: from `begin` on, where the last one ended.

        That is as far as its pre-roll reaches back. With many arrays there is no time for it when the sound is there.
        """
        if not self._newest_only or frame_index - begin >= round(self._parameters.pre_roll_s / FRAME_S):
            return
        if frame_index != begin and self._ahead != (begin, frame_index - 1):
            return
        if frame_index == begin:
            for stream in self._streams.values():
                stream.next_ear = Ear()
        streams = self._streams.values()
        self._listening.hear(((stream.spec.name, stream.next_ear, stream.frames) for stream in streams), [frame_index])
        self._ahead = begin, frame_index

    def _span(self, event: _OpenEvent) -> range:
        return range(self._span_start(event.start), event.closed + 1)

    def _span_start(self, start: int) -> int:
        """The first frame index that belongs to an event, with its pre-roll, that became active at `start`."""
        return max(start - round(self._parameters.pre_roll_s / FRAME_S), self._heard_until)

    def _update(self, event: _OpenEvent, frame_index: int) -> list[Output]:
        window = range(frame_index - round(self._parameters.window_s / FRAME_S) + 1, frame_index + 1)
        sounds = _Sounds(self._parameters.live_sources, ended=False)
        powers: dict[str, FloatArray] = {}
        for name, stream in self._streams.items():
            pieces, there = stream.segments([r for r in window if stream.has_active(r)])
            if pieces and not doubts(self._votes[name]):
                sounds.pieces[name] = pieces
                sounds.onsets[name] = stream.ear.at(window)
                powers[name] = np.array([stream.frames[r].power for r in there])
        if len(sounds) < self._parameters.min_arrays:
            return []
        found = self._estimator.locate(sounds)
        middle_ns = (window.start + window.stop) * FRAME_NS // 2
        estimate = _estimate(found, middle_ns, sounds)
        status, _ = self._judge(estimate, found)
        loudest = max(float(power.max()) for power in powers.values())
        contributions = self._contributions(powers, estimate, found)
        complete_ns = window.stop * FRAME_NS
        others = self._others(found, middle_ns, sounds)
        update = Update(self._id(event.start), status, estimate, loudest, contributions, complete_ns, others)
        trusted = [*([] if status is Status.REFUSED else [estimate]), *others]
        tracks: list[Track] = self._tracker.step(middle_ns, trusted, probable=found.features is not None)
        return [update, Window(middle_ns, found.evidence), *tracks]

    def _finish(self) -> list[Output]:
        event, self._event = self._event, None
        assert event is not None
        told = self._told(event) if event.told is None else self._reconsidered(event, event.told)
        self._heard_until = event.last_active + 1
        if event.became_quiet:
            self._align()
        return told

    def _align(self) -> None:
        """Join the arrays by what is known of their clocks, from here on; amid a sound it would be torn.

        What has been told of an array that moves on in time is not told again.
        """
        if self.clock_offsets is None:
            return
        onward = 0
        for name, stream in self._streams.items():
            by = self.clock_offsets.frames_ahead(name) - stream.ahead
            if by:
                stream.move(by)
                self._ahead = None
                onward = max(onward, -by)
            stream.rest_ns = round(1e9 * self.clock_offsets.rest_s(name))
        if onward and self._next is not None:
            self._heard_until += onward
            self._next = max(self._next, self._heard_until)

    def _is_left_out(self, event: _OpenEvent) -> bool:
        """Whether another fusion tells of it, by now."""
        return event.last_active < self._told_until or (event.ended and event.closed <= self._closing_until)

    def _told(self, event: _OpenEvent) -> list[Output]:
        """What those that heard an event say of it; nothing where another fusion tells it."""
        if self._is_left_out(event):
            return []
        heard = event.heard = self._heard(event)
        if not heard.sounds:
            return []
        answers, found = self._answer(event, heard)
        first = answers[0]
        if first.status is Status.LOCATED and first.estimate is not None and event.became_quiet and len(answers) == 1:
            self._learn_clocks(first.end_ns, first.estimate, self._span(event))
        if first.status is not Status.REFUSED and found is not None:
            self._count_votes(event.start, found, heard.sounds)
        return [*answers]

    def _heard(self, event: _OpenEvent) -> _Heard:
        parameters = self._parameters
        span = self._span(event)
        heard = _Heard(_Sounds(parameters.sources, {name for name, votes in self._votes.items() if doubts(votes)}))
        for name, stream in self._streams.items():
            active = [frame_index for frame_index in span if stream.has_active(frame_index)]
            if not active:
                continue
            # beyond its hang-over may lie the run-up to its next sound, which comes when that begins
            own_end = active[-1] + round(parameters.hang_over_s / FRAME_S) + 1
            _, there = stream.segments(range(span.start, min(span.stop, own_end)))
            power = np.array([stream.frames[frame_index].power for frame_index in there])
            mask = exact_mask(power, parameters.threshold)
            frame_indices = [there[index] for start, stop in runs(mask) for index in range(start, stop)]
            pieces, _ = stream.segments(frame_indices)
            if not pieces:
                continue
            if not stream.ear.has(there) and stream.keeps(there):  # some came late
                self._hear_anew(stream, span)
            heard.sounds.pieces[name], heard.powers[name] = pieces, power[mask]
            heard.sounds.onsets[name] = stream.ear.at(range(span.start, frame_indices[-1] + 1))
            heard.start_ns = min(heard.start_ns, frame_indices[0] * FRAME_NS - stream.rest_ns)
            heard.end_ns = max(heard.end_ns, (frame_indices[-1] + 1) * FRAME_NS - stream.rest_ns)
        return heard

    def _answer(
        self, event: _OpenEvent, heard: _Heard, asked: Mapping[str, AskedSound] | None = None
    ) -> tuple[list[Event], Localization | None]:
        """What the arrays that heard a sound say of it together with some that were asked, of each source one event."""
        sounds, powers = heard.with_asked(asked or {})
        middle_ns = (heard.start_ns + heard.end_ns) // 2
        found: Localization | None = None
        estimate: Estimate | None = None
        status = Status.REFUSED
        contributions: tuple[Contribution, ...] = ()
        others: tuple[Estimate, ...] = ()
        reason: str | None = f"heard by {len(sounds)} of at least {self._parameters.min_arrays} arrays"
        if len(sounds) >= self._parameters.min_arrays:
            found = self._estimator.locate(sounds)
            estimate = _estimate(found, middle_ns, sounds)
            status, reason = self._judge(estimate, found)
            others = self._others(found, middle_ns, sounds)
            if status is Status.REFUSED:
                estimate = None
            else:
                contributions = self._contributions(powers, estimate, found, asked or {})
        first = Event(
            id=self._id(event.start),
            start_ns=heard.start_ns,
            end_ns=heard.end_ns,
            status=status,
            reason=reason,
            estimate=estimate,
            power=max(float(power.max()) for power in heard.powers.values()),
            method=self._estimator.name,
            contributions=contributions,
            heard_by=tuple(heard.sounds),
            late_frames=event.late_frames,
            latency_s=(self._now_ns - heard.end_ns) / 1e9,
            complete_ns=(event.closed + 1) * FRAME_NS,
        )
        if found is None:
            return [first], None
        return [
            first,
            *(
                replace(
                    first,
                    id=f"{first.id}-{source}",
                    source=source,
                    status=Status.LOCATED,
                    reason=None,
                    estimate=other,  # of how loud each was nobody can tell
                    contributions=self._contributions(powers, other, found, asked or {}),
                )
                for source, other in enumerate(others, 2)
            ),
        ], found

    def _others(self, found: Localization, time_ns: int, sounds: Mapping[str, Sound]) -> tuple[Estimate, ...]:
        """Further sources of the same sound: those that are places."""
        estimates = (_estimate(other, time_ns, sounds) for other in found.others)
        places = zip(estimates, found.others, strict=True)
        return tuple(estimate for estimate, other in places if self._judge(estimate, other)[0] is Status.LOCATED)

    def _end(self, event: _OpenEvent) -> list[Output]:
        """The sound is over: tell of it, unless somebody is to be asked first."""
        event.ended = True
        if self.can_backfill:
            event.told = self._told(event)
            event.asked = self._whom_to_ask(event)
            event.asked_ns = self._now_ns
        if not event.asked:
            return self._finish()
        ahead = {name: self._streams[name].ahead for name in event.asked}
        spans = {name: asked.span for name, asked in event.asked.items()}
        return [BackfillRequest(name, span[0] + ahead[name], span[-1] + ahead[name]) for name, span in spans.items()]

    def _whom_to_ask(self, event: _OpenEvent) -> dict[str, Asked]:
        """Arrays that may help where those that heard the sound are not sure."""
        answer = next((told for told in event.told or () if isinstance(told, Event)), None)
        if answer is None or event.heard is None or is_sure(answer):
            return {}
        if not any(event.heard.sounds.onsets.values()):
            return {}  # the estimator gives every array the same weight, whatever it heard
        heard = [self._streams[name].spec for name in answer.heard_by]
        silent = [
            stream.spec
            for name, stream in self._streams.items()
            if name in self.can_backfill - set(self._excluded) and name not in answer.heard_by and not stream.left
        ]
        first = self._span_start(event.start)
        span = range(first, min(event.last_active + 1, first + round(MOST_ASKED_S / FRAME_S)))
        return {
            spec.name: Asked(span)
            for spec in (nearest(silent, heard) if silent else ())
            if self._streams[spec.name].allowance.take(len(span), event.closed)
        }

    def _is_answered(self, event: _OpenEvent) -> bool:
        if self._now_ns - event.asked_ns >= self._parameters.answer_s * 1e9:
            return True
        return all(asked.is_answered or name not in self.can_backfill for name, asked in event.asked.items())

    def _take_answer(self, stream: Stream, frame: Frame) -> None:
        asked = None if self._event is None else self._event.asked.get(frame.array)
        if (
            asked is not None
            and frame.frame_index in asked.span
            and len(frame.samples) == len(stream.spec.microphones_m)
        ):
            asked.frames[frame.frame_index] = frame

    def _reconsidered(self, event: _OpenEvent, told: list[Output]) -> list[Output]:
        """The answer with those that were asked, where it is better with all or one of them."""
        if self._is_left_out(event):
            return []  # it has been told meanwhile
        best: list[Event] = [output for output in told if isinstance(output, Event)]
        if not best or event.heard is None:
            return told
        sounds = {name: asked.sound(self._estimator, event.start) for name, asked in event.asked.items()}
        some = {name: sound for name, sound in sounds.items() if sound is not None}
        tries = [some, *({name: some[name]} for name in some if len(some) > 1)] if some else []
        for each in tries:
            answers, found = self._answer(event, event.heard, each)
            if better(answers[0], best[0]):
                best = answers
                if answers[0].status is not Status.REFUSED and found is not None:
                    self._count_votes(event.start, found, event.heard.sounds)
        return [*best]

    def _learn_clocks(self, time_ns: int, estimate: Estimate, span: range) -> None:
        clocks = self.clock_offsets
        if clocks is None or not self._learns or not clocks.tell_apart(estimate.arrays):
            return
        streams = [self._streams[name] for name in estimate.arrays]
        whole = [(s.spec, max(s.segments(span)[0], key=len)) for s in streams if s.keeps(span)]
        clocks.hear(time_ns, estimate.position_m, whole)

    def _judge(self, estimate: Estimate, found: Localization) -> tuple[Status, str | None]:
        return judged(found, [self._streams[name].spec for name in estimate.arrays])

    def _count_votes(self, start: int, found: Localization, sounds: Iterable[str]) -> None:
        """Remember who agreed. Replaced, never changed, for other threads read it."""
        if found.outliers is None or len(found.evidence) < LEAST_VOTES:
            return
        for name in (name for name in sounds if name not in found.unneeded):
            before = [vote for vote in self._votes[name] if vote[0] != start]
            self._votes[name] = (*before, (start, found.outliers.get(name)))[-VOTES:]

    def _contributions(
        self,
        powers: Mapping[str, FloatArray],
        estimate: Estimate,
        found: Localization,
        asked: Collection[str] = (),
    ) -> tuple[Contribution, ...]:
        return tuple(
            _contribution(self._streams[name].spec, powers[name], estimate, found, asked=name in asked)
            for name in powers
        )

    def _id(self, frame_index: int) -> str:
        return f"{self._site}-{frame_index * FRAME_NS // 1_000_000}"

    def _prune(self) -> None:
        assert self._next is not None
        keep = max(self._parameters.pre_roll_s, self._parameters.window_s)
        oldest = (self._next if self._event is None else self._event.start) - round(keep / FRAME_S) - 1
        for stream in self._streams.values():
            while stream.frames and (first := next(iter(stream.frames))) < oldest:
                del stream.frames[first]
            onsets = stream.ear.onsets
            while onsets and (first := next(iter(onsets))) < oldest:
                del onsets[first]


class _Segments(Sequence[Float32Array]):
    """Runs of frames, each joined when it is looked at: of many arrays never all at once, and not if nobody looks.

    Frames whose samples were let go are left out: they are the first.
    """

    def __init__(self, pieces: Sequence[Sequence[Frame]]) -> None:
        kept = ([frame for frame in piece if frame.samples.size] for piece in pieces)
        self._pieces = [piece for piece in kept if piece]

    @overload
    def __getitem__(self, index: int) -> Float32Array: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Float32Array]: ...
    def __getitem__(self, index: int | slice) -> Float32Array | Sequence[Float32Array]:
        if isinstance(index, slice):
            return _Segments(self._pieces[index])
        return np.concatenate([frame.samples for frame in self._pieces[index]], axis=1)

    def __len__(self) -> int:
        return len(self._pieces)


def _alive(samples: Float32Array) -> list[bool]:
    """Which channels have anything but zeros: a few samples of a live one tell."""
    alive: list[bool] = np.asarray(np.any(samples[:, ::_SOME], axis=1)).tolist()
    return alive if all(alive) else np.asarray(np.any(samples, axis=1)).tolist()


def judged(found: Localization, specs: Sequence[ArraySpec]) -> tuple[Status, str | None]:
    """Whether what was found is a place, only a direction, or neither, and why.

    Parameters
    ----------
    found : Localization
    specs : sequence of ArraySpec
        The arrays that it was found by.
    """
    spread_m = float(np.sqrt(max(0.0, np.linalg.eigvalsh(found.covariance_m2)[-1])))
    nearest_m = min(_distance_m(spec, found.position_m) for spec in specs)
    alone = len(specs) == 1 and nearest_m > RANGE_APERTURES * specs[0].aperture_m
    if spread_m <= RANGE_UNKNOWN * nearest_m and not alone:
        return (Status.LOCATED, _dissent(found)) if found.refused is None else (Status.REFUSED, found.refused)
    if found.features is not None and not found.features.tell_direction:
        return Status.REFUSED, "nothing that was heard came from any one direction"
    who = "one array cannot" if len(specs) == 1 else "these arrays cannot"
    return Status.DIRECTION_ONLY, f"{who} tell how far away it is: ±{spread_m:.2f} m at {nearest_m:.2f} m"


class _Sounds(Mapping[str, Sound]):
    """What the arrays heard."""

    def __init__(self, sources: int, suspect: Collection[str] = (), *, ended: bool = True) -> None:
        self.suspect = suspect
        self.ended = ended
        self.sources = sources
        self.pieces: dict[str, Sequence[Sequence[Frame]]] = {}
        self.onsets: dict[str, tuple[OnsetGCC, ...]] = {}

    def __getitem__(self, array: str) -> Sound:
        pieces = self.pieces[array]
        onsets = self.onsets[array]
        return Sound(
            _Segments(pieces),
            pieces[0][0].sample_rate_hz,
            onsets,
            array in self.suspect,
            self.sources,
            self.ended,
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self.pieces)

    def __len__(self) -> int:
        return len(self.pieces)


@dataclass(slots=True)
class _Heard:
    """What the arrays heard of one event: their sounds, the powers of the frames in them, from when to when."""

    sounds: _Sounds
    powers: dict[str, FloatArray] = field(default_factory=dict)
    start_ns: int = 2**63 - 1
    end_ns: int = -(2**63)

    def with_asked(self, asked: Mapping[str, AskedSound]) -> tuple[_Sounds, dict[str, FloatArray]]:
        """These sounds and powers, and those of arrays that were asked."""
        sounds, powers = _Sounds(self.sounds.sources, self.sounds.suspect), dict(self.powers)
        sounds.pieces |= self.sounds.pieces
        sounds.onsets |= self.sounds.onsets
        for name, sound in asked.items():
            sounds.pieces[name], sounds.onsets[name] = [sound.frames], sound.onsets
            powers[name] = np.array([frame.power for frame in sound.frames])
        return sounds, powers


def _estimate(found: Localization, time_ns: int, sounds: Mapping[str, Sound]) -> Estimate:
    arrays = tuple(name for name in sounds if name not in (found.outliers or ()) and name not in found.unneeded)
    return Estimate(time_ns, found.position_m, found.covariance_m2, found.confidence, arrays)


def _distance_m(spec: ArraySpec, position_m: FloatArray) -> float:
    """How far an array is from the place, or half its width: inside a wide one, its centre is nothing to look from."""
    return max(direction_deg(spec.centre_m, position_m)[2], spec.aperture_m / 2.0)


def _contribution(
    spec: ArraySpec, power: FloatArray, estimate: Estimate, found: Localization, *, asked: bool
) -> Contribution:
    azimuth, elevation, distance = direction_deg(spec.centre_m, estimate.position_m)
    agrees: bool | None = None
    if found.outliers is not None and len(found.evidence) > 1 and spec.name not in found.unneeded:
        agrees = spec.name not in found.outliers
    off_deg = (found.outliers or {}).get(spec.name)
    return Contribution(
        spec.name, len(power) * FRAME_S, float(power.mean()), azimuth, elevation, distance, agrees, off_deg, asked
    )


def _dissent(found: Localization) -> str | None:
    """Who was outvoted, in words."""
    if not found.outliers:
        return None
    each = " and ".join(f"{name!r} ({off_deg:.0f}° off)" for name, off_deg in sorted(found.outliers.items()))
    return f"located without {each}: outvoted by the others"
