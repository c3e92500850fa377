"""Words claps, poses and the speed of sound for `livessl calibrate`: as lines, or as JSON objects.

The words of findings are in `livessl.core.commission.findings`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from livessl.cli.output import xyz

if TYPE_CHECKING:
    from livessl.calibration import Clap
    from livessl.core.commission.resection import MeasuredPose, MeasuredSetUp


def clap_object(clap: Clap) -> dict[str, Any]:
    """Return a clap as JSON."""
    found_m = clap.sound.position_m
    return {
        "kind": "clap",
        "place_m": clap.place_m.tolist(),
        "start_s": clap.sound.start_s,
        "position_m": None if found_m is None else found_m.tolist(),
        "error_m": clap.error_m,
        "status": clap.sound.status,
        "reason": clap.sound.reason,
    }


def clap_line(clap: Clap) -> str:
    """Return a clap as text."""
    found_m = clap.sound.position_m
    found = xyz(None if found_m is None else found_m.tolist())
    error = "not located" if clap.error_m is None else f"{clap.error_m:.2f} m off"
    return f"{xyz(clap.place_m.tolist())}  found {found:<22}  {error}"


def pose_object(name: str, pose: MeasuredPose) -> dict[str, Any]:
    """Return a measured pose as JSON."""
    return {
        "kind": "pose",
        "array": name,
        "microphones_m": pose.microphones_m.round(4).tolist(),
        "shift_m": pose.shift_m.round(4).tolist(),
        "turn_deg": [round(math.degrees(angle), 2) for angle in pose.turn.as_rotvec().tolist()],
        "position_std_m": round(pose.position_std_m, 4),
        "orientation_std_deg": round(pose.orientation_std_deg, 2),
        "misfit_us": [round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
        "determined": pose.is_determined,
    }


def pose_line(name: str, pose: MeasuredPose) -> str:
    """Return a measured pose as text."""
    shift = ", ".join(f"{x:+.3f}" for x in pose.shift_m)
    return (
        f"{name}: shifted by ({shift}) m, turned by {math.degrees(pose.turn.magnitude()):.1f} degrees "
        f"(known to {pose.position_std_m:.3f} m and {pose.orientation_std_deg:.1f} degrees), "
        f"misfit {1e6 * pose.misfit_before_s:.0f} -> {1e6 * pose.misfit_s:.0f} us"
    )


def speed_object(measured: MeasuredSetUp, filed_m_s: float) -> dict[str, Any]:
    """Return the measured speed of sound as JSON."""
    return {
        "kind": "speed",
        "array": None,
        "speed_of_sound_m_s": round(measured.c_m_s, 2),
        "std_m_s": round(measured.c_std_m_s, 2),
        "filed_m_s": round(filed_m_s, 2),
    }


def speed_line(measured: MeasuredSetUp, filed_m_s: float) -> str:
    """Return the measured speed of sound as text."""
    return f"speed of sound: {measured.c_m_s:.1f} ± {measured.c_std_m_s:.1f} m/s (in the site file: {filed_m_s:.1f})"


def progress_line(measured: MeasuredSetUp) -> str:
    """Return how well the poses are known so far."""
    each = (
        f"{name} {pose.position_std_m:.3f} m, {pose.orientation_std_deg:.1f} degrees"
        for name, pose in measured.poses.items()
    )
    return f"known so far: {'; '.join(each)}; misfit {1e6 * measured.misfit_s:.0f} us"
