"""The judgement whether the process that owns a device still works."""

from __future__ import annotations

import signal

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from livessl.capture.device_report import DeviceState, Report
from livessl.capture.device_watch import BEATS_PER_S, FLOODS, LAGGING_S, Seen, judge

BLOCK_S = 0.02
OPEN = Report(DeviceState.OPEN, hardware=True)
ABSENT = Report(DeviceState.ABSENT, "device 'UMC' is not connected; connect it")


def problem(seen: Seen) -> str:
    verdict = judge("UMC", BLOCK_S, seen)
    return "" if verdict is None else f"{verdict.problem}{' (over)' if verdict.over else ''}"


@given(st.floats(0.0, 0.99), st.booleans(), st.integers(0, FLOODS - 1))
def test_device_that_delivers_has_no_problem(idle_s: float, before: bool, floods: int) -> None:
    seen = Seen(OPEN, delivered=True, delivered_before=before, idle_s=idle_s, beats=1, silent_s=idle_s, floods=floods)
    assert problem(seen) == ""


@given(st.floats(1.05, 2.0), st.integers(0, 30), st.floats(0.0, 2.0))
def test_stream_that_ends_is_reported_within_two_seconds(idle_s: float, beats: int, silent_s: float) -> None:
    assert problem(Seen(OPEN, delivered=True, idle_s=idle_s, beats=beats, silent_s=silent_s)) != ""


@given(st.floats(1.6, 2.0), st.integers(0, 30), st.floats(0.0, 2.0))
def test_device_that_never_delivers_is_reported_within_two_seconds(idle_s: float, beats: int, silent_s: float) -> None:
    assert problem(Seen(OPEN, idle_s=idle_s, beats=beats, silent_s=silent_s)) != ""


@given(st.floats(LAGGING_S, 100.0), st.integers(0, 1000), st.floats(0.0, 100.0), st.booleans())
def test_stream_without_sound_is_always_given_up_in_the_end(
    idle_s: float, beats: int, silent_s: float, delivered: bool
) -> None:
    seen = Seen(OPEN, delivered=delivered, idle_s=idle_s, beats=beats, silent_s=silent_s)
    assert problem(seen).endswith(" (over)")


@given(st.integers(-15, 255), st.sampled_from([None, OPEN, ABSENT]))
def test_process_that_ended_is_started_again(exit_code: int, report: Report | None) -> None:
    assert problem(Seen(report, exit_code=exit_code)).endswith("it was started again (over)")


@given(st.floats(1.1, 4.9), st.floats(0.0, 1.9))
def test_lack_of_processor_time_is_not_blamed_on_the_device(idle_s: float, silent_s: float) -> None:
    beats = int(idle_s * BEATS_PER_S / 2) - 1
    assume(silent_s <= idle_s)
    assert problem(Seen(OPEN, delivered=True, idle_s=idle_s, beats=beats, silent_s=silent_s)).startswith(
        f"this machine lags: the process that reads device 'UMC' got only {beats} of "
    )


UMC = "device 'UMC'"
LIBRARY = f"the sound library of {UMC}"
SERVER = Report(DeviceState.OPEN)


@pytest.mark.parametrize(
    ("seen", "words"),
    [
        (Seen(OPEN, delivered=True, idle_s=1.1, beats=11), f"{UMC} stopped delivering sound; opening it again (over)"),
        (Seen(OPEN, idle_s=1.6, beats=16), f"{UMC} is open but delivers no sound; opening it again (over)"),
        (
            Seen(OPEN, delivered=True, idle_s=2.1, silent_s=2.1),
            f"{LIBRARY} hangs; it was started again (over)",
        ),
        (Seen(SERVER, idle_s=3.9, beats=39), ""),
        (Seen(SERVER, idle_s=4.1, beats=41), f"{UMC} is open but delivers no sound; opening it again (over)"),
        (Seen(OPEN, floods=FLOODS), f"{LIBRARY} prints without end; it was started again (over)"),
        (
            Seen(OPEN, delivered=True, idle_s=9.0, beats=90, flagged=400),
            f"{UMC} loses sound in every block: this machine is too busy; stop other programs, or set device.latency_s "
            "to a longer time",
        ),
        (
            Seen(OPEN, delivered=True, idle_s=9.0, beats=90, flagged=1, unflagged_s=8.9),
            f"{UMC} stopped delivering sound; opening it again (over)",
        ),
        (
            Seen(Report(DeviceState.STOPPED), delivered=True),
            f"{UMC} has stopped; was it unplugged? Waiting for it (over)",
        ),
        (Seen(None), ""),
        (Seen(None, silent_s=1.6), f"the sound library has not opened {UMC} yet; waiting for it"),
        (Seen(None, silent_s=15.1), f"{LIBRARY} does not start; it was started again (over)"),
        (Seen(ABSENT), f"{UMC} is not connected; connect it"),
        (Seen(ABSENT, delivered_before=True), f"{UMC} was unplugged; waiting for it"),
        (Seen(ABSENT, silent_s=5.1), f"{LIBRARY} hangs; it was started again (over)"),
        (Seen(None, exit_code=-9), f"the process that reads {UMC} ended by signal 9; it was started again (over)"),
        (
            Seen(OPEN, delivered=True, exit_code=-signal.SIGXCPU),
            f"{LIBRARY} ran for 1 s without a pause, so the kernel ended its process before it could take the machine; "
            "it was started again (over)",
        ),
        (Seen(None, exit_code=1), f"the process that reads {UMC} ended with code 1; it was started again (over)"),
    ],
)
def test_each_state_has_its_own_words(seen: Seen, words: str) -> None:
    assert problem(seen) == words
