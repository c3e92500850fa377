"""Real claps in a reverberant laboratory: how many are located, how accurately, and how many get a second source.

`python benchmarks/claps.py [--arrays recorders|frames] [--every N] [--json]`. Eight stereo recorders stand in four
frames of about 1 m. The two channels of a recorder are exact; the two recorders of a frame were aligned to 0 to 8
samples only. `recorders` takes each recorder as an array of its own, and `frames` each frame as one array whose clocks
inside disagree. A clap is one recording: nothing is learned from one clap for the next. The recordings are not part of
the project (`benchmarks/recordings.py`).

`--aligned` shows what the disagreeing clocks cost: it shifts the second recorder of each frame by the samples with
which the frame agrees best about the true place. That needs the truth, so it is a bound and not a method.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import soundfile
import yaml

from livessl.core.types import Event, Float32Array, FloatArray, Status
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.site.load import parse_site
from livessl.site.models import Site
from recordings import DATA, events_in

FOLDER: Final = DATA / "lab_claps"

ORIGIN_M: Final = np.array([1.0, 1.2, 1.8])
"""Place of the recordings' origin in the site's room: their z axis points down, and the room is 7.4 m x 8.4 m x 3.4 m
with a margin around the microphones, as its own size was not written down."""

ROOM_M: Final = (7.4, 8.4, 3.4)

QUIET_S: Final = 0.02
"""Time at the beginning of each clip, in seconds, that is quiet in every one: it is repeated before and after."""

FADE_S: Final = 0.005
"""Overlap, in seconds, of the repetitions."""

LEAD_S: Final = 1.5
"""Quiet, in seconds, before and after each clap."""

LARGEST_SHIFT: Final = 12
"""Samples by which the recorders of a frame may be apart; they are known to 0 to 8."""

FAR_M: Final = 0.5
"""Error, in metres, from which a place is wrong."""


@dataclass(frozen=True)
class Clap:
    """The outcome of one clap: status and error of the first source, and the errors of each further located one."""

    name: str
    status: str
    error_m: float | None
    confidence: float | None
    outliers: Mapping[str, float]
    reason: str | None
    seconds_m: tuple[float, ...]
    in_ellipsoid: bool | None


def names() -> Sequence[str]:
    """Return the names of the clips, session by session."""
    sessions = json.loads((FOLDER / "truth.json").read_text())["sessions"]
    return [Path(file).stem for session in sessions.values() for file in session["files"]]


def site(arrays: str) -> Site:
    """Return the site with each recorder, or each frame of two recorders, as one array."""
    channels = json.loads((FOLDER / "truth.json").read_text())["channels"][:16]
    size = {"recorders": 2, "frames": 4}[arrays]
    places_m = [placed_m(channel["position_m"]).round(4).tolist() for channel in channels]
    data = {
        "site": "lab",
        "room": {"size_m": list(ROOM_M)},
        "arrays": {f"a{n // size + 1}": {"microphones_m": places_m[n : n + size]} for n in range(0, 16, size)},
    }
    return parse_site(yaml.safe_dump(data))


def placed_m(place_m: Sequence[float]) -> FloatArray:
    """Return a place of the recordings in the site's room, z up."""
    return np.asarray(ORIGIN_M + np.array(place_m) * [1.0, 1.0, -1.0])


def samples_of(name: str) -> tuple[Float32Array, float]:
    """Return a clap between stretches of its own quiet: (16, n), and the sampling rate."""
    parts = [soundfile.read(FOLDER / "events" / f"{name}_{part}.flac", dtype="float32") for part in "ab"]
    clip, rate_hz = np.concatenate([samples for samples, _ in parts], axis=1).T, float(parts[0][1])
    fade = round(FADE_S * rate_hz)
    quiet = clip[:, : round(QUIET_S * rate_hz)]
    whole = quiet
    for piece in [quiet] * round(LEAD_S / (QUIET_S - FADE_S)) + [clip] + [quiet] * round(LEAD_S / (QUIET_S - FADE_S)):
        whole = _joined(whole, piece, fade)
    return np.asarray(whole, dtype=np.float32), rate_hz


def _joined(before: Float32Array, after: Float32Array, fade: int) -> Float32Array:
    up = np.sqrt(np.linspace(0.0, 1.0, fade, dtype=np.float32))
    overlap = before[:, -fade:] * up[::-1] + after[:, :fade] * up
    return np.concatenate([before[:, :-fade], overlap, after[:, fade:]], axis=1)


def aligned(samples: Float32Array, rate_hz: float) -> Float32Array:
    """Return samples (16, n) with the second recorder of each frame shifted to agree best with the first."""
    truth = json.loads((FOLDER / "truth.json").read_text())
    places_m = np.array([channel["position_m"] for channel in truth["channels"][:16]])
    travel = np.linalg.norm(places_m - np.array(truth["source_m"]), axis=1) / 343.0 * rate_hz
    shifted = samples.copy()
    lags = np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1)
    for first in range(0, 16, 4):
        spectra = np.fft.rfft(samples[first : first + 4], 2 * samples.shape[1])
        height = np.zeros(len(lags))
        for one in (0, 1):
            for other in (2, 3):
                cross = spectra[other] * np.conj(spectra[one])
                gcc = np.fft.irfft(cross / np.maximum(np.abs(cross), 1e-12))
                expected = round(travel[first + other] - travel[first + one])
                height += gcc[expected + lags]
        shifted[first + 2 : first + 4] = np.roll(samples[first + 2 : first + 4], -lags[height.argmax()], axis=1)
    return shifted


def heard(name: str, arrays: Site, method: str | None = None, *, in_line: bool = False) -> list[Event]:
    """Return the events of one clap, `in_line` if the recorders of a frame are `aligned`."""
    samples, rate_hz = samples_of(name)
    if in_line:
        samples = aligned(samples, rate_hz)
    parts, first = [], 0
    for spec in arrays.specs:
        channels = tuple(range(first + 1, first + 1 + len(spec.microphones_m)))
        parts.append(AssignedRecording(spec.name, MemoryRecording("clap", rate_hz, samples), 0, channels))
        first += len(channels)
    return events_in(arrays, parts, method)


def clap(name: str, arrays: Site, method: str | None = None, *, in_line: bool = False) -> Clap:
    """Locate one clap, `in_line` if the recorders of a frame are `aligned`: its first source is the loudest event's."""
    truth_m = placed_m(json.loads((FOLDER / "truth.json").read_text())["source_m"])
    events = heard(name, arrays, method, in_line=in_line)
    first = max((event for event in events if event.source == 1), key=lambda event: event.power or 0.0)
    further = [event for event in events if event is not first and event.status is Status.LOCATED]
    estimate, error_m, inside = first.estimate, None, None
    if estimate is not None:
        off_m = estimate.position_m - truth_m
        error_m = float(np.linalg.norm(off_m))
        inside = bool(off_m @ np.linalg.solve(estimate.covariance_m2, off_m) <= 6.25)
    return Clap(
        name,
        str(first.status),
        error_m,
        estimate.confidence if estimate else None,
        {c.array: c.off_deg for c in first.contributions if c.off_deg is not None},
        first.reason,
        tuple(float(np.linalg.norm(event.estimate.position_m - truth_m)) for event in further if event.estimate),
        inside,
    )


def summary(claps: Sequence[Clap]) -> dict[str, Any]:
    """Return the figures of some claps."""
    errors_m = np.array([one.error_m for one in claps if one.status == "located"])
    return {
        "claps": len(claps),
        "located": len(errors_m),
        "refused": sum(one.status == "refused" for one in claps),
        "median_m": round(float(np.median(errors_m)), 3),
        "wrong": int((errors_m > FAR_M).sum()),
        "with_second": sum(bool(one.seconds_m) for one in claps),
        "with_outlier": sum(bool(one.outliers) for one in claps),
        "in_ellipsoid": sum(bool(one.in_ellipsoid) for one in claps if one.status == "located"),
    }


def main() -> None:
    """Print each clap and the figures of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrays", choices=("recorders", "frames"), default="recorders")
    parser.add_argument("--every", type=int, default=1, help="locate every N-th clap only")
    parser.add_argument("--method")
    parser.add_argument("--aligned", action="store_true", help="as if the clocks of each frame agreed")
    given = parser.parse_args()
    claps = []
    arrays = site(given.arrays)
    for name in names()[:: given.every]:
        claps.append(clap(name, arrays, given.method, in_line=given.aligned))
        print(json.dumps(asdict(claps[-1])), flush=True)
    print(json.dumps(summary(claps)))


if __name__ == "__main__":
    main()
