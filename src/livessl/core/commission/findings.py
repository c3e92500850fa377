"""Makes and words most findings of doctor: dead, deaf, copied, inverted or swapped channels, levels and poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.diagnosis import Diagnosis, diagnose
from livessl.core.commission.finding import LEAST_SOUNDS, Finding, Severity, in_order
from livessl.core.commission.observe import LEAST_SHARPNESS
from livessl.core.commission.places import Delays, Microphones, stacked
from livessl.core.commission.set_up import DELAY_STD_S, Freedom, Known, careful
from livessl.core.types import BoolArray, FloatArray, Observation

EXACT_S: Final = 2e-6
"""Standard deviation, in seconds, of a delay whose pairs agree perfectly, because converters and microphones differ by
that much."""

MOST_SHARE: Final = 0.6
"""Least share of the sounds in which a channel must have a fault for the fault to be reported."""

DEAF_COHERENCE: Final = 0.35
"""Coherence, relative to the array's clearest channels, below which a channel did not receive the sound."""

LEVEL_DB: Final = 3.0
"""Median difference of level within an array, in decibels, that is reported after `LEVEL_SOUNDS` sounds: the medians of
ten sounds differ by less than 0.7 dB between good channels."""

LEVEL_DB_AT_ONCE: Final = 6.0
"""Median difference of level, in decibels, that is reported after fewer than `LEVEL_SOUNDS` sounds: in a single sound,
good channels differ by up to 3 dB."""

LEVEL_SOUNDS: Final = 8

SAME_SIGNAL_S: Final = 2e-6
"""Delay, in seconds, that two channels with the same signal never exceed."""

APART_M: Final = 0.02
"""Distance between microphones, in metres, from which sounds from different directions differ by more than
`SAME_SIGNAL_S`."""

VERIFY_CURE: Final = "clap at places that you know, and run livessl calibrate verify"
MEASURE_CURE: Final = "measure these again, or measure all poses by claps: livessl calibrate poses --write"

SILENT: Final = 1e-9
"""Power relative to the array's median below which a channel is dead: converters leave more noise."""


def find_faults(
    microphones: Microphones,
    sounds: Sequence[Sequence[Observation]],
    bounds_m: FloatArray,
    c_m_s: float,
    freedom: Mapping[str, Freedom] | None = None,
) -> list[Finding]:
    """Find what is wrong with a set-up.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        Positions in the site file, metres.
    sounds : sequence of sequences of Observation
        Observations of the arrays for each sound.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound in the site file, m/s.
    freedom : mapping of array to Freedom, or None
        Standard deviations of the set-up; None for a careful set-up.
    """
    findings = channel_findings(microphones, sounds)
    joint = [sound for sound in sounds if len(sound) > 1]
    delays = sharp_delays(microphones, joint, findings)
    known = Known(freedom or careful(microphones), stds_s(delays, joint))
    microphones = {array: microphones[array] for array in delays}
    if len(microphones) > 1 and len(next(iter(delays.values()))) >= LEAST_SOUNDS:
        findings += set_up_findings(diagnose(microphones, delays, bounds_m, c_m_s, known))
    return in_order(findings)


def channel_findings(microphones: Microphones, sounds: Sequence[Sequence[Observation]]) -> list[Finding]:
    """Find the faults of single channels, which need no geometry: see `find_faults`."""
    findings: list[Finding] = []
    for array, at_m in microphones.items():
        observed = [one for sound in sounds for one in sound if one.array == array]
        findings += _of_channels(array, at_m, observed)
    return findings


def sharp_delays(
    microphones: Microphones, sounds: Sequence[Sequence[Observation]], findings: Sequence[Finding]
) -> dict[str, FloatArray]:
    """Return the delays (S, K), seconds, of each array that clearly received any of the sounds.

    Delays are NaN if an array did not clearly receive a sound, and for channels without their own signal.
    """
    unusable = {array: np.zeros(len(at_m), dtype=bool) for array, at_m in microphones.items()}
    for finding in findings:
        if finding.array in unusable and finding.channel is not None and finding.fault in ("dead", "deaf", "duplicate"):
            unusable[finding.array][finding.channel - 1] = True
    delays = stacked([_usable(sound, unusable) for sound in sounds], microphones)
    return {array: measured for array, measured in delays.items() if np.isfinite(measured).any()}


def stds_s(delays: Delays, sounds: Sequence[Sequence[Observation]]) -> dict[str, FloatArray]:
    """Return the standard deviation (S,), seconds, of each array's delays, estimated from how well its pairs agree.

    Two channels have only one pair, whose error cannot be estimated in this way.
    """
    found = {name: np.full(len(sounds), DELAY_STD_S) for name in delays}
    for row, sound in enumerate(sounds):
        for one in sound:
            if one.array in found and np.isfinite(one.delays_s).sum() > 2:
                found[one.array][row] = float(np.hypot(EXACT_S, one.closure_s))
    return found


def _usable(sound: Sequence[Observation], unusable: Mapping[str, BoolArray]) -> dict[str, FloatArray]:
    return {
        one.array: np.where(unusable[one.array], np.nan, one.delays_s)
        for one in sound
        if one.array in unusable and one.sharpness >= LEAST_SHARPNESS
    }


def _of_channels(array: str, at_m: FloatArray, observed: Sequence[Observation]) -> Iterator[Finding]:
    """Yield the faults of single channels of an array."""
    if len(observed) < LEAST_SOUNDS:
        return
    powers = np.array([one.powers for one in observed])
    median = np.median(powers, axis=1, keepdims=True)
    silent = (powers <= SILENT * median).mean(axis=0)
    coherence = np.array([one.coherence for one in observed])
    clearest = np.sort(coherence, axis=1)[:, -2:].mean(axis=1, keepdims=True)
    deaf = (coherence < DEAF_COHERENCE * clearest).mean(axis=0)
    level_db = 10.0 * np.log10(np.maximum(powers, 1e-20) / np.maximum(median, 1e-20))
    inverted = np.array([one.inverted for one in observed]).mean(axis=0)
    needed_db = LEVEL_DB if len(observed) >= LEVEL_SOUNDS else LEVEL_DB_AT_ONCE
    copies = _copies(at_m, observed)
    for index in range(len(at_m)):
        where = f"channel {index + 1} of {array!r}"
        off_db = float(np.median(level_db[:, index]))
        if silent[index] >= MOST_SHARE:
            yield _channel_fault(
                "dead", array, index, silent[index], f"{where} is silent", "check its cable, phantom power and gain"
            )
        elif index in copies:
            other, share = copies[index]
            yield _channel_fault(
                "duplicate",
                array,
                index,
                share,
                f"{where} carries the same signal as channel {other + 1}",
                "check the cables, and the routing of the interface; each microphone needs an input of its own",
            )
        elif deaf[index] >= MOST_SHARE and len(at_m) > 2:
            yield _channel_fault(
                "deaf",
                array,
                index,
                deaf[index],
                f"{where} has noise but not the sounds that its neighbours receive",
                "check its microphone, cable and phantom power",
            )
        elif abs(off_db) >= needed_db:
            how = "weaker" if off_db < 0.0 else "louder"
            yield Finding(
                "level",
                array,
                index + 1,
                Severity.WARNING,
                min(0.99, 0.5 + abs(off_db) / 20.0),
                f"{where} is {abs(off_db):.0f} dB {how} than its neighbours",
                "set the gains of the array's inputs alike",
            )
        if inverted[index] >= MOST_SHARE and silent[index] < MOST_SHARE and deaf[index] < MOST_SHARE:
            yield _channel_fault(
                "inverted",
                array,
                index,
                inverted[index],
                f"{where} has the opposite polarity of its neighbours",
                "exchange the two signal wires of its cable, or switch the polarity of its input",
            )


def _channel_fault(fault: str, array: str, index: int, share: float, message: str, cure: str) -> Finding:
    return Finding(fault, array, index + 1, Severity.ERROR, min(0.99, float(share)), message, cure)


def _copies(at_m: FloatArray, observed: Sequence[Observation]) -> dict[int, tuple[int, float]]:
    """Return the channels that carry the signal of another one, with that channel and the share of such sounds."""
    delays_s = np.array([one.delays_s for one in observed])
    found = {}
    for k in range(1, len(at_m)):
        for i in range(k):
            if np.linalg.norm(at_m[i] - at_m[k]) < APART_M:
                continue
            same = np.abs(delays_s[:, k] - delays_s[:, i]) < SAME_SIGNAL_S
            share = float(same.mean())
            if share >= max(MOST_SHARE, 0.8) and k not in found:
                found[k] = i, share
    return found


def set_up_findings(diagnosis: Diagnosis, *, at_known_places: bool = False) -> Iterator[Finding]:
    """Yield the findings about the order of channels, the poses and the speed of sound.

    Parameters
    ----------
    diagnosis : Diagnosis
    at_known_places : bool
        Whether the places of the sounds were known, so that the cure is not to make sounds at known places.
    """
    misfit_us = 1e6 * diagnosis.misfit_s
    if diagnosis.best is not None:
        what, cure = _words(diagnosis.best)
        best = diagnosis.best
        better = f"{misfit_us:.0f} -> {1e6 * best.misfit_s:.0f} us over {diagnosis.sounds} sounds"
        for array in (best.array,) if best.other is None else (best.array, best.other):
            yield Finding(
                best.fault,
                array,
                best.channel,
                Severity.ERROR,
                min(0.99, diagnosis.confidence),
                f"{what}: misfit {better}",
                cure,
            )
    elif diagnosis.undecided:
        words = [_words(one) for one in diagnosis.undecided]
        what = f"either {' or '.join(what for what, _ in words)}, which the sounds cannot tell apart"
        better = f"{misfit_us:.0f} -> {1e6 * diagnosis.undecided[0].misfit_s:.0f} us over {diagnosis.sounds} sounds"
        for one, (_, cure) in zip(diagnosis.undecided, words, strict=True):
            share = 1.0 / len(words)
            yield Finding(one.fault, one.array, one.channel, Severity.ERROR, share, f"{what}: misfit {better}", cure)
    elif diagnosis.contradicts and diagnosis.rivals[0].is_large:
        likely = " or ".join(dict.fromkeys(_words(one)[0] for one in diagnosis.rivals[:2]))
        yield Finding(
            diagnosis.rivals[0].fault,
            None,
            None,
            Severity.ERROR,
            0.5,
            f"the arrays contradict each other by {misfit_us:.0f} us over {diagnosis.sounds} sounds; perhaps {likely}",
            MEASURE_CURE if at_known_places else VERIFY_CURE,
        )


def _words(alternative: Alternative) -> tuple[str, str]:
    """Describe an alternative and its cure."""
    array = alternative.array
    if alternative.fault == "swapped":
        moved = [index for index, channel in enumerate(alternative.order) if channel != index + 1]
        order = ", ".join(str(channel) for channel in alternative.order)
        if len(moved) == 2:
            first, second = (index + 1 for index in moved)
            what = f"channels {first} and {second} of {array!r} are swapped"
        else:
            what = f"the channels of {array!r} are in the order {order}"
        return what, "exchange the plugs, or give the channels in this order in the site file (nodes.NAME.arrays)"
    if alternative.fault == "mirrored":
        return (
            "in all arrays the channels have the same wrong order, so that the room appears mirrored",
            f"plug in the microphones in the order {', '.join(str(channel) for channel in alternative.order)}, "
            "or give the channels so in the site file (nodes.NAME.arrays)",
        )
    if alternative.fault == "exchanged":
        return (
            f"the inputs of {array!r} and {alternative.other!r} are exchanged",
            "exchange the plugs of the two arrays, or their channels in the site file (nodes.NAME.arrays)",
        )
    if alternative.fault == "height":
        rise_m = alternative.shift_m[2]
        return (
            f"all arrays are {abs(rise_m):.2f} m {'higher' if rise_m > 0.0 else 'lower'} than the site file has them",
            "measure z of arrays.NAME.position_m again, from the floor of room.size_m",
        )
    if alternative.fault == "late_channel":
        return (
            f"channel {alternative.channel} of {array!r} is {1e6 * alternative.late_s:+.0f} us late",
            "use inputs of one kind (all analogue, or all by the same converter) for an array",
        )
    if alternative.fault == "geometry":
        return (
            f"microphone {alternative.channel} of {array!r} is "
            f"{100.0 * float(np.linalg.norm(alternative.shift_m)):.0f} cm from where the site file has it",
            f"measure the array again; the sounds suggest a shift of ({_metres(alternative.shift_m)}) m",
        )
    if alternative.fault == "turned":
        axis = np.array(alternative.turn_deg)
        about = float(axis[2])
        angle = float(np.linalg.norm(axis))
        if abs(about) >= 0.9 * angle:
            sense = "counter-clockwise" if about > 0.0 else "clockwise"
            return (
                f"{array!r} is turned by {angle:.0f} degrees {sense}, seen from above",
                f"turn it back, or add {about:.0f} to arrays.{array}.orientation_deg.yaw",
            )
        return f"{array!r} is turned by {angle:.0f} degrees", f"check arrays.{array}.orientation_deg"
    if alternative.fault == "moved":
        distance_m = float(np.linalg.norm(alternative.shift_m))
        return (
            f"{array!r} is {distance_m:.2f} m from where the site file has it",
            f"measure arrays.{array}.position_m again; the sounds suggest a shift of "
            f"({_metres(alternative.shift_m)}) m",
        )
    return (
        f"the speed of sound is {alternative.speed_m_s or 0.0:.0f} m/s, {alternative.speed_off_m_s:+.0f} m/s off",
        "correct temperature_c or speed_of_sound_m_s in the site file",
    )


def _metres(shift_m: Sequence[float]) -> str:
    return ", ".join(f"{x:+.2f}" for x in shift_m)
