"""The benchmark of calibration in short: a room without reverberation and few sounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import calibrate


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate, "RT60_S", (0.0,))
        patch.setattr(calibrate, "CLAPS", 6)
        patch.setattr(calibrate, "UNKNOWN", 12)
        return list(calibrate.one_room(2, 3))


def test_claps_give_poses_and_the_speed_of_sound(rows: list[dict[str, Any]]) -> None:
    claps = [row for row in rows if row["task"].startswith("6 claps")]
    assert {row["task"] for row in claps} == {"6 claps", "6 claps at proposed places"}
    poses = [row for row in claps if row["array"] is not None]
    assert max(row["position_m"] for row in poses) < 0.08
    assert max(row["rotation_deg"] for row in poses) < 1.5
    assert max(abs(row["speed_m_s"]) for row in claps if row["array"] is None) < 3.0


def test_a_common_clock_makes_unknown_sounds_give_positions(rows: list[dict[str, Any]]) -> None:
    (pose,) = [row for row in rows if row["task"] == "12 unknown sounds, one clock" and row["array"] is not None]
    assert pose["array"] == "south"
    assert pose["position_m"] < 0.10
    assert pose["rotation_deg"] < 1.5
    assert pose["determined"]


def test_four_claps_name_each_fault_and_no_other(rows: list[dict[str, Any]]) -> None:
    verified = {row["fault"]: row for row in rows if row["task"] == "verify"}
    assert set(verified) == {fault.name for fault in calibrate.FAULTS}
    assert [name for name, row in verified.items() if not row["named"]] == ["none"]
    assert not any(row["other"] for row in verified.values())


def test_the_table_counts_rooms_and_takes_quantiles(rows: list[dict[str, Any]]) -> None:
    text = calibrate.table(rows)
    own = [row["position_m"] for row in rows if row["task"] == "6 claps" and row["array"] is not None]
    assert f"| 6 claps | 2 | {100 * np.median(own):.1f} / {100 * np.quantile(own, 0.95):.1f} |" in text
    assert "| swapped | 1 of 1 | 0 of 1 |" in text
