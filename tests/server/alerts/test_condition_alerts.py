"""Rules on conditions that last: an array that is lost, and findings about the set-up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from alert_desk import (
    Desk,
    after,
    dated,
    kept_site,
    running_desk,
    sound,
)
from livessl.core.commission.finding import Finding, Severity
from livessl.server.set_up_watch import SetUpState
from small_site import wait_until


def test_lost_array_alerts_once_until_it_has_recovered(tmp_path: Path) -> None:
    lost = {"arrays": {"lasts_s": 0}, "hold_off_s": 0}
    with running_desk(kept_site(tmp_path, arrays=lost)) as desk:
        desk.arrays.states["south"] = "lost"
        wait_until(lambda: len(desk.published) == 1, "the first alert")
        desk.arrays.states["north"] = "degraded"
        wait_until(lambda: len(desk.published) == 2, "the second alert")
    assert [alert["array"]["name"] for alert in desk.published] == ["south", "north"]
    assert desk.published[0]["text"] == "array 'south' is lost"
    with running_desk(kept_site(tmp_path, arrays=lost), state="starting") as desk:
        desk.arrays.states["south"] = "lost"  # still: no second alert after a restart
        desk.arrays.states["north"] = "healthy"
        wait_until(lambda: desk.alerts.states["arrays"].ongoing == ("south",), "the recovery")
        desk.arrays.states["north"] = "lost"
        wait_until(lambda: desk.published, "the alert about the second loss")
    assert [alert["array"]["name"] for alert in desk.published] == ["north"]


def test_arrays_are_not_watched_during_a_replay() -> None:
    with running_desk(kept_site(arrays={"arrays": {"lasts_s": 0}, "hold_off_s": 0})) as desk:
        desk.time.is_replay = True
        desk.arrays.states["south"] = "lost"
        looks = patch.object(desk.arrays, "describe", side_effect=AssertionError("looked at"))
        with looks:
            desk.alerts.take_final(dated(sound(1)), after(sound(1)))
        desk.time.is_replay = False
        wait_until(lambda: desk.published, "the alert after the replay")


def test_finding_alerts_by_severity() -> None:
    faults = [Finding("swapped", "north", 2, Severity.ERROR, 0.9, "channels are swapped", "exchange the plugs")]
    faults += [Finding("temperature", None, None, Severity.WARNING, 0.9, "it is warm", "correct temperature_c")]
    rules: dict[str, dict[str, Any]] = {
        "errors": {"findings": {}, "hold_off_s": 0},
        "all": {"findings": {"severity": "warning"}, "hold_off_s": 0},
        "swaps": {"findings": {"severity": "info", "faults": ["turned"]}},
    }
    with running_desk(kept_site(None, **rules)) as desk:
        desk.findings.state = SetUpState(3, tuple(faults))
        wait_until(lambda: len(desk.published) == 3, "the alerts")
    found = sorted((alert["rule"], alert["finding"]["fault"]) for alert in desk.published)
    assert found == [("all", "swapped"), ("all", "temperature"), ("errors", "swapped")]


NTP = Finding("ntp", None, None, Severity.WARNING, 0.95, "node 'a': its clock is not synchronized", "start chrony")
CPU = Finding("cpu", None, None, Severity.WARNING, 0.95, "node 'a': 7 blocks were lost", "stop other programs")
TURNED = Finding("turned", "north", None, Severity.ERROR, 0.9, "it is turned", "correct rotation")
NOT_OK: dict[str, Any] = {"findings": {"severity": "warning"}, "hold_off_s": 0}


def found_by(desk: Desk) -> list[str]:
    return [f"{alert['finding']['fault']} {alert['finding']['message'][:8]}" for alert in desk.published]


@pytest.mark.parametrize("sounds", [0, 1, 2])
def test_finding_that_needs_no_sound_alerts_before_the_third_sound(sounds: int) -> None:
    with running_desk(kept_site(None, faults=NOT_OK)) as desk:
        desk.findings.state = SetUpState(sounds, (NTP, CPU))
        wait_until(lambda: len(desk.published) == 2, "the alerts")
    assert found_by(desk) == ["ntp node 'a'", "cpu node 'a'"]


def test_each_node_with_the_same_fault_alerts_and_its_figures_do_not_matter() -> None:
    lost = [replace(CPU, message=message) for message in ("node 'a': 9 lost", "node 'b': 3 lost", "node 'a': 12 lost")]
    with running_desk(kept_site(None, faults=NOT_OK)) as desk:
        desk.findings.state = SetUpState(0, (lost[0], lost[1]))
        wait_until(lambda: len(desk.published) == 2, "the alerts")
        desk.findings.state = SetUpState(0, (lost[2], lost[1], NTP))
        wait_until(lambda: len(desk.published) == 3, "another alert")
    assert found_by(desk) == ["cpu node 'a'", "cpu node 'b'", "ntp node 'a'"]
    assert len({alert["key"] for alert in desk.published}) == 3


def test_finding_that_has_alerted_does_not_alert_again_after_a_restart(tmp_path: Path) -> None:
    """After a restart nothing is known until the nodes have reported for a while, and three sounds have come."""
    with running_desk(kept_site(tmp_path, faults=NOT_OK)) as desk:
        desk.findings.state = SetUpState(3, (TURNED, NTP), are_reports_complete=True)
        wait_until(lambda: len(desk.published) == 2, "the alerts")
    with running_desk(kept_site(tmp_path, faults=NOT_OK)) as desk:
        desk.findings.state = SetUpState(0, (CPU,))
        wait_until(lambda: found_by(desk) == ["cpu node 'a'"], "what is new")
        desk.findings.state = SetUpState(3, (TURNED,), are_reports_complete=True)
        wait_until(lambda: desk.alerts.states["faults"].ongoing == ("turned north None",), "the recoveries")
        desk.findings.state = SetUpState(3, (TURNED, NTP), are_reports_complete=True)
        wait_until(lambda: len(desk.published) == 2, "the alert about the second fault")
    assert found_by(desk) == ["cpu node 'a'", "ntp node 'a'"]
