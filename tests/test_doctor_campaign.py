"""The doctor's campaign: faults are where the seed says, answers are judged fairly, and tables have their intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import doctor
import doctor_rooms
from doctor_rooms import ARRAYS, FAULTS, RATE_HZ, Fault, Room
from livessl import offline
from livessl.core.commission.finding import Finding, Severity
from livessl.core.commission.set_up import DELAY_STD_S
from livessl.examination import gather

BY_NAME = {fault.name: fault for fault in FAULTS}


def room(seed: int) -> Room:
    """A room whose recordings are noise: nothing is rendered."""
    rng = np.random.default_rng(seed)
    return Room(seed, {name: (0.01 * rng.standard_normal((4, 4800))).astype(np.float32) for name in ARRAYS})


def finding(fault: str, array: str | None, channel: int | None = None, confidence: float = 0.99) -> Finding:
    return Finding(fault, array, channel, Severity.ERROR, confidence, "it is wrong", "mend it")


def test_table_of_live_rooms_says_what_harms_what_stays_healthy_and_what_alarms_for_a_time() -> None:
    def row(seed: int, fault: str, error_m: float, degraded_after: int | None, degraded: list[str]) -> doctor.Row:
        said = {"named": bool(degraded), "wrong": False, "changes": 2}
        return {"arrays": 2, "seed": seed, "fault": fault, "error_m": error_m, **said} | {
            "degraded": degraded,
            "degraded_after": degraded_after,
        }

    rows = [row(0, "none", 0.1, None, []), row(1, "none", 0.5, 3, [])]  # the second alarms, and takes it back
    rows += [row(0, "inverted", 0.4, 3, ["south"]), row(1, "inverted", 0.6, 4, ["south"])]
    rows += [row(0, "moved by 0.5 m", 0.31, 5, []), row(1, "moved by 0.5 m", np.inf, None, [])]
    lines = [line.strip("| ").split(" | ") for line in doctor.live_table(rows).splitlines() if line.startswith("| ")]
    assert [line[2:7] for line in lines[2:]] == [
        ["2", "0.30", "0", "0", "1"],
        ["2", "0.50", "1", "0", "2"],
        ["2", "inf", "2", "2", "1"],
    ]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_changes_what_it_says_and_nothing_else(fault: Fault) -> None:
    for seed in (1000, 1001):
        made = room(seed)
        filed = [one.site_with(fault, 3).specs for one in (made, room(seed))]
        none = next(one for one in FAULTS if not one.expected and one.measured == fault.measured)
        right, wrong = made.site_with(none, 3).specs, filed[0]
        assert all((a.microphones_m == b.microphones_m).all() for a, b in zip(*filed, strict=True))
        moved = {a.name for a, b in zip(right, wrong, strict=True) if (a.microphones_m != b.microphones_m).any()}
        assert moved == ({made.target.array} if fault.filed else set())
        clean, faulty = made.recordings_with(FAULTS[0], 3), made.recordings_with(fault, 3)
        changed = {name for name in ARRAYS if (clean[name] != faulty[name]).any()}
        everywhere = {"all wired the other way round": set(ARRAYS), "inputs of two arrays exchanged": set(ARRAYS[:2])}
        assert changed == everywhere.get(fault.name, {made.target.array} if fault.recorded or fault.routed else set())
        assert all(faulty[name].shape == clean[name].shape for name in ARRAYS)
        assert all(faulty[name].dtype == np.float32 for name in ARRAYS)


def test_rooms_differ_and_their_arrays_are_inside() -> None:
    rooms = [Room(seed) for seed in range(12)]
    assert len({made.rt60_s for made in rooms}) == 12
    assert min(made.rt60_s for made in rooms) < 0.4 < 0.7 < max(made.rt60_s for made in rooms)
    assert {made.target.array for made in rooms} == set(ARRAYS[:2])
    assert {made.target.channel for made in rooms} == {0, 1, 2, 3}
    for made in rooms:
        for fault in (one for one in FAULTS if one.filed is not None):
            site = made.site_with(fault, 3)
            for spec in site.specs:
                assert (spec.microphones_m > 0.0).all()
                assert (spec.microphones_m < site.room.size_m).all()


def test_answers_are_judged_by_code_array_and_channel() -> None:
    at = replace(room(1000).target, array="south", channel=2)
    swapped, late, none = (BY_NAME[name] for name in ("two channels swapped", "two samples late", "none"))

    def judged(fault: Fault, *findings: Finding) -> set[str]:
        return {what for what, said in doctor.verdict(fault, at, findings).items() if said}

    assert judged(swapped, finding("swapped", "south")) == {"named"}
    assert judged(swapped, finding("swapped", "north")) == {"wrong"}
    assert judged(late, finding("late_channel", "south", 3)) == {"named"}
    assert judged(late, finding("late_channel", "south", 2)) == {"wrong"}
    assert judged(late) == judged(none) == set()
    assert judged(none, replace(finding("level", "south", 3), severity=Severity.WARNING)) == {"wrong"}
    moved = [finding("moved", name, confidence=0.5) for name in ("north", "south")]
    assert judged(BY_NAME["moved by 0.5 m"], *moved) == {"either"}
    assert judged(swapped, finding("moved", None, confidence=0.5)) == {"open"}


def test_tables_have_intervals_and_replace_what_is_between_the_marks() -> None:
    rows = [
        {"arrays": 2, "seed": seed, "fault": fault, "named": fault != "none", "either": False, "open": False}
        | {"wrong": fault == "none" and seed == 0, "cpu_s": 0.04 if fault == "none" else 0.25}
        for seed in range(30)
        for fault in ("none", "hum")
    ]
    text = doctor.table(rows)
    assert "| hum | 30 of 30 (89 to 100 %) | 0 | 0 | 0 |" in text
    assert "| none | - of 30 | 0 | 0 | 1 of 30 (1 to 17 %) |" in text
    assert "0.04 s without faults (0.04 s), 0.25 s with one (0.25 s)" in text
    page = "before\n<!-- begin doctor -->\nold\n<!-- end doctor -->\nafter\n"
    written = doctor.written_into(page, "doctor", text)
    assert "old" not in written
    assert written.startswith("before\n")
    assert written.endswith("after\n")
    assert doctor.written_into(written, "doctor", text) == written
    with pytest.raises(ValueError, match="expected the lines"):
        doctor.written_into("nothing", "doctor", text)


def test_a_clock_that_is_off_keeps_the_length_and_the_sound() -> None:
    made = room(1001)
    clean = made.recordings_with(FAULTS[0], 3)[made.target.array]
    late = made.recordings_with(BY_NAME["clock 2 s off"], 3)[made.target.array]
    assert (np.roll(clean, round(2.0 * RATE_HZ), axis=1) == late).all()


def test_plugs_in_other_inputs_are_observed_as_if_they_were_recorded_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """The campaign does not localize their recordings again."""
    monkeypatch.setattr(doctor_rooms, "SOUNDS", 2)
    made, fault = Room(1003), BY_NAME["three channels exchanged"]
    assert fault.routed is not None
    clean, wrong = (
        gather(*offline.assigned(made.site_with(one, 2), made.recordings_with(one, 2), RATE_HZ))
        for one in (FAULTS[0], fault)
    )
    assert len(clean.sounds) >= 2
    for routed, recorded in zip(doctor._routed(clean, fault.routed(made.target)).sounds, wrong.sounds, strict=True):
        by_array = {one.array: one for one in routed}
        assert by_array.keys() == {one.array for one in recorded}
        for one in recorded:
            assert by_array[one.array].delays_s == pytest.approx(one.delays_s, abs=DELAY_STD_S)
            assert (by_array[one.array].inverted == one.inverted).all()
            assert by_array[one.array].powers == pytest.approx(one.powers, rel=0.05)
