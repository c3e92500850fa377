"""Real sound: recordings whose truth is known, and measured rooms, through the whole pipeline.

The recordings are not part of the project. They are looked for in LIVESSL_DATA, or beside the project in shared/data.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import soundfile
import yaml
from scipy.signal import oaconvolve

from livessl.capture.devices import ArrayRecording, Placed
from livessl.capture.recorded import Part
from livessl.cli import main
from livessl.clock import UnpacedClock
from livessl.config import Site, parse_site
from livessl.core.types import Event, Float32Array, FloatArray
from livessl.replay import run
from livessl.simulate.scene import read_sounds

DATA = Path(os.environ.get("LIVESSL_DATA", Path(__file__).parents[2] / "shared" / "data"))

pytestmark = pytest.mark.recordings


def folder(name: str) -> Path:
    """A folder of recordings, or skip."""
    path = DATA / name
    if not path.is_dir():
        pytest.skip(f"the recordings {name} are not here; set LIVESSL_DATA to the folder that holds them")
    return path


def wrapped_deg(angle_deg: float) -> float:
    """The same angle, from -180 to 180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


FIELD = {
    "site": "field",
    "room": {"size_m": [4.6, 4.6, 3.0]},
    "band_hz": [4000, 16000],
    "grid": {"spacing_m": 0.05, "bounds_m": [[0, 4.6], [0, 4.6], [0.2, 0.4]]},
    "arrays": {
        "field": {"microphones_m": [[0, 0, 0.5], [0, 4.6, 0.5], [4.6, 4.6, 0.5], [4.6, 0, 0.5], [0, 2.3, 0.8]]}
    },
}
"""A field of 4.6 m by 4.6 m with a microphone at each corner and one on a side; the source is near the floor."""


def test_pulses_in_a_field_of_five_microphones_are_located(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "field.yaml"
    site.write_text(yaml.safe_dump(FIELD), encoding="utf-8")
    files = sorted(folder("epo4_room_5mic").glob("*.wav"))
    worst_m, medians_m = [], []
    for file in files:
        truth_m = np.array([int(number) for number in re.findall(r"\d+", file.stem)[-2:]]) / 100.0
        channels = "field=1,2,3,4,5"
        assert main(["locate", "--site", str(site), "--wav", f"field={file}", "--channels", channels, "--json"]) == 0
        events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        errors_m = [float(np.hypot(*(np.array(event["position_m"][:2]) - truth_m))) for event in events]
        assert errors_m, f"nothing was heard in {file.name}"
        worst_m.append(max(errors_m))
        medians_m.append(float(np.median(errors_m)))
    assert len(files) == 10
    assert np.median(medians_m) <= 0.10
    assert max(worst_m) <= 0.25


@pytest.mark.timeout(300)
def test_directions_in_measured_rooms_are_right_to_two_degrees() -> None:
    rooms = sorted(folder("inhouse_rirs_uca8").glob("*.mat"))
    sounds = read_sounds(folder("dcase2016_task2"), 48000.0)
    chosen = [sound for _, sound in sounds[::4]]  # five of each class
    errors_deg: list[float] = []
    unheard = 0
    for room in rooms:
        measured = scipy.io.loadmat(room)
        microphones = measured["loc_microphone"]
        speaker = measured["loc_loudspeaker"][0]
        for square in (slice(0, 8, 2), slice(1, 8, 2)):
            site = one_array_site(microphones[square], [8.1, 6.8, 3.07])
            heard = played_in(measured["RIR"][:, square].T.astype(np.float32), chosen, rate_hz=48000)
            azimuths = azimuths_deg(site, heard, 48000.0)
            centre = microphones[square].mean(axis=0)
            true_deg = float(np.degrees(np.arctan2(*(speaker - centre)[1::-1])))
            errors_deg += [abs(wrapped_deg(azimuth - true_deg)) for azimuth in azimuths]
            unheard += max(0, len(chosen) - len(azimuths))
    assert len(rooms) == 7
    assert unheard <= 0.02 * 14 * len(chosen)
    assert np.median(errors_deg) <= 2.0
    assert np.percentile(errors_deg, 90) <= 10.0


@pytest.mark.parametrize(
    ("take", "true_deg"), [("respeaker_mic4", 270.0), ("respeaker_mic1-4", 315.0), ("respeaker_mic1-4_2", 315.0)]
)
def test_a_talker_beside_a_small_circle_is_heard_from_the_right_side(take: str, true_deg: float) -> None:
    """Nominal directions are good to about 10 degrees; the array is 64 mm wide."""
    tracks = [soundfile.read(folder("respeaker_4mic") / take / f"track{k}.wav", dtype="float32") for k in range(2, 6)]
    rate_hz = float(tracks[0][1])
    radius_m = 0.032
    around = np.radians([0.0, 90.0, 180.0, 270.0])
    circle = np.column_stack([radius_m * np.cos(around), radius_m * np.sin(around), np.zeros(4)])
    site = one_array_site(circle + [2.5, 2.5, 1.0], [5.0, 5.0, 2.5])
    azimuths = azimuths_deg(site, np.stack([samples for samples, _ in tracks]), rate_hz)
    assert azimuths
    for azimuth in azimuths:
        assert abs(wrapped_deg(azimuth - true_deg)) <= 12.0


def one_array_site(microphones_m: FloatArray, room_m: list[float]) -> Site:
    data: dict[str, Any] = {
        "site": "one",
        "room": {"size_m": room_m},
        "grid": {"spacing_m": 0.1},
        "arrays": {"array": {"microphones_m": microphones_m.round(6).tolist()}},
    }
    return parse_site(yaml.safe_dump(data))


def played_in(responses: Float32Array, sounds: list[Float32Array], *, rate_hz: int) -> Float32Array:
    """Sounds one after the other in a measured room, with 1.5 s between them and a little noise, (K, n)."""
    rng = np.random.default_rng(1)
    pieces = [np.zeros((len(responses), rate_hz), dtype=np.float32)]
    for sound in sounds:
        heard = oaconvolve(responses, sound[None] / np.abs(sound).max(), axes=1)
        pieces += [heard, np.zeros((len(responses), rate_hz // 2), dtype=np.float32)]
    whole = np.concatenate(pieces, axis=1)
    whole *= 0.5 / np.abs(whole).max()
    noise = rng.standard_normal(whole.shape, dtype=np.float32)
    return np.asarray(whole + np.float32(1e-4) * noise, dtype=np.float32)


def azimuths_deg(site: Site, samples: Float32Array, rate_hz: float) -> list[float]:
    """Azimuth of every event, as the array sees it."""
    recording = ArrayRecording("recorded", rate_hz, samples)
    part = Part("array", Placed(recording, 0), tuple(range(1, len(samples) + 1)))
    events = [output for output in run(site, [part], UnpacedClock()) if isinstance(output, Event)]
    return [event.contributions[0].azimuth_deg for event in events]
