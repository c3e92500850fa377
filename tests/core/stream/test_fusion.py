"""Arrays joined on the grid of frames: whatever comes, when it comes, or does not come at all."""

from __future__ import annotations

import json
import pickle
import weakref
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.correlate.band import band_power
from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.geometry import Grid
from livessl.core.joint_array import joined
from livessl.core.locate.confidence import NEAR_M, ConfidenceFeatures
from livessl.core.locate.estimator import Localization, PowerMaps, Sound
from livessl.core.locate.set_up_error import half_axis_m, probability_within, set_up_covariance_m2
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.stream.array_health import ArrayHealth, ArrayState, ArrayStatus
from livessl.core.stream.array_stream import ArrayStream
from livessl.core.stream.evidence import KEPT_ARRAYS, RELEASE_FRAMES
from livessl.core.stream.fusion import EVENTS_ONLY, Fusion, Role
from livessl.core.stream.parameters import FusionParameters
from livessl.core.stream.site_state import SiteState
from livessl.core.types import (
    FRAME_NS,
    GCC,
    ArraySpec,
    Candidate,
    ClockState,
    Estimate,
    Event,
    Evidence,
    Float32Array,
    FloatArray,
    Frame,
    Mark,
    Message,
    Output,
    Status,
    Track,
    TrackState,
    Uncertainty,
    Update,
    Window,
)

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.25)
SOURCE_M = np.array([1.13, 3.31, 1.47])

START = 20 * 1_700_000_000
"""Frame index at which every test begins; those below count from it."""

HANG_OVER = 6
DEADLINE = 10
"""Defaults, in frame indices of 50 ms."""

NOTHING = GCC(np.array([[0, 1]]), np.array([0.0, 1e-4]), np.zeros((1, 2)))
"""Evidence of no sound."""

Arrivals = list[tuple[float, Message]]
"""When, in frame indices after START, a message comes in."""


class Scripted:
    """An estimator that returns one position and remembers what it was given."""

    name = "scripted"

    def __init__(self) -> None:
        self.calls: list[dict[str, list[int]]] = []
        self.prepared: list[tuple[str, float]] = []

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        self.prepared.append((array, sample_rate_hz))

    def onset_front_end(self, array: str, sample_rate_hz: float) -> None:
        return None

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.calls.append({name: [piece.shape[1] for piece in sound.segments] for name, sound in sounds.items()})
        heard = tuple(Evidence(spec, NOTHING) for spec in (NORTH, SOUTH) if spec.name in sounds)
        return Localization(SOURCE_M.copy(), 0.01 * np.eye(3), 0.5, heard)

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        return PowerMaps(GRID, np.full(GRID.size, len(evidence), dtype=np.float32), {})


@pytest.fixture(scope="module")
def located() -> SrpPhat:
    return SrpPhat([NORTH, SOUTH], GRID, C_M_S)


def state_of(estimator: Any = None, arrays: Sequence[ArraySpec] = (NORTH, SOUTH), **parameters: Any) -> SiteState:
    return SiteState("site", arrays, estimator or Scripted(), FusionParameters(**parameters))


def fusion_of(estimator: Any = None, *, updates: bool = False, **parameters: Any) -> Fusion:
    return Fusion(state_of(estimator, **parameters), Role(updates=updates))


def frame(array: str, frame_index: int, active: bool = True, power: float = 1e-2, **changes: Any) -> Frame:
    made = Frame(
        array,
        1,
        START + frame_index,
        (START + frame_index) * FRAME_NS,
        RATE_HZ,
        np.zeros((4, 20), np.float32),
        power,
        active,
    )
    return replace(made, **changes)


def mark(array: str, frame_index: int, **changes: Any) -> Mark:
    return replace(Mark(array, 0, START + frame_index, 1e-7, 1e-7, (1e-7,) * 4, clock=ClockState.LOCKED), **changes)


def node(array: str, active: Collection[int], frame_indices: Iterable[int], delay: float = 0.0) -> Arrivals:
    """The messages of a node, each as its frame index ends: frames while active and in a hang-over, else marks."""
    sent: Arrivals = []
    for frame_index in frame_indices:
        lately = any(frame_index - k in active for k in range(HANG_OVER + 1))
        loud = frame_index in active
        message = frame(array, frame_index, loud, 1e-2 if loud else 1e-7) if lately else mark(array, frame_index)
        if loud and frame_index - 1 not in active:
            sent += [(frame_index + 1 + delay, frame(array, frame_index - k, False, 1e-7)) for k in (2, 1)]
        sent.append((frame_index + 1 + delay, message))
    return sent


def play(
    fusion: Fusion, arrivals: Arrivals, end: int, start: int = 0, every: float = 1.0
) -> list[tuple[float, Output]]:
    """Step through time, in frame indices; what came out, and when."""
    waiting = sorted(arrivals, key=lambda arrival: arrival[0])
    said: list[tuple[float, Output]] = []
    for step in range(round((end - start) / every) + 1):
        now = start + step * every
        here = [message for when, message in waiting if when <= now]
        waiting = waiting[len(here) :]
        said += [(now, output) for output in fusion.step(here, now_ns(now))]
    return said


def now_ns(frame_index: float) -> int:
    return START * FRAME_NS + round(frame_index * FRAME_NS)


def events_of(said: Iterable[tuple[float, Output]]) -> list[tuple[float, Event]]:
    return [(when, output) for when, output in said if isinstance(output, Event)]


def only_event(said: Iterable[tuple[float, Output]]) -> Event:
    ((_, event),) = events_of(said)
    return event


def told(outputs: Iterable[Output]) -> str:
    """All that events say, to the last bit."""
    told = [asdict(replace(output, received=())) for output in outputs if isinstance(output, Event)]
    return json.dumps(told, default=np.ndarray.tolist)


def status_of(fusion: Fusion, array: str, now: float) -> ArrayStatus:
    (status,) = [status for status in fusion.status(now_ns(now)) if status.name == array]
    return status


def sound_frames(
    spec: ArraySpec, first: int, count: int, rate_hz: float = RATE_HZ, *, noise: float = 0.0
) -> list[Frame]:
    """A burst of noise from the source as an array receives it, in frames: real samples, power and activity."""
    n = round(0.05 * rate_hz)
    samples = heard(spec, SOURCE_M, burst(n * count), rate_hz)
    samples += (noise * np.random.default_rng(1).standard_normal(samples.shape)).astype(np.float32)
    made = []
    for k in range(count):
        piece: Float32Array = samples[:, k * n : (k + 1) * n].copy()
        power = float(band_power(piece, rate_hz, spec.band_hz).mean())
        made.append(frame(spec.name, first + k, power > 1e-4, power, samples=piece, sample_rate_hz=rate_hz))
    return made


def live(frames: Sequence[Frame], end: int) -> Arrivals:
    """These frames as they end, and marks before and after."""
    array, frame_indices = frames[0].array, {made.frame_index - START for made in frames}
    quiet = [(k + 1.0, mark(array, k)) for k in range(end) if k not in frame_indices]
    return [(made.frame_index - START + 1.0, made) for made in frames] + list[tuple[float, Message]](quiet)


def position_of(event: Event) -> FloatArray:
    assert event.estimate is not None
    return event.estimate.position_m


# --- what an event is made of


def test_two_arrays_locate_together(located: SrpPhat) -> None:
    frames = [sound_frames(spec, 10, 6) for spec in (NORTH, SOUTH)]
    said = play(fusion_of(located), live(frames[0], 30) + live(frames[1], 30), 30)
    ((when, event),) = events_of(said)
    assert (event.status, event.reason) == (Status.LOCATED, None)
    assert event.heard_by == ("north", "south")
    assert event.id == f"site-{(START + 10) * 50}"  # site and milliseconds
    # all of the burst; 1 mm is derived at the estimator's test, and the frames cut off only its faded ends
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3
    assert event.start_ns == now_ns(10)
    assert event.duration_s == pytest.approx(0.3)
    assert event.power == max(made.power for some in frames for made in some)
    assert event.method == "srp-phat"
    assert event.late_frames == 0
    # out when the hang-over has been seen to be quiet: the interval 15 + 6 ends at 22
    assert when == 16 + HANG_OVER
    assert event.latency_s == pytest.approx(HANG_OVER * 0.05)
    assert event.complete_ns - event.end_ns == HANG_OVER * FRAME_NS
    for contribution, spec in zip(event.contributions, (NORTH, SOUTH), strict=True):
        assert contribution.array == spec.name
        assert contribution.active_s == pytest.approx(0.3)
        assert contribution.distance_m == pytest.approx(float(np.linalg.norm(SOURCE_M - spec.centre_m)), abs=2e-3)
    assert event.contributions[0].azimuth_deg == pytest.approx(np.degrees(np.arctan2(3.31 - 4.2, 1.13 - 2.7)), abs=0.2)


def test_clocks_may_differ_by_a_fraction_of_a_frame(located: SrpPhat) -> None:
    """An array's clock a whole frame off costs nothing: delays are formed within an array only."""
    frames = [sound_frames(spec, first, 6) for spec, first in ((NORTH, 10), (SOUTH, 11))]
    event = only_event(play(fusion_of(located), live(frames[0], 30) + live(frames[1], 30), 30))
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3


def test_sounds_apart_are_two_events_of_one_array_each() -> None:
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(30, 36), range(50))
    assert [event.heard_by for _, event in events_of(play(fusion_of(), arrivals, 50))] == [("north",), ("south",)]
    # a pause within the hang-over does not part them
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(16 + HANG_OVER - 1, 30), range(50))
    assert only_event(play(fusion_of(), arrivals, 50)).heard_by == ("north", "south")


def test_one_small_array_gives_only_a_direction() -> None:
    spec = tetra("north", NORTH.centre_m, edge_m=0.06)
    fusion = Fusion(state_of(SrpPhat([spec], GRID, C_M_S), [spec]), EVENTS_ONLY)
    event = only_event(play(fusion, live(sound_frames(spec, 10, 6, noise=0.03), 30), 30))
    # Its lags change with distance by d^2 / (2 c R^2) = 1.6 us a metre; side lobes of 0.1 in the GCCs leave them
    # uncertain by s / sqrt(kappa) = 0.1 / 22 kHz = 5 us.
    assert event.status is Status.DIRECTION_ONLY
    assert event.reason is not None
    assert event.reason.startswith("one array cannot resolve the distance: ±")
    towards, right = position_of(event) - spec.centre_m, SOURCE_M - spec.centre_m
    # the direction by 5 us of 0.06 m over sqrt(3) independent lags, 0.9 degrees; by far less in truth, at 10 dB
    assert towards @ right / np.linalg.norm(towards) / np.linalg.norm(right) > np.cos(np.radians(0.9))


def test_distance_from_a_wide_array_is_at_least_half_its_aperture() -> None:
    """Half a centimetre from its middle, a place may be as uncertain as a quarter of the half width, not of that."""
    both = joined([NORTH, SOUTH], {"north": "rack", "south": "rack"}, "both")

    def judged(spread_m: float) -> Status:
        class Uncertain(Scripted):
            def locate(self, sounds: Mapping[str, Sound]) -> Localization:
                place_m = both.centre_m + np.array([0.003, -0.004, 0.0])
                return replace(super().locate(sounds), position_m=place_m, covariance_m2=spread_m**2 * np.eye(3))

        frames = [frame("both", k, samples=np.ones((8, 20), dtype=np.float32)) for k in (10, 11)]
        return only_event(play(Fusion(state_of(Uncertain(), [both]), EVENTS_ONLY), live(frames, 30), 30)).status

    quarter_m = 0.25 * both.aperture_m / 2.0
    assert judged(0.99 * quarter_m) is Status.LOCATED
    assert judged(1.01 * quarter_m) is Status.DIRECTION_ONLY


def test_arrays_of_different_rates_locate_together(located: SrpPhat) -> None:
    north, south = sound_frames(NORTH, 10, 6), sound_frames(SOUTH, 10, 6, 48_000.0)
    fusion = fusion_of(located)
    event = only_event(play(fusion, live(north, 30) + live(south, 30), 30))
    assert event.status is Status.LOCATED
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3
    rates = [status.sample_rate_hz for status in fusion.status(now_ns(30))]
    assert rates == [16_000.0, 48_000.0]
    # and a rate misread is another place
    wrong = [replace(made, sample_rate_hz=RATE_HZ) for made in south]
    event = only_event(play(fusion_of(located), live(north, 30) + live(wrong, 30), 30))
    assert np.linalg.norm(position_of(event) - SOURCE_M) > 0.02


def test_event_uses_the_exact_rule_and_gaps_divide_segments() -> None:
    scripted = Scripted()
    powers = {10: 1e-2, 11: 1e-3, 12: 0.9e-3, 13: 5e-3, 15: 5e-3}  # the third is under a tenth; 14 never comes
    arrivals: Arrivals = [(k + 1.0, frame("north", k, power=power)) for k, power in powers.items()]
    event = only_event(play(fusion_of(scripted), arrivals + node("north", (), range(16, 30)), 30))
    assert scripted.calls == [{"north": [40, 20, 20]}]  # of 20 samples a frame
    (contribution,) = event.contributions
    assert contribution.active_s == pytest.approx(0.2)
    assert contribution.power == pytest.approx(np.mean([1e-2, 1e-3, 5e-3, 5e-3]))
    assert event.power == 1e-2
    assert (event.start_ns, event.end_ns) == (now_ns(10), now_ns(16))


def test_event_begins_in_the_pre_roll_where_the_exact_rule_is_met() -> None:
    """Live it was too soft to be sound, knowing only the past; it is a tenth of what then came."""
    arrivals: Arrivals = [(k + 1.0, mark("north", k)) for k in range(10)]
    arrivals += [(11.0, frame("north", k, False, 2e-3)) for k in (8, 9)]
    arrivals += node("north", (), range(16, 30))
    arrivals += [(11.0, frame("north", 10)), *((k + 1.0, frame("north", k, False, 1e-7)) for k in range(11, 16))]
    event = only_event(play(fusion_of(), arrivals, 30))
    assert event.start_ns == now_ns(8)
    assert event.id == f"site-{(START + 10) * 50}"  # stable: it was told already in updates


def test_event_of_too_few_arrays_is_refused() -> None:
    scripted = Scripted()
    arrivals = node("north", range(10, 15), range(30)) + node("south", (), range(30))
    event = only_event(play(fusion_of(scripted, min_arrays=2, updates=True), arrivals, 30))
    assert (event.status, event.estimate, event.contributions) == (Status.REFUSED, None, ())
    assert event.reason == "detected by 1 array; fusion.min_arrays is 2"
    assert event.heard_by == ("north",)
    assert scripted.calls == []


# --- order and time


@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_order_between_arrays_does_not_matter(data: st.DataObject, located: SrpPhat) -> None:
    queues = [
        [m for _, m in sorted(live(sound_frames(spec, 10, 5), 24), key=lambda arrival: arrival[0])]
        for spec in (NORTH, SOUTH)
    ]
    straight = fusion_of(located)
    expected = straight.step([m for pair in zip(*queues, strict=True) for m in pair], now_ns(24))
    expected += straight.flush(now_ns(24))
    turns = data.draw(st.permutations([0] * len(queues[0]) + [1] * len(queues[1])), label="whose turn")
    batches = data.draw(st.lists(st.integers(1, 48), min_size=1), label="messages a step")
    fusion, outputs = fusion_of(located), []
    mixed = [queues[who].pop(0) for who in turns]
    while mixed:
        size = batches.pop(0) if batches else len(mixed)
        outputs += fusion.step(mixed[:size], now_ns(24))
        mixed = mixed[size:]
    outputs += fusion.flush(now_ns(24))
    assert told(outputs) == told(expected)
    assert '"located"' in told(expected)


def test_result_is_the_same_live_and_all_at_once() -> None:
    active = {*range(10, 17), *range(40, 95)}
    arrivals = node("north", active, range(120)) + node("south", active, range(120))
    one, other = Scripted(), Scripted()
    parted = [event for _, event in events_of(play(fusion_of(one, max_event_s=1.0), arrivals, 120))]
    fusion = fusion_of(other, max_event_s=1.0)
    at_once = fusion.step([message for _, message in arrivals], now_ns(120)) + fusion.flush(now_ns(120))
    assert told(at_once) == told(replace(event, latency_s=(now_ns(120) - event.end_ns) / 1e9) for event in parted)
    assert one.calls == other.calls
    assert len(parted) == 4


@pytest.mark.parametrize("stops", [0, 5, 12, 18])
def test_silent_array_delays_an_event_by_at_most_the_deadline(stops: int) -> None:
    """It stops sending before, in or after a sound of the other array; one deadline later it is not awaited."""
    prompt = 16 + HANG_OVER
    arrivals = node("north", range(10, 16), range(60)) + node("south", range(10, 16), range(stops))
    ((when, event),) = events_of(play(fusion_of(), arrivals, 60))
    # its first missing interval is closed a deadline after the other's has come; then all that have come meanwhile
    assert when == max(prompt, stops + 1 + DEADLINE if stops else 0)
    assert event.heard_by == (("north", "south") if stops > 10 else ("north",))


def test_delay_follows_the_chosen_deadline() -> None:
    arrivals = node("north", range(10, 16), range(60)) + node("south", (), range(12))
    for deadline_s in (0.1, 0.5, 1.0):
        ((when, _),) = events_of(play(fusion_of(deadline_s=deadline_s), arrivals, 60))
        assert when == max(22, 13 + round(deadline_s / 0.05))


def test_late_array_is_awaited_up_to_the_deadline() -> None:
    for delay, heard_by in ((DEADLINE - 1, ("north", "south")), (3 * DEADLINE, ("north",))):
        arrivals = node("north", range(10, 16), range(80)) + node("south", range(10, 16), range(80), delay)
        (when, event), *_ = events_of(play(fusion_of(), arrivals, 80))
        assert event.heard_by == heard_by
        assert when <= 22 + DEADLINE


def test_array_that_was_away_is_used_again() -> None:
    active = {*range(10, 16), *range(60, 66), *range(100, 106)}
    south = [
        (max(when, 46.0) if 5 <= message.frame_index - START < 45 else when, message)
        for when, message in node("south", active, range(140))
    ]
    south = [(when + (4.0 if message.frame_index - START >= 95 else 0.0), message) for when, message in south]
    fusion = fusion_of()
    said = events_of(play(fusion, node("north", active, range(140)) + south, 140))
    assert [event.heard_by for _, event in said] == [("north",), ("north", "south"), ("north", "south")]
    # and it is waited for again: the third time it is 0.2 s behind
    assert [when for when, _ in said] == [22, 72, 116]
    assert status_of(fusion, "south", 140).counters["late"] == 6


def test_array_that_is_always_late_delays_no_event() -> None:
    active = range(100, 106)
    arrivals = node("north", active, range(140)) + node("south", active, range(140), 3 * DEADLINE)
    (when, event), *_ = events_of(play(fusion_of(), arrivals, 140))
    assert (when, event.heard_by) == (106 + HANG_OVER, ("north",))


def test_array_that_is_punctual_again_is_awaited() -> None:
    """Behind by less than the deadline, it never comes first again; but it need not."""
    active = {*range(10, 16), *range(100, 106)}
    south = node("south", active, range(140), 3 * DEADLINE)
    south = [(max(when - 25, 80.0) if message.frame_index - START >= 50 else when, message) for when, message in south]
    said = events_of(play(fusion_of(), node("north", active, range(140)) + south, 145))
    assert said[0][1].heard_by == ("north",)
    assert (said[-1][0], said[-1][1].heard_by) == (106 + HANG_OVER + 5, ("north", "south"))


def test_late_active_frames_are_counted() -> None:
    delay = 12  # over the deadline, but before the event is over
    fusion = fusion_of()
    arrivals = node("north", range(10, 30), range(80)) + node("south", range(10, 30), range(80), delay)
    first = events_of(play(fusion, arrivals, 80))[0][1]
    assert first.late_frames > 0
    assert status_of(fusion, "south", 80).counters["late"] >= first.late_frames
    assert status_of(fusion, "north", 80).counters["late"] == 0
    status = status_of(fusion, "south", 80)
    assert (status.state, status.reason) == (ArrayState.DEGRADED, "its frames come after their deadline")


def test_long_sound_is_split_and_no_frame_is_used_twice() -> None:
    active = range(10, 110)
    scripted = Scripted()
    arrivals = node("north", active, range(140)) + node("south", active, range(140))
    said = events_of(play(fusion_of(scripted, max_event_s=2.0), arrivals, 140))
    assert [(event.start_ns, event.end_ns) for _, event in said] == [
        (now_ns(10), now_ns(50)),
        (now_ns(50), now_ns(90)),
        (now_ns(90), now_ns(110)),
    ]
    assert [when for when, _ in said] == [50, 90, 110 + HANG_OVER]
    assert sum(sum(call["north"]) for call in scripted.calls) == 20 * len(active)
    assert len({event.id for _, event in said}) == 3


def test_event_ends_when_all_arrays_stop_sending() -> None:
    arrivals = node("north", range(10, 100), range(20)) + node("south", range(10, 100), range(20))
    ((when, event),) = events_of(play(fusion_of(), arrivals, 60))
    # heard last at 20; nothing more for a deadline and a hang-over
    assert when == 20 + DEADLINE + HANG_OVER + 1
    assert event.end_ns == now_ns(20)


def test_flush_reports_the_open_event() -> None:
    fusion = fusion_of()
    assert fusion.flush(now_ns(0)) == []
    said = play(fusion, node("north", range(10, 100), range(20)) + node("south", (), range(15)), 20)
    assert events_of(said) == []
    (event,) = fusion.flush(now_ns(21))
    assert isinstance(event, Event)
    assert event.end_ns == now_ns(20)
    assert event.latency_s == pytest.approx(0.05)


def test_long_pause_is_skipped() -> None:
    fusion = fusion_of()
    play(fusion, node("north", range(10, 100), range(20)), 20)
    later = 20 * 3600 * 24 * 365 * 10  # ten years: walked through they would take hours
    frame_indices = range(later, later + 40)
    said = play(fusion, node("north", range(later + 10, later + 15), frame_indices), later + 40, start=later)
    assert [event.start_ns for _, event in events_of(said)] == [now_ns(10), now_ns(later + 10)]


def test_fusion_starts_over_when_the_servers_clock_is_set_back() -> None:
    fusion = fusion_of(updates=True)
    hour = 20 * 3600
    said = play(fusion, node("north", range(hour + 10, hour + 100), range(hour, hour + 20)), hour + 20, start=hour)
    assert any(isinstance(output, Track) for _, output in said)
    said = play(fusion, node("north", range(10, 15), range(40)), 40)
    assert [event.start_ns for _, event in events_of(said)] == [now_ns(hour + 10), now_ns(10)]
    assert [track.id for _, track in said if isinstance(track, Track) and track.state is TrackState.END] == [1]
    assert status_of(fusion, "north", 40).state is ArrayState.HEALTHY
    assert status_of(fusion, "north", 40).counters["late"] == 0


# --- what is said while a sound lasts


def test_updates_come_only_while_there_is_sound() -> None:
    scripted = Scripted()
    arrivals = node("north", range(10, 20), range(120)) + node("south", range(14, 20), range(120))
    fusion = fusion_of(scripted, updates=True)
    said = play(fusion, arrivals, 120)
    updates = [(when, output) for when, output in said if isinstance(output, Update)]
    assert [when for when, _ in updates] == [12, 14, 16, 18, 20]  # every 0.1 s, as the interval ends
    assert {update.event_id for _, update in updates} == {f"site-{(START + 10) * 50}"}
    assert [update.estimate.arrays for _, update in updates] == [("north",)] * 2 + [("north", "south")] * 3
    # windows of 0.2 s, their middle 0.1 s ago; before the sound there is nothing to use
    assert [update.estimate.time_ns for _, update in updates] == [now_ns(when - 2) for when, _ in updates]
    assert [update.complete_ns for _, update in updates] == [now_ns(when) for when, _ in updates]
    assert [call["north"] for call in scripted.calls[:-1]] == [[40], [80], [80], [80], [80]]
    windows = [(when, output) for when, output in said if isinstance(output, Window)]
    assert [(when, window.time_ns) for when, window in windows] == [(w, u.estimate.time_ns) for w, u in updates]
    assert [len(window.evidence) for _, window in windows] == [1, 1, 2, 2, 2]
    assert fusion.power_maps(windows[-1][1]).fused.max() == 2.0
    tracks = [(when, output) for when, output in said if isinstance(output, Track)]
    assert [track.state for _, track in tracks] == [TrackState.NEW] + [TrackState.UPDATE] * 4 + [TrackState.END]
    assert tracks[-1][0] == 20 - 2 + 60 + 1  # three seconds after the last estimate


class Undecided(Scripted):
    """An estimator that cannot tell two places apart."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        mirror_m = found.position_m + np.array([0.0, 0.0, 1.0])
        candidates = (Candidate(found.position_m, 0.5), Candidate(mirror_m, 0.5))
        return replace(found, candidates=candidates, ambiguity="all microphones lie in one plane")


def test_estimates_with_candidates_are_directions_and_start_no_track() -> None:
    arrivals = node("north", range(10, 20), range(120)) + node("south", range(10, 20), range(120))
    said = play(fusion_of(Undecided(), updates=True), arrivals, 120)
    event = only_event(said)
    assert event.status is Status.DIRECTION_ONLY
    assert event.reason == "all microphones lie in one plane"
    updates = [output for _, output in said if isinstance(output, Update)]
    assert updates
    answers: list[Event | Update] = [event, *updates]
    for answer in answers:
        assert answer.status is Status.DIRECTION_ONLY
        assert answer.estimate is not None
        assert [each.probability for each in answer.estimate.candidates] == [0.5, 0.5]
    assert not [output for _, output in said if isinstance(output, Track)]


def test_live_fusion_that_is_behind_locates_only_the_newest_window() -> None:
    arrivals = node("north", range(10, 20), range(30)) + node("south", range(10, 20), range(30))
    site = Fusion(state_of(), Role(newest_only=True))
    said = play(site, arrivals, 16)  # in step: nothing is left out
    assert len([output for _, output in said if isinstance(output, Update)]) == 3
    assert site.updates.left_out == 0
    behind = Fusion(state_of(), Role(newest_only=True))
    told = behind.step(
        [message for when, message in sorted(arrivals, key=lambda arrival: arrival[0]) if when <= 17], now_ns(17)
    )
    assert [output.complete_ns for output in told if isinstance(output, Update)] == [now_ns(16)]
    assert behind.updates.left_out == 2


def test_events_only_role_gives_no_updates() -> None:
    arrivals = node("north", range(10, 20), range(40))
    said = play(fusion_of(updates=False), arrivals, 40)
    assert [type(output) for _, output in said] == [Event]


# --- whom not to believe


def test_unknown_array_is_counted_and_ignored() -> None:
    fusion = fusion_of()
    said = play(fusion, node("west", range(10, 16), range(40)), 40)
    assert said == []
    assert fusion.unknown_arrays == len(node("west", range(10, 16), range(40)))


def test_wrong_number_of_channels_is_rejected() -> None:
    fusion = fusion_of()
    three = np.zeros((3, 20), np.float32)
    arrivals: Arrivals = [
        (when, replace(m, samples=three.copy()) if isinstance(m, Frame) else m)
        for when, m in node("south", range(10, 16), range(40))
    ]
    event = only_event(play(fusion, node("north", range(10, 16), range(40)) + arrivals, 40))
    assert event.heard_by == ("north",)
    status = status_of(fusion, "south", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason == "its frames have 3 channels, the server's site file says 4"
    assert status.counters["rejected"] == 2 + 6 + HANG_OVER
    assert status.counters["frames"] == 0


@pytest.mark.parametrize(("off", "side"), [(72_000, "ahead of"), (-72_000, "behind")])
def test_clock_an_hour_off_is_rejected_and_others_go_on(off: int, side: str) -> None:
    fusion = fusion_of()
    north = node("north", range(10, 16), range(40))
    astray = [
        (when, replace(m, frame_index=m.frame_index + off)) for when, m in node("south", range(10, 16), range(40))
    ]
    said = play(fusion, north + astray, 40)
    alone = play(fusion_of(), north, 40)
    assert told(output for _, output in said) == told(output for _, output in alone)
    assert [when for when, _ in said] == [when for when, _ in alone]
    status = status_of(fusion, "south", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason is not None
    assert status.reason.startswith("its clock is 3")
    assert status.reason.endswith(f" s {side} the server's; set both by NTP")
    assert status.counters["rejected"] == len(astray)


def test_frames_up_to_half_a_minute_old_are_accepted() -> None:
    for age, rejected in ((590, 0), (610, 1)):
        fusion = fusion_of()
        fusion.step([frame("north", 0)], now_ns(age))
        assert status_of(fusion, "north", age).counters["rejected"] == rejected


# --- how the arrays are doing


def test_array_starts_then_is_healthy_then_lost() -> None:
    fusion = fusion_of()
    assert status_of(fusion, "north", 0) == ArrayStatus(
        "north", ArrayState.STARTING, "no message yet", False, None, None, None, (), None, None, None,
        dict.fromkeys(("frames", "marks", "late", "rejected", "lost_frames", "overflows"), 0),
    )  # fmt: skip
    play(fusion, node("north", (), range(10)), 10)
    status = status_of(fusion, "north", 12)
    assert (status.state, status.reason) == (ArrayState.HEALTHY, None)
    assert status.age_s == pytest.approx(0.1)
    assert (status.power, status.noise_power, status.clock) == (1e-7, 1e-7, ClockState.LOCKED)
    assert status.counters["marks"] == 10
    assert status_of(fusion, "north", 39).state is ArrayState.HEALTHY
    status = status_of(fusion, "north", 40)  # one and a half seconds later
    assert (status.state, status.reason) == (ArrayState.LOST, "no message for 1.5 s")
    play(fusion, node("north", (), range(60, 62)), 62, start=61)
    assert status_of(fusion, "north", 62).state is ArrayState.HEALTHY
    assert status_of(fusion, "south", 62).state is ArrayState.STARTING


def test_array_is_active_while_its_frames_are() -> None:
    fusion = fusion_of()
    for frame_index, active in ((5, False), (12, True), (17, False), (30, False)):
        play(fusion, node("north", range(10, 16), range(frame_index + 1)), frame_index + 1, start=frame_index)
        assert status_of(fusion, "north", frame_index + 1).active == active
    fusion = fusion_of()
    play(fusion, node("north", range(10, 16), range(13)), 13)
    assert status_of(fusion, "north", 14).active
    assert not status_of(fusion, "north", 60).active  # lost


def test_node_that_has_ended_is_lost_and_not_awaited() -> None:
    fusion = fusion_of()
    play(fusion, node("north", (), range(10)) + node("south", (), range(10)), 10)
    fusion.leave("south")
    fusion.leave("nobody")
    status = status_of(fusion, "south", 10)
    assert (status.state, status.reason) == (ArrayState.LOST, "its node has ended")
    ((when, _),) = events_of(play(fusion, node("north", range(12, 16), range(10, 40)), 40, start=11))
    assert when == 16 + HANG_OVER
    play(fusion, node("south", (), range(40, 42)), 42, start=41)
    assert status_of(fusion, "south", 42).state is ArrayState.HEALTHY


@pytest.mark.parametrize(
    ("powers", "said"),
    [
        ((1e-7, 1e-7, 0.0, 1e-7), "microphone [3] is dead: all-zero samples; check cable, gain and channel numbers"),
        ((0.0,) * 4, "all channels are dead: all-zero samples; check cable, gain and channel numbers"),
    ],
)
def test_dead_microphone_is_reported_after_a_second(powers: tuple[float, ...], said: str) -> None:
    fusion = fusion_of()
    for frame_index in range(60):
        dead = 10 <= frame_index < 50
        message = mark("north", frame_index, channel_power=powers) if dead else mark("north", frame_index)
        fusion.step([message], now_ns(frame_index + 1))
        status = status_of(fusion, "north", frame_index + 1)
        if 10 + 20 <= frame_index < 50:
            assert (status.state, status.reason) == (ArrayState.DEGRADED, said)
        else:
            assert (status.state, status.reason) == (ArrayState.HEALTHY, None)


@pytest.mark.parametrize(
    ("trouble", "said"),
    [
        ({"overflows": 3}, "its device loses samples; use larger blocks or a less busy machine"),
        ({"lost_frames": 3}, "the device skipped samples; frames at the gap were dropped"),
        ({"clock": ClockState.STEPPED}, "its clock has stepped"),
    ],
)
def test_fault_is_reported_for_ten_seconds(trouble: dict[str, Any], said: str) -> None:
    fusion = fusion_of()
    lasting = {name: value for name, value in trouble.items() if name != "clock"}
    for frame_index in range(240):
        changes = trouble if frame_index == 20 else lasting if frame_index > 20 else {}
        fusion.step([mark("north", frame_index, **changes)], now_ns(frame_index + 1))
        status = status_of(fusion, "north", frame_index + 1)
        troubled = 20 <= frame_index < 20 + 200
        assert status.state is (ArrayState.DEGRADED if troubled else ArrayState.HEALTHY)
        assert status.reason == (said if troubled else None)
    assert status.counters["overflows"] == trouble.get("overflows", 0)
    assert status.counters["lost_frames"] == trouble.get("lost_frames", 0)


def test_counters_from_before_the_connection_are_no_fault() -> None:
    fusion = fusion_of()
    play(fusion, [(1.0, mark("north", 0, overflows=7, lost_frames=9))], 1)
    assert status_of(fusion, "north", 1).state is ArrayState.HEALTHY


def test_prepare_is_passed_to_the_estimator() -> None:
    scripted = Scripted()
    fusion_of(scripted).prepare("north", 44_100.0)
    assert scripted.prepared == [("north", 44_100.0)]


# --- for ever


@pytest.mark.parametrize("arrays", [("north",), ("north", "south")])
def test_memory_does_not_grow(arrays: tuple[str, ...]) -> None:
    """Hours of quiet with a sound now and then: what is held is the last second's, whatever came before."""
    scripted = Scripted()
    fusion = fusion_of(scripted, max_event_s=1.0)
    held: list[weakref.ref[Float32Array]] = []
    sizes = []
    for frame_index in range(12_000):
        loud = frame_index % 100 < 45
        for array in arrays:
            message: Message = frame(array, frame_index) if loud else mark(array, frame_index)
            if isinstance(message, Frame):
                held.append(weakref.ref(message.samples))
            fusion.step([message], now_ns(frame_index + 1))
        if frame_index % 2000 == 1999:
            scripted.calls.clear()
            sizes.append(len(pickle.dumps(fusion)))
            held = [reference for reference in held if reference() is not None]
            # an event of 20 frames, and 9 for pre-roll and window before it
            assert len(held) <= len(arrays) * (20 + 9 + 2)
    assert max(sizes[1:]) <= sizes[0] + 200  # counters get longer


class Gauge:
    """Stands for a front end: it says of each frame how loud it was."""

    sample_rate_hz = RATE_HZ

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        assert samples.size
        return OnsetGCC(np.zeros((1, 1), np.float32), np.full(4, np.abs(samples).max(), np.float64))

    def reset(self) -> None:
        raise AssertionError("all frames are there")


class Gauged(Scripted):
    """Listens."""

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        return Gauge()

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.calls.append({name: [piece.shape[1] for piece in sound.segments] for name, sound in sounds.items()})
        heard = tuple(Evidence(spec, NOTHING) for spec in MANY if spec.name in sounds)
        return Localization(SOURCE_M.copy(), 0.01 * np.eye(3), 0.5, heard)


MANY = [replace(NORTH, name=f"a{k:02d}") for k in range(KEPT_ARRAYS + 6)]


@pytest.mark.parametrize("order", [1, -1])
def test_of_many_arrays_only_those_with_strong_onsets_keep_samples(order: int) -> None:
    """The correlations of the other arrays stay: these arrays detect the event and contribute to it."""
    gauged = Gauged()
    fusion = Fusion(state_of(gauged, MANY), EVENTS_ONLY)
    held: dict[str, list[weakref.ref[Float32Array]]] = {spec.name: [] for spec in MANY}
    most = dict.fromkeys(held, 0)
    events: list[Output] = []
    for frame_index in range(100):
        for rank, spec in enumerate(MANY[::order]):
            message: Message = mark(spec.name, frame_index)
            if frame_index < 90:
                samples = np.full((4, 20), 1e-3 * (1 + rank), np.float32)
                message = frame(
                    spec.name, frame_index, frame_index >= 10, 1e-2 if frame_index >= 10 else 1e-7, samples=samples
                )
                held[spec.name].append(weakref.ref(message.samples))
            events += fusion.step([message], now_ns(frame_index + 1))
            del message
        for name, references in held.items():
            held[name] = [reference for reference in references if reference() is not None]
            most[name] = max(most[name], len(held[name]))
    (event,) = [output for output in events if isinstance(output, Event)]
    assert set(event.heard_by) == set(most)
    assert {c.array: c.active_s for c in event.contributions} == dict.fromkeys(most, 4.0)  # 80 frames
    let_go = {spec.name for spec in MANY[::order][:6]}
    for name, pieces in gauged.calls[-1].items():
        assert (sum(pieces) < 20 * 20) if name in let_go else (pieces == [80 * 20]), name
        # windows and a hang-over, and what has come since the last look; else all of it with the run-up
        assert (most[name] <= 10 + RELEASE_FRAMES + 9) if name in let_go else (most[name] >= 88), name


def test_released_samples_do_not_depend_on_the_order_of_arrival() -> None:
    """One by one, in another order, or all at once, as a recording's: the same pieces are left of every array."""
    loudness = np.random.default_rng(1).uniform(0.5, 1.0, (len(MANY), 90)).astype(np.float32)
    frames: list[Message] = [
        frame(spec.name, frame_index, frame_index >= 10, samples=np.full((4, 20), loudness[k, frame_index], np.float32))
        for frame_index in range(90)
        for k, spec in enumerate(MANY)
    ]
    quiet: list[Message] = [mark(spec.name, frame_index) for frame_index in range(90, 100) for spec in MANY]
    left = []
    for steps in (
        [[message] for message in frames + quiet],
        [[message] for message in sorted(frames + quiet, key=lambda m: (m.frame_index, -int(m.array[1:])))],
        [frames + quiet],
    ):
        gauged = Gauged()
        fusion = Fusion(state_of(gauged, MANY), EVENTS_ONLY)
        said = [output for step in steps for output in fusion.step(step, now_ns(step[-1].frame_index - START + 1))]
        assert sum(isinstance(output, Event) for output in said) == 1
        left.append(gauged.calls[-1])
    assert left[0] == left[1] == left[2]
    assert len({sum(pieces) for pieces in left[0].values()}) > 2  # some went early, some late, some not at all


class FrontEnd:
    """A front end that remembers what was pushed, and returns for each frame its number."""

    sample_rate_hz = RATE_HZ

    def __init__(self, heard: list[tuple[int, bool] | None]) -> None:
        self.heard = heard

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        self.heard.append((int(samples[0, 0]), quiet))
        return OnsetGCC(np.array([[samples[0, 0]]], np.float32), np.ones(1))

    def reset(self) -> None:
        self.heard.append(None)


class Correlating(Scripted):
    """An estimator with a front end for every frame."""

    def __init__(self, refused: str | None = None) -> None:
        super().__init__()
        self.heard: list[tuple[int, bool] | None] = []
        self.sums: list[tuple[float, float]] = []
        self.refused = refused

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        assert (array, sample_rate_hz) == ("north", RATE_HZ)
        self.heard.append(None)  # a new one, that has heard nothing
        return FrontEnd(self.heard)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        onsets = summed(sounds["north"].onsets)
        self.sums.append((float(onsets.lags.sum()), onsets.weight))
        return replace(super().locate(sounds), refused=self.refused)


def numbered(frame_index: int, active: bool) -> Frame:
    return frame(
        "north", frame_index, active, 1e-2 if active else 1e-7, samples=np.full((4, 20), frame_index, np.float32)
    )


def test_each_frame_of_an_event_is_correlated_once_and_in_order() -> None:
    estimator = Correlating()
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 15)) for k in range(4, 40) if k != 13]
    events = events_of(play(fusion_of(estimator, updates=True), arrivals, 60))
    before = [(k, True) for k in range(4, 12)]  # 0.4 s of pre-roll
    after = [(k, True) for k in range(15, 21)]
    assert estimator.heard == [None, *before, (12, False), None, (14, False), *after]
    assert len(events) == 1
    assert estimator.sums[-1] == (sum(range(4, 13)) + 14, 10.0)  # up to the last active one


def test_late_frames_are_correlated_in_their_place() -> None:
    on_time, late = Correlating(), Correlating()
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18)) for k in range(4, 40)]
    events_of(play(fusion_of(on_time), arrivals, 60))
    held = [(21.0 if frame.frame_index == START + 13 else when, frame) for when, frame in arrivals]
    (event,) = (event for _, event in events_of(play(fusion_of(late), held, 60)))
    assert event.late_frames == 1
    assert late.sums == on_time.sums
    assert late.heard.count(None) > 1  # it had been missing at first
    assert on_time.heard.count(None) == 1


def test_two_passes_correlate_each_frame_once() -> None:
    """Each pass uses the correlations of the other while both have the same frames, and then makes its own."""
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18)) for k in range(4, 40)]
    alone, both = Correlating(), Correlating()
    play(fusion_of(alone), arrivals, 60)
    shared = state_of(both)
    for fusion in (Fusion(shared, EVENTS_ONLY), Fusion(shared, EVENTS_ONLY)):
        play(fusion, arrivals, 60)
    assert both.heard == alone.heard
    assert both.sums == 2 * alone.sums

    partly = Correlating()
    shared = state_of(partly)
    first, second = Fusion(shared, EVENTS_ONLY), Fusion(shared, EVENTS_ONLY)
    play(first, [arrival for arrival in arrivals if arrival[1].frame_index != START + 16], 60)
    play(second, arrivals, 60)
    assert partly.sums[-1] == alone.sums[-1]


@pytest.mark.parametrize("pause", [5, 7, 9])
def test_correlating_ahead_changes_no_result(pause: int) -> None:
    """A pre-roll that is known to begin at the end of the last sound has been correlated when the next one comes."""
    again = range(18 + pause, 24 + pause)
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18 or k in again)) for k in range(4, 50)]
    told, heard_at_once = [], []
    for newest_only in (False, True):
        estimator = Correlating()
        fusion = Fusion(state_of(estimator), Role(updates=False, newest_only=newest_only))
        until = [arrival for arrival in arrivals if arrival[1].frame_index < START + again.start]
        play(fusion, until, again.start)
        before = len(estimator.heard)
        fusion.step([numbered(again.start, True)], now_ns(again.start + 1.0))
        heard_at_once.append(len(estimator.heard) - before)
        play(
            fusion,
            [arrival for arrival in arrivals if arrival[1].frame_index > START + again.start],
            70,
            again.start + 2,
        )
        told.append(estimator.sums)
    assert told[0] == told[1]
    assert heard_at_once[0] == {5: 1, 7: 9, 9: 10}[pause]
    assert heard_at_once[1] == {5: 1, 7: 1, 9: 10}[pause]


def test_memory_of_a_sound_without_end_is_bounded() -> None:
    fusion = fusion_of(Correlating(), max_event_s=1.0)
    held: list[weakref.ref[Float32Array]] = []
    most = 0
    for k in range(4, 200):
        message = numbered(k, k >= 12)
        held.append(weakref.ref(message.samples))
        fusion.step([message], now_ns(k + 1))
        del message
        held = [reference for reference in held if reference() is not None]
        most = max(most, len(held))
    assert 20 <= most < 60  # a second of sound, and what windows and pre-rolls reach back to


def test_correlations_are_pruned_with_their_frames() -> None:
    stream = ArrayStream(NORTH, ArrayHealth(4))
    for k in range(10):
        stream.add(numbered(k, True))
        stream.correlations.onsets[START + k] = OnsetGCC(np.zeros((1, 1), np.float32), np.ones(1))
    stream.prune(START + 7)
    assert list(stream.frames) == list(stream.correlations.onsets) == [START + k for k in (7, 8, 9)]


@pytest.mark.parametrize("refused", [None, "too unsure"])
def test_refused_location_gives_no_position_and_no_track(refused: str | None) -> None:
    estimator = Scripted()
    place = estimator.locate
    estimator.locate = lambda sounds: replace(place(sounds), refused=refused)  # type: ignore[method-assign]
    arrivals = node("north", range(12, 30), range(60)) + node("south", range(12, 30), range(60))
    said = [output for _, output in play(fusion_of(estimator, updates=True), arrivals, 70)]
    (event,) = (output for output in said if isinstance(output, Event))
    expected = Status.LOCATED if refused is None else Status.REFUSED
    assert (event.status, event.reason, event.estimate is None) == (expected, refused, refused is not None)
    assert {output.status for output in said if isinstance(output, Update)} == {expected}
    assert any(isinstance(output, Track) for output in said) == (refused is None)


def test_microphone_that_dies_during_a_sound_is_reported() -> None:
    """No mark comes during a sound, but the samples of its frames show the same."""
    fusion = fusion_of()
    samples = np.full((4, 20), 0.1, np.float32)
    samples[2] = 0.0
    arrivals: Arrivals = [(k + 1.0, frame("north", k, samples=samples.copy())) for k in range(30)]
    play(fusion, arrivals, 19)
    assert status_of(fusion, "north", 20).state is ArrayState.HEALTHY
    play(fusion, arrivals[20:], 30, start=20)
    status = status_of(fusion, "north", 30)
    assert status.state is ArrayState.DEGRADED
    assert status.reason == "microphone [3] is dead: all-zero samples; check cable, gain and channel numbers"


# --- consensus and outliers


class Voting(Scripted):
    """An estimator that finds the outliers that the test names."""

    def __init__(self) -> None:
        super().__init__()
        self.outliers: dict[str, float] = {}
        self.suspect: list[set[str]] = []

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.suspect.append({name for name, sound in sounds.items() if sound.suspect})
        found = super().locate(sounds)
        evidence = tuple(Evidence(spec, NOTHING) for spec in (NORTH, SOUTH, EAST) if spec.name in sounds)
        outliers = {name: off for name, off in self.outliers.items() if name in sounds}
        return replace(found, evidence=evidence, outliers=outliers)


EAST = tetra("east", [3.9, 2.4, 1.9])
THREE = (NORTH, SOUTH, EAST)


def sound_at(fusion: Fusion, frame_index: int, arrays: Sequence[str] = ("north", "south", "east")) -> list[Output]:
    """One short sound that these arrays detect."""
    span = range(frame_index, frame_index + 20)
    arrivals = [message for name in arrays for message in node(name, {frame_index + 5, frame_index + 6}, span)]
    return [output for _, output in play(fusion, arrivals, frame_index + 21, frame_index)]


def test_repeated_outlier_is_named_becomes_suspect_and_is_cleared() -> None:
    estimator = Voting()
    fusion = Fusion(state_of(estimator, THREE))
    estimator.outliers = {"east": 29.6}
    for turn in range(4):
        (event,) = (output for output in sound_at(fusion, 20 * turn) if isinstance(output, Event))
        assert event.reason == "located without the outlier 'east' (30° off)"
        assert event.status is Status.LOCATED
        assert event.estimate is not None
        assert event.estimate.arrays == ("north", "south")
        assert event.heard_by == ("north", "south", "east")
        agrees = {c.array: (c.agrees, c.off_deg) for c in event.contributions}
        assert agrees == {"north": (True, None), "south": (True, None), "east": (False, 29.6)}
        status = status_of(fusion, "east", 20 * turn + 20)
        assert (status.agreed, status.disagreed) == (0, turn + 1)
        assert status.state is (ArrayState.HEALTHY if turn < 2 else ArrayState.DEGRADED)
    assert status.reason is not None
    assert "an outlier in 4 of the last 4 events, by 30°; check its pose" in status.reason
    assert status_of(fusion, "north", 80).state is ArrayState.HEALTHY
    assert estimator.suspect[-1] == {"east"}  # the fourth event
    assert "east" not in estimator.calls[-2]  # updates leave out suspect arrays, events do not
    assert "east" in estimator.calls[-1]
    estimator.outliers = {}
    for turn in range(4, 7):
        assert status_of(fusion, "east", 20 * turn).state is ArrayState.DEGRADED
        sound_at(fusion, 20 * turn)
    assert status_of(fusion, "east", 140).state is ArrayState.HEALTHY
    sound_at(fusion, 140)
    assert estimator.suspect[-1] == set()


class Choosing(Voting):
    """An estimator that needs no more than two arrays, which agree."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        return replace(super().locate(sounds), unneeded={"north"}, outliers={})


def test_array_that_is_not_needed_detects_but_neither_contributes_nor_votes() -> None:
    fusion = Fusion(state_of(Choosing(), THREE))
    (event,) = (output for output in sound_at(fusion, 0) if isinstance(output, Event))
    assert event.heard_by == ("north", "south", "east")
    assert event.estimate is not None
    assert event.estimate.arrays == ("south", "east")
    assert {c.array: c.agrees for c in event.contributions} == {"north": None, "south": True, "east": True}
    assert [status_of(fusion, name, 20).agreed for name in ("north", "south", "east")] == [0, 1, 1]


def test_two_arrays_have_no_vote_and_two_passes_count_a_sound_once() -> None:
    estimator = Voting()
    shared = state_of(estimator, THREE)
    fusion = Fusion(shared)
    sound_at(fusion, 0, ("north", "south"))
    assert (status_of(fusion, "north", 20).agreed, status_of(fusion, "north", 20).disagreed) == (0, 0)
    final = Fusion(shared, EVENTS_ONLY)
    estimator.outliers = {"south": 12.0}
    sound_at(final, 20)
    sound_at(fusion, 20)  # the other pass's result of the same sound
    assert (status_of(fusion, "south", 40).agreed, status_of(fusion, "south", 40).disagreed) == (0, 1)


def test_microphone_that_receives_no_sound_is_reported() -> None:
    samples = np.random.default_rng(3).standard_normal((4, 800)).astype(np.float32)
    samples[2] *= 1e-3
    arrivals: Arrivals = [(k + 1.0, frame("north", k, samples=samples.copy())) for k in range(10)]
    arrivals += [(k + 1.0, mark("north", k)) for k in range(10, 40)]
    fusion = fusion_of()
    play(fusion, arrivals, 40)
    status = status_of(fusion, "north", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason is not None
    assert "microphone [3] receives next to nothing of what the others receive" in status.reason
    again: Arrivals = [(k + 1.0, frame("north", k, samples=samples[[0, 1, 0, 1]])) for k in range(40, 44)]
    play(fusion, again, 44, 40)
    assert status_of(fusion, "north", 44).state is ArrayState.HEALTHY


# --- several sources


OTHER_M = SOURCE_M - np.array([0.0, 1.5, 0.0])


class Duet(Scripted):
    """An estimator that finds two places where it may."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        if not all(sound.sources > 1 for sound in sounds.values()):
            return found
        return replace(found, others=(replace(found, position_m=OTHER_M, confidence=0.7),))

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        return FrontEnd([])


def test_each_of_two_sources_gives_an_event() -> None:
    fusion = Fusion(state_of(Duet(), THREE))
    outputs = sound_at(fusion, 0, ("north", "south"))
    one, other = (output for output in outputs if isinstance(output, Event))
    assert (one.id, one.source) == (f"site-{(START + 5) * 50}", 1)
    assert (other.id, other.source) == (f"{one.id}-2", 2)
    assert other.estimate is not None
    np.testing.assert_array_equal(other.estimate.position_m, OTHER_M)
    assert (other.start_ns, other.end_ns, other.status) == (one.start_ns, one.end_ns, Status.LOCATED)
    assert other.estimate.confidence == 0.7
    assert other.contributions[0].azimuth_deg != one.contributions[0].azimuth_deg
    assert all(output.others == () for output in outputs if isinstance(output, Update))  # unless it is asked for
    alone = Fusion(state_of(Duet(), THREE, sources=1))
    assert [event.source for event in sound_at(alone, 0, ("north", "south")) if isinstance(event, Event)] == [1]


def test_updates_hold_a_second_source_where_the_site_asks_for_it() -> None:
    fusion = Fusion(state_of(Duet(), THREE, live_sources=2))
    outputs = sound_at(fusion, 0, ("north", "south"))
    (update,) = (output for output in outputs if isinstance(output, Update))
    (other,) = update.others
    np.testing.assert_array_equal(other.position_m, OTHER_M)
    assert {output.id for output in outputs if isinstance(output, Track)} == {1, 2}


@pytest.mark.parametrize(("position", "variance"), [(1.0, np.nan), (np.nan, 0.01), (1.0, np.inf)])
def test_an_answer_that_is_not_finite_is_refused(position: float, variance: float) -> None:
    class Odd(Scripted):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            found = super().locate(sounds)
            return replace(found, position_m=np.full(3, position), covariance_m2=np.full((3, 3), variance))

    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    event = only_event(play(fusion_of(Odd(), updates=True), arrivals, 50))
    assert event.status is Status.REFUSED
    assert event.reason == "method 'scripted' answered with a position or covariance that is not finite"


@pytest.mark.parametrize("powers", [(None, None), (4e-3, 1e-3), (4e-3, None)])
def test_each_source_has_the_level_that_the_estimator_found(powers: tuple[float | None, float | None]) -> None:
    """The first has all power unless it was divided; the second has none but its own."""

    class Divided(Duet):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            found = super().locate(sounds)
            others = tuple(replace(other, power=powers[1]) for other in found.others)
            return replace(found, power=powers[0], others=others)

    outputs = sound_at(Fusion(state_of(Divided(), THREE)), 0, ("north", "south"))
    first, second = (output for output in outputs if isinstance(output, Event))
    alone = Fusion(state_of(Duet(), THREE, sources=1))
    (whole,) = (output for output in sound_at(alone, 0, ("north", "south")) if isinstance(output, Event))
    assert (first.power, second.power) == (powers[0] or whole.power, powers[1])


@pytest.mark.parametrize("free_axes", [(0, 1, 2), (0, 1)])
def test_a_position_without_covariance_has_the_error_of_the_set_up(free_axes: tuple[int, ...]) -> None:
    class Certain(Scripted):
        def locate(self, sounds: Mapping[str, Sound]) -> Localization:
            return replace(super().locate(sounds), covariance_m2=np.zeros((3, 3)))

    state = SiteState("site", (NORTH, SOUTH), Certain(), free_axes=free_axes)
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    estimate = only_event(play(Fusion(state, Role(updates=False)), arrivals, 50)).estimate
    assert estimate is not None
    assert tuple(np.flatnonzero(np.diag(estimate.covariance_m2))) == free_axes
    np.testing.assert_array_equal(estimate.sound_covariance_m2, np.zeros((3, 3)))
    expected_m2 = set_up_covariance_m2((NORTH, SOUTH), SOURCE_M, free_axes)
    np.testing.assert_allclose(estimate.covariance_m2, expected_m2)


class Sure(Scripted):
    """An estimator whose confidence is a probability."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        return replace(found, covariance_m2=1e-4 * np.eye(3), confidence=0.95, features=ConfidenceFeatures(0.5, 9.0))


def located_with(estimator: Scripted, orientation_deg: float) -> tuple[Event, Estimate]:
    """An event, and its estimate, of arrays whose orientation is known so well."""
    known = Uncertainty(0.01, orientation_deg, 0.0, 0.0)
    arrays = [replace(spec, uncertainty=known) for spec in (NORTH, SOUTH)]
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(10, 16), range(50))
    event = only_event(play(Fusion(state_of(estimator, arrays), Role(updates=False)), arrivals, 50))
    assert event.estimate is not None
    return event, event.estimate


@settings(max_examples=15)
@given(orientation_deg=st.floats(0.1, 30.0), further_deg=st.floats(1.0, 20.0))
def test_confidence_falls_with_the_error_of_the_set_up_and_the_reason_says_so(
    orientation_deg: float, further_deg: float
) -> None:
    """A position stays a position: the sound determines it, and measuring the poses is what helps."""
    event, estimate = located_with(Sure(), orientation_deg)
    _, worse = located_with(Sure(), orientation_deg + further_deg)
    assert event.status is Status.LOCATED
    assert worse.confidence <= estimate.confidence <= 0.95
    assert estimate.sound_confidence == worse.sound_confidence == 0.95
    within = probability_within(NEAR_M, estimate.covariance_m2)
    assert estimate.confidence == pytest.approx(0.95 * within, rel=1e-6)
    is_limited = half_axis_m(estimate.set_up_covariance_m2) > NEAR_M
    assert is_limited == (event.reason is not None)
    assert not is_limited or "the set-up alone allows an error of" in str(event.reason)


def test_confidence_that_is_no_probability_stays() -> None:
    assert located_with(Scripted(), 20.0)[1].confidence == 0.5
