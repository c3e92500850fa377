"""States of the arrays: reported at once when one changes, else twice a second, and hidden while one is disabled."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from world_parts import START, HandClock

from livessl import wire
from livessl.core.types import FRAME_NS, ChannelLevel, HostState
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import REPORT_NS, WATCH_NS, ArrayStates
from livessl.server.ingest import Ingest
from livessl.server.node_clocks import WINDOW_NS
from livessl.server.overload import Overload
from livessl.server.run import live_run
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.site_time import SiteTime
from livessl.server.store import Finalized, Store, StoreError
from small_site import mark, site_of

SITE = site_of()
QUIET = ChannelLevel(-41.26, -52.0, 0, 0.0001234567, None, None, -70.0)
HELLO = wire.Hello("lab-pc", "run-1", {"north": 16000.0, "south": 16000.0})


class ReadOnlyStore(Store):
    """A store that takes nothing."""

    def enable(self, site: str, array: str, enabled: bool) -> None:
        raise StoreError("disk full")


def for_each(function: Callable[[Any], None], items: Iterable[Any]) -> None:
    for item in items:
        function(item)


class Desk:
    """Array states with all that they need, and a fusion to describe."""

    def __init__(self, store: Store | None = None) -> None:
        self.clock = HandClock()
        self.ingest = Ingest(SITE)
        self.published: list[JsonObject] = []
        self.store = Store() if store is None else store
        site_time = SiteTime(self.clock)
        self.overload = Overload(self.clock)
        self.watch = SetUpWatch(SITE, self.overload)
        self.states = ArrayStates(
            SITE, self.clock, self.store, site_time, self.ingest, self.overload, self.watch, self.published.append
        )
        self.fusion = live_run(SITE, Finalized(None, None), for_each).fusion
        self.states.follow(self.fusion)
        self.pace = 0

    def greet(self, hello: wire.Hello = HELLO) -> None:
        self.ingest.receive(b"p1", wire.encode(hello), self.clock.monotonic_ns())

    def quiet(self, *arrays: str) -> None:
        """One frame index passes, and these arrays send a mark of it."""
        self.pace += 1
        self.clock.time_ns += FRAME_NS
        marks = [mark(0, START + self.pace - 1, array) for array in arrays]
        self.take()
        self.fusion.step(marks, self.clock.now_ns())

    def take(self, waited_s: float = 0.0) -> None:
        """The fusion takes what has arrived, of which the first message has waited for so long."""
        self.overload.note(waited_s, 1, 0, sheds=False)

    def report(
        self, array: str, level: ChannelLevel, host: HostState | None = None, drift_error_ppm: float | None = None
    ) -> None:
        """The node sends a mark with the level of its array's channels, once a second."""
        self.clock.time_ns += 1_000_000_000
        levels = (QUIET, level, QUIET, QUIET)
        quiet = mark(0, START + self.pace, array)
        report = replace(quiet, levels=levels, drift_error_ppm=drift_error_ppm, host=host)
        self.ingest.receive(b"p1", wire.encode(report), self.clock.monotonic_ns())
        self.states.watch()

    def array(self, name: str) -> dict[str, Any]:
        return next(array for array in self.states.describe() if array["name"] == name)


def states(message: JsonObject) -> dict[str, str]:
    return {array["name"]: array["state"] for array in message["arrays"]}


def test_states_are_published_twice_a_second_and_at_once_when_one_changes(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk()
    times_ns: list[int] = []
    with caplog.at_level("INFO"):
        for _ in range(10 * REPORT_NS // WATCH_NS):
            desk.clock.time_ns += WATCH_NS
            desk.states.watch()
            desk.states.watch()  # looks no oftener than every WATCH_NS
            times_ns += [desk.clock.time_ns] * (len(desk.published) - len(times_ns))
        assert [later - earlier for earlier, later in pairwise(times_ns)] == [REPORT_NS] * 9
        assert caplog.text == ""
        desk.pace = (desk.clock.time_ns - START * FRAME_NS) // FRAME_NS
        desk.quiet("north")
        desk.clock.time_ns += WATCH_NS
        desk.states.watch()
    assert len(desk.published) == 11
    assert states(desk.published[-2]) == {"north": "starting", "south": "starting"}
    assert states(desk.published[-1]) == {"north": "healthy", "south": "starting"}
    assert "array 'north' is healthy" in caplog.text


def test_disabled_state_hides_the_other_one_and_names_it() -> None:
    desk = Desk()
    desk.quiet("north", "south")
    desk.states.enable("north", False)
    assert desk.states.disabled == {"north"}
    north = desk.array("north")
    assert (north["state"], north["enabled"]) == ("disabled", False)
    assert north["reason"] == "an operator has disabled it, and its sound is not used; otherwise healthy"
    assert (desk.array("south")["state"], desk.array("south")["enabled"]) == ("healthy", True)
    desk.states.enable("north", True)
    assert desk.array("north")["state"] == "healthy"


def test_silent_array_of_a_refused_node_has_the_refusal_as_its_reason() -> None:
    desk = Desk()
    newer = bytearray(wire.encode(HELLO))
    newer[4] = wire.VERSION + 1
    desk.ingest.receive(b"p1", bytes(newer), desk.clock.monotonic_ns())
    north = desk.array("north")
    assert north["state"] == "starting"
    assert north["reason"].startswith("its node 'lab-pc' is refused: the node runs a newer livessl than the server")


def test_array_stays_enabled_if_the_store_cannot_remember_otherwise() -> None:
    desk = Desk(ReadOnlyStore())
    with pytest.raises(StoreError):
        desk.states.enable("north", False)
    assert desk.states.disabled == frozenset()


def test_store_remembers_what_is_disabled() -> None:
    desk = Desk()
    desk.states.enable("south", False)
    assert Desk(desk.store).states.disabled == {"south"}


def test_problem_that_a_node_reports_degrades_its_arrays() -> None:
    desk = Desk()
    desk.greet(replace(HELLO, problem="input device 'UMC1820' is not connected"))
    desk.quiet("north", "south")
    north = desk.array("north")
    assert (north["state"], north["reason"]) == ("degraded", "input device 'UMC1820' is not connected")


def test_array_whose_node_greets_without_sound_is_quiet_and_not_lost() -> None:
    desk = Desk()
    desk.quiet("north", "south")
    desk.clock.time_ns += 3_000_000_000
    desk.take()
    assert desk.array("north")["state"] == "lost"
    desk.greet()
    north = desk.array("north")
    assert (north["state"], north["reason"]) == ("quiet", "its node is there, but no sound comes from its device")


@pytest.mark.parametrize("waited_s", [0.0, 1.2, 7.0])
def test_array_whose_messages_wait_for_the_server_is_not_lost(waited_s: float) -> None:
    desk = Desk()
    desk.quiet("north", "south")
    desk.clock.time_ns += round(1e9 * waited_s)
    desk.take(waited_s)  # of a queue that is not empty: north's next message may be in it
    desk.clock.time_ns += 3_000_000_000  # a long turn
    assert (desk.array("north")["state"], desk.array("north")["age_s"]) == ("healthy", 0.0)
    desk.take()  # all that came is taken, and nothing of north was in it
    assert desk.array("north")["state"] == "lost"


def test_a_clock_that_is_behind_is_named_and_only_then() -> None:
    desk = Desk()
    desk.greet()
    for behind_s, named in ((0.0, False), (2.0, True), (0.0, False)):
        for _ in range(WINDOW_NS // FRAME_NS * 2 + 2):
            desk.quiet("north", "south")
            now_ns = desk.clock.now_ns()
            desk.ingest.node_clocks.note("north", now_ns - round(behind_s * 1e9) - 3_000_000, now_ns)
            desk.ingest.node_clocks.note("south", now_ns - 3_000_000, now_ns)
        north, south = desk.array("north"), desk.array("south")
        assert south["state"] == "healthy"
        assert north["state"] == ("degraded" if named else "healthy")
        assert (north["reason"] is not None) is named
        if named:
            assert "clock is 2.0 s behind the server's" in north["reason"]
            assert "NTP" in north["reason"]
        desk.states.watch()
        found = [(one.fault, one.array) for one in desk.watch.state.findings]
        assert found == ([("clock", "north")] if named else [])


def test_levels_and_machine_that_a_node_reports_are_described() -> None:
    desk = Desk()
    desk.greet()
    north = desk.array("north")
    assert (north["channels"], north["channels_age_s"], north["host"]) == ([], None, None)
    host = HostState(True, "chrony", "ntp.example", 0.0021049999, 2, 0.456, machine="m1")
    desk.report("north", ChannelLevel(-200.0, -200.0, 17, None, 50.0, -60.04, None), host)
    desk.clock.time_ns += 700_000_000
    north = desk.array("north")
    assert north["channels"][0] == {
        "peak_dbfs": -41.3,
        "rms_dbfs": -52.0,
        "noise_dbfs": -70.0,
        "clipped": 0,
        "mean": 0.00012,
        "hum_hz": None,
        "hum_dbfs": None,
        "faults": [],
    }
    second = north["channels"][1]
    assert (second["peak_dbfs"], second["rms_dbfs"], second["clipped"], second["mean"]) == (None, None, 17, None)
    assert (second["hum_hz"], second["hum_dbfs"]) == (50.0, -60.0)
    assert north["channels_age_s"] == 0.7
    assert north["host"] == {
        "synchronized": True,
        "service": "chrony",
        "reference": "ntp.example",
        "error_s": 0.002105,
        "lost_blocks": 2,
        "load": 0.46,
    }
    assert desk.array("south")["channels"] == []
    desk.states.follow(desk.fusion)
    assert desk.array("north")["channels"] == []  # another run is about another set-up


def test_drift_is_settling_until_its_error_is_below_5_ppm_and_never_known_through_a_sound_server() -> None:
    desk = Desk()
    desk.greet()
    assert desk.array("north")["drift"] is None
    direct, server = HostState(True), HostState(True, sound_server=True)
    for error_ppm, host, expected in (
        (None, direct, "settling"),
        (5.1, direct, "settling"),
        (4.9, direct, "known"),
        (4.9, None, "known"),
        (0.1, server, "unmeasurable"),
    ):
        desk.report("north", QUIET, host, error_ppm)
        assert desk.array("north")["drift"] == expected


def test_lasting_fault_of_a_channel_becomes_a_finding_and_shows_at_the_channel(
    caplog: pytest.LogCaptureFixture,
) -> None:
    desk = Desk()
    desk.greet()
    hums = replace(QUIET, hum_hz=50.0, hum_dbfs=-50.0)
    with caplog.at_level("WARNING"):
        for turn in range(20):
            desk.report("north", replace(hums, hum_dbfs=-50.0 - turn % 3))
    assert [channel["faults"] for channel in desk.array("north")["channels"]] == [[], ["hum"], [], []]
    assert desk.array("north")["state"] == desk.array("south")["state"]  # a warning: positions are as before
    [finding] = desk.watch.state.findings
    assert (finding.fault, finding.array, finding.channel, finding.input) == ("hum", "north", 2, 2)
    assert caplog.text.count("channel 2 of 'north' hums at 50 Hz") == 1  # its figures change, and it is one fault
    for _ in range(10):
        desk.report("north", QUIET)
    assert desk.watch.state.findings == ()
    assert desk.array("north")["channels"][1]["faults"] == []
