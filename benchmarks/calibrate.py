"""How exactly claps and unknown sounds tell poses and the speed of sound, and what four claps tell of a wrong set-up.

    python benchmarks/calibrate.py --seeds 10 --arrays 3 --out docs/calibration

Each seed is a room of 8 x 10 x 4 m with RT60 0.3, 0.5 or 0.8 s and tetrahedra of 0.5 m, whose microphones are 2 mm
(standard deviation) from where they should be. Claps are short bursts of noise; the places that are given for them are
1 cm from the true ones, along each axis. The unknown sounds are the project's own. The speed of sound in the site file
is off by 2 m/s (standard deviation), its positions by 0.3 m and its yaw by 15 degrees. Sounds go through activity
detection and correlation as in `livessl locate`. A fault counts as named if a finding has its code and its array.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from careful_set_up import POSITIONS_M, RATE_HZ, RT60_S, built, site_of
from livessl.arrival_times import arrival_times
from livessl.calibration import HeardSound, sounds_of
from livessl.core.commission.diagnosis import verify
from livessl.core.commission.finding import Severity
from livessl.core.commission.findings import set_up_findings, sharp_delays
from livessl.core.commission.next_place import proposed_place
from livessl.core.commission.refine import refine
from livessl.core.commission.resection import MeasuredSetUp, measure_poses
from livessl.core.types import Float32Array, FloatArray
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import NamedSound, Scene, make_scene, render, synthesised_sounds
from livessl.site.load import parse_site
from livessl.site.models import Site

CLAPS: Final = 8
FEW_CLAPS: Final = 4
UNKNOWN: Final = 20
PLACE_STD_M: Final = 0.01
SPEED_STD_M_S: Final = 2.0
FILED_STD_M: Final = 0.3
FILED_STD_DEG: Final = 15.0
CAREFUL_STD_M: Final = 0.02
CAREFUL_STD_DEG: Final = 1.2
"""How far a set-up that was filed carefully is from the truth."""

INSIDE_90: Final = 6.251
"""Chi-square of three degrees of freedom that is exceeded with a probability of 0.1."""

KNOWN: Final = "north"
"""The array that is where the site file says, for the unknown sounds."""

Arrays = dict[str, FloatArray]


@dataclass(frozen=True)
class Fault:
    """A fault of the set-up as filed, and the code and array of the finding that names it."""

    name: str
    code: str | None
    array: str | None


FAULTS: Final = (
    Fault("none", None, None),
    Fault("mirrored", "mirrored", None),
    Fault("exchanged", "exchanged", "south"),
    Fault("swapped", "swapped", "south"),
    Fault("turned by 15 degrees", "turned", "south"),
    Fault("turned by 90 degrees", "turned", "south"),
    Fault("heights off by 0.5 m", "height", None),
)


def clap(seed: int) -> Float32Array:
    """A burst of noise with a decay of 8 ms, 0.15 s long."""
    rng = np.random.default_rng([seed, 7])
    time_s = np.arange(round(0.15 * RATE_HZ)) / RATE_HZ
    return (0.5 * rng.standard_normal(len(time_s)) * np.exp(-time_s / 0.008)).astype(np.float32)


def heard(
    site: Site,
    placed: Arrays,
    sounds: Sequence[NamedSound],
    count: int,
    seed: int,
    at_m: FloatArray | None = None,
    keep_away: Site | None = None,
) -> tuple[list[HeardSound], FloatArray, list[AssignedRecording]]:
    """What the arrays observed of sounds at random or given places, and the places; without events, none."""
    scene = make_scene(
        site.room.size_m,
        rt60_s=RT60_S[seed % len(RT60_S)],
        sounds=sounds,
        count=count,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in (keep_away or site).specs],
        seed=seed + 100,
    )
    if at_m is not None:
        moved = (replace(source, position_m=place_m) for source, place_m in zip(scene.sources, at_m, strict=True))
        scene = replace(scene, sources=tuple(moved))
    parts = [
        AssignedRecording(
            name,
            MemoryRecording(name, RATE_HZ, render(scene, microphones_m, seed=seed + number)),
            0,
            tuple(range(1, len(microphones_m) + 1)),
        )
        for number, (name, microphones_m) in enumerate(placed.items())
    ]
    return *_matched(scene, sounds_of(site, parts)), parts


def _matched(scene: Scene, sounds: Sequence[HeardSound]) -> tuple[list[HeardSound], FloatArray]:
    """Return the first sound that began after each source, and the source's place."""
    found, places_m = [], []
    ends_s = [source.start_s for source in scene.sources[1:]] + [scene.duration_s]
    for source, end_s in zip(scene.sources, ends_s, strict=True):
        own = [sound for sound in sounds if source.start_s - 0.1 <= sound.start_s < end_s - 0.1]
        if own:
            found.append(own[0])
            places_m.append(source.position_m)
    return found, np.array(places_m)


def proposed(filed: Arrays, site: Site, rng: np.random.Generator) -> FloatArray:
    """The places that livessl proposes with the set-up as filed; a person is there to 10 cm, and then measures."""
    bounds_m, places_m = np.array([[0.0, size] for size in site.room.size_m]), np.zeros((0, 3))
    for _ in range(CLAPS):
        place_m = proposed_place(filed, places_m, bounds_m, site.c_m_s, PLACE_STD_M)
        assert place_m is not None
        places_m = np.vstack([places_m, place_m])
    return places_m + rng.normal(0.0, 0.1, places_m.shape)


def wrong(placed: Arrays, rng: np.random.Generator, position_std_m: float, orientation_std_deg: float) -> Arrays:
    """The set-up as filed: that far from the truth."""
    filed = {}
    for name, at_m in placed.items():
        centre_m = at_m.mean(axis=0)
        turn = Rotation.from_euler("z", rng.normal(0.0, orientation_std_deg), degrees=True)
        filed[name] = turn.apply(at_m - centre_m) + centre_m + rng.normal(0.0, position_std_m, 3)
    return filed


def errors(measured: MeasuredSetUp, placed: Arrays, true_c_m_s: float) -> Iterator[dict[str, Any]]:
    """Yield the errors of each measured pose, and of the speed of sound."""
    for name, pose in measured.poses.items():
        true_m, found_m = placed[name], pose.microphones_m
        off_m = found_m.mean(axis=0) - true_m.mean(axis=0)
        turn, _ = Rotation.align_vectors(found_m - found_m.mean(axis=0), true_m - true_m.mean(axis=0))
        square = float(off_m @ np.linalg.solve(pose.covariance[:3, :3], off_m))
        yield {
            "array": name,
            "position_m": float(np.linalg.norm(off_m)),
            "rotation_deg": float(np.degrees(turn.magnitude())),
            "inside": square <= INSIDE_90,
            "determined": pose.is_determined,
        }
    yield {"array": None, "speed_m_s": measured.c_m_s - true_c_m_s}


def one_room(arrays: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yield one row for each error and each fault in one room."""
    site = site_of(arrays, seed)
    shape = {spec.name: spec.microphones_m for spec in site.specs}
    placed = built(site, seed, position_std_m=0.0, orientation_std_deg=0.0)
    rng = np.random.default_rng([seed, 11])
    filed = wrong(shape, rng, FILED_STD_M, FILED_STD_DEG)
    c_m_s = site.c_m_s + rng.normal(0.0, SPEED_STD_M_S)
    claps, places_m, _ = heard(site, placed, [("clap", clap(seed))], CLAPS, seed)
    known_m = places_m + rng.normal(0.0, PLACE_STD_M, places_m.shape)
    delays = sharp_delays(shape, [sound.observations for sound in claps], [])
    for count in (FEW_CLAPS, CLAPS):
        some = {name: measured[:count] for name, measured in delays.items()}
        measured = measure_poses(filed, some, known_m[:count], c_m_s, PLACE_STD_M)
        for row in errors(measured, placed, site.c_m_s):
            yield {"task": f"{count} claps", "arrays": arrays, "seed": seed} | row
    true_m = proposed(filed, site, rng)
    claps, at_m, _ = heard(site, placed, [("clap", clap(seed))], CLAPS, seed, true_m)
    told_m = at_m + rng.normal(0.0, PLACE_STD_M, at_m.shape)
    at_proposed = sharp_delays(shape, [sound.observations for sound in claps], [])
    for row in errors(measure_poses(filed, at_proposed, told_m, c_m_s, PLACE_STD_M), placed, site.c_m_s):
        yield {"task": f"{CLAPS} claps at proposed places", "arrays": arrays, "seed": seed} | row
    few = {name: measured[:FEW_CLAPS] for name, measured in delays.items()}
    careful = wrong(shape, rng, CAREFUL_STD_M, CAREFUL_STD_DEG)
    for fault in FAULTS:
        yield {"task": "verify", "arrays": arrays, "seed": seed} | verdict(
            fault, careful, few, known_m[:FEW_CLAPS], c_m_s
        )
    sounds, _, parts = heard(site, placed, synthesised_sounds(RATE_HZ, seed), UNKNOWN, seed)
    unknown = sharp_delays(shape, [sound.observations for sound in sounds], [])
    bounds_m = np.array([[0.0, size] for size in site.room.size_m])
    rough = filed | {KNOWN: shape[KNOWN]}
    refined = refine(rough, unknown, bounds_m, c_m_s, [KNOWN])
    for row in errors(refined, placed, site.c_m_s):
        yield {"task": f"{UNKNOWN} unknown sounds", "arrays": arrays, "seed": seed} | row
    found = rough | {name: pose.microphones_m for name, pose in refined.poses.items()}
    starts_s = [sound.start_s for sound in sounds]
    times = arrival_times(parts, found, starts_s, refined.places_m, refined.c_m_s, site.band_hz)
    refined = refine(rough, unknown, bounds_m, c_m_s, [KNOWN], times)
    for row in errors(refined, placed, site.c_m_s):
        yield {"task": f"{UNKNOWN} unknown sounds, one clock", "arrays": arrays, "seed": seed} | row


def located(arrays: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yield the errors of sounds that are located with the true set-up, with the calibrated one, and as filed."""
    site = site_of(arrays, seed)
    shape = {spec.name: spec.microphones_m for spec in site.specs}
    placed = built(site, seed, position_std_m=0.0, orientation_std_deg=0.0)
    rng = np.random.default_rng([seed, 11])
    filed = wrong(shape, rng, FILED_STD_M, FILED_STD_DEG)
    claps, places_m, _ = heard(site, placed, [("clap", clap(seed))], CLAPS, seed)
    delays = sharp_delays(shape, [sound.observations for sound in claps], [])
    known_m = places_m + rng.normal(0.0, PLACE_STD_M, places_m.shape)
    poses = measure_poses(filed, delays, known_m, site.c_m_s, PLACE_STD_M).poses
    calibrated = {name: pose.microphones_m for name, pose in poses.items()}
    for name, set_up in (("true", placed), (f"{CLAPS} claps", calibrated), ("as filed", filed)):
        own = with_microphones(site, set_up)
        sounds, true_m, _ = heard(own, placed, synthesised_sounds(RATE_HZ, seed), UNKNOWN, seed, keep_away=site)
        pairs = zip(sounds, true_m, strict=True)
        off_m = [float(np.linalg.norm(one.position_m - at_m)) for one, at_m in pairs if one.position_m is not None]
        yield {"task": "located", "arrays": arrays, "seed": seed, "set_up": name, "count": len(sounds), "off_m": off_m}


def with_microphones(site: Site, set_up: Arrays) -> Site:
    """The site with its microphones elsewhere."""
    arrays = {name: {"microphones_m": at_m.tolist()} for name, at_m in set_up.items()}
    return parse_site(json.dumps({"site": site.site, "room": {"size_m": list(site.room.size_m)}, "arrays": arrays}))


def verdict(
    fault: Fault, filed: Arrays, delays: Mapping[str, FloatArray], places_m: FloatArray, c_m_s: float
) -> dict[str, Any]:
    """What four claps say about one fault: whether it was named, and whether an error was told that is none."""
    filed, delays = dict(filed), dict(delays)
    south_m = filed["south"] if "south" in filed else next(iter(filed.values()))
    if fault.name == "mirrored":
        delays = {name: measured[:, [0, 1, 3, 2]] for name, measured in delays.items()}
    elif fault.name == "exchanged":
        delays["north"], delays["south"] = delays["south"], delays["north"]
    elif fault.name == "swapped":
        delays["south"] = delays["south"][:, [0, 2, 1, 3]]
    elif fault.name.startswith("turned"):
        turn = Rotation.from_euler("z", float(fault.name.split()[2]), degrees=True)
        centre_m = south_m.mean(axis=0)
        filed["south"] = turn.apply(south_m - centre_m) + centre_m
    elif fault.name.startswith("heights"):
        filed = {name: at_m - np.array([0.0, 0.0, 0.5]) for name, at_m in filed.items()}
    findings = list(set_up_findings(verify(filed, delays, places_m, c_m_s)))
    named = any(_names(fault, one.fault, one.array) and one.severity is Severity.ERROR for one in findings)
    other = any(not _names(fault, one.fault, one.array) and one.severity is Severity.ERROR for one in findings)
    said = [f"{one.fault} {one.array}: {one.message}" for one in findings]
    return {"fault": fault.name, "named": named, "other": other, "said": said}


def _names(fault: Fault, code: str, array: str | None) -> bool:
    return code == fault.code and (fault.code == "exchanged" or array == fault.array)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as two tables: errors of poses and speed, and faults that were named."""
    lines = [
        "| task | arrays | position: median / 95 % (cm) | rotation: median / 95 % (degrees) "
        "| speed of sound: median (m/s) |"
        " true place inside the 90 % ellipsoid | not determined |",
        "|---|---|---|---|---|---|---|",
    ]
    for task, arrays in dict.fromkeys((row["task"], row["arrays"]) for row in rows if row["task"] != "verify"):
        own = [row for row in rows if (row["task"], row["arrays"]) == (task, arrays)]
        poses = [row for row in own if row["array"] is not None]
        position_cm = 100.0 * np.array([row["position_m"] for row in poses])
        rotation_deg = np.array([row["rotation_deg"] for row in poses])
        speed = np.median([abs(row["speed_m_s"]) for row in own if row["array"] is None])
        lines.append(
            f"| {task} | {arrays} | {np.median(position_cm):.1f} / {np.quantile(position_cm, 0.95):.1f} "
            f"| {np.median(rotation_deg):.2f} / {np.quantile(rotation_deg, 0.95):.2f} | {speed:.2f} "
            f"| {100.0 * np.mean([row['inside'] for row in poses]):.0f} % "
            f"| {sum(not row['determined'] for row in poses)} of {len(poses)} |"
        )
    lines += ["", "| fault, four claps | named | another error |", "|---|---|---|"]
    for fault in FAULTS:
        own = [row for row in rows if row["task"] == "verify" and row["fault"] == fault.name]
        named = "-" if fault.code is None else f"{sum(row['named'] for row in own)} of {len(own)}"
        lines.append(f"| {fault.name} | {named} | {sum(row['other'] for row in own)} of {len(own)} |")
    return "\n".join(lines)


def table_of_located(rows: Sequence[Mapping[str, Any]]) -> str:
    """The errors of sounds with each set-up, as a table."""
    lines = ["| arrays | set-up | located | error: median / 95 % (cm) |", "|---|---|---|---|"]
    for arrays, name in dict.fromkeys((row["arrays"], row["set_up"]) for row in rows):
        own = [row for row in rows if (row["arrays"], row["set_up"]) == (arrays, name)]
        off_cm = 100.0 * np.array([off_m for row in own for off_m in row["off_m"]])
        median, most = (np.median(off_cm), np.quantile(off_cm, 0.95)) if len(off_cm) else (np.nan, np.nan)
        count = sum(row["count"] for row in own)
        lines.append(f"| {arrays} | {name} | {len(off_cm)} of {count} | {median:.1f} / {most:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Run the campaign and write its rows and its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--arrays", type=int, nargs="+", default=[2, 3], choices=range(2, len(POSITIONS_M) + 1))
    parser.add_argument("--locate", action="store_true", help="locate sounds with the measured poses instead")
    parser.add_argument("--out", type=Path, help="folder for rows.jsonl and table.md")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arrays in arguments.arrays:
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            for row in located(arrays, seed) if arguments.locate else one_room(arrays, seed):
                rows.append(row)
                print(json.dumps(row), flush=True)
    text = table_of_located(rows) if arguments.locate else table(rows)
    print(text)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        (arguments.out / "table.md").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
