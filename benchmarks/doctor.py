"""Faults of a set-up, made on purpose, and what the doctor says about them.

    python benchmarks/doctor.py --seeds 10 --arrays 2 --out docs/doctor

Each seed is a room of 8 x 10 x 4 m with RT60 0.3, 0.5 or 0.8 s, tetrahedra of 0.5 m that are turned at random and stand
2 cm and 1.2 degrees (standard deviations) from where the site file has them, microphones 2 mm from theirs, and ten
sounds. A fault counts as named if a finding has its code, its array and, where it has one, its channel.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

import livessl
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import ArraySpec, Float32Array, FloatArray
from livessl.simulation.of_site import Simulation
from livessl.simulation.scene import render
from livessl.site.load import parse_site
from livessl.site.models import Site

DOUBT: Final = 0.5
"""Confidence at which a finding leaves open which array it is about."""

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
    channel by `channel`, where they are not None.
    """

    name: str
    expected: tuple[str, ...]
    array: str | None = ARRAY
    channel: int | None = None
    recorded: Callable[[Recordings, np.random.Generator], None] | None = None
    placed: Callable[[dict[str, FloatArray]], None] | None = None


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


def examined(site: Site, seed: int, fault: Fault) -> tuple[Finding, ...]:
    """What the doctor says about one fault in one room."""
    placed = built(site, seed)
    if fault.placed is not None:
        fault.placed(placed)
    specs = tuple(replace(spec, microphones_m=placed[spec.name]) for spec in site.specs)
    recordings = recorded(site, specs, seed)
    if fault.recorded is not None:
        fault.recorded(recordings, np.random.default_rng([seed, 3]))
    return livessl.examine(site, recordings, RATE_HZ).findings


_rendered: dict[Any, Recordings] = {}


def recorded(site: Site, specs: tuple[ArraySpec, ...], seed: int) -> Recordings:
    """Recordings of the true microphones; those of a seed are made once where the microphones are the same."""
    rt60_s = RT60_S[seed % len(RT60_S)]
    simulation: Simulation | None = None
    found = {}
    for number, spec in enumerate(specs):
        key = seed, len(specs), spec.name, spec.microphones_m.tobytes()
        if key not in _rendered:
            simulation = simulation or livessl.simulate(
                site, rt60_s=rt60_s, count=SOUNDS, sample_rate_hz=RATE_HZ, seed=seed
            )
            _rendered[key] = {spec.name: render(simulation.scene, spec.microphones_m, seed=seed + 1 + number)}
        found[spec.name] = _rendered[key][spec.name].copy()
    return found


def verdict(fault: Fault, findings: tuple[Finding, ...]) -> dict[str, bool]:
    """Whether the fault was named, and whether an error was told that is none."""
    named = any(_names(fault, one) for one in findings)
    false = any(one.severity is Severity.ERROR and not _names(fault, one) for one in findings)
    return {"named": named, "doubt": any(one.confidence <= DOUBT for one in findings) and not named, "false": false}


def _names(fault: Fault, finding: Finding) -> bool:
    right = finding.fault in fault.expected and finding.confidence > DOUBT
    if fault.array is not None and fault.expected:
        right = right and finding.array == fault.array
    return right and (fault.channel is None or finding.channel == fault.channel)


def campaign(arrays: int, seeds: range, faults: tuple[Fault, ...] = FAULTS) -> Iterator[dict[str, Any]]:
    """Yield one row for each seed and fault."""
    for seed in seeds:
        site = site_of(arrays, seed)
        _rendered.clear()
        for fault in faults:
            findings = examined(site, seed, fault)
            said = [f"{one.fault} {one.array} {one.channel}: {one.message}" for one in findings]
            yield {"arrays": arrays, "seed": seed, "fault": fault.name} | verdict(fault, findings) | {"said": said}


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a table: in how many of the rooms each fault was named, and something wrong was told as an error."""
    counts = sorted({row["arrays"] for row in rows})
    head = "| fault |" + "".join(f" {n} arrays: named | contradiction left open | wrong error |" for n in counts)
    lines = [head, "|---|" + "---|---|---|" * len(counts)]
    for fault in FAULTS:
        if not any(row["fault"] == fault.name for row in rows):
            continue
        cells = ""
        for count in counts:
            own: list[dict[str, Any]] = [row for row in rows if row["fault"] == fault.name and row["arrays"] == count]
            named = f"{sum(row['named'] for row in own)} of {len(own)}" if fault.expected else "-"
            cells += f" {named} | {sum(row['doubt'] for row in own)} | {sum(row['false'] for row in own)} |"
        lines.append(f"| {fault.name} |{cells}")
    return "\n".join(lines)


def main() -> None:
    """Run the campaign and write its rows and its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--arrays", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--fault", action="append", help="only faults of this name; repeatable")
    parser.add_argument("--out", type=Path, help="folder for rows.jsonl and table.md")
    arguments = parser.parse_args()
    chosen = tuple(fault for fault in FAULTS if not arguments.fault or fault.name in arguments.fault)
    rows: list[dict[str, Any]] = []
    for count in arguments.arrays:
        for row in campaign(count, range(arguments.first, arguments.first + arguments.seeds), chosen):
            rows.append(row)
            print(_short(row), flush=True)
    print(table(rows))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        (arguments.out / "table.md").write_text(table(rows) + "\n", encoding="utf-8")


def _short(row: Mapping[str, Any]) -> str:
    mark = "named" if row["named"] else ("-" if not row["said"] else "other")
    return f"{row['arrays']} {row['seed']:3d} {row['fault']:<32} {mark:<6} {'; '.join(row['said'])}"


if __name__ == "__main__":
    main()
