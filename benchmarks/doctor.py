"""Faults of a set-up, made on purpose, and what the doctor says about them.

    python benchmarks/doctor.py --seeds 10 --arrays 2 3 --out results/doctor
    python benchmarks/doctor.py --out results/doctor --table    # the table of the rows so far
    python benchmarks/doctor.py --seeds 3 --live --out results/doctor-live

Each seed is a room of 8 x 10 x 4 m with RT60 0.3, 0.5 or 0.8 s, tetrahedra of 0.5 m that are turned at random and stand
2 cm and 1.2 degrees (standard deviations) from where the site file has them, microphones 2 mm from theirs, and ten
sounds. A fault counts as named if a finding has its code, its array and, where it has one, its channel. With `--live`
the events go one by one to the examination of a running server, which is looked at after each.

Except for clocks, the examinations of two arrays use what they observed beside the third one. Rows are appended to
`rows.jsonl` as they come, and those that are there already are not made again, so that a campaign can be interrupted.
Observations are kept in `--cache`, if given: then only conclusions are drawn again.
"""

from __future__ import annotations

import argparse
import json
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl import offline
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import ArraySpec, Event, Float32Array, FloatArray
from livessl.examination import Gathered, conclude, gather
from livessl.server.overload import Overload
from livessl.server.set_up_watch import SetUpWatch
from livessl.simulation.of_site import scene_of
from livessl.simulation.scene import Scene, render
from livessl.site.load import parse_site
from livessl.site.models import Site

DOUBT: Final = 0.5
"""Confidence at which a finding leaves open which array it is about."""

HARMFUL_M: Final = 0.2
"""Increase of the median error, in metres, from which a fault may not leave all arrays healthy."""

RATE_HZ: Final = 16000.0
ARRAY: Final = "south"
CHANNEL: Final = 3
SOUNDS: Final = 10
RT60_S: Final = (0.3, 0.5, 0.8)
POSITIONS_M: Final = {"north": (4.0, 2.5, 2.0), "south": (4.0, 7.5, 2.0), "west": (1.2, 5.0, 2.2)}
POSITION_STD_M, ORIENTATION_STD_DEG, MICROPHONE_STD_M = 0.02, 1.2, 0.002

Recordings = dict[str, Float32Array]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what it does to the recordings or to the true places of microphones, and what should be said.

    `expected` holds the codes that name it; empty if nothing should be said. An array is named by `array`, and a
    channel by `channel`, where they are not None. `filed` holds settings of the site file that are wrong.
    """

    name: str
    expected: tuple[str, ...]
    array: str | None = ARRAY
    channel: int | None = None
    recorded: Callable[[Recordings, np.random.Generator], None] | None = None
    placed: Callable[[dict[str, FloatArray]], None] | None = None
    filed: Mapping[str, Any] = field(default_factory=dict)


def _channel(change: Callable[[Float32Array, np.random.Generator], Float32Array]) -> Callable[..., None]:
    def apply(recordings: Recordings, rng: np.random.Generator) -> None:
        samples = recordings[ARRAY]
        samples[CHANNEL - 1] = change(samples[CHANNEL - 1], rng)

    return apply


def _order(order: list[int], arrays: tuple[str, ...] | None = (ARRAY,)) -> Callable[..., None]:
    def apply(recordings: Recordings, _rng: np.random.Generator) -> None:
        for array in arrays or tuple(recordings):
            recordings[array] = recordings[array][order]

    return apply


def _duplicate(recordings: Recordings, _rng: np.random.Generator) -> None:
    recordings[ARRAY][CHANNEL - 1] = recordings[ARRAY][CHANNEL - 2]


def _crosstalk(recordings: Recordings, _rng: np.random.Generator) -> None:
    recordings[ARRAY][CHANNEL - 1] += np.float32(0.1) * recordings[ARRAY][CHANNEL - 2]


def _behind(recordings: Recordings, _rng: np.random.Generator) -> None:
    samples = recordings[ARRAY]
    late = round(2.0 * RATE_HZ)
    recordings[ARRAY] = np.concatenate([samples[:, -late:], samples[:, :-late]], axis=1)


def _exchange(recordings: Recordings, _rng: np.random.Generator) -> None:
    recordings["north"], recordings["south"] = recordings["south"], recordings["north"]


def _turn(angle_deg: float) -> Callable[..., None]:
    def apply(placed: dict[str, FloatArray]) -> None:
        centre_m = placed[ARRAY].mean(axis=0)
        turn = Rotation.from_euler("z", angle_deg, degrees=True)
        placed[ARRAY] = turn.apply(placed[ARRAY] - centre_m) + centre_m

    return apply


def _shift(shift_m: tuple[float, float, float], channel: int | None = None) -> Callable[..., None]:
    def apply(placed: dict[str, FloatArray]) -> None:
        rows = slice(None) if channel is None else channel - 1
        placed[ARRAY] = placed[ARRAY].copy()
        placed[ARRAY][rows] += shift_m

    return apply


def _hum(samples: Float32Array, _rng: np.random.Generator) -> Float32Array:
    time_s = np.arange(len(samples)) / RATE_HZ
    hum = sum(0.01 / n * np.sin(2.0 * np.pi * 50.0 * n * time_s) for n in (1, 3, 5))
    return (samples + hum).astype(np.float32)


def _clip(samples: Float32Array, _rng: np.random.Generator) -> Float32Array:
    return np.asarray(np.clip(samples * np.float32(8.0 / max(1e-9, np.abs(samples).max())), -1.0, 1.0))


def _late(samples: Float32Array, _rng: np.random.Generator) -> Float32Array:
    return np.concatenate([np.zeros(2, dtype=np.float32), samples[:-2]])


FAULTS: Final = (
    Fault("none", ()),
    Fault("dead", ("dead",), channel=CHANNEL, recorded=_channel(lambda x, _: 0.0 * x)),
    Fault(
        "dead, own noise at -50 dBFS",
        ("deaf",),
        channel=CHANNEL,
        recorded=_channel(lambda x, rng: (10**-2.5 * rng.standard_normal(len(x))).astype(np.float32)),
    ),
    Fault("20 dB weaker", ("level",), channel=CHANNEL, recorded=_channel(lambda x, _: np.float32(0.1) * x)),
    Fault("10 dB louder", ("level",), channel=CHANNEL, recorded=_channel(lambda x, _: np.float32(3.2) * x)),
    Fault("hum", ("hum",), channel=CHANNEL, recorded=_channel(_hum)),
    Fault("constant", ("dc",), channel=CHANNEL, recorded=_channel(lambda x, _: x + np.float32(0.05))),
    Fault("clipping", ("clipping",), channel=CHANNEL, recorded=_channel(_clip)),
    Fault("crosstalk of -20 dB", ("crosstalk",), channel=CHANNEL, recorded=_crosstalk),
    Fault("inverted", ("inverted",), channel=CHANNEL, recorded=_channel(lambda x, _: -x)),
    Fault("one signal on two channels", ("duplicate",), recorded=_duplicate),
    Fault("two samples late", ("late_channel",), channel=CHANNEL, recorded=_channel(_late)),
    Fault("two channels swapped", ("swapped",), recorded=_order([0, 2, 1, 3])),
    Fault("three channels exchanged", ("swapped", "turned"), recorded=_order([0, 2, 3, 1])),
    Fault("all wired the other way round", ("mirrored",), array=None, recorded=_order([0, 1, 3, 2], None)),
    Fault("inputs of two arrays exchanged", ("exchanged",), array=None, recorded=_exchange),
    Fault("microphone 5 cm off", ("geometry",), channel=CHANNEL, placed=_shift((0.03, -0.03, 0.027), CHANNEL)),
    Fault("turned by 5 degrees", ("turned",), placed=_turn(5.0)),
    Fault("turned by 15 degrees", ("turned",), placed=_turn(15.0)),
    Fault("turned by 30 degrees", ("turned",), placed=_turn(30.0)),
    Fault("moved by 0.5 m", ("moved",), placed=_shift((0.4, 0.3, 0.0))),
    Fault("temperature 20 degrees off", ("temperature",), array=None, filed={"temperature_c": 0.0}),
    Fault("clock 2 s off", ("clock",), array=None, recorded=_behind),
)


def site_of(arrays: int, seed: int, **settings: Any) -> Site:
    """A site with so many arrays, which are turned at random, and with other settings of the site file."""
    rng = np.random.default_rng([seed, 1])
    names = list(POSITIONS_M)[:arrays]
    text: dict[str, Any] = {
        "site": "doctor",
        "room": {"size_m": [8.0, 10.0, 4.0]},
        "arrays": {
            name: {
                "geometry": {"tetrahedron": {"edge_m": 0.5}},
                "position_m": list(POSITIONS_M[name]),
                "orientation_deg": {"yaw": round(float(rng.uniform(-180.0, 180.0)), 1)},
            }
            for name in names
        },
        **settings,
    }
    return parse_site(json.dumps(text))


def built(
    site: Site,
    seed: int,
    position_std_m: float = POSITION_STD_M,
    orientation_std_deg: float = ORIENTATION_STD_DEG,
    microphone_std_m: float = MICROPHONE_STD_M,
) -> dict[str, FloatArray]:
    """The true places of the microphones, metres: not quite those of the site file."""
    rng = np.random.default_rng([seed, 2])
    placed = {}
    for spec in site.specs:
        turn = Rotation.from_rotvec(np.radians(rng.normal(0.0, orientation_std_deg, 3)))
        shift_m = rng.normal(0.0, position_std_m, 3)
        own_m = rng.normal(0.0, microphone_std_m, spec.microphones_m.shape)
        placed[spec.name] = turn.apply(spec.microphones_m - spec.centre_m) + spec.centre_m + shift_m + own_m
    return placed


def scene_in(site: Site, seed: int) -> Scene:
    """Ten sounds in a site's room."""
    return scene_of(site, rt60_s=RT60_S[seed % len(RT60_S)], count=SOUNDS, sample_rate_hz=RATE_HZ, seed=seed)


def recorded(site: Site, specs: Sequence[ArraySpec], seed: int) -> Recordings:
    """Recordings of these microphones in a site's room."""
    scene = scene_in(site, seed)
    return {spec.name: render(scene, spec.microphones_m, seed=seed + 1 + number) for number, spec in enumerate(specs)}


class Room:
    """One room: its scene, and the recordings of its arrays, which are made once.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.scene = scene_in(site_of(len(POSITIONS_M), seed), seed)
        self._rendered: dict[tuple[str, bytes], Float32Array] = {}

    def recorded(self, specs: Sequence[ArraySpec]) -> Recordings:
        """Recordings of microphones, which may be changed."""
        found = {}
        for number, spec in enumerate(specs):
            key = spec.name, spec.microphones_m.tobytes()
            if key not in self._rendered:
                self._rendered[key] = render(self.scene, spec.microphones_m, seed=self.seed + 1 + number)
            found[spec.name] = self._rendered[key].copy()
        return found

    def with_fault(self, fault: Fault, arrays: int) -> tuple[Site, Recordings]:
        """The site file, and what the arrays record."""
        site = site_of(arrays, self.seed)
        placed = built(site, self.seed)
        if fault.placed is not None:
            fault.placed(placed)
        recordings = self.recorded([replace(spec, microphones_m=placed[spec.name]) for spec in site.specs])
        if fault.recorded is not None:
            fault.recorded(recordings, np.random.default_rng([self.seed, 3]))
        return site_of(arrays, self.seed, **fault.filed), recordings

    def error_m(self, events: Sequence[Event]) -> float:
        """Median distance between the sounds and what was found of them, metres; infinite where nothing was."""
        errors = []
        for source in self.scene.sources:
            end_s = source.start_s + len(source.sound) / RATE_HZ
            found = [
                float(np.linalg.norm(event.estimate.position_m - source.position_m))
                for event in events
                if event.estimate is not None
                and event.start_ns / 1e9 < end_s + 0.1
                and event.end_ns / 1e9 > source.start_s
            ]
            errors.append(min(found, default=np.inf))
        return float(np.median(errors))


class Rooms:
    """The last room that was asked for, and what was observed in all, kept on the disk.

    Parameters
    ----------
    cache : Path or None
        Folder for observations.
    """

    def __init__(self, cache: Path | None) -> None:
        self._cache = cache
        self._room: Room | None = None

    def room(self, seed: int) -> Room:
        """A room."""
        if self._room is None or self._room.seed != seed:
            self._room = Room(seed)
        return self._room

    def gathered(self, seed: int, fault: Fault, arrays: int) -> tuple[Site, Gathered]:
        """The site file, and what its examination rests on; what fewer arrays observed is that beside all others."""
        if arrays < len(POSITIONS_M) and "clock" not in fault.expected:
            site = site_of(arrays, seed, **fault.filed)
            return site, _of_arrays(self.gathered(seed, fault, len(POSITIONS_M))[1], set(site.arrays))
        path = None if self._cache is None else self._cache / f"{seed}-{arrays}-{fault.name.replace(' ', '_')}.pickle"
        if path is not None and path.exists():
            gathered = pickle.loads(path.read_bytes())  # noqa: S301 - written below
            return site_of(arrays, seed, **fault.filed), gathered
        site, recordings = self.room(seed).with_fault(fault, arrays)
        gathered = gather(*offline.assigned(site, recordings, RATE_HZ))
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(gathered))
        return site, gathered


def _of_arrays(gathered: Gathered, arrays: set[str]) -> Gathered:
    """Return what some arrays observed."""
    sounds = (tuple(one for one in sound if one.array in arrays) for sound in gathered.sounds)
    findings = tuple(one for one in gathered.findings if one.array in arrays)
    return replace(gathered, sounds=tuple(sound for sound in sounds if sound), findings=findings)


def verdict(fault: Fault, findings: Sequence[Finding]) -> dict[str, bool]:
    """Judge what was found: the fault by name, as one of several, or as a contradiction; and anything wrong."""
    named = any(_names(fault, one) and one.confidence > DOUBT for one in findings)
    either = not named and any(_names(fault, one) and one.array is not None for one in findings)
    errors = [one for one in findings if one.severity is Severity.ERROR and not _names(fault, one)]
    if either:
        errors = [one for one in errors if one.fault not in fault.expected]
    left_open = [one for one in errors if one.confidence <= DOUBT]
    wrong = len(errors) > len(left_open) or (not fault.expected and bool(findings))
    return {"named": named, "either": either, "open": bool(left_open) and not named, "wrong": wrong}


def _names(fault: Fault, finding: Finding) -> bool:
    right = finding.fault in fault.expected
    if fault.array is not None and fault.expected:
        right = right and finding.array == fault.array
    return right and (fault.channel is None or finding.channel == fault.channel)


def _said(findings: Sequence[Finding]) -> list[str]:
    return [f"{one.fault} {one.array} {one.channel} {one.confidence:.2f}: {one.message}" for one in findings]


def recorded_row(rooms: Rooms, seed: int, fault: Fault, arrays: int) -> dict[str, Any]:
    """Examine recordings."""
    findings = conclude(*rooms.gathered(seed, fault, arrays)).findings
    return verdict(fault, findings) | {"said": _said(findings)}


def live_row(rooms: Rooms, seed: int, fault: Fault, arrays: int) -> dict[str, Any]:
    """Give the events to a server's examination one by one."""
    room = rooms.room(seed)
    site, recordings = room.with_fault(fault, arrays)
    watch = SetUpWatch(site, Overload(SystemClock()))
    events, degraded_after, changes = [], None, 0
    loaded, parts = offline.assigned(site, recordings, RATE_HZ)
    for event in offline.run(loaded, parts, UnpacedClock()):
        if isinstance(event, Event):
            before = {(one.fault, one.array, one.channel) for one in watch.state.findings}
            watch.take(event)
            watch.examine()
            events.append(replace(event, received=()))
            changes += before != {(one.fault, one.array, one.channel) for one in watch.state.findings}
            if watch.state.errors and degraded_after is None:
                degraded_after = watch.state.sounds
    findings = watch.state.findings
    return verdict(fault, findings) | {
        "error_m": room.error_m(events),
        "degraded": sorted(watch.state.errors),
        "degraded_after": degraded_after,
        "changes": changes,
        "said": _said(findings),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a table: in how many rooms each fault was named, and something wrong was found."""
    counts = sorted({row["arrays"] for row in rows})
    heads = "".join(f" {n} arrays: named | one of several | left open | wrong |" for n in counts)
    lines = [f"| fault |{heads}", "|---|" + "---|---|---|---|" * len(counts)]
    for fault in FAULTS:
        if not any(row["fault"] == fault.name for row in rows):
            continue
        cells = ""
        for count in counts:
            own = [row for row in rows if row["fault"] == fault.name and row["arrays"] == count]
            named = f"{sum(row['named'] for row in own)} of {len(own)}" if fault.expected else f"- of {len(own)}"
            cells += f" {named} | " + " | ".join(
                f"{sum(row[what] for row in own)}" for what in ("either", "open", "wrong")
            )
            cells += " |"
        lines.append(f"| {fault.name} |{cells}")
    return "\n".join(lines)


def live_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows of `--live` as a table: which faults harm, and whether they leave all arrays healthy."""
    harmless = {(row["arrays"], row["seed"]): row["error_m"] for row in rows if row["fault"] == "none"}
    lines = [
        "| fault | arrays | rooms | median error (m) | rooms that it harms | of these all healthy | most changes |",
        "|---|---|---|---|---|---|---|",
    ]
    for count in sorted({row["arrays"] for row in rows}):
        for fault in FAULTS:
            own = [row for row in rows if row["fault"] == fault.name and row["arrays"] == count]
            if not own:
                continue
            harmed = [row for row in own if row["error_m"] - harmless.get((count, row["seed"]), 0.0) > HARMFUL_M]
            healthy = sum(not row["degraded"] for row in harmed)
            error_m = float(np.median([row["error_m"] for row in own]))
            changes = max(row["changes"] for row in own)
            lines.append(
                f"| {fault.name} | {count} | {len(own)} | {error_m:.2f} | {len(harmed)} | {healthy} | {changes} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Run the campaign, or what is left of it, and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--arrays", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--fault", action="append", help="only faults of this name; repeatable")
    parser.add_argument("--live", action="store_true", help="give the events to a server's examination, one by one")
    parser.add_argument("--out", type=Path, required=True, help="folder for rows.jsonl and table.md")
    parser.add_argument("--cache", type=Path, help="folder for observations")
    parser.add_argument("--table", action="store_true", help="only make the table of the rows so far")
    arguments = parser.parse_args()
    path = arguments.out / "rows.jsonl"
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    if not arguments.table:
        arguments.out.mkdir(parents=True, exist_ok=True)
        known = {(row["arrays"], row["seed"], row["fault"]) for row in rows}
        make, rooms = live_row if arguments.live else recorded_row, Rooms(arguments.cache)
        with path.open("a", encoding="utf-8") as kept:
            for seed, fault, arrays in cases(arguments):
                if (arrays, seed, fault.name) not in known:
                    row = {"arrays": arrays, "seed": seed, "fault": fault.name} | make(rooms, seed, fault, arrays)
                    rows.append(row)
                    print(_short(row), flush=True)
                    kept.write(json.dumps(row) + "\n")
                    kept.flush()
    text = live_table(rows) if arguments.live else table(rows)
    (arguments.out / "table.md").write_text(text + "\n", encoding="utf-8")
    print(text)


def cases(arguments: argparse.Namespace) -> Iterator[tuple[int, Fault, int]]:
    """Yield seed, fault and number of arrays; all of a seed before the next one."""
    chosen = [fault for fault in FAULTS if not arguments.fault or fault.name in arguments.fault]
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        for fault in chosen:
            for arrays in arguments.arrays:
                yield seed, fault, arrays


def _short(row: Mapping[str, Any]) -> str:
    mark = next((what for what in ("named", "either", "open", "wrong") if row[what]), "-")
    wrong = " wrong" if row["wrong"] else ""
    return f"{row['arrays']} {row['seed']:3d} {row['fault']:<32} {mark + wrong:<12} {'; '.join(row['said'])}"


if __name__ == "__main__":
    main()
