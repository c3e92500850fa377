"""Sounds with known positions, through the whole pipeline: real recordings, measured rooms, simulated rooms.

The recordings are not part of the project. They are looked for in LIVESSL_DATA, or beside the project in shared/data.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
import soundfile
import yaml
from scipy.signal import oaconvolve

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.types import Event, Float32Array, FloatArray
from livessl.lab.demo import SITE_FILE
from livessl.recordings.assign import AssignedRecording, assign_files
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import NamedSound, make_scene, read_sounds, render
from livessl.site.load import load_site, parse_site
from livessl.site.models import Site

DATA: Final = Path(os.environ.get("LIVESSL_DATA", Path(__file__).parents[2] / "shared" / "data"))

FIELD: Final[dict[str, Any]] = {
    "site": "field",
    "room": {"size_m": [4.6, 4.6, 3.0]},
    "band_hz": [4000, 16000],
    "grid": {"spacing_m": 0.05, "bounds_m": [[0, 4.6], [0, 4.6], [0.2, 0.4]]},
    "arrays": {"field": {"microphones_m": [[0, 0, 0.5], [0, 4.6, 0.5], [4.6, 4.6, 0.5], [4.6, 0, 0.5], [0, 2.3, 0.8]]}},
}
"""A field of 4.6 m by 4.6 m with a microphone at each corner and one on a side; the source is near the floor."""

FIELD_CHANNELS: Final = (1, 2, 3, 4, 5)

TALKERS: Final = {"respeaker_mic4": 270.0, "respeaker_mic1-4": 315.0, "respeaker_mic1-4_2": 315.0}
"""Takes with a circle of four microphones 64 mm wide, and the talker's direction in degrees, known to about 10."""

CLASSES: Final = ("doorslam", "keysDrop", "phone", "speech")


@dataclass(frozen=True)
class Found:
    """One sound with a known position: class, error, squared error in units of the covariance; None if not located."""

    sound: str
    error_m: float | None
    mahalanobis2: float | None


def events_in(site: Site, parts: Sequence[AssignedRecording], method: str | None = None) -> list[Event]:
    """Return all events of the pipeline, by the site's method or another."""
    outputs = offline.run(site, parts, UnpacedClock(), method=method)
    return [output for output in outputs if isinstance(output, Event)]


def wrapped_deg(angle_deg: float) -> float:
    """Return an angle in the range of -180 to 180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def field_truth_m(file: Path) -> FloatArray:
    """Return the source's true position: the last two numbers of the file's name are centimetres."""
    return np.array([int(number) for number in re.findall(r"\d+", file.stem)[-2:]]) / 100.0


def field_errors_m(method: str | None = None) -> dict[str, list[float]]:
    """Return the horizontal error of every event, for each file of the field."""
    site = parse_site(yaml.safe_dump(FIELD))
    errors: dict[str, list[float]] = {}
    for file in sorted((DATA / "epo4_room_5mic").glob("*.wav")):
        parts = assign_files(site, {"field": file}, {"field": FIELD_CHANNELS})
        events = events_in(site, parts, method)
        places = [event.estimate.position_m[:2] for event in events if event.estimate is not None]
        errors[file.name] = [float(np.linalg.norm(place - field_truth_m(file))) for place in places]
    return errors


def measured_room_errors_deg(method: str | None = None, *, every: int = 4) -> tuple[list[float], int]:
    """Return the azimuth error of every event in the measured rooms, and the number of sounds that were played.

    One sound out of `every` is played in each of seven measured rooms, to each of two interleaved squares of
    microphones.
    """
    sounds = [sound for _, sound in read_sounds(DATA / "dcase2016_task2", 48000.0)[::every]]
    errors: list[float] = []
    played = 0
    for room in sorted((DATA / "inhouse_rirs_uca8").glob("*.mat")):
        measured = scipy.io.loadmat(room)
        for square in (slice(0, 8, 2), slice(1, 8, 2)):
            microphones = measured["loc_microphone"][square]
            towards = measured["loc_loudspeaker"][0] - microphones.mean(axis=0)
            true_deg = float(np.degrees(np.arctan2(towards[1], towards[0])))
            recorded = _played_in(measured["RIR"][:, square].T.astype(np.float32), sounds, 48000)
            azimuths = _azimuths_deg(_one_array_site(microphones, [8.1, 6.8, 3.07]), recorded, 48000.0, method)
            errors += [abs(wrapped_deg(azimuth - true_deg)) for azimuth in azimuths]
            played += len(sounds)
    return errors, played


def talker_errors_deg(take: str, method: str | None = None) -> list[float]:
    """Return the azimuth error of every event of one take of a talker."""
    folder = DATA / "respeaker_4mic" / take
    tracks = [soundfile.read(folder / f"track{k}.wav", dtype="float32") for k in range(2, 6)]
    around = np.radians([0.0, 90.0, 180.0, 270.0])
    circle = 0.032 * np.column_stack([np.cos(around), np.sin(around), np.zeros(4)])
    site = _one_array_site(circle + np.array([2.5, 2.5, 1.0]), [5.0, 5.0, 2.5])
    azimuths = _azimuths_deg(site, np.stack([samples for samples, _ in tracks]), float(tracks[0][1]), method)
    return [abs(wrapped_deg(azimuth - TALKERS[take])) for azimuth in azimuths]


def simulated(sounds: Sequence[NamedSound], rt60_s: float, seeds: Sequence[int], count: int) -> tuple[list[Found], int]:
    """Localize sounds at random positions in the demo's room; return each result, and the number of false events."""
    site = load_site(SITE_FILE)
    found: list[Found] = []
    surplus = 0
    for seed in seeds:
        scene = make_scene(
            site.room.size_m,
            rt60_s=rt60_s,
            sounds=sounds,
            count=count,
            sample_rate_hz=44100.0,
            c_m_s=site.c_m_s,
            keep_away_m=[spec.centre_m for spec in site.specs],
            seed=seed,
        )
        parts = []
        for number, spec in enumerate(site.specs):
            samples = render(scene, spec.microphones_m, seed=seed + 1 + number)
            parts.append(AssignedRecording(spec.name, MemoryRecording("scene", 44100.0, samples), 0, (1, 2, 3, 4)))
        events = events_in(site, parts)
        used = set()
        for source in scene.sources:
            nearest = min(events, key=lambda event: abs(event.start_ns / 1e9 - source.start_s))
            if abs(nearest.start_ns / 1e9 - source.start_s) > 1.0 or nearest.estimate is None:
                found.append(Found(source.name, None, None))
                continue
            used.add(nearest.id)
            off = nearest.estimate.position_m - source.position_m
            distance2 = float(off @ np.linalg.solve(nearest.estimate.sound_covariance_m2, off))
            found.append(Found(source.name, float(np.linalg.norm(off)), distance2))
        surplus += len(events) - len(used)
    return found, surplus


def _one_array_site(microphones_m: FloatArray, room_m: list[float]) -> Site:
    data = {
        "site": "one",
        "room": {"size_m": room_m},
        "grid": {"spacing_m": 0.1},
        "arrays": {"array": {"microphones_m": microphones_m.round(6).tolist()}},
    }
    return parse_site(yaml.safe_dump(data))


def _played_in(responses: Float32Array, sounds: Sequence[Float32Array], rate_hz: int) -> Float32Array:
    """Return sounds one after the other in a measured room, with pauses and a little noise: (K, n)."""
    rng = np.random.default_rng(1)
    pieces = [np.zeros((len(responses), rate_hz), dtype=np.float32)]
    for sound in sounds:
        wet = oaconvolve(responses, sound[None] / np.abs(sound).max(), axes=1)
        pieces += [wet, np.zeros((len(responses), rate_hz // 2), dtype=np.float32)]
    whole = np.concatenate(pieces, axis=1)
    whole *= 0.5 / np.abs(whole).max()
    noise = rng.standard_normal(whole.shape, dtype=np.float32)
    return np.asarray(whole + np.float32(1e-4) * noise, dtype=np.float32)


def _azimuths_deg(site: Site, samples: Float32Array, rate_hz: float, method: str | None) -> list[float]:
    """Return the azimuth of every event from the array."""
    recording = MemoryRecording("recorded", rate_hz, samples)
    part = AssignedRecording("array", recording, 0, tuple(range(1, len(samples) + 1)))
    return [event.contributions[0].azimuth_deg for event in events_in(site, [part], method)]
